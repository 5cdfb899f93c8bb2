"""Logs with ground truth as arrays: MRCLAM folders and recordings of `up --record`."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cpcbl_agents.sources import mrclam
from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.calibration.statistics import Mask
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_team.config import Landmark
from cpcbl_team.inputs import Odometry, Sightings

LONGEST_GAP_S = 1.0  # truth is interpolated only between rows that are at most so far apart


class RobotLog(NamedTuple):
    """What one robot reported in one log, and the true poses. Seconds, m, rad."""

    truth: Floats  # (n, 4): s, x, y, heading
    odometry: Floats  # (n, 4): from s, until s, distance, turn
    sightings: Floats  # (n, 4): stamp s, object (index of `objects`), range, bearing; NaN: none
    objects: tuple[Floats, ...]  # the truth of each as (n, 3): s, x, y; one row: it does not move
    teammates: frozenset[int] = frozenset()  # those of `objects` that are robots


RobotLogs = dict[str, list[RobotLog]]


def has_truth_at(stamps: Floats, times_s: Floats) -> Mask:
    """Whether times lie between rows of truth that are at most LONGEST_GAP_S apart."""
    after = np.searchsorted(stamps, times_s)
    inside = (after > 0) & (after < len(stamps))
    after = np.clip(after, 1, len(stamps) - 1)
    return inside & (stamps[after] - stamps[after - 1] <= LONGEST_GAP_S)


def wrap_angles(angles: Floats) -> Floats:
    """Angles (n,) in [-pi, pi), rad."""
    return np.asarray((angles + math.pi) % math.tau - math.pi)


def read_logs(paths: Sequence[Path]) -> RobotLogs:
    """The parts of all logs, by robot. Raises LogError."""
    logs: RobotLogs = {}
    for path in paths:
        for name, log in read_log(path).items():
            logs.setdefault(name, []).append(log)
    return dict(sorted(logs.items()))


def read_log(path: Path) -> dict[str, RobotLog]:
    """The robots of an MRCLAM folder, or of a recording of `up --record`. Raises LogError."""
    return _read_recording(path) if path.suffix == ".mcap" else _read_mrclam(path)


def _read_mrclam(folder: Path) -> dict[str, RobotLog]:
    names = mrclam.robots_in(folder)
    if not names:
        missing = ", ".join(mrclam.missing_files(folder, mrclam.ROBOTS[0]))
        raise LogError(f"{folder}: no robot has all files; robot 1 lacks {missing}")
    subjects = {int(b): str(int(s)) for s, b in mrclam.read_table(folder / "Barcodes.dat", 2)}
    truth = {name: mrclam.read_truth(folder, name) for name in names}
    measured = {n: mrclam.read_table(folder / f"Robot{n}_Measurement.dat", 4) for n in names}
    frames = {name: mrclam.frames(rows, subjects, name) for name, rows in measured.items()}
    odometry = {name: mrclam.read_odometry(folder, name) for name in names}
    return _robot_logs(mrclam.read_landmarks(folder), truth, odometry, frames)


def _read_recording(path: Path) -> dict[str, RobotLog]:
    recorded = read_recording(path)
    if not recorded.truth:
        raise LogError(
            f"{path}: holds no truth; record a simulated team, or publish poses on field/truth"
        )
    inputs = recorded.inputs
    odometry = {n: [i for i in items if isinstance(i, Odometry)] for n, items in inputs.items()}
    frames = {n: [i for i in items if isinstance(i, Sightings)] for n, items in inputs.items()}
    return _robot_logs(recorded.team.map.landmarks, recorded.truth, odometry, frames)


def _robot_logs(
    landmarks: Mapping[str, Landmark],
    truth: Mapping[str, Floats],
    odometry: Mapping[str, Iterable[Odometry]],
    frames: Mapping[str, Iterable[Sightings]],
) -> dict[str, RobotLog]:
    """The arrays of every robot with ground truth."""
    truth, objects, teammates = ground_truth(landmarks, truth)
    logs = {}
    for name, rows in truth.items():
        if len(rows) > 1:
            motion = _odometry_rows(odometry.get(name, ()))
            seen = sighting_table(frames.get(name, ()), objects)
            logs[name] = RobotLog(rows, motion, seen[:, :4], tuple(objects.values()), teammates)
    return logs


class GroundTruth(NamedTuple):
    """True poses of the robots, each stamp once, and true positions of all objects."""

    poses: dict[str, Floats]
    objects: dict[str, Floats]
    teammates: frozenset[int]


def ground_truth(landmarks: Mapping[str, Landmark], truth: Mapping[str, Floats]) -> GroundTruth:
    """The landmarks and robots as `objects` and `teammates` of a `RobotLog`."""
    poses = {n: rows[np.unique(rows[:, 0], return_index=True)[1]] for n, rows in truth.items()}
    objects = {name: np.array([[0.0, mark.x_m, mark.y_m]]) for name, mark in landmarks.items()}
    objects |= {name: rows[:, :3] for name, rows in poses.items()}
    return GroundTruth(poses, objects, frozenset(i for i, n in enumerate(objects) if n in poses))


def _odometry_rows(odometry: Iterable[Odometry]) -> Floats:
    rows = [(o.from_ns * 1e-9, o.stamp_ns * 1e-9, o.distance_m, o.turn_rad) for o in odometry]
    table = np.array(sorted(rows)).reshape(-1, 4)
    ends = np.maximum.accumulate(table[:, 1]) if len(table) else table[:, 1]
    return table[np.concatenate(([True], table[1:, 0] > ends[:-1] - 1e-6))[: len(table)]]


def sighting_table(frames: Iterable[Sightings], objects: Iterable[str]) -> Floats:
    """The sightings of these objects (n, 8): stamp s, index of the object, range, bearing, sigmas
    of both, heading of the object, its sigma; NaN: none."""
    number = {name: i for i, name in enumerate(objects)}
    rows = [
        (
            *(frame.stamp_ns * 1e-9, number[s.id], s.range_m, s.bearing_rad),
            *(s.range_sigma_m, s.bearing_sigma_rad, s.heading_rad, s.heading_sigma_rad),
        )
        for frame in frames
        for s in frame.sightings
        if s.id in number
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 8)
