"""All robots of some logs, calibrated one by one, and written as robot types of a team file."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomlkit
from msgspec.structs import replace
from tomlkit.items import Table
from tomlkit.toml_document import TOMLDocument

from cpcbl_launch.calibration import odometry, sensor
from cpcbl_launch.calibration.between_days import (
    ANOTHER_DAY,
    DayVariance,
    odometry_day_variances,
    pooled_variances,
    sensor_day_variances,
    with_day_variances,
)
from cpcbl_launch.calibration.logs import RobotLog, RobotLogs
from cpcbl_launch.calibration.search_bounds import bound_notes, without_bounds
from cpcbl_launch.calibration.statistics import Estimate, decimals
from cpcbl_launch.calibration.team_tables import MINIMUM, team_source
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.team.file import builtin_path, parse_team
from cpcbl_team.errors import InputError

SHORT_S = 20.0  # of a short recording: where a value is at a bound, it may have any other
INTERVAL_S = 0.5  # with correlation_s known, more frequent sightings of an object add little
_CORRECTED = {  # the noise of a reading: its correction, the neutral value, the unit of the noise
    "range_share": ("range_scale", 1.0, 1.0),
    "range_floor_m": ("range_bias_m", 0.0, 1.0),
    "bearing_sigma_deg": ("bearing_bias_deg", 0.0, 1.0),
    odometry.CRAWL_NOISE: ("least_speed_m_s", 0.0, math.sqrt(odometry.WINDOW_S)),  # for a window
}


class RobotCalibration(msgspec.Struct, frozen=True):
    """The values of one robot; those that the logs do not determine are missing, with a note."""

    odometry: dict[str, Estimate]
    sensor: dict[str, Estimate]
    notes: tuple[str, ...] = ()
    range_is_depth: bool = False
    day_variances: dict[str, DayVariance] = {}


class Calibration(msgspec.Struct, frozen=True):
    """What `calibrate --json` writes."""

    logs: tuple[str, ...]
    robots: dict[str, RobotCalibration]


def calibrate_robots(
    logs: RobotLogs, names: Sequence[str], progress: Callable[[float], None] = lambda done: None
) -> Calibration:
    """All robots of the logs with these names, each over all its logs. Raises InputError."""
    robots = {}
    for i, (robot, parts) in enumerate(logs.items()):
        robots[robot] = _calibrate_robot(parts)
        progress((i + 1) / len(logs))
    if not any(robot.odometry or robot.sensor for robot in robots.values()):
        raise InputError(
            f"{', '.join(names)}: nothing to calibrate: no robot drives, and none sees landmarks or"
            " robots with known ground truth"
        )
    return Calibration(tuple(names), robots)


def _calibrate_robot(logs: Sequence[RobotLog]) -> RobotCalibration:
    """One robot, from all its logs."""
    odometry_values, motion = odometry.calibrate_odometry(logs)
    sensor_values, sight = sensor.calibrate_sensor(logs)
    drives, sees = bool(odometry_values), bool(sensor_values)
    odometry_values, sensor_values = (
        _with_standard_errors(odometry_values),
        _with_standard_errors(sensor_values),
    )
    if max(np.ptp(log.truth[:, 0]) for log in logs) < SHORT_S:
        odometry_values = without_bounds("odometry", odometry_values)
        sensor_values = without_bounds("sensor", sensor_values)
    days = {} if motion is None else odometry_day_variances(motion)
    days |= {} if sight is None else sensor_day_variances(sight)
    is_depth = sight is not None and sight.after.is_depth
    notes = []
    if not drives:
        notes.append("does not drive, or not for long enough: odometry stays as it is")
    if not sees:
        notes.append("too few sightings with ground truth: the sensor stays as it is")
    if is_depth:
        notes.append("ranges are depths along the optical axis")
    axis = () if is_depth else ("optical_axis_deg",)
    for part, has_data, found, names in (
        ("odometry", drives, odometry_values, (*odometry.CORRECTIONS, *odometry.NOISE)),
        ("sensor", sees, sensor_values, (*sensor.CORRECTIONS, *sensor.NOISE, "correlation_s")),
    ):
        missing = [name for name in names if name not in found and name not in axis]
        if has_data and missing:
            notes.append(f"not determined by the logs: {part} {', '.join(missing)}")
    at_bounds = [
        *bound_notes("odometry", odometry_values),
        *bound_notes("sensor", sensor_values),
    ]
    if at_bounds:
        notes.append(f"at a bound of the calibration: {', '.join(at_bounds)}")
    return RobotCalibration(odometry_values, sensor_values, tuple(notes), is_depth, days)


def _with_standard_errors(values: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Those with a value and a standard error: of too short a log they are not numbers."""
    return {
        name: found
        for name, found in values.items()
        if math.isfinite(found.value) and math.isfinite(found.standard_error)
    }


def base_team(logs: Sequence[Path], team_file: Path | None) -> tuple[str, str]:
    """The text of the team file to which types are added, and its name in errors.

    It is the given one (or a built-in one by its name), else the recorded team, else the built-in
    mrclam-uncalibrated. Raises TeamFileError, LogError.
    """
    if team_file is None and logs[0].suffix == ".mcap":
        return tomlkit.dumps(non_default_settings(read_recording(logs[0]).team)), str(logs[0])
    path = team_file or builtin_path("mrclam-uncalibrated")
    return team_source(path, path)[0], str(path)


