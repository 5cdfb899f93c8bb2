"""Logs of the UTIAS multi-robot cooperative localization and mapping dataset (MRCLAM).

K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, IJRR 30(8), 2011. Text files, `#` starts a
comment, Unix seconds, metres, radians. A sighting names a barcode; subjects 1-5 are the robots.
"""

import warnings
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cpcbl_team.config import Landmark
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Odometry, Sighting, Sightings

LONGEST_PIECE_NS = 100_000_000
LONGEST_GAP_S = 3600.0
LARGEST, LATEST_S = 1e6, 4e9  # of numbers (m, rad, ...) and of times: nothing real is beyond
WHERE = "asrl.utias.utoronto.ca/datasets/mrclam"
ROBOTS = ("1", "2", "3", "4", "5")


class LogError(InputError):
    """A log that is not there or cannot be read; says which file and why."""


def read_table(path: Path, columns: int) -> NDArray[np.float64]:
    """The rows of a log file, sorted by their first column. Raises LogError."""
    if not path.is_file():
        raise LogError(f"{path}: not found (get the data at {WHERE})")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy only warns of an empty file
            table = np.loadtxt(path, ndmin=2)
    except (ValueError, UserWarning, OSError) as error:
        raise LogError(f"{path}: {error}") from error
    if table.shape[1] != columns:
        raise LogError(f"{path}: {table.shape[1]} columns; there must be {columns}")
    if not np.isfinite(table).all():
        row = int(np.argmin(np.isfinite(table).all(axis=1)))
        raise LogError(f"{path}: row {row + 1} has a number that is not finite")
    is_large = np.abs(table) > np.array([LATEST_S] + [LARGEST] * (columns - 1))
    if is_large.any():
        row, column = (int(i) for i in np.argwhere(is_large)[0])
        raise LogError(
            f"{path}: row {row + 1}, column {column + 1}: {table[row, column]:g} is out of range;"
            " write seconds, metres and radians"
        )
    return table[np.argsort(table[:, 0], kind="stable")]


def read_log(path: Path, columns: int) -> NDArray[np.float64]:
    """The same, of a table whose first column is a time. Raises LogError: after a stamp of
    another epoch, such as 0, a replay would wait for years."""
    table = read_table(path, columns)
    gaps = np.diff(table[:, 0])
    if len(gaps) and gaps.max() > LONGEST_GAP_S:
        row = int(np.argmax(gaps))
        before, after = table[row, 0], table[row + 1, 0]
        raise LogError(
            f"{path}: the time jumps from {before:.3f} to {after:.3f} s; remove the rows before or"
            " after that"
        )
    return table


def robots_in(folder: Path) -> list[str]:
    """The robots of a log of which all files are there (truth included). Raises LogError."""
    if not (folder / "Barcodes.dat").is_file():
        raise LogError(f"{folder}: no MRCLAM log here (get the data at {WHERE})")
    return [r for r in ROBOTS if not missing_files(folder, r)]


def missing_files(folder: Path, robot: str) -> list[str]:
    """The names of the files of a robot that a log lacks."""
    names = [f"Robot{robot}_{kind}.dat" for kind in ("Odometry", "Measurement")]
    missing = [name for name in names if not (folder / name).is_file()]
    return missing if _truth_file(folder, robot) else [*missing, f"Robot{robot}_Groundtruth.dat"]


def read_landmarks(folder: Path) -> dict[str, Landmark]:
    """The map: landmarks by subject number."""
    table = read_table(folder / "Landmark_Groundtruth.dat", 5)
    return {str(int(subject)): Landmark(x_m=x, y_m=y) for subject, x, y, _, _ in table.tolist()}


def read_truth(folder: Path, robot: str) -> NDArray[np.float64]:
    """Ground truth, shape (n, 4): seconds, x, y, heading. Recovered where there is no original."""
    path = _truth_file(folder, robot)
    return read_log(path or folder / f"Robot{robot}_Groundtruth.dat", 4)


def _truth_file(folder: Path, robot: str) -> Path | None:
    names = (f"Robot{robot}_Groundtruth.dat", f"Robot{robot}_Groundtruth_recovered.dat")
    return next((folder / name for name in names if (folder / name).is_file()), None)


def odometry_span_ns(folder: Path, robot: str) -> tuple[int, int]:
    """(first, last) stamp of a robot's odometry."""
    table = read_log(folder / f"Robot{robot}_Odometry.dat", 3)
    return _ns(table[0, 0]), _ns(table[-1, 0])


def _ns(seconds: float) -> int:
    return round(seconds * 1e3) * 1_000_000  # the files have whole milliseconds


def read_odometry(folder: Path, robot: str) -> Iterator[Odometry]:
    """A command holds until the next one; equal commands in a row make one piece of up to 0.1 s."""
    table = read_log(folder / f"Robot{robot}_Odometry.dat", 3)
    rows = [(_ns(t), v, w) for t, v, w in table.tolist()]
    from_ns, speed, turn_rate = rows[0]
    for stamp_ns, next_speed, next_turn_rate in rows[1:]:
        same = next_speed == speed and next_turn_rate == turn_rate
        if stamp_ns <= from_ns or (same and stamp_ns - from_ns < LONGEST_PIECE_NS):
            continue
        seconds = (stamp_ns - from_ns) * 1e-9
        yield Odometry(from_ns, stamp_ns, speed * seconds, turn_rate * seconds)
        from_ns, speed, turn_rate = stamp_ns, next_speed, next_turn_rate


def frames(table: NDArray[np.float64], names: dict[int, str], robot: str) -> Iterator[Sightings]:
    """The sightings of each time; a barcode that nobody carries keeps its number."""
    for stamp_ns, rows in groupby(table.tolist(), key=lambda row: _ns(row[0])):
        named = ((names.get(int(row[1]), f"barcode-{int(row[1])}"), row) for row in rows)
        seen = tuple(Sighting(name, row[2], row[3]) for name, row in named if name != robot)
        if seen:
            yield Sightings(stamp_ns, seen)


class MrclamSource:
    """Replays one robot's log in the log's own time. Raises LogError."""

    def __init__(self, folder: Path, robot: str) -> None:
        barcodes = read_table(folder / "Barcodes.dat", 2)
        names = {int(barcode): str(int(subject)) for subject, barcode in barcodes.tolist()}
        odometry = read_odometry(folder, robot)
        seen = frames(read_log(folder / f"Robot{robot}_Measurement.dat", 4), names, robot)
        items: list[Odometry | Sightings] = [*odometry, *seen]
        items.sort(key=lambda item: item.stamp_ns)
        self.first_ns = next((i.from_ns for i in items if isinstance(i, Odometry)), 0)
        self._items = [i for i in items if i.stamp_ns >= self.first_ns]
        self._next = 0

    @property
    def next_ns(self) -> int | None:
        return self._items[self._next].stamp_ns if self._next < len(self._items) else None

    @property
    def is_finished(self) -> bool:
        return self._next == len(self._items)

    def poll(self, now_ns: int) -> Sequence[Odometry | Sightings]:
        first = self._next
        self._next = bisect_right(self._items, now_ns, lo=first, key=lambda item: item.stamp_ns)
        return self._items[first : self._next]
