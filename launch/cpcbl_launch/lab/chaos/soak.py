"""A soak test: faults in random order for any time, and what the processes hold afterwards."""

import random
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import linear_regression, median
from typing import NamedTuple

from cpcbl_launch.lab.chaos.checks import Check, at_most, equal_to
from cpcbl_launch.lab.chaos.figures import (
    localized_after_s,
    longest_track_gap_s,
    lost_share,
    maximum,
    track_tiers,
)
from cpcbl_launch.lab.chaos.injectors import Echo
from cpcbl_launch.lab.chaos.inputs import start_flood
from cpcbl_launch.lab.chaos.relay import LinkQuality, Relay
from cpcbl_launch.lab.chaos.run_log import RunLog
from cpcbl_launch.lab.chaos.scenario import (
    FOUND_M,
    ScenarioOptions,
    ScenarioResult,
    checks_recovered,
)
from cpcbl_launch.lab.chaos.team import (
    FIELD,
    ROUTER,
    RunPlan,
    TeamUnderTest,
    demo_team,
    run_team_under_test,
)
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.run.usage import MIB, process_usage, require_process_usage
from cpcbl_transport.zenoh_bus import open_bus

SAMPLE_S = 5.0
REST_S = (3.0, 9.0)
FAULT_S = (2.0, 6.0)
WARM_S, LEAST_LIFE_S, SPAN_S = 20.0, 80.0, 20.0
GROWTH_MIB = 6.0  # of a life: allocators take in steps
SLOPE_MIB_A_MINUTE, LONG_LIFE_S = 0.5, 300.0
MORE_FILES = 10
STUCK_S = 30.0


class ProcessSample(NamedTuple):
    """The memory and open files of a process at one time."""

    at_s: float
    process: str
    pid: int
    own_bytes: int
    files: int


class ProcessLife(NamedTuple):
    """One process from its start to its end, by its samples."""

    process: str
    seconds: float
    start_mib: float
    """The median of the 20 s after its first 20 s."""
    end_mib: float
    """The median of its last 20 s."""
    mib_a_minute: float
    more_files: int


def soak(options: ScenarioOptions) -> ScenarioResult:
    """Kills, suspends, cuts, slows, floods and repeats, in random order."""
    require_process_usage("chaos soak")
    team_file, endpoint = demo_team(), free_endpoint()
    with ExitStack() as stack:
        links = {n: stack.enter_context(Relay(endpoint, options.seed)) for n in team_file.robots}
        dialled = {name: link.endpoint for name, link in links.items()}
        plan = RunPlan(team_file, options.seed, endpoint=endpoint, links=dialled)
        team = stack.enter_context(run_team_under_test(plan))
        options.report_progress("starting a team")
        team.settle()
        tormentor = _FaultSequence(team, links, options)
        tormentor.run()
        options.report_progress("waiting until all robots are localized")
        calm_s = team.now_s
        team.wait_until(lambda: _are_all_localized(team.run_log, team.robots, calm_s), STUCK_S)
        well_s = team.now_s
        team.run_for(8.0)
        log = team.run_log
        checks = soak_checks(
            log,
            team.robots,
            process_lives(tormentor.samples),
            (0.0, calm_s, well_s, team.now_s),
            sum(team.supervisor.restarts.values()),
            tormentor.faults["kill"],
            team.tracebacks(),
        )
        return ScenarioResult(checks, tuple(_figures(tormentor, log, team.robots)))


def _are_all_localized(log: RunLog, robots: Iterable[str], from_s: float) -> bool:
    return all(localized_after_s(log, name, from_s, FOUND_M) is not None for name in robots)


def soak_checks(
    log: RunLog,
    robots: Sequence[str],
    lived: Sequence[ProcessLife],
    times_s: tuple[float, float, float, float],
    restarts: int,
    kills: int,
    tracebacks: int,
) -> list[Check]:
    """Memory does not grow, no robot stays lost or silent, and no process ended without being
    killed. `times_s`: the start, the last fault, when all were localized again, the end."""
    from_s, calm_s, well_s, until_s = times_s
    silent = [longest_track_gap_s(log, name, from_s, until_s) for name in robots]
    back = [localized_after_s(log, name, calm_s, FOUND_M) for name in robots]
    grown = [life.end_mib - life.start_mib for life in lived]
    slopes = [life.mib_a_minute for life in lived if life.seconds >= LONG_LIFE_S]
    steep = at_most(
        f"steepest growth of a process that ran for {LONG_LIFE_S:g} s",
        max(slopes, default=None),
        SLOPE_MIB_A_MINUTE,
        "MiB/min",
    )
    return [
        equal_to("processes that ended without being killed", restarts - kills, 0),
        equal_to("tracebacks in logs", tracebacks, 0),
        at_most("longest gap between tracks", maximum(silent), STUCK_S, "s"),
        at_most("from the last fault until all were localized", maximum(back), STUCK_S, "s"),
        at_most("largest growth of memory", max(grown, default=None), GROWTH_MIB, "MiB"),
        *([steep] if slopes else []),
        at_most(
            "largest growth of the number of open files",
            max((life.more_files for life in lived), default=None),
            MORE_FILES,
        ),
        *checks_recovered(log, robots, well_s, until_s),
    ]


