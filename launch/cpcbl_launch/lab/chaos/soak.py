"""A soak test: faults in random order for any time, and what the processes hold afterwards."""

import random
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from statistics import mean, median

from msgspec.structs import replace

from cpcbl_launch.lab.chaos import injectors
from cpcbl_launch.lab.chaos.checks import Check, equal_to
from cpcbl_launch.lab.chaos.expectations import GOOD_M, check_back, check_gap, checks_recovered
from cpcbl_launch.lab.chaos.history import Span, check_claims, without, write_history
from cpcbl_launch.lab.chaos.memory import (
    LEAST_LIFE_S,
    MemorySampler,
    ProcessLife,
    memory_checks,
    process_lives,
)
from cpcbl_launch.lab.chaos.run_log import worst
from cpcbl_launch.lab.chaos.scenario import FaultRun, ScenarioOptions, ScenarioResult, latest
from cpcbl_launch.lab.chaos.schedule import PlannedFault
from cpcbl_launch.lab.chaos.team import (
    FIELD,
    ROUTER,
    ChaosError,
    RunPlan,
    demo_team,
    run_team,
)
from cpcbl_launch.run.processes import require_process_usage
from cpcbl_team.config.recording import RecordingSettings
from cpcbl_team.errors import InputError
from cpcbl_transport.messages import Track

FAULTS = ("kill", "freeze", "cut", "slow", "narrow", "flood", "echo")  # names of injectors
REST_S = (3.0, 9.0)
FAULT_S = (2.0, 6.0)
UNDISTURBED_S = LEAST_LIFE_S + 10.0  # at the end nothing is killed, so that every process is judged
SHORTEST_S = UNDISTURBED_S + 30.0
STUCK_S = 30.0
RECORDING = RecordingSettings(segment_bytes=16 * 2**20, keep_bytes=96 * 2**20)  # of each robot
MOVED_S = 15.0  # after the death of a field all robots stand elsewhere, and have to notice it


def require_judged_soak(duration_s: float) -> None:
    """Raises InputError for a soak test that could not be judged."""
    if duration_s < SHORTEST_S:
        raise InputError(
            f"--duration {duration_s:g}: too short to judge whether memory grows: each process must"
            f" run for {LEAST_LIFE_S:g} s; at least {SHORTEST_S:g}"
        )


def soak(options: ScenarioOptions) -> ScenarioResult:
    """Kills, suspends, cuts, slows, floods and repeats, in random order. The recordings of the
    robots are kept if a check is not met."""
    require_process_usage("chaos soak")
    recordings = Path(tempfile.mkdtemp(prefix="cpcbl-soak-"))
    remark = f"recorded: cpcbl-team replay {recordings}"
    try:
        result = _soak(options, recordings)
    except ChaosError as error:
        raise ChaosError(f"{error}; {remark}") from error
    if not all(check.is_met for check in result.checks):
        return result._replace(remarks=(*result.remarks, remark))
    shutil.rmtree(recordings)
    return result


def _soak(options: ScenarioOptions, recordings: Path) -> ScenarioResult:
    settings = replace(demo_team(), recording=RECORDING)
    relayed = list(settings.robots)
    plan = RunPlan(settings, options.seed, relayed, watched=True, recordings=recordings)
    plan = plan._replace(secured=options.secured)
    options.report_progress("starting a team")
    with run_team(plan, options.machine) as team:
        team.settle()
        sampler = MemorySampler(team)
        faults = _inject(sampler, options)
        options.report_progress("waiting until all robots are localized")
        run = FaultRun(team.run_log, team.robots, fault_s=team.now_s)
        team.wait_until(lambda: _back_after_s(latest(run, team)) is not None, STUCK_S)
        run.healed_s = team.now_s
        team.run_for(8.0)
        lives = process_lives(sampler.samples)
        kills = sum(fault.name == "kill" for fault in faults)
        unasked = sum(team.supervisor.restarts.values()) - kills
        judged = memory_checks(lives, team.supervisor.names)
        checks = [*soak_checks(latest(run, team), unasked, team.tracebacks(), faults), *judged]
        if (path := options.history) is not None:
            path = path.with_stem(f"{path.stem}-soak")
            write_history(path, options.seed, faults, run.log, checks)
        return ScenarioResult(checks, tuple(_figures(faults, lives, run)))


def _back_after_s(run: FaultRun) -> float | None:
    return worst(run.log.localized_after_s, run.robots, run.fault_s)


def soak_checks(
    run: FaultRun, unasked_restarts: int, tracebacks: int, faults: Sequence[PlannedFault] = ()
) -> list[Check]:
    """No robot stays lost or silent, or certain of a wrong position, and no process ended without
    being killed. `run`: from the last fault until all robots were localized again, and to the end;
    `faults`: with the times of the run."""
    window = run.log, run.robots, 0.0, run.end_s
    moved = [fault.from_s for fault in faults if fault[:2] == ("kill", FIELD)]
    spans = [Span(name, at_s, at_s + MOVED_S) for at_s in moved for name in run.robots]
    return [
        equal_to("processes that ended without being killed", unasked_restarts, 0),
        equal_to("tracebacks in logs", tracebacks, 0),
        check_gap(*window, "longest gap between tracks", STUCK_S),
        check_claims(without(run.log, spans), run.robots, GOOD_M),
        check_back(
            run, "from the last fault until all were localized", _back_after_s(run), run.fault_s
        ),
        *checks_recovered(run, run.healed_s),
    ]


def _inject(sampler: MemorySampler, options: ScenarioOptions) -> list[PlannedFault]:
    """Injects one fault after another for `duration_s`; which ones, and when."""
    team, dice = sampler.team, random.Random(options.seed)
    robots, end_s = team.robots, team.now_s + (options.duration_s or SHORTEST_S)
    faults: list[PlannedFault] = []
    targets = {"echo": ["observer"], "kill": [*robots, FIELD, ROUTER]}

    def wait(least_s: float, most_s: float) -> None:
        team.wait_until(sampler.sample, dice.uniform(least_s, most_s))

    while team.now_s < end_s:
        wait(*REST_S)
        left_s = max(end_s - team.now_s, 0.0)
        name = dice.choice(FAULTS if left_s > UNDISTURBED_S else FAULTS[1:])
        options.report_progress(f"{name}; {left_s:.0f} s left")
        robot, from_s = dice.choice(targets.get(name, robots)), team.now_s
        with getattr(injectors, name)(team, FaultRun(team.run_log, robots, robot)):
            if name != "kill":
                wait(*FAULT_S)
        faults.append(PlannedFault(name, robot, from_s, team.now_s))
    return faults


def _figures(
    faults: Iterable[PlannedFault], lives: Iterable[ProcessLife], run: FaultRun
) -> Iterator[str]:
    counts = Counter(fault.name for fault in faults)
    yield "faults: " + ", ".join(f"{name} {n}" for name, n in sorted(counts.items()))
    yield from map(str, lives)
    for name in run.robots:
        tracks: Sequence[Track] = [t.track for t in run.log.tracks[name] if t.stamp_s >= 0.0]
        lost, tier = mean(bool(t.lost) for t in tracks), median(t.tier for t in tracks)
        yield f"robot {name}: lost {lost:.2%} of the time, median tier {tier:.0f}"
