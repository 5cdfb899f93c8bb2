"""From a seed or a history to its outcome: plain data, so that any executor can run it anywhere."""

import gc
import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import msgspec

from cpcbl_launch.lab.chaos.history import honest
from cpcbl_launch.lab.luck.history import History, Kind
from cpcbl_launch.lab.luck.plan import history_of
from cpcbl_launch.lab.luck.simulator import Simulation
from cpcbl_launch.lab.luck.teams import is_blind
from cpcbl_launch.lab.luck.verdict import consistency_of, tracks_hz, violations, without_unknowable
from cpcbl_launch.lab.luck.violations import Violation


class Outcome(msgspec.Struct, frozen=True):
    """What came of one history."""

    seed: int
    robots: int
    duration_s: float
    digest: str
    messages: int  # put on the bus
    used: int  # inputs that robots used
    events: dict[Kind, int]
    violations: tuple[Violation, ...] = ()
    blind_nees: float = 0.0  # mean NEES of the blind robots, by their independent samples,
    blind_samples: float = 0.0  # of which there are so many


def run_seed(seed: int, duration_s: float) -> Outcome:
    """The outcome of the history that a seed makes."""
    return run_history(history_of(seed, duration_s))


def run_history(history: History, stop_early: bool = False) -> Outcome:
    """The outcome of a history. `stop_early`: it ends at the first rule that a message breaks."""
    with _quiet(), _without_collector():
        return _outcome_of(history, stop_early)


def _outcome_of(history: History, stop_early: bool) -> Outcome:
    simulation = Simulation(history, stop_early)
    run = simulation.run()
    broken = run.violations
    if not (stop_early and broken) and all(v.invariant != "no exception" for v in broken):
        broken += tuple(violations(run.log, history, simulation.team))
    names, team = filter(is_blind, history.robots), simulation.team
    log = honest(without_unknowable(run.log, history, team))
    blind = [c for n in names if (c := consistency_of(log, n, tracks_hz(team, n)))]
    samples = sum(c.independent for c in blind)
    nees = sum(c.nees * c.independent for c in blind) / max(samples, 1.0)
    kinds = Counter(event.kind for event in history.events)
    known = history.seed, len(history.robots), history.duration_s
    return Outcome(
        *known, run.digest, sum(run.messages.values()), run.used, dict(kinds), broken, nees, samples
    )


@contextmanager
def _without_collector() -> Iterator[None]:
    """Without Python's collector of cyclic garbage, which took a fifth of the time to look through
    what lives as long as the simulation. What one history leaves is young: it is collected then."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
            gc.collect(0)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the warnings of hundreds of robots that are killed."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
