"""Errors of cameras' sightings, compared with the ground truth and with the stated sigmas.

The sightings come from recordings of robots with cameras, or from pictures that were taken at known
poses.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.calibration.logs import (
    GroundTruth,
    RobotLog,
    ground_truth,
    sighting_table,
    wrap_angles,
)
from cpcbl_launch.calibration.sensor import SensorCorrections, all_sighting_rows, calibrate_sensor
from cpcbl_launch.calibration.statistics import (
    MIN_ROWS,
    OUTLIER_SIGMAS,
    Estimate,
    Integers,
    Mask,
    RowFilter,
    jackknife,
    join_rows,
    robust_sigma,
    select_rows,
)
from cpcbl_launch.reporting.files import read_csv
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_team.config import CameraSettings, Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Sightings

BINS_M = (0.0, 2.0, 4.0, math.inf)
MIN_IN_BIN = 10
PICTURE_INTERVAL_S = 100.0  # pictures have no time; at this interval nothing is correlated
STATIONARY_S = 0.1  # before and after a picture nothing moves for this time


class CameraObservations(NamedTuple):
    """The sightings of one robot in one log; `stated` and `headings` match `log.sightings`."""

    log: RobotLog
    stated: Floats
    """(n, 2): sigmas of range (m) and bearing (rad) that the detector states; NaN: none."""
    headings: Floats
    """(n, 3): a teammate's heading in the robot's frame, its sigma, the true one (rad); NaN."""


class CameraDataset(NamedTuple):
    """All sightings of some robots with known ground truth, and their camera."""

    robots: tuple[str, ...]
    camera: CameraSettings
    observations: list[CameraObservations]
    notes: tuple[str, ...] = ()


class _PoseRow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A line of poses: the pose of a robot in a picture; `robot` is empty for the observer."""

    file: str
    x_m: float
    y_m: float
    heading_deg: float
    robot: str = ""


def dataset_from_recordings(paths: Sequence[Path], robot: str | None) -> CameraDataset:
    """The sightings of this robot, or of all with a camera. Raises LogError, InputError."""
    found: list[tuple[str, CameraSettings, CameraObservations]] = []
    for path in paths:
        if path.suffix != ".mcap":
            raise InputError(f"{path}: no recording of `up --record` (.mcap)")
        recording = read_recording(path)
        if not recording.truth:
            raise LogError(f"{path}: holds no truth; publish poses on field/truth")
        truth, team = ground_truth(recording.team.map.landmarks, recording.truth), recording.team
        for name in [robot] if robot else team.cameras:
            frames = [i for i in recording.inputs.get(name, ()) if isinstance(i, Sightings)]
            if frames and len(truth.poses.get(name, ())) > 1:
                if name not in team.robots:
                    names = ", ".join(team.cameras)
                    raise InputError(f"--robot {name}: a guest of {path}; with a camera: {names}")
                camera = replace(team.robots[name].camera, frames="")  # any source of images
                found.append((name, camera, camera_observations(name, frames, truth)))
    if not found:
        who = robot or "robots with cameras"
        raise InputError(f"{paths[0]}: no sightings of {who} where the truth is known")
    robots = tuple(dict.fromkeys(name for name, _, _ in found))
    if len({camera for _, camera, _ in found}) > 1:
        raise InputError(
            f"{', '.join(robots)}: different cameras, which have different errors; name one robot"
            " by --robot, and recordings of one camera"
        )
    return CameraDataset(robots, found[0][1], [observations for _, _, observations in found])


def observer_name(team: Team, robot: str | None) -> str:
    """The named robot, or the only one with a camera. Raises InputError."""
    robots = team.cameras
    if robot is None and len(robots) == 1:
        return robots[0]
    if robot not in robots:
        known = ", ".join(robots) or 'none; write sensing = "camera"'
        raise InputError(f"--robot: name the robot that took the pictures; with a camera: {known}")
    return robot


