"""A soak test: faults in random order for any time, and what the processes hold afterwards."""

import random
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import linear_regression, mean, median
from typing import NamedTuple

from cpcbl_launch.lab.chaos import injectors
from cpcbl_launch.lab.chaos.checks import Check, at_most, equal_to
from cpcbl_launch.lab.chaos.expectations import checks_recovered
from cpcbl_launch.lab.chaos.run_log import worst
from cpcbl_launch.lab.chaos.scenario import FaultRun, ScenarioOptions, ScenarioResult, latest
from cpcbl_launch.lab.chaos.team import FIELD, ROUTER, RunPlan, TeamUnderTest, demo_team, run_team
from cpcbl_launch.run.processes import own_memory_mib, require_process_usage

FAULTS = ("kill", "freeze", "cut", "slow", "narrow", "flood", "echo")  # names of injectors
SAMPLE_S = 5.0
REST_S = (3.0, 9.0)
FAULT_S = (2.0, 6.0)
WARM_S, LEAST_LIFE_S, SPAN_S = 20.0, 80.0, 20.0
GROWTH_MIB = 6.0  # of a life: allocators take in steps
SLOPE_MIB_A_MINUTE, LONG_LIFE_S = 0.5, 300.0
MORE_FILES = 10
STUCK_S = 30.0


class ProcessSample(NamedTuple):
    """The memory and the number of open files of a process at one time."""

    at_s: float
    mib: float
    files: int


class ProcessLife(NamedTuple):
    """One process from its start to its end, by its samples."""

    process: str
    seconds: float
    start_mib: float  # the median of the 20 s after its first 20 s
    end_mib: float  # the median of its last 20 s
    mib_a_minute: float
    more_files: int


def soak(options: ScenarioOptions) -> ScenarioResult:
    """Kills, suspends, cuts, slows, floods and repeats, in random order."""
    require_process_usage("chaos soak")
    settings = demo_team()
    plan = RunPlan(settings, options.seed, relayed=list(settings.robots))
    options.report_progress("starting a team")
    with run_team(plan) as team:
        team.settle()
        faults = _FaultSequence(team, options)
        faults.run()
        options.report_progress("waiting until all robots are localized")
        run = FaultRun(team.run_log, team.robots, fault_s=team.now_s)
        team.wait_until(lambda: _back_after_s(latest(run, team)) is not None, STUCK_S)
        run.healed_s = team.now_s
        team.run_for(8.0)
        lives = process_lives(faults.samples)
        unasked = sum(team.supervisor.restarts.values()) - faults.counts["kill"]
        checks = soak_checks(latest(run, team), lives, unasked, team.tracebacks())
        return ScenarioResult(checks, tuple(_figures(faults.counts, lives, run)))


def _back_after_s(run: FaultRun) -> float | None:
    return worst(run.log.localized_after_s, run.robots, run.fault_s)


def soak_checks(
    run: FaultRun, lives: Sequence[ProcessLife], unasked_restarts: int, tracebacks: int
) -> list[Check]:
    """Memory does not grow, no robot stays lost or silent, and no process ended without being
    killed. `run`: from the last fault until all robots were localized again, and to the end."""
    gap_s = worst(run.log.longest_track_gap_s, run.robots, 0.0, run.end_s)
    growth_mib = max((life.end_mib - life.start_mib for life in lives), default=None)
    slopes = [life.mib_a_minute for life in lives if life.seconds >= LONG_LIFE_S]
    steepest = f"steepest growth of a process that ran for {LONG_LIFE_S:g} s"
    more_files = max((life.more_files for life in lives), default=None)
    return [
        equal_to("processes that ended without being killed", unasked_restarts, 0),
        equal_to("tracebacks in logs", tracebacks, 0),
        at_most("longest gap between tracks", gap_s, STUCK_S, "s"),
        at_most("from the last fault until all were localized", _back_after_s(run), STUCK_S, "s"),
        at_most("largest growth of memory", growth_mib, GROWTH_MIB, "MiB"),
        *([at_most(steepest, max(slopes), SLOPE_MIB_A_MINUTE, "MiB/min")] if slopes else []),
        at_most("largest growth of the number of open files", more_files, MORE_FILES),
        *checks_recovered(run, run.healed_s),
    ]


