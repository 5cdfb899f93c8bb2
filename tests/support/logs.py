"""Writes a small log in the format of MRCLAM from an exact simulation without noise.

Robots drive squares: straight ahead or turning on the spot, so that sums of commands are exact.
"""

import math
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.geometry import Pose2, step

EPOCH_MS = 1_200_000_000_000
STEP_MS = 20
FRAME_MS = 200
SIGHT_M = 5.0
UNKNOWN_BARCODE = 99
BARCODES = {"1": 5, "2": 14, "3": 41, "4": 32, "5": 23, "6": 63, "7": 25, "8": 45, "9": 16}
LANDMARKS = {"6": (0.0, 0.0), "7": (4.0, 0.0), "8": (4.0, 3.0), "9": (0.0, 3.0)}
STARTS = {
    "1": Pose2(1.0, 1.0, 0.0),
    "2": Pose2(3.0, 2.0, math.pi),
    "3": Pose2(1.0, 2.5, -1.0),
    "4": Pose2(2.0, 0.5, 2.0),
    "5": Pose2(3.5, 1.0, 1.0),
}
Row = tuple[float, ...]


class Log(NamedTuple):
    """What was written: the true poses by robot and milliseconds."""

    folder: Path
    truth: dict[str, dict[int, Pose2]]

    def pose(self, robot: str, stamp_ns: int) -> Pose2:
        return self.truth[robot][stamp_ns // 1_000_000]


def write_log(
    folder: Path,
    robots: Sequence[str] = ("1", "2"),
    seconds: float = 10.0,
    *,
    recovered: Collection[str] = (),
    backwards: bool = False,
    unknown_barcode: bool = False,
) -> Log:
    """A log of these robots; the files of the others are missing.

    `recovered`: robots whose truth is in the recovered form. `backwards`: some stamps go back.
    `unknown_barcode`: each frame also has a barcode that nobody carries.
    """
    folder.mkdir(parents=True, exist_ok=True)
    times = range(EPOCH_MS, EPOCH_MS + round(seconds * 1000) + 1, STEP_MS)
    truth = {robot: _driven(robot, times) for robot in robots}
    _write(folder / "Barcodes.dat", "Subject Barcode", [(int(s), b) for s, b in BARCODES.items()])
    marks = [(int(s), x, y, 0.001, 0.001) for s, (x, y) in LANDMARKS.items()]
    _write(folder / "Landmark_Groundtruth.dat", "Subject x [m] y [m] sigma x sigma y", marks)
    for robot in robots:
        stem = folder / f"Robot{robot}"
        commands: list[Row] = [(at * 1e-3, *_command(robot, at, times[-1])) for at in times]
        seen = _seen(robot, truth, unknown_barcode)
        if backwards:
            commands, seen = _shuffled(commands), _shuffled(seen)
        _write(Path(f"{stem}_Odometry.dat"), "Time [s] v [m/s] w [rad/s]", commands)
        _write(Path(f"{stem}_Measurement.dat"), "Time [s] barcode range bearing", seen)
        kind = "Groundtruth_recovered" if robot in recovered else "Groundtruth"
        rows = [(at * 1e-3, *pose) for at, pose in truth[robot].items()]
        _write(Path(f"{stem}_{kind}.dat"), "Time [s] x [m] y [m] orientation [rad]", rows)
    return Log(folder, truth)


def log_team(*robots: str) -> Team:
    return Team(name="log", robots={r: RobotSettings(source="mrclam") for r in robots})


def _command(robot: str, at_ms: int, end_ms: int) -> tuple[float, float]:
    """(speed, turn rate): two seconds ahead, one turning left; standing at the end."""
    phase = (at_ms - EPOCH_MS + 340 * int(robot)) % 3000
    if at_ms >= end_ms - 500:
        return 0.0, 0.0
    return (0.0, 1.5) if phase >= 2000 else (0.4, 0.0)


def _driven(robot: str, times: range) -> dict[int, Pose2]:
    pose = STARTS[robot]
    poses = {}
    for at in times:
        poses[at] = pose
        speed, turn_rate = _command(robot, at, times[-1])
        pose = step(pose, speed * STEP_MS * 1e-3, turn_rate * STEP_MS * 1e-3)
    return poses


def _seen(robot: str, truth: dict[str, dict[int, Pose2]], unknown_barcode: bool) -> list[Row]:
    rows: list[Row] = []
    for at, pose in truth[robot].items():
        if (at - EPOCH_MS) % FRAME_MS:
            continue
        others = {name: (p[at].x, p[at].y) for name, p in truth.items() if name != robot}
        for name, place in {**LANDMARKS, **others}.items():
            x, y = pose.inverse().transform(*place)
            if math.hypot(x, y) <= SIGHT_M:
                rows.append((at * 1e-3, BARCODES[name], math.hypot(x, y), math.atan2(y, x)))
        if unknown_barcode:
            rows.append((at * 1e-3, UNKNOWN_BARCODE, 1.0, 0.0))
    return rows


def _shuffled(rows: list[Row]) -> list[Row]:
    """Every tenth time of stamping comes before the one that it follows."""
    stamps = sorted({row[0] for row in rows})
    for i in range(1, len(stamps), 10):
        stamps[i - 1], stamps[i] = stamps[i], stamps[i - 1]
    place = {stamp: i for i, stamp in enumerate(stamps)}
    return sorted(rows, key=lambda row: place[row[0]])


def _write(path: Path, header: str, rows: Iterable[Row]) -> None:
    lines = ["# synthetic, without noise", f"# {header}"]
    lines += ["\t".join([_number(row[0]), *(repr(v) for v in row[1:])]) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.3f}"
