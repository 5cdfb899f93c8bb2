"""A soak: faults in random order for as long as one likes, and what it leaves behind."""

import random
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import linear_regression, median
from typing import NamedTuple

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.figures import found_after_s, longest_gap_s, lost_share, tiers, worst
from cpcbl_launch.lab.chaos.injectors import Echo
from cpcbl_launch.lab.chaos.inputs import flooding
from cpcbl_launch.lab.chaos.relay import Quality, Relay
from cpcbl_launch.lab.chaos.run_log import Notes
from cpcbl_launch.lab.chaos.scenario import FOUND_M, Found, Setting, all_is_well
from cpcbl_launch.lab.chaos.team import FIELD, ROUTER, Plan, TeamUnderTest, demo_team, running
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


class Sample(NamedTuple):
    """What a process held at a time."""

    at_s: float
    process: str
    pid: int
    own_bytes: int
    files: int


class Life(NamedTuple):
    """One process from its start to its end, by its samples."""

    process: str
    seconds: float
    start_mib: float
    """Median of the 20 s after its first 20 s."""
    end_mib: float
    """Median of its last 20 s."""
    mib_a_minute: float
    more_files: int


def soak(setting: Setting) -> Found:
    """Kill, freeze, cut, slow, flood, echo, again and again."""
    require_process_usage("chaos soak")
    team_file, endpoint = demo_team(), free_endpoint()
    with ExitStack() as stack:
        links = {n: stack.enter_context(Relay(endpoint, setting.seed)) for n in team_file.robots}
        dialled = {name: link.endpoint for name, link in links.items()}
        plan = Plan(team_file, setting.seed, endpoint=endpoint, links=dialled)
        team = stack.enter_context(running(plan))
        setting.say("starting a team")
        team.settle()
        tormentor = _Tormentor(team, links, setting)
        tormentor.run()
        setting.say("waiting until all robots are localized")
        calm_s = team.now_s
        team.until(lambda: _all_found(team.notes, team.robots, calm_s), STUCK_S)
        well_s = team.now_s
        team.run_for(8.0)
        notes = team.notes
        checks = judged_soak(
            notes,
            team.robots,
            lives(tormentor.samples),
            (0.0, calm_s, well_s, team.now_s),
            sum(team.supervisor.restarts.values()),
            tormentor.faults["kill"],
            team.tracebacks(),
        )
        return Found(checks, tuple(_figures(tormentor, notes, team.robots)))


def _all_found(notes: Notes, robots: Iterable[str], from_s: float) -> bool:
    return all(found_after_s(notes, name, from_s, FOUND_M) is not None for name in robots)


def judged_soak(
    notes: Notes,
    robots: Sequence[str],
    lived: Sequence[Life],
    times_s: tuple[float, float, float, float],
    restarts: int,
    kills: int,
    tracebacks: int,
) -> list[Check]:
    """Memory is flat, nobody is stuck, nothing ended that was not killed. `times_s`: the beginning,
    the last fault, when all were well again, the end."""
    from_s, calm_s, well_s, until_s = times_s
    silent = [longest_gap_s(notes, name, from_s, until_s) for name in robots]
    back = [found_after_s(notes, name, calm_s, FOUND_M) for name in robots]
    grown = [life.end_mib - life.start_mib for life in lived]
    slopes = [life.mib_a_minute for life in lived if life.seconds >= LONG_LIFE_S]
    steep = Check(
        what=f"steepest growth of a process that ran for {LONG_LIFE_S:g} s",
        seen=max(slopes, default=None),
        unit="MiB/min",
        at_most=SLOPE_MIB_A_MINUTE,
    )
    return [
        Check(
            what="processes that ended without being killed",
            seen=restarts - kills,
            at_least=0,
            at_most=0,
        ),
        Check(what="tracebacks in logs", seen=tracebacks, at_least=0, at_most=0),
        Check(what="longest gap between tracks", seen=worst(silent), unit="s", at_most=STUCK_S),
        Check(
            what="from the last fault until all were localized",
            seen=worst(back),
            unit="s",
            at_most=STUCK_S,
        ),
        Check(
            what="largest growth of memory",
            seen=max(grown, default=None),
            unit="MiB",
            at_most=GROWTH_MIB,
        ),
        *([steep] if slopes else []),
        Check(
            what="largest growth of the number of open files",
            seen=max((life.more_files for life in lived), default=None),
            at_most=MORE_FILES,
        ),
        *all_is_well(notes, robots, well_s, until_s),
    ]