def process_lives(samples: Mapping[tuple[str, int], Sequence[ProcessSample]]) -> list[ProcessLife]:
    """The processes that ran long enough to show whether their memory grows, by their samples."""
    return [
        _life(process, kept)
        for (process, _), kept in samples.items()
        if kept[-1].at_s - kept[0].at_s >= LEAST_LIFE_S
    ]


def _life(process: str, samples: Sequence[ProcessSample]) -> ProcessLife:
    begin_s, end_s = samples[0].at_s, samples[-1].at_s
    warm = [s for s in samples if s.at_s >= begin_s + WARM_S]
    first = [s for s in warm if s.at_s <= begin_s + WARM_S + SPAN_S]
    last = [s for s in warm if s.at_s >= end_s - SPAN_S]
    return ProcessLife(
        process,
        end_s - begin_s,
        median(s.mib for s in first),
        median(s.mib for s in last),
        60.0 * linear_regression([s.at_s for s in warm], [s.mib for s in warm]).slope,
        int(median(s.files for s in last) - median(s.files for s in first)),
    )


class _FaultSequence:
    """Injects one fault after another, and samples the memory of all processes."""

    def __init__(self, team: TeamUnderTest, options: ScenarioOptions) -> None:
        self._team, self._options = team, options
        self._random = random.Random(options.seed)
        self._sampled_s = 0.0
        self.samples = defaultdict[tuple[str, int], list[ProcessSample]](list)  # by name and pid
        self.counts: Counter[str] = Counter()

    def run(self) -> None:
        """Injects faults for `soak_s`."""
        robots, end_s = self._team.robots, self._team.now_s + self._options.soak_s
        targets = {"echo": ["observer"], "kill": [*robots, FIELD, ROUTER]}
        while self._team.now_s < end_s:
            self._wait(*REST_S)
            name = self._random.choice(FAULTS)
            self.counts[name] += 1
            left_s = max(end_s - self._team.now_s, 0.0)
            self._options.report_progress(f"{name}; {left_s:.0f} s left")
            robot = self._random.choice(targets.get(name, robots))
            fault = FaultRun(self._team.run_log, robots, robot)
            with getattr(injectors, name)(self._team, fault):
                if name != "kill":
                    self._wait(*FAULT_S)

    def _wait(self, least_s: float, most_s: float) -> None:
        self._team.wait_until(self._sample, self._random.uniform(least_s, most_s))

    def _sample(self) -> bool:
        now_s = self._team.now_s
        if now_s - self._sampled_s >= SAMPLE_S:
            self._sampled_s = now_s
            for process, pid in self._team.supervisor.pids.items():
                try:
                    files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
                    mib = own_memory_mib(pid)
                except (OSError, KeyError):  # it ends just now
                    continue
                self.samples[process, pid].append(ProcessSample(now_s, mib, files))
        return False


def _figures(counts: Counter[str], lives: Iterable[ProcessLife], run: FaultRun) -> Iterator[str]:
    yield "faults: " + ", ".join(f"{name} {n}" for name, n in sorted(counts.items()))
    for life in lives:
        yield (
            f"{life.process}: {life.start_mib:.1f} MiB, after {life.seconds:.0f} s"
            f" {life.end_mib:.1f} MiB ({life.mib_a_minute:+.3f} MiB/min)"
        )
    for name in run.robots:
        tracks = [t.track for t in run.log.tracks[name] if t.stamp_s >= 0.0]
        lost, tier = mean(bool(t.lost) for t in tracks), median(t.tier for t in tracks)
        yield f"robot {name}: lost {lost:.2%} of the time, median tier {tier:.0f}"
