"""The table of `make bench`: `python -m benchmarks.table RAW OUT` reads what pytest-benchmark
wrote to RAW, prints times and ratios, and writes them to OUT as JSON."""

import platform
import sys
from collections import defaultdict
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
from benchmarks.contenders import YARDSTICK
from rich.console import Console
from rich.table import Table

GATED = "float EKF, with gates"
Medians = dict[str, dict[int, float]]


class Row(msgspec.Struct, frozen=True):
    """One contender: medians over the laps, each ratio taken within a lap."""

    name: str
    cycle_us: float
    ratio: float  # to the bare float EKF
    least_ratio: float
    greatest_ratio: float
    ratio_to_gated: float


def medians(raw: dict[str, Any]) -> Medians:
    """Microseconds a cycle: the median of each lap of each contender."""
    found: Medians = defaultdict(dict)
    for one in raw["benchmarks"]:
        info = one["extra_info"]
        found[info["name"]][info["lap"]] = 1e6 * one["stats"]["median"] / info["cycles"]
    return found


def rows(laps: Medians) -> list[Row]:
    """A row a contender, the fastest first."""
    found = []
    for name, own in laps.items():
        ratios = [us / laps[YARDSTICK][lap] for lap, us in own.items()]
        to_gated = median(us / laps[GATED][lap] for lap, us in own.items())
        us = median(own.values())
        found.append(Row(name, us, median(ratios), min(ratios), max(ratios), to_gated))
    return sorted(found, key=lambda row: row.ratio)


def printed(found: list[Row]) -> Table:
    table = Table(title="one cycle: odometry and four landmarks, range and bearing")
    table.add_column("contender")
    for heading in ("µs", "× float EKF", "of laps", "× with gates"):
        table.add_column(heading, justify="right")
    for r in found:
        table.add_row(
            r.name,
            f"{r.cycle_us:.1f}",
            f"{r.ratio:.2f}",
            f"{r.least_ratio:.2f} - {r.greatest_ratio:.2f}",
            f"{r.ratio_to_gated:.2f}",
        )
    return table


def main(raw: Path, out: Path) -> None:
    found = rows(medians(msgspec.json.decode(raw.read_bytes())))
    python = platform.python_version()
    report = {"python": python, "machine": platform.machine(), "rows": found}
    out.write_bytes(msgspec.json.format(msgspec.json.encode(report)))
    Console().print(printed(found))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