def lives(samples: Iterable[Sample]) -> list[Life]:
    """The processes that lived long enough to tell whether their memory is flat."""
    by_pid: dict[tuple[str, int], list[Sample]] = {}
    for sample in samples:
        by_pid.setdefault((sample.process, sample.pid), []).append(sample)
    return [
        _life(process, kept)
        for (process, _), kept in by_pid.items()
        if kept[-1].at_s - kept[0].at_s >= LEAST_LIFE_S
    ]


def _life(process: str, samples: Sequence[Sample]) -> Life:
    begin_s, end_s = samples[0].at_s, samples[-1].at_s
    warm = [s for s in samples if s.at_s >= begin_s + WARM_S]
    first = [s for s in warm if s.at_s <= begin_s + WARM_S + SPAN_S]
    last = [s for s in warm if s.at_s >= end_s - SPAN_S]
    mib = [s.own_bytes / MIB for s in warm]
    return Life(
        process,
        end_s - begin_s,
        median(s.own_bytes for s in first) / MIB,
        median(s.own_bytes for s in last) / MIB,
        60.0 * linear_regression([s.at_s for s in warm], mib).slope,
        int(median(s.files for s in last) - median(s.files for s in first)),
    )


class _Tormentor:
    """Does one fault after another, and samples what processes hold."""

    def __init__(self, team: TeamUnderTest, links: Mapping[str, Relay], setting: Setting) -> None:
        self._team, self._links, self._setting = team, links, setting
        self._dice = random.Random(setting.seed)
        self._sampled_s = 0.0
        self.samples: list[Sample] = []
        self.faults: Counter[str] = Counter()

    def run(self) -> None:
        """For `soak_s`."""
        kinds: dict[str, Callable[[], None]] = {
            "kill": self._kill,
            "freeze": self._freeze,
            "cut": lambda: self._spoil(Quality(cut=True)),
            "slow": lambda: self._spoil(Quality(delay_s=0.2, jitter_s=0.1)),
            "narrow": lambda: self._spoil(Quality(bytes_per_s=6250.0)),
            "flood": self._flood,
            "echo": self._echo,
        }
        end_s = self._team.now_s + self._setting.soak_s
        while self._team.now_s < end_s:
            self._wait(*REST_S)
            name = self._dice.choice(list(kinds))
            self.faults[name] += 1
            left_s = end_s - self._team.now_s
            self._setting.say(f"{name}; {max(left_s, 0.0):.0f} s left")
            kinds[name]()

    def _wait(self, least_s: float, most_s: float) -> None:
        self._team.until(self._sample, self._dice.uniform(least_s, most_s))

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
                self.samples.append(Sample(now_s, process, pid, held, files))
        return False

    def _robot(self) -> str:
        return self._dice.choice(self._team.robots)

    def _kill(self) -> None:
        who = self._dice.choice([*self._team.robots, FIELD, ROUTER])
        self._team.until(lambda: self._runs(who), 20.0)
        self._team.kill(who)

    def _runs(self, who: str) -> bool:
        process = f"robot-{who}" if who in self._team.robots else who
        return process in self._team.supervisor.pids

    def _freeze(self) -> None:
        who = self._robot()
        self._team.until(lambda: self._runs(who), 20.0)
        self._team.freeze(who)
        self._wait(*FAULT_S)
        self._team.thaw(who)

    def _spoil(self, quality: Quality) -> None:
        link = self._links[self._robot()]
        link.set(quality)
        self._wait(*FAULT_S)
        link.set(Quality())

    def _flood(self) -> None:
        who = self._robot()
        process = flooding(self._team, who, self._team.others(who))
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


def _figures(tormentor: _Tormentor, notes: Notes, robots: Sequence[str]) -> Iterable[str]:
    yield "faults: " + ", ".join(f"{name} {n}" for name, n in sorted(tormentor.faults.items()))
    for life in lives(tormentor.samples):
        yield (
            f"{life.process}: {life.start_mib:.1f} MiB, after {life.seconds:.0f} s"
            f" {life.end_mib:.1f} MiB ({life.mib_a_minute:+.3f} MiB/min)"
        )
    for name in robots:
        lost, seen = lost_share(notes, name, 0.0) or 0.0, tiers(notes, name, 0.0)
        yield f"robot {name}: lost {lost:.2%} of the time, median tier {median(seen):.0f}"
