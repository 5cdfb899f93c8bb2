"""A soak test: faults in random order for any time, and what the processes hold afterwards."""

import random
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from statistics import mean, median

from cpcbl_launch.lab.chaos import injectors
from cpcbl_launch.lab.chaos.checks import Check, equal_to
from cpcbl_launch.lab.chaos.expectations import check_back, check_gap, checks_recovered
from cpcbl_launch.lab.chaos.memory import (
    LEAST_LIFE_S,
    MemorySampler,
    ProcessLife,
    memory_checks,
    process_lives,
)
from cpcbl_launch.lab.chaos.run_log import worst
from cpcbl_launch.lab.chaos.scenario import FaultRun, ScenarioOptions, ScenarioResult, latest
from cpcbl_launch.lab.chaos.team import FIELD, ROUTER, RunPlan, demo_team, run_team
from cpcbl_launch.run.processes import require_process_usage
from cpcbl_team.errors import InputError
from cpcbl_transport.messages import Track

FAULTS = ("kill", "freeze", "cut", "slow", "narrow", "flood", "echo")  # names of injectors
REST_S = (3.0, 9.0)
FAULT_S = (2.0, 6.0)
UNDISTURBED_S = LEAST_LIFE_S + 10.0  # at the end nothing is killed, so that every process is judged
SHORTEST_S = UNDISTURBED_S + 30.0
STUCK_S = 30.0


def require_judged_soak(duration_s: float) -> None:
    """Raises InputError for a soak test that could not be judged."""
    if duration_s < SHORTEST_S:
        raise InputError(
            f"--duration {duration_s:g}: too short to judge whether memory grows: each process must"
            f" run for {LEAST_LIFE_S:g} s; at least {SHORTEST_S:g}"
        )


def soak(options: ScenarioOptions) -> ScenarioResult:
    """Kills, suspends, cuts, slows, floods and repeats, in random order."""
    require_process_usage("chaos soak")
    settings = demo_team()
    plan = RunPlan(settings, options.seed, relayed=list(settings.robots), watched=True)
    plan = plan._replace(secured=options.secured)
    options.report_progress("starting a team")
    with run_team(plan, options.machine) as team:
        team.settle()
        sampler = MemorySampler(team)
        counts = _inject(sampler, options)
        options.report_progress("waiting until all robots are localized")
        run = FaultRun(team.run_log, team.robots, fault_s=team.now_s)
        team.wait_until(lambda: _back_after_s(latest(run, team)) is not None, STUCK_S)
        run.healed_s = team.now_s
        team.run_for(8.0)
        lives = process_lives(sampler.samples)
        unasked = sum(team.supervisor.restarts.values()) - counts["kill"]
        judged = memory_checks(lives, team.supervisor.names)
        checks = [*soak_checks(latest(run, team), unasked, team.tracebacks()), *judged]
        return ScenarioResult(checks, tuple(_figures(counts, lives, run)))


def _back_after_s(run: FaultRun) -> float | None:
    return worst(run.log.localized_after_s, run.robots, run.fault_s)


def soak_checks(run: FaultRun, unasked_restarts: int, tracebacks: int) -> list[Check]:
    """No robot stays lost or silent, and no process ended without being killed. `run`: from the
    last fault until all robots were localized again, and to the end."""
    window = run.log, run.robots, 0.0, run.end_s
    return [
        equal_to("processes that ended without being killed", unasked_restarts, 0),
        equal_to("tracebacks in logs", tracebacks, 0),
        check_gap(*window, "longest gap between tracks", STUCK_S),
        check_back(
            run, "from the last fault until all were localized", _back_after_s(run), run.fault_s
        ),
        *checks_recovered(run, run.healed_s),
    ]


def _inject(sampler: MemorySampler, options: ScenarioOptions) -> Counter[str]:
    """Injects one fault after another for `duration_s`; how many of each."""
    team, dice = sampler.team, random.Random(options.seed)
    robots, end_s, counts = (
        team.robots,
        team.now_s + (options.duration_s or SHORTEST_S),
        Counter[str](),
    )
    targets = {"echo": ["observer"], "kill": [*robots, FIELD, ROUTER]}

    def wait(least_s: float, most_s: float) -> None:
        team.wait_until(sampler.sample, dice.uniform(least_s, most_s))

    while team.now_s < end_s:
        wait(*REST_S)
        left_s = max(end_s - team.now_s, 0.0)
        name = dice.choice(FAULTS if left_s > UNDISTURBED_S else FAULTS[1:])
        counts[name] += 1
        options.report_progress(f"{name}; {left_s:.0f} s left")
        robot = dice.choice(targets.get(name, robots))
        with getattr(injectors, name)(team, FaultRun(team.run_log, robots, robot)):
            if name != "kill":
                wait(*FAULT_S)
    return counts


def _figures(counts: Counter[str], lives: Iterable[ProcessLife], run: FaultRun) -> Iterator[str]:
    yield "faults: " + ", ".join(f"{name} {n}" for name, n in sorted(counts.items()))
    yield from map(str, lives)
    for name in run.robots:
        tracks: Sequence[Track] = [t.track for t in run.log.tracks[name] if t.stamp_s >= 0.0]
        lost, tier = mean(bool(t.lost) for t in tracks), median(t.tier for t in tracks)
        yield f"robot {name}: lost {lost:.2%} of the time, median tier {tier:.0f}"