def non_default_settings(settings: msgspec.Struct) -> dict[str, Any]:
    """The keys of a settings struct that differ from their defaults, as nested plain data."""
    result = {}
    for field in msgspec.structs.fields(settings):
        value = getattr(settings, field.name)
        if field.required or value != field.default:
            result[field.name] = _plain(value)
    return result


def _plain(value: Any) -> Any:
    if isinstance(value, msgspec.Struct):
        return non_default_settings(value)
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    return msgspec.to_builtins(value)


def calibrated_team(
    calibration: Calibration, base: str, name: str, *, margin: float, correction_margin: float
) -> str:
    """The base team file with a type for each calibrated robot. Raises TeamFileError, InputError.

    The new type of a robot includes its former one. Calibrated keys of the robot itself are
    removed. `margin`: all sigmas are increased by this share. What differs between the days of
    several logs is added to them (`between_days`). Of one log it is not known: instead the share
    `correction_margin` of each correction of a range or bearing is added to its noise. Of the least
    speed, which is not compared, it is always added.
    """
    parse_team(base, name)
    document = tomlkit.parse(base)
    pooled = pooled_variances([robot.day_variances for robot in calibration.robots.values()])
    present = [n for n in calibration.robots if n in document["robots"]]
    if not present:
        raise InputError(f"{name}: has none of the robots {', '.join(calibration.robots)}")
    noise = (*odometry.NOISE, odometry.CRAWL_NOISE)
    for robot in present:
        found = calibration.robots[robot]
        share = 0.0 if "range" in pooled else correction_margin  # the differences were measured
        motion = _with_margin(found.odometry, noise, margin, correction_margin)
        sight = _with_margin(found.sensor, sensor.NOISE, margin, share)
        own = found.day_variances
        motion, sight = (with_day_variances(values, own, pooled) for values in (motion, sight))
        _add_type(document, robot, replace(found, odometry=motion, sensor=sight))
    document["calibrated_on"] = list(calibration.logs)
    text = f"# Calibrated by `cpcbl-team calibrate` from {', '.join(calibration.logs)}.\n"
    text += tomlkit.dumps(document)
    parse_team(text, name)
    return text


def _add_type(document: TOMLDocument, robot: str, found: RobotCalibration) -> None:
    """Raises InputError if another robot has a type with the name of this robot's new type."""
    robots: Any = document["robots"]
    own = robots[robot]
    type_name = f"robot-{robot}" if len(robot) < 26 else robot
    for other, settings in robots.items():
        if other != robot and settings.get("type") == type_name:
            raise InputError(
                f"robots.{other}.type: {type_name}: robot {robot} gets a type of that name; rename"
                " the present one"
            )
    types: Any = document.setdefault("types", tomlkit.table(is_super_table=True))
    former = dict(types.get(own.get("type", ""), {}))
    table = tomlkit.table()
    calibrated = {"odometry": found.odometry, "sensor": found.sensor}
    companions = _companion_settings(found)
    for part, added in companions.items():
        former[part] = {**former.get(part, {}), **added}
    for key, value in former.items():
        if key not in calibrated:
            table.add(key, value)
    for part, values in calibrated.items():
        kept = {k: v for k, v in former.get(part, {}).items() if k not in values}
        if kept or values:
            table.add(part, _toml_table(part, kept, values))
    for part in ("odometry", "sensor", "localizer"):
        for key in (*calibrated.get(part, ()), *companions.get(part, ())):
            own.get(part, {}).pop(key, None)
    types[type_name] = table
    own["type"] = type_name


def _companion_settings(found: RobotCalibration) -> dict[str, dict[str, bool | float]]:
    """Settings that go with calibrated values: the meaning of a range, how often an object is used,
    how well the scales of the odometry are known, and no self-calibration."""
    parts: dict[str, dict[str, bool | float]] = {}
    if found.sensor:
        parts["sensor"] = {"range_is_depth": found.range_is_depth}
        parts["localizer"] = {"object_interval_s": INTERVAL_S}
    if found.odometry:
        parts["odometry"] = {**ANOTHER_DAY}
        parts.setdefault("localizer", {})["self_calibration"] = False
    return parts


def _with_margin(
    values: Mapping[str, Estimate], noise: Sequence[str], margin: float, correction_margin: float
) -> dict[str, Estimate]:
    """The values with larger sigmas, which include a share of each correction."""
    result = dict(values)
    for name in noise:
        if name in result:
            correction, neutral, unit = _CORRECTED.get(name, ("", 0.0, 0.0))
            size = values[correction].value - neutral if correction in values else 0.0
            uncertainty = correction_margin * abs(size * unit)
            sigma = math.hypot((1.0 + margin) * result[name].value, uncertainty)
            result[name] = Estimate(sigma, result[name].standard_error)
    return result


def _toml_table(part: str, kept: Mapping[str, Any], values: Mapping[str, Estimate]) -> Table:
    table = tomlkit.table()
    for key, value in kept.items():
        table.add(key, value)
    for key, estimate in values.items():
        digits = decimals(estimate.standard_error)
        least = MINIMUM.get(key, MINIMUM.get(f"{part}.{key}", -math.inf))
        item = tomlkit.item(max(round(estimate.value, digits), least) + 0.0)
        item.comment(f"± {estimate.standard_error:.{digits}f}")
        table.add(key, item)
    return table
