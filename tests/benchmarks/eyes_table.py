"""The second table of `make bench`: `python -m benchmarks.eyes_table RAW OUT` reads what
pytest-benchmark wrote to RAW, prints times and ratios, and writes them to OUT as JSON."""

import platform
import sys
from pathlib import Path
from statistics import median

import cv2
import msgspec
from benchmarks.table import Medians, medians
from benchmarks.viewers import YARDSTICK
from rich.console import Console
from rich.table import Table


class Row(msgspec.Struct, frozen=True):
    """One viewer: medians over the laps, each ratio taken within a lap."""

    name: str
    frame_ms: float
    ratio: float  # to OpenCV's marker detection
    least_ratio: float
    greatest_ratio: float


def rows(laps: Medians) -> list[Row]:
    """A row a viewer."""
    found = []
    for name, own in laps.items():
        ratios = [us / laps[YARDSTICK][lap] for lap, us in own.items()]
        ms = 1e-3 * median(own.values())
        found.append(Row(name, ms, median(ratios), min(ratios), max(ratios)))
    return found


def printed(found: list[Row]) -> Table:
    table = Table(title="one frame of 640 x 480: landmarks and teammates")
    table.add_column("viewer")
    for heading in ("ms", "× OpenCV's markers", "of laps"):
        table.add_column(heading, justify="right")
    for r in found:
        spread = f"{r.least_ratio:.2f} - {r.greatest_ratio:.2f}"
        table.add_row(r.name, f"{r.frame_ms:.2f}", f"{r.ratio:.2f}", spread)
    return table


def main(raw: Path, out: Path) -> None:
    found = rows(medians(msgspec.json.decode(raw.read_bytes())))
    versions = {"python": platform.python_version(), "opencv": cv2.__version__}
    report = {**versions, "machine": platform.machine(), "rows": found}
    out.write_bytes(msgspec.json.format(msgspec.json.encode(report)))
    Console().print(printed(found))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