def dataset_from_pictures(
    folder: Path,
    poses: Path,
    observer: str | None,
    team: Team,
    progress: Callable[[float], None] = lambda done: None,
) -> CameraDataset:
    """The sightings of a robot (default: the only one with a camera) in pictures from known poses.
    Raises InputError. Needs OpenCV."""
    from cpcbl_agents.vision.detector import CameraDetector
    from cpcbl_launch.calibration.pictures import read_picture

    robot, rows = observer_name(team, observer), read_poses(poses, team)
    names = list(dict.fromkeys(row.file for row in rows))
    detector = CameraDetector(robot, team)
    frames: list[Sightings] = []
    rejected: dict[str, str] = {}
    ambiguities: Counter[str] = Counter()
    for i, name in enumerate(names):
        pixels = read_picture(folder / name).pixels
        detections = pixels if isinstance(pixels, str) else detector.detections(pixels)
        if isinstance(detections, str):
            rejected[name] = detections
        else:
            ambiguities.update(ambiguity.reason for ambiguity in detections.ambiguities)
            frames.append(Sightings(_stamp_ns(i), tuple(one.sighting for one in detections.found)))
        progress((i + 1) / len(names))
    if not frames:
        name, reason = next(iter(rejected.items()))
        raise InputError(f"{folder}: no picture can be used: {name}: {reason}")
    truth = ground_truth(team.map.landmarks, _stationary_truth(rows, names, robot))
    notes = [f"{name}: {reason}" for name, reason in rejected.items()]
    if ambiguities:
        reasons = ", ".join(f"{reason} {n}" for reason, n in ambiguities.most_common())
        notes.append(f"detected, but not reported: {reasons}")
    observations = [camera_observations(robot, frames, truth)]
    return CameraDataset((robot,), team.robots[robot].camera, observations, tuple(notes))


def camera_observations(
    robot: str, frames: Iterable[Sightings], truth: GroundTruth
) -> CameraObservations:
    """A robot's sightings as arrays."""
    table = sighting_table(frames, truth.objects)
    at_s, true_headings = table[:, 0], np.full(len(table), math.nan)
    headings = {name: (rows[:, 0], np.unwrap(rows[:, 3])) for name, rows in truth.poses.items()}
    own = np.interp(at_s, *headings[robot])
    for i, name in enumerate(truth.objects):
        if name in headings:
            mine = table[:, 1] == i
            true_headings[mine] = np.interp(at_s[mine], *headings[name]) - own[mine]
    objects = tuple(truth.objects.values())
    log = RobotLog(truth.poses[robot], np.empty((0, 4)), table[:, :4], objects, truth.teammates)
    relative = np.column_stack([table[:, 6:], wrap_angles(true_headings)])
    return CameraObservations(log, table[:, 4:6], relative)


def read_poses(path: Path, team: Team) -> list[_PoseRow]:
    """Reads a CSV file: file, x_m, y_m, heading_deg, and robot for teammates. Raises InputError."""
    rows = read_csv(path, _PoseRow, "--poses")
    for row in rows:
        if row.robot and row.robot not in team.robots:
            known = ", ".join(team.robots)
            raise InputError(f"--poses {path}: no robot {row.robot!r} in the team; known: {known}")
    return rows


def _stamp_ns(picture: int) -> int:
    return int((picture + 1) * PICTURE_INTERVAL_S * 1e9)


def _stationary_truth(
    rows: Sequence[_PoseRow], names: Sequence[str], observer_name: str
) -> dict[str, Floats]:
    """The poses as those of a log in which all robots stand still while a picture is taken."""
    truth: dict[str, list[tuple[float, float, float, float]]] = {observer_name: []}
    for row in rows:
        at = _stamp_ns(names.index(row.file)) * 1e-9
        pose = row.x_m, row.y_m, math.radians(row.heading_deg)
        log = truth.setdefault(row.robot or observer_name, [])
        log += [(at - STATIONARY_S, *pose), (at + STATIONARY_S, *pose)]
    return {name: np.array(sorted(log)) for name, log in truth.items()}


class ErrorStatistics(msgspec.Struct, frozen=True):
    """The errors of one kind of reading, compared with the stated sigmas."""

    bias: float
    sigma: float
    """About the bias."""
    inside_3_sigma: float | None
    """Share of the errors within three of the stated sigmas; None if none are stated."""
    times: float | None
    """The errors as a multiple of the stated sigmas (RMS without outliers)."""


class AccuracyRow(msgspec.Struct, frozen=True):
    """Errors of sightings of one kind in one span of ranges, before any correction. Errors of
    ranges are shares of the range, those of bearings and headings are in degrees."""

    kind: str
    from_m: float
    to_m: float | None
    sightings: int
    range_share: ErrorStatistics | None
    bearing_deg: ErrorStatistics | None
    heading_deg: ErrorStatistics | None


class CameraAccuracy(msgspec.Struct, frozen=True):
    """What `calibrate sensor --json` writes."""

    agreements: tuple[AccuracyRow, ...]
    sensor: dict[str, Estimate]
    """Named as in `SensorSettings`; values that were not determined are missing."""
    range_is_depth: bool
    times: Estimate | None
    """The factor from the stated sigmas to the errors that are left after correction."""


