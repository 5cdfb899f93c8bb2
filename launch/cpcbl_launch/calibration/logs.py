"""Logs with truth, read into arrays: MRCLAM folders and recordings of `up --record`."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cpcbl_agents.sources import mrclam
from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.calibration.robot_log import RobotLog
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.recording import read_recording
from cpcbl_team.config import Landmark
from cpcbl_team.inputs import Odometry, Sightings

RobotLogs = dict[str, list[RobotLog]]


def read_logs(paths: Sequence[Path]) -> RobotLogs:
    """By robot its part of every log. Raises LogError."""
    logs: RobotLogs = {}
    for path in paths:
        for name, log in read_log(path).items():
            logs.setdefault(name, []).append(log)
    return dict(sorted(logs.items()))


def read_log(path: Path) -> dict[str, RobotLog]:
    """The robots of an MRCLAM folder, or of a recording of `up --record`. Raises LogError."""
    return _recorded(path) if path.suffix == ".mcap" else _mrclam(path)


def _mrclam(folder: Path) -> dict[str, RobotLog]:
    names = mrclam.robots_in(folder)
    if not names:
        missing = ", ".join(mrclam.missing_files(folder, mrclam.ROBOTS[0]))
        raise LogError(f"{folder}: no robot has all files; robot 1 lacks {missing}")
    subjects = {int(b): str(int(s)) for s, b in mrclam.read_table(folder / "Barcodes.dat", 2)}
    truth = {name: mrclam.read_truth(folder, name) for name in names}
    frames = {
        name: mrclam.frames(
            mrclam.read_table(folder / f"Robot{name}_Measurement.dat", 4), subjects, name
        )
        for name in names
    }
    odometry = {name: mrclam.read_odometry(folder, name) for name in names}
    return _logs(mrclam.read_landmarks(folder), truth, odometry, frames)


def _recorded(path: Path) -> dict[str, RobotLog]:
    recorded = read_recording(path)
    if not recorded.truth:
        raise LogError(
            f"{path}: holds no truth; record a simulated team, or publish poses on field/truth"
        )
    inputs = recorded.inputs
    odometry = {n: [i for i in said if isinstance(i, Odometry)] for n, said in inputs.items()}
    frames = {n: [i for i in said if isinstance(i, Sightings)] for n, said in inputs.items()}
    return _logs(recorded.team.map.landmarks, recorded.truth, odometry, frames)


def _logs(
    landmarks: Mapping[str, Landmark],
    truth: Mapping[str, Floats],
    odometry: Mapping[str, Any],
    frames: Mapping[str, Any],
) -> dict[str, RobotLog]:
    """Arrays of what was read, for every robot with truth."""
    truth, objects, teammates = placed(landmarks, truth)
    number = {name: i for i, name in enumerate(objects)}
    return {
        name: RobotLog(
            rows,
            _pieces(odometry.get(name, ())),
            _sightings(frames.get(name, ()), number),
            tuple(objects.values()),
            teammates,
        )
        for name, rows in truth.items()
        if len(rows) > 1
    }


class Placed(NamedTuple):
    """Where everything truly was: the robots' poses, each stamp once, and all that can be seen."""

    truth: dict[str, Floats]
    objects: dict[str, Floats]
    teammates: frozenset[int]


def placed(landmarks: Mapping[str, Landmark], truth: Mapping[str, Floats]) -> Placed:
    """Landmarks and robots as `RobotLog` has them: `objects` and `teammates`."""
    truth = {
        name: rows[np.unique(rows[:, 0], return_index=True)[1]] for name, rows in truth.items()
    }
    places = {name: np.array([[0.0, mark.x_m, mark.y_m]]) for name, mark in landmarks.items()}
    places |= {name: rows[:, :3] for name, rows in truth.items()}
    number = {name: i for i, name in enumerate(places)}
    return Placed(truth, places, frozenset(number[name] for name in truth))


def _pieces(odometry: Any) -> Floats:
    rows = [(o.from_ns * 1e-9, o.stamp_ns * 1e-9, o.distance_m, o.turn_rad) for o in odometry]
    table = np.array(sorted(rows)).reshape(-1, 4)
    ends = np.maximum.accumulate(table[:, 1]) if len(table) else table[:, 1]
    return table[np.concatenate(([True], table[1:, 0] > ends[:-1] - 1e-6))[: len(table)]]


def _sightings(frames: Any, number: Mapping[str, int]) -> Floats:
    def given(value: float | None) -> float:
        return math.nan if value is None else value

    rows = [
        (frame.stamp_ns * 1e-9, number[s.id], given(s.range_m), given(s.bearing_rad))
        for frame in frames
        for s in frame.sightings
        if s.id in number
    ]
    return np.array(rows, dtype=float).reshape(-1, 4)
