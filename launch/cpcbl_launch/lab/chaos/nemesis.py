"""The nemesis: faults that overlap, in an order that a seed determines, and the history afterwards.

The team has two sites and a budget; each robot has its own link. `schedule.py` plans the faults,
`injectors.py` and `abuses.py` make them, `history.py` holds the invariants.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial

import numpy as np

from cpcbl_launch.lab.chaos import injectors
from cpcbl_launch.lab.chaos.checks import Check, at_least, equal_to
from cpcbl_launch.lab.chaos.history import Span, invariants, without, write_history
from cpcbl_launch.lab.chaos.memory import MemorySampler, ProcessSample, memory_checks, process_lives
from cpcbl_launch.lab.chaos.run_log import RunLog
from cpcbl_launch.lab.chaos.scenario import FaultRun, Injector, ScenarioOptions, ScenarioResult
from cpcbl_launch.lab.chaos.schedule import PlannedFault, largest_overlap, schedule
from cpcbl_launch.lab.chaos.team import (
    FAR_ROUTER,
    FIELD,
    ROUTER,
    UP,
    RunPlan,
    TeamUnderTest,
    demo_team,
    run_team,
)
from cpcbl_launch.lab.experiments.runs import with_settings
from cpcbl_launch.run.processes import require_process_usage
from cpcbl_team.errors import InputError
from cpcbl_transport.messages import Refusal

FAULTS: dict[str, Injector] = {
    "kill": injectors.kill,
    "freeze": injectors.freeze,
    "cut": injectors.cut,
    "slow": injectors.slow,
    "narrow": injectors.narrow,
    "flood": injectors.flood,
    "garbage": injectors.garbage,
    "echo": injectors.echo,
    "clock": injectors.clock_step,
    "liar": injectors.liar,
    "guest": injectors.guest,
    "deaf": injectors.abuse("deaf"),
    "half-open": injectors.abuse("half-open"),
    "large": injectors.abuse("large"),
    "tokens": injectors.abuse("tokens"),
}
SECURED = {
    "tokens": True,  # without keys nobody can be blamed
    "half-open": False,  # whoever closes them lets the router's TLS fail: docs/security.md
}
INSTANT = ("kill",)
KILLS = {"kill": 1, "clock": 2, "liar": 2}  # processes that a fault ends
FAR = ("navigator", "patrol")
GUESTS = ("visitor1", "visitor2")
BYTES_PER_S = 400.0
SHORTEST_S, USUAL_S, STUCK_S, AFTER_S = 20.0, 60.0, 30.0, 8.0
JUDGED_S = 90.0  # from this duration on, the memory of what is never killed is judged


def require_judged_nemesis(duration_s: float) -> None:
    """Raises InputError for a nemesis that is too short to be judged."""
    if duration_s < SHORTEST_S:
        raise InputError(f"--duration {duration_s:g}: too short to judge; at least {SHORTEST_S:g}")


def nemesis(options: ScenarioOptions, secured: bool = False) -> ScenarioResult:
    """Injects overlapping faults for `duration_s`, then checks the history."""
    require_process_usage("chaos nemesis")
    duration_s, secured = options.duration_s or USUAL_S, secured or options.secured
    budget = {"bytes_per_s": BYTES_PER_S}
    settings = with_settings(demo_team(), None, collaboration={"budget": budget})
    robots = list(settings.robots)
    plan = RunPlan(settings, options.seed, relayed=robots, far=FAR, watched=True)
    plan = plan._replace(secured=secured, guests=GUESTS if secured else ())
    faults = schedule(options.seed, duration_s, _targets(robots, secured), INSTANT)
    options.report_progress("starting a team")
    with run_team(plan, options.machine) as team:
        team.settle()
        nemesis = Nemesis(team, options)
        nemesis.inject(faults)
        healed_s = nemesis.healing_time_s()
        team.run_for(AFTER_S)
        log, end_s = without(merged_log(team), nemesis.unknown), team.now_s
        held = invariants(log, team.robots, healed_s, end_s, nemesis.forged)
        checks = [*held, *nemesis.checks(duration_s)]
        remarks = tuple(_remarks(options.seed, faults, nemesis, checks))
        if (path := options.history) is not None:
            path = path.with_stem(f"{path.stem}-with-keys") if secured else path
            write_history(path, options.seed, faults, log, checks)
        return ScenarioResult(checks, remarks)


def _targets(robots: Sequence[str], secured: bool) -> dict[str, Sequence[str]]:
    """What each fault may concern. The field is left alone: its death moves all robots."""
    names = [name for name in FAULTS if SECURED.get(name, secured) is secured]
    abuses = dict.fromkeys(("guest", "deaf", "half-open", "large", "tokens"), GUESTS)
    own = abuses | {"kill": [*robots, ROUTER], "freeze": [*robots, ROUTER]}
    own |= {"cut": [*robots, FAR_ROUTER]}
    return {name: own.get(name, robots) for name in names}


def merged_log(team: TeamUnderTest) -> RunLog:
    """What was received of each robot at its own site."""
    near, far = team.run_log, team.far_log
    tracks = {**near.tracks, **{name: far.tracks.get(name, ()) for name in team.plan.far}}
    statuses = {**near.statuses, **{name: far.statuses.get(name, ()) for name in team.plan.far}}
    tokens = [t for t in near.tokens if t.robot not in team.plan.far]
    tokens += [t for t in far.tokens if t.robot in team.plan.far]
    return near._replace(tracks=tracks, statuses=statuses, tokens=tokens)


def refusals(log: RunLog, robot: str) -> int:
    """How many payloads a robot refused and counted, over all its processes."""
    counts = log.counts_between(robot, -np.inf)
    return sum(counts[reason] for reason in Refusal)


class Nemesis:
    """Injects the faults of a plan, several at a time."""

    def __init__(self, team: TeamUnderTest, options: ScenarioOptions) -> None:
        self._team, self._report = team, options.report_progress
        self._sampler = MemorySampler(team)
        self.begun: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self.unknown: list[Span] = []
        """Times in which a robot's clock was wrong, or about to be."""
        self.forged: list[Span] = []
        """Times in which somebody sent in the name of a robot, under a tier that is not its."""

    @property
    def samples(self) -> Mapping[tuple[str, int], Sequence[ProcessSample]]:
        return self._sampler.samples

    def inject(self, faults: Sequence[PlannedFault]) -> None:
        """Begins and ends each fault at its time."""
        team, begin_s = self._team, self._team.now_s
        active: dict[PlannedFault, tuple[ExitStack, FaultRun]] = {}
        moments = [(f.from_s, 1, f) for f in faults] + [(f.until_s, 0, f) for f in faults]
        with ExitStack() as everything:
            for at_s, begins, fault in sorted(moments):
                left_s = begin_s + at_s - team.now_s
                team.wait_until(self._sampler.sample, max(0.0, left_s))
                if begins:
                    own = everything.enter_context(ExitStack())
                    run = FaultRun(team.run_log, team.robots, fault.target, team.now_s)
                    active[fault] = own, run
                    own.enter_context(FAULTS[fault.name](team, run))
                    self.begun[fault.name] += 1
                else:
                    own, run = active.pop(fault)
                    own.close()
                    self._end_fault(fault, run)
                self._report(", ".join(f"{f.name} {f.target}" for f in active) or "no fault")

    def _end_fault(self, fault: PlannedFault, run: FaultRun) -> None:
        span = Span(fault.target, run.fault_s - 0.5, self._team.now_s + 0.5)
        self.sent[fault.name] += run.sent
        kept = {"clock": self.unknown, "flood": self.forged}.get(fault.name)
        if kept is not None:
            kept.append(span)

    def healing_time_s(self) -> float:
        """Waits until all that was killed runs again; returns the time (s)."""
        team = self._team
        self._report("waiting until all processes run")
        names = set(team.supervisor.names)
        team.wait_until(lambda: names == team.supervisor.pids.keys(), STUCK_S)
        for span in [s for s in self.unknown if s.until_s > team.now_s - 3.0]:
            self.unknown.append(span._replace(until_s=team.now_s + 1.0))
        return team.now_s

    def checks(self, duration_s: float) -> Iterator[Check]:
        """No process ended unasked, and none holds more and more."""
        team = self._team
        kills = sum(n * KILLS.get(name, 0) for name, n in self.begun.items())
        unasked = sum(team.supervisor.restarts.values()) - kills
        yield Check(
            what="processes that ended without being killed",
            seen=unasked,
            at_most=0,
            by_load=False,
        )
        yield equal_to("tracebacks in logs", team.tracebacks(), 0)
        refused = sum(refusals(team.run_log, name) for name in team.robots)
        # Of what was sent: on a busy machine the process that sends them may start too late
        least = min(10 * self.begun["garbage"], self.sent["garbage"] // 10)
        yield at_least("meaningless payloads counted", refused, least)
        yield at_least("kinds of faults", len(self.begun), min(len(FAULTS) - 1, duration_s / 8.0))
        judged = (FIELD, UP, FAR_ROUTER) if duration_s >= JUDGED_S else ()
        lives = process_lives(self._sampler.samples)
        if lives or judged:
            yield from memory_checks(lives, judged)


def _remarks(
    seed: int, faults: Sequence[PlannedFault], nemesis: Nemesis, checks: Sequence[Check]
) -> Iterator[str]:
    yield f"seed {seed}: {len(faults)} faults, up to {largest_overlap(faults)} at a time"
    if not all(check.is_met for check in checks):
        yield "events: " + "; ".join(map(str, faults))
    yield from map(str, process_lives(nemesis.samples))


nemesis_with_keys = partial(nemesis, secured=True)
