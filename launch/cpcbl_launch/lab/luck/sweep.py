"""Many histories: their sums, and the shortest history of each way to fail."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgspec
from rich.console import RenderableType
from rich.table import Table

from cpcbl_launch.lab.chaos.consistency import ALARM, chi_square_quantile
from cpcbl_launch.lab.luck.history import History, history_text
from cpcbl_launch.lab.luck.outcome import Outcome, run_history, run_seed
from cpcbl_launch.lab.luck.plan import history_of
from cpcbl_launch.lab.luck.shrink import fails_like, shrink
from cpcbl_launch.lab.luck.violations import INVARIANTS, Violation
from cpcbl_launch.lab.seeds import Workers, run_seeds

USUAL_BLIND_NEES = 1.1
"""Of robots that see teammates only: 2 in a linear world, but split covariance intersection and the
caution about teammates overstate their covariance (docs/luck.md)."""
SHRUNK = 3  # histories that a command shrinks at most: each takes up to some minutes


class Failure(msgspec.Struct, frozen=True):
    """A history that failed, as short as it became."""

    history: History
    violations: tuple[Violation, ...]
    file: str = ""


class Sweep(msgspec.Struct, frozen=True):
    """What came of many histories."""

    histories: int
    team_s: float
    messages: int
    used: int
    events: dict[str, int]  # by kind
    broken: dict[str, int]  # histories by the invariant that did not hold
    failing_seeds: list[int]
    digests: dict[int, str]  # by seed
    blind_nees: float = 0.0  # mean NEES of all robots that see no landmarks,
    blind_nees_bound: float = 0.0  # and its bound, by the number of independent samples
    failures: list[Failure] = []

    @property
    def has_failed(self) -> bool:
        return bool(self.failing_seeds) or self.blind_nees > self.blind_nees_bound


def sweep(
    seeds: Sequence[int], duration_s: float, where: Workers, done: Callable[[], None]
) -> Sweep:
    """Runs the history of each seed."""
    outcomes = run_seeds(run_seed, [(s, duration_s) for s in seeds], where, done)
    return summed(outcomes)


def summed(outcomes: Sequence[Outcome]) -> Sweep:
    """The sums over outcomes."""
    broken = Counter(name for o in outcomes for name in {v.invariant for v in o.violations})
    events, samples = Counter[str](), sum(o.blind_samples for o in outcomes)
    for outcome in outcomes:
        events.update(outcome.events)
    return Sweep(
        histories=len(outcomes),
        team_s=sum(o.duration_s for o in outcomes),
        messages=sum(o.messages for o in outcomes),
        used=sum(o.used for o in outcomes),
        events=dict(events),
        broken=dict(broken),
        failing_seeds=[o.seed for o in outcomes if o.violations],
        digests={o.seed: o.digest for o in outcomes},
        blind_nees=sum(o.blind_nees * o.blind_samples for o in outcomes) / max(1.0, samples),
        blind_nees_bound=nees_bound(samples),
    )


def nees_bound(samples: float) -> float:
    """What consistent robots without landmarks exceed with the probability `ALARM`, by the number
    of their independent samples."""
    freedom = 2.0 * max(1.0, samples)
    return USUAL_BLIND_NEES * chi_square_quantile(freedom, 1.0 - ALARM) / freedom


def shrunk_failures(found: Sweep, duration_s: float, folder: Path) -> Iterator[Failure]:
    """The first few failing histories, shrunk and written as `luck-SEED.json`. Raises OSError."""
    for seed in found.failing_seeds[:SHRUNK]:
        history = history_of(seed, duration_s)
        invariant = run_history(history).violations[0].invariant
        history = shrink(history, fails_like(invariant))
        file = folder / f"luck-{seed}.json"
        file.write_bytes(history_text(history))
        yield Failure(history, run_history(history, stop_early=True).violations, str(file))


def tables(found: Sweep) -> Iterator[RenderableType]:
    """The events and the invariants, with figures."""
    events = Table("event", "times", title="Bad luck")
    for kind, number in sorted(found.events.items(), key=lambda item: -item[1]):
        events.add_row(kind, f"{number}")
    held = Table("invariant", "histories that break it", "meaning", title="What must hold")
    for name, text in INVARIANTS.items():
        held.add_row(name, f"{found.broken.get(name, 0)} of {found.histories}", text)
    yield events
    yield held
    yield (
        f"{found.histories} histories, {found.team_s:,.0f} s of team time, {found.messages:,}"
        f" messages, {found.used:,} inputs used, {len(found.failing_seeds)} histories failed"
    )
    yield (
        f"NEES of all robots that see no landmarks: {found.blind_nees:.2f}, at most"
        f" {found.blind_nees_bound:.2f}"
    )
    for failure in found.failures:
        yield "\n".join(failure_lines(failure))


def failure_lines(failure: Failure) -> Iterator[str]:
    """What happened in a failing history, and how to see it again."""
    yield ""
    yield from failure.history.sentences()
    yield from (f"Then: {violation}" for violation in failure.violations)
    if failure.file:
        yield f"Again: cpcbl-team experiment luck --replay {failure.file}"