def process_lives(samples: Iterable[ProcessSample]) -> list[ProcessLife]:
    """The processes that ran long enough to show whether their memory grows."""
    by_pid: dict[tuple[str, int], list[ProcessSample]] = {}
    for sample in samples:
        by_pid.setdefault((sample.process, sample.pid), []).append(sample)
    return [
        _life(process, kept)
        for (process, _), kept in by_pid.items()
        if kept[-1].at_s - kept[0].at_s >= LEAST_LIFE_S
    ]


def _life(process: str, samples: Sequence[ProcessSample]) -> ProcessLife:
    begin_s, end_s = samples[0].at_s, samples[-1].at_s
    warm = [s for s in samples if s.at_s >= begin_s + WARM_S]
    first = [s for s in warm if s.at_s <= begin_s + WARM_S + SPAN_S]
    last = [s for s in warm if s.at_s >= end_s - SPAN_S]
    mib = [s.own_bytes / MIB for s in warm]
    return ProcessLife(
        process,
        end_s - begin_s,
        median(s.own_bytes for s in first) / MIB,
        median(s.own_bytes for s in last) / MIB,
        60.0 * linear_regression([s.at_s for s in warm], mib).slope,
        int(median(s.files for s in last) - median(s.files for s in first)),
    )


class _FaultSequence:
    """Injects one fault after another, and samples the memory of all processes."""

    def __init__(
        self, team: TeamUnderTest, links: Mapping[str, Relay], options: ScenarioOptions
    ) -> None:
        self._team, self._links, self._setting = team, links, options
        self._dice = random.Random(options.seed)
        self._sampled_s = 0.0
        self.samples: list[ProcessSample] = []
        self.faults: Counter[str] = Counter()

    def run(self) -> None:
        """Injects faults for `soak_s`."""
        kinds: dict[str, Callable[[], None]] = {
            "kill": self._kill,
            "freeze": self._freeze,
            "cut": lambda: self._impair_link(LinkQuality(cut=True)),
            "slow": lambda: self._impair_link(LinkQuality(delay_s=0.2, jitter_s=0.1)),
            "narrow": lambda: self._impair_link(LinkQuality(bytes_per_s=6250.0)),
            "flood": self._flood,
            "echo": self._echo,
        }
        end_s = self._team.now_s + self._setting.soak_s
        while self._team.now_s < end_s:
            self._wait(*REST_S)
            name = self._dice.choice(list(kinds))
            self.faults[name] += 1
            left_s = end_s - self._team.now_s
            self._setting.report_progress(f"{name}; {max(left_s, 0.0):.0f} s left")
            kinds[name]()

    def _wait(self, least_s: float, most_s: float) -> None:
        self._team.wait_until(self._sample, self._dice.uniform(least_s, most_s))

    def _sample(self) -> bool:
        now_s = self._team.now_s
        if now_s - self._sampled_s >= SAMPLE_S:
            self._sampled_s = now_s
            for process, pid in self._team.supervisor.pids.items():
                try:
                    files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
                    held = process_usage(pid).own_bytes
                except (OSError, KeyError):  # it ends just now
                    continue
                self.samples.append(ProcessSample(now_s, process, pid, held, files))
        return False

    def _robot(self) -> str:
        return self._dice.choice(self._team.robots)

    def _kill(self) -> None:
        who = self._dice.choice([*self._team.robots, FIELD, ROUTER])
        self._team.wait_until(lambda: self._runs(who), 20.0)
        self._team.kill(who)

    def _runs(self, who: str) -> bool:
        process = f"robot-{who}" if who in self._team.robots else who
        return process in self._team.supervisor.pids

    def _freeze(self) -> None:
        who = self._robot()
        self._team.wait_until(lambda: self._runs(who), 20.0)
        self._team.freeze(who)
        self._wait(*FAULT_S)
        self._team.thaw(who)

    def _impair_link(self, quality: LinkQuality) -> None:
        link = self._links[self._robot()]
        link.set(quality)
        self._wait(*FAULT_S)
        link.set(LinkQuality())

    def _flood(self) -> None:
        who = self._robot()
        process = start_flood(self._team, who, self._team.others(who))
        try:
            self._wait(*FAULT_S)
        finally:
            process.terminate()
            process.communicate(timeout=20.0)

    def _echo(self) -> None:
        with (
            open_bus(self._team.plan.team.name, [self._team.endpoint]) as bus,
            Echo(bus, "observer", 4.0, self._dice.randrange(2**32)),
        ):
            self._wait(*FAULT_S)


def _figures(tormentor: _FaultSequence, log: RunLog, robots: Sequence[str]) -> Iterable[str]:
    yield "faults: " + ", ".join(f"{name} {n}" for name, n in sorted(tormentor.faults.items()))
    for life in process_lives(tormentor.samples):
        yield (
            f"{life.process}: {life.start_mib:.1f} MiB, after {life.seconds:.0f} s"
            f" {life.end_mib:.1f} MiB ({life.mib_a_minute:+.3f} MiB/min)"
        )
    for name in robots:
        lost, seen = lost_share(log, name, 0.0) or 0.0, track_tiers(log, name, 0.0)
        yield f"robot {name}: lost {lost:.2%} of the time, median tier {median(seen):.0f}"