class _ErrorRows(NamedTuple):
    """Errors of sightings with known ground truth, and the stated sigmas. Both have columns for
    range (m), bearing and heading (rad); NaN: no such reading."""

    stretch: Integers
    teammate: Mask
    true_range: Floats
    errors: Floats
    sigmas: Floats


def measure_camera_accuracy(observations: Sequence[CameraObservations]) -> CameraAccuracy:
    """The errors of a camera's sightings. Raises InputError with too few of them."""
    rows = _error_rows(observations, SensorCorrections())
    if len(rows.stretch) < MIN_ROWS:
        raise InputError(
            f"{len(rows.stretch)} sightings with known truth; at least {MIN_ROWS} are needed:"
            " more pictures or a longer drive, near and far, all over the picture"
        )
    values, fit = calibrate_sensor([observed.log for observed in observations])
    corrections = SensorCorrections() if fit is None else fit.after
    times = _remaining_error_factor(_error_rows(observations, corrections))
    return CameraAccuracy(tuple(_accuracy_rows(rows)), values, corrections.is_depth, times)


def _error_rows(observations: Sequence[CameraObservations], now: SensorCorrections) -> _ErrorRows:
    """Corrected minus true readings."""
    parts = []
    for i, observed in enumerate(observations):
        rows = all_sighting_rows(observed.log, i, now.delay_s)
        heading, heading_sigma, true_heading = observed.headings.T
        heading_error = wrap_angles(heading - true_heading)
        errors = np.column_stack([now.range_errors(rows), now.bearing_errors(rows), heading_error])
        sigmas = np.column_stack([observed.stated, heading_sigma])
        part = _ErrorRows(rows.stretch, rows.teammate, rows.true_range, errors, sigmas)
        parts.append(select_rows(part, rows.true_range > 0.05))
    return join_rows(parts)


def _accuracy_rows(rows: _ErrorRows) -> list[AccuracyRow]:
    """One row for all sightings of a kind, then one for each span of ranges."""
    found = []
    for kind, mine in (("landmarks", ~rows.teammate), ("teammates", rows.teammate)):
        for i, (low, high) in enumerate([(0.0, math.inf), *pairwise(BINS_M)]):
            part = select_rows(rows, mine & (rows.true_range >= low) & (rows.true_range < high))
            if (n := len(part.stretch)) >= (MIN_IN_BIN if i else 1):
                to_m = None if high == math.inf else high
                found.append(AccuracyRow(kind, low, to_m, n, *_error_statistics(part)))
    return found


def _error_statistics(rows: _ErrorRows) -> Iterator[ErrorStatistics | None]:
    """Of ranges, bearings and headings, in the units of `AccuracyRow`."""
    in_units = (rows.true_range, 1.0), (1.0, math.degrees(1.0)), (1.0, math.degrees(1.0))
    for errors, sigmas, (divisor, unit) in zip(rows.errors.T, rows.sigmas.T, in_units, strict=True):
        there = np.isfinite(errors)
        if not there.any():
            yield None
            continue
        error, sigma = (errors / divisor)[there], (sigmas / divisor)[there]
        stated = np.isfinite(sigma) & (sigma > 0.0)
        unitless = error[stated] / sigma[stated]
        yield ErrorStatistics(
            unit * float(error.mean()),
            unit * float(error.std()),
            float((np.abs(unitless) <= 3.0).mean()) if stated.any() else None,
            _rms_without_outliers(unitless) if stated.any() else None,
        )


def _rms_without_outliers(unitless: Floats) -> float:
    """The root mean square without outliers, which are not noise."""
    usual = unitless[np.abs(unitless) < OUTLIER_SIGMAS * robust_sigma(unitless)]
    return math.sqrt(float((usual * usual).mean())) if len(usual) else 0.0


def _remaining_error_factor(rows: _ErrorRows) -> Estimate | None:
    """The factor for ranges or for bearings, whichever is larger."""
    if not np.isfinite(rows.sigmas[:, :2]).any():
        return None
    in_sigmas = (rows.errors / rows.sigmas)[:, :2].T

    def largest(keep: RowFilter) -> Floats:
        some = keep(rows.stretch)
        return np.array([max(_rms_without_outliers(e[some & np.isfinite(e)]) for e in in_sigmas)])

    (times,) = jackknife(largest, rows.stretch)
    return times
