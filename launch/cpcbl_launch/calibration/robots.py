"""`cpcbl-team calibrate`: logs with truth in, robot types of a team file out."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomlkit
from tomlkit.items import Table
from tomlkit.toml_document import TOMLDocument

from cpcbl_agents.sources import mrclam
from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.calibration import odometry, sensor
from cpcbl_launch.calibration.robot_log import RobotLog
from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_launch.recording import read_recording
from cpcbl_launch.team_file import TeamFileError, builtin, parse_team
from cpcbl_team.config import Landmark
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_team.metrics import Floats

MARGIN = 0.5
INTERVAL_S = 0.5  # with correlation_s known, using an object more often tells little
LEAST = {  # what is written at least: without any noise a filter would believe without bounds
    "odometry.delay_s": 0.0,
    "distance_loss_m_per_rad": 0.0,
    "distance_sigma_m_per_sqrt_m": 1e-3,
    "turn_sigma_rad_per_sqrt_rad": 1e-3,
    "turn_sigma_rad_per_sqrt_m": 1e-3,
    "range_floor_m": 1e-3,
    "bearing_sigma_deg": 0.01,
}


class RobotCalibration(msgspec.Struct, frozen=True):
    """What the logs say of one robot; a value that they do not tell is missing, with a note."""

    odometry: dict[str, Estimate]
    sensor: dict[str, Estimate]
    notes: tuple[str, ...] = ()
    range_is_depth: bool = False


class Calibration(msgspec.Struct, frozen=True):
    """What `calibrate --json` writes."""

    logs: tuple[str, ...]
    robots: dict[str, RobotCalibration]


RobotLogs = dict[str, list[RobotLog]]


# Logs -------------------------------------------------------------------------------------------


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
    truth = {
        name: rows[np.unique(rows[:, 0], return_index=True)[1]] for name, rows in truth.items()
    }
    places = {name: np.array([[0.0, mark.x_m, mark.y_m]]) for name, mark in landmarks.items()}
    places |= {name: rows[:, :3] for name, rows in truth.items()}
    number = {name: i for i, name in enumerate(places)}
    teammates = frozenset(number[name] for name in truth)
    return {
        name: RobotLog(
            rows,
            _pieces(odometry.get(name, ())),
            _sightings(frames.get(name, ()), number),
            tuple(places.values()),
            teammates,
        )
        for name, rows in truth.items()
        if len(rows) > 1
    }


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


# Estimates --------------------------------------------------------------------------------------


def read_logs(paths: Sequence[Path]) -> RobotLogs:
    """By robot its part of every log. Raises LogError."""
    logs: RobotLogs = {}
    for path in paths:
        for name, log in read_log(path).items():
            logs.setdefault(name, []).append(log)
    return dict(sorted(logs.items()))


def calibrated(
    logs: RobotLogs, names: Sequence[str], progress: Callable[[float], None] = lambda done: None
) -> Calibration:
    """All robots of the logs with these names, each over all its logs. Raises ValueError."""
    robots = {}
    for i, (robot, parts) in enumerate(logs.items()):
        robots[robot] = calibrated_robot(parts)
        progress((i + 1) / len(logs))
    if not any(robot.odometry or robot.sensor for robot in robots.values()):
        raise ValueError(
            f"{', '.join(names)}: nothing to calibrate: no robot drives, and none sees landmarks or"
            " robots where the truth is known"
        )
    return Calibration(tuple(names), robots)


def calibrated_robot(logs: Sequence[RobotLog]) -> RobotCalibration:
    """One robot, from all its logs."""
    driving = odometry.calibrate_odometry(logs)
    seeing, is_depth = sensor.calibrate_sensor(logs)
    notes = []
    if not driving:
        notes.append("does not drive: odometry stays as it is")
    if not seeing:
        notes.append("sees too little where truth is known: the sensor stays as it is")
    if is_depth:
        notes.append("ranges are depths along the optical axis")
    axis = () if is_depth else ("optical_axis_deg",)
    for part, found, names in (
        ("odometry", driving, (*odometry.CORRECTIONS, *odometry.NOISE)),
        ("sensor", seeing, (*sensor.CORRECTIONS, *sensor.NOISE, "correlation_s")),
    ):
        missing = [name for name in names if name not in found and name not in axis]
        if found and missing:
            notes.append(f"not told by the logs: {part} {', '.join(missing)}")
    return RobotCalibration(driving, seeing, tuple(notes), is_depth)


# Team file --------------------------------------------------------------------------------------


def base_text(logs: Sequence[Path], team_file: Path | None) -> tuple[str, str]:
    """The team file to add types to, and what to call it: the given one (or a built-in one by its
    name), the recorded team, or the built-in mrclam-uncalibrated. Raises TeamFileError, LogError.
    """
    if team_file is None and logs[0].suffix == ".mcap":
        return tomlkit.dumps(changed_keys(read_recording(logs[0]).team)), str(logs[0])
    path = team_file or builtin("mrclam-uncalibrated")
    if not path.exists() and builtin(path.name).exists():
        path = builtin(path.name)
    try:
        return path.read_text(encoding="utf-8"), str(path)
    except (OSError, UnicodeDecodeError) as error:
        raise TeamFileError(f"{path}: cannot be read: {error}") from error


def changed_keys(settings: msgspec.Struct) -> dict[str, Any]:
    """The keys of a settings struct that are not at their default, deeply, as plain data."""
    result = {}
    for field in msgspec.structs.fields(settings):
        value = getattr(settings, field.name)
        if field.required or value != field.default:
            result[field.name] = _plain(value)
    return result


def _plain(value: Any) -> Any:
    if isinstance(value, msgspec.Struct):
        return changed_keys(value)
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    return msgspec.to_builtins(value)


def team_text(
    calibration: Calibration, base: str, name: str = "team file", margin: float = MARGIN
) -> str:
    """The base team file with a type for each calibrated robot. Raises TeamFileError, ValueError.

    A robot's former type goes into its new one; keys of its own that were calibrated are taken out.
    `margin`: all sigmas are written larger by this share, and this share of each correction of the
    sensor, which may be another one on another day, is added to its noise.
    """
    parse_team(base, name)
    document = tomlkit.parse(base)
    there = [n for n in calibration.robots if n in document["robots"]]
    if not there:
        raise ValueError(f"{name}: has none of the robots {', '.join(calibration.robots)}")
    for robot in there:
        _add_type(document, robot, calibration.robots[robot], margin)
    document["calibrated_on"] = list(calibration.logs)
    text = f"# Calibrated by `cpcbl-team calibrate` from {', '.join(calibration.logs)}.\n"
    text += tomlkit.dumps(document)
    parse_team(text, name)
    return text


def _add_type(document: TOMLDocument, robot: str, found: RobotCalibration, margin: float) -> None:
    own: Any = document["robots"][robot]
    types: Any = document.setdefault("types", tomlkit.table(is_super_table=True))
    former = dict(types.get(own.get("type", ""), {}))
    kind = f"robot-{robot}" if len(robot) < 26 else robot
    table = tomlkit.table()
    driving = _with_margin(found.odometry, odometry.NOISE, margin)
    seeing = _with_margin(found.sensor, sensor.NOISE, margin)
    rules = dict(former.get("localizer", {}))
    if seeing:
        former["sensor"] = {**former.get("sensor", {}), "range_is_depth": found.range_is_depth}
        rules["object_interval_s"] = INTERVAL_S
    if driving:
        rules["self_calibration"] = False
    if rules:
        former["localizer"] = rules
    for key, value in former.items():
        if key not in ("odometry", "sensor"):
            table.add(key, value)
    for part, values in (("odometry", driving), ("sensor", seeing)):
        kept = {k: v for k, v in former.get(part, {}).items() if k not in values}
        if kept or values:
            table.add(part, _part(part, kept, values))
        for key in values:
            own.get(part, {}).pop(key, None)
    types[kind] = table
    own["type"] = kind


def _with_margin(
    values: Mapping[str, Estimate], noise: Sequence[str], margin: float
) -> dict[str, Estimate]:
    """With noise as of another day: sigmas grown, and a share of each correction in them."""
    result = dict(values)
    for name in noise:
        if name in result:
            doubt = margin * abs(_corrected_by(values, name))
            sigma = math.hypot((1.0 + margin) * result[name].value, doubt)
            result[name] = Estimate(sigma, result[name].standard_error)
    return result


def _corrected_by(values: Mapping[str, Estimate], noise: str) -> float:
    """How far a reading is corrected, in the unit of this noise."""
    match noise:
        case "range_share" if "range_scale" in values:
            return 1.0 - values["range_scale"].value
        case "range_floor_m" if "range_bias_m" in values:
            return values["range_bias_m"].value
        case "bearing_sigma_deg" if "bearing_bias_deg" in values:
            return values["bearing_bias_deg"].value
    return 0.0


def _part(part: str, kept: Mapping[str, Any], values: Mapping[str, Estimate]) -> Table:
    table = tomlkit.table()
    for key, value in kept.items():
        table.add(key, value)
    for key, estimate in values.items():
        digits = decimals(estimate.standard_error)
        least = LEAST.get(key, LEAST.get(f"{part}.{key}", -math.inf))
        number = round(estimate.value, digits)
        written = tomlkit.item(max(number, least) + 0.0)
        written.comment(f"± {estimate.standard_error:.{digits}f}")
        table.add(key, written)
    return table


def decimals(standard_error: float) -> int:
    """How many decimals a value is worth: rounding adds at most a sixth of the standard error."""
    if not 0.0 < standard_error < math.inf:
        return 4
    return min(max(math.ceil(-math.log10(standard_error / 3.0)), 0), 6)
