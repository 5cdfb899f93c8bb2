"""What the processes of a running team hold: their memory and open files over their lives."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import linear_regression, median
from typing import NamedTuple

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.team import TeamUnderTest
from cpcbl_launch.run.processes import own_memory_mib

SAMPLE_S = 5.0
WARM_S, SPAN_S, LEAST_LIFE_S = 20.0, 20.0, 80.0
GROWTH_MIB = 6.0  # of a life: allocators take in steps
SLOPE_MIB_A_MINUTE, LONG_LIFE_S = 0.5, 300.0
MORE_FILES = 10


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
    late_mib_a_minute: float = 0.0  # in its second half: buffers that fill do so in the first one

    def __str__(self) -> str:
        return (
            f"{self.process}: {self.start_mib:.1f} MiB, after {self.seconds:.0f} s"
            f" {self.end_mib:.1f} MiB ({self.mib_a_minute:+.3f} MiB/min,"
            f" in its second half {self.late_mib_a_minute:+.3f})"
        )


class MemorySampler:
    """Samples all processes of a team every 5 s."""

    def __init__(self, team: TeamUnderTest) -> None:
        self.team, self._sampled_s = team, 0.0
        self.samples = defaultdict[tuple[str, int], list[ProcessSample]](list)  # by name and pid

    def sample(self) -> bool:
        """To be called often. False, so that it can be what is waited for."""
        now_s = self.team.now_s
        if now_s - self._sampled_s >= SAMPLE_S:
            self._sampled_s = now_s
            for process, pid in self.team.supervisor.pids.items():
                try:
                    files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
                    mib = own_memory_mib(pid)
                except (OSError, KeyError, ValueError):  # it ends just now
                    continue
                self.samples[process, pid].append(ProcessSample(now_s, mib, files))
        return False


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
        _mib_a_minute(warm),
        int(median(s.files for s in last) - median(s.files for s in first)),
        _mib_a_minute([s for s in warm if s.at_s >= 0.5 * (begin_s + end_s)]),
    )


def _mib_a_minute(samples: Sequence[ProcessSample]) -> float:
    return 60.0 * linear_regression([s.at_s for s in samples], [s.mib for s in samples]).slope


def memory_checks(lives: Sequence[ProcessLife], processes: Sequence[str]) -> list[Check]:
    """No process holds more and more memory or files, and each of these ran long enough to tell."""
    short = sorted(set(processes) - {life.process for life in lives})
    slopes = [life for life in lives if life.seconds >= LONG_LIFE_S]
    steepest = max(slopes, key=lambda life: life.late_mib_a_minute, default=None)
    young = [life for life in lives if life.seconds < 2.0 * LONG_LIFE_S]
    grown = max(young, key=lambda life: life.end_mib - life.start_mib, default=None)
    growth_mib = grown and grown.end_mib - grown.start_mib
    name = grown.process if grown else ""
    checks = [
        _check_at_most("processes that ran too shortly to judge their memory", len(short), 0),
        _check_at_most("largest growth of memory", growth_mib, GROWTH_MIB, "MiB", name),
        _check_at_most(
            "largest growth of the number of open files",
            max((life.more_files for life in lives), default=None),
            MORE_FILES,
        ),
    ]
    if steepest is not None:
        what = f"steepest growth in the second half of a life of {LONG_LIFE_S:g} s"
        late, bound = steepest.late_mib_a_minute, SLOPE_MIB_A_MINUTE
        checks.append(_check_at_most(what, late, bound, "MiB/min", steepest.process))
    return checks


def _check_at_most(
    what: str, seen: float | None, bound: float, unit: str = "", robot: str = ""
) -> Check:
    return Check(what=what, seen=seen, at_most=bound, unit=unit, robot=robot, by_load=False)
