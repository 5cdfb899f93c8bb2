"""How many robots, a process each, keep 10 Hz on this machine, and what each of them needs.

Each size of a team runs as `up` runs it: one process per robot, one for the simulated field, and a
router in this process, in real time. For comparison, as many bare processes put a belief at the
rate at which robots do, and receive and decode those of all others ("broadcast"); they localize
nothing. `--record` measures the same robots once more while each records itself, and `--old` the
robots of another checkout in the same run, with the present field and router. A size is kept if the
worst of its robots keeps `KEPT` of its ticks.

`make bench-processes ARGS='--team-sizes 24,32,40 --duration 8 --old ../earlier-checkout'`
"""

import argparse
import os
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path

import msgspec
from benchmarks.process_load import (
    Load,
    Start,
    measure_broadcast,
    measure_start,
    measure_team,
)
from benchmarks.report import show_and_write
from benchmarks.scaling import MOST_ROBOTS
from rich.console import RenderableType

from cpcbl_launch.reporting.tables import number, table
from cpcbl_launch.run.processes import require_process_usage
from cpcbl_team.errors import InputError

KEPT = 0.95
STARTS = 5


class Size(msgspec.Struct, frozen=True, kw_only=True):
    """One size of a team: the robots, the same with recordings, those of the old checkout, and the
    broadcast."""

    robots: int
    team: Load
    recorded: Load | None
    old: Load | None
    broadcast: Load


class Processes(msgspec.Struct, frozen=True, kw_only=True):
    """What the benchmark writes."""

    experiment: str
    version: str
    old: str
    """The folder of the old checkout; empty: none."""
    seconds: float
    """The time for which each size was measured."""
    start: Start
    """One robot, alone on the machine."""
    old_start: Start | None
    sizes: list[Size]
    most_kept: int
    """The largest team of these that kept its 10 Hz; 0 if none did."""
    cores: int
    load_average: float
    """Of the last minute before the start: other work on the machine changes the figures."""


def parse_sizes(text: str) -> list[int]:
    """The sizes in a text such as `4,8,16`. Raises InputError."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and 1 <= int(part) <= MOST_ROBOTS for part in parts):
        raise InputError(f"--team-sizes {text}: name sizes from 1 to {MOST_ROBOTS}, such as 4,8,16")
    return [int(part) for part in parts]


def measure(
    sizes: Sequence[int],
    seconds: float,
    old: Path | None = None,
    starts: int = STARTS,
    record: bool = False,
) -> Processes:
    """Measures the sizes in this order until the present robots do not keep 10 Hz."""
    load_average = os.getloadavg()[0]
    start = measure_start(starts)
    old_start = None if old is None else measure_start(starts, old)
    measured: list[Size] = []
    for robots in sizes:
        size = Size(
            robots=robots,
            team=measure_team(robots, seconds),
            recorded=measure_team(robots, seconds, record=True) if record else None,
            old=None if old is None else measure_team(robots, seconds, old),
            broadcast=measure_broadcast(robots, seconds),
        )
        measured.append(size)
        if size.team.kept < KEPT:
            break
    return Processes(
        experiment="processes",
        version=version("cpcbl-team"),
        old="" if old is None else str(old),
        seconds=seconds,
        start=start,
        old_start=old_start,
        sizes=measured,
        most_kept=max((s.robots for s in measured if s.team.kept >= KEPT), default=0),
        cores=os.cpu_count() or 1,
        load_average=load_average,
    )


def tables(result: Processes) -> Iterable[RenderableType]:
    """The figures for people."""
    shown = table(
        f"Real processes, {result.seconds:g} s each",
        ("robots", ""),
        ("kept %", "field", "CPU %", "field", "router", "RSS", "PSS", "in /s", "in B/s"),
    )
    for size in result.sizes:
        loads = size.team, size.recorded, size.old, size.broadcast
        for kind, load in zip(("team", "recorded", "old", "broadcast"), loads, strict=True):
            if load is None:
                continue
            shares = (load.kept, load.field_kept, load.cpu, load.cpu_field, load.cpu_router)
            shown.add_row(
                str(size.robots) if load is size.team else "",
                kind,
                *(number(None if share is None else 100.0 * share, 1) for share in shares),
                number(load.resident_mib, 0),
                number(load.proportional_mib, 0),
                number(load.received_hz, 1),
                number(load.received_bytes_s, 0),
            )
    yield shown
    starts = table("One robot, alone", ("",), ("start s", "slowest", "RSS"))
    for name, start in (("team", result.start), ("old", result.old_start)):
        if start is not None:
            figures = number(start.median_s, 2), number(start.slowest_s, 2)
            starts.add_row(name, *figures, number(start.resident_mib, 0))
    yield starts
    yield (
        f"{result.most_kept} robots keep 10 Hz: {KEPT:.0%} of the ticks of the worst robot.\n"
        "CPU (% of a core), memory (MiB) and what is received are means per robot.\n"
        "start: from the start of the process to its liveliness token, median.\n"
        f"{result.cores} cores, load average before: {result.load_average:.1f}"
    )


def main() -> None:
    """Measures, prints tables and writes `processes.json`."""
    parser = argparse.ArgumentParser(prog="bench-processes", description=main.__doc__)
    parser.add_argument("--team-sizes", default="4,8,16,24,32,48,64", help="Sizes of the team.")
    parser.add_argument("--duration", type=float, default=15.0, help="Seconds for each size.")
    parser.add_argument("--record", action="store_true", help="Measure recorded robots, too.")
    parser.add_argument("--old", type=Path, help="Another checkout, measured in the same run.")
    parser.add_argument("--output", type=Path, default=Path("build"), help="Folder for the JSON.")
    given = parser.parse_args()
    require_process_usage("bench-processes")
    try:
        sizes = parse_sizes(given.team_sizes)
    except InputError as error:
        parser.error(str(error))
    result = measure(sizes, given.duration, given.old, record=given.record)
    show_and_write(result, tables(result), given.output / "processes.json")


if __name__ == "__main__":
    main()
