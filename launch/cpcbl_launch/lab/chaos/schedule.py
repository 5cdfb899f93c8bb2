"""Which faults the nemesis injects and when: a plan that a seed determines. Pure functions."""

import random
from collections.abc import Mapping, Sequence
from typing import NamedTuple

BEGIN_EVERY_S = (1.0, 4.5)
LASTS_S = (2.0, 8.0)
SHORT_S = 0.5  # of what is over at once, such as a kill
FIRST_S = 1.0


class PlannedFault(NamedTuple):
    """One fault. Seconds after the first one may begin."""

    name: str
    target: str
    from_s: float
    until_s: float

    def __str__(self) -> str:
        return f"{self.name} {self.target} {self.from_s:.1f}-{self.until_s:.1f} s"


def schedule(
    seed: int, duration_s: float, targets: Mapping[str, Sequence[str]], instant: Sequence[str]
) -> list[PlannedFault]:
    """Faults that overlap, ordered by their begin; all are over after `duration_s`.

    `targets`: what each fault may concern; `instant`: faults that are over at once. Every fault
    comes once before any comes again. No fault begins a second time on the same target before it
    ended.
    """
    dice, at_s = random.Random(seed), FIRST_S
    plan: list[PlannedFault] = []
    bag: list[str] = []
    while at_s < duration_s - LASTS_S[0]:
        if not bag:
            bag = dice.sample(sorted(targets), len(targets))
        name = bag.pop()
        lasts_s = SHORT_S if name in instant else dice.uniform(*LASTS_S)
        until_s = min(at_s + lasts_s, duration_s)
        busy = {f.target for f in plan if f.name == name and f.until_s >= at_s}
        free = [target for target in targets[name] if target not in busy]
        if free:
            plan.append(PlannedFault(name, dice.choice(free), at_s, until_s))
        at_s += dice.uniform(*BEGIN_EVERY_S)
    return plan


def largest_overlap(plan: Sequence[PlannedFault]) -> int:
    """The largest number of faults at one time."""
    return max((sum(f.from_s <= g.from_s < f.until_s for f in plan) for g in plan), default=0)
