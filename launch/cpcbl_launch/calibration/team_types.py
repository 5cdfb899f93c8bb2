"""Calibrated values of robots as robot types of a team file."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import tomlkit
from msgspec.structs import replace
from tomlkit.items import Table
from tomlkit.toml_document import TOMLDocument

from cpcbl_launch.calibration import odometry, sensor
from cpcbl_launch.calibration.odometry_windows import WINDOW_S
from cpcbl_launch.calibration.robots import Calibration, RobotCalibration
from cpcbl_launch.calibration.statistics import Estimate, decimals
from cpcbl_launch.calibration.team_tables import MINIMUM, team_source
from cpcbl_launch.reporting.recording import read_recording
from cpcbl_launch.team_file import builtin_path, parse_team
from cpcbl_team.errors import InputError

INTERVAL_S = 0.5  # with correlation_s known, more frequent sightings of an object add little


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
    calibration: Calibration,
    base: str,
    name: str = "team file",
    *,
    margin: float,
    correction_margin: float,
) -> str:
    """The base team file with a type for each calibrated robot. Raises TeamFileError, InputError.

    The new type of a robot includes its former one. Calibrated keys of the robot itself are
    removed. `margin`: all sigmas are increased by this share. `correction_margin`: this share of
    each correction (range, bearing, least speed) is added to its noise, because it may be different
    on another day.
    """
    parse_team(base, name)
    document = tomlkit.parse(base)
    present = [n for n in calibration.robots if n in document["robots"]]
    if not present:
        raise InputError(f"{name}: has none of the robots {', '.join(calibration.robots)}")
    for robot in present:
        found = calibration.robots[robot]
        noise = (*odometry.NOISE, odometry.CRAWL_NOISE)
        odometry_values = _with_margin(found.odometry, noise, margin, correction_margin)
        sensor_values = _with_margin(found.sensor, sensor.NOISE, margin, correction_margin)
        _add_type(document, robot, replace(found, odometry=odometry_values, sensor=sensor_values))
    document["calibrated_on"] = list(calibration.logs)
    text = f"# Calibrated by `cpcbl-team calibrate` from {', '.join(calibration.logs)}.\n"
    text += tomlkit.dumps(document)
    parse_team(text, name)
    return text


def _add_type(document: TOMLDocument, robot: str, toml_value: RobotCalibration) -> None:
    own: Any = document["robots"][robot]
    types: Any = document.setdefault("types", tomlkit.table(is_super_table=True))
    former = dict(types.get(own.get("type", ""), {}))
    type_name = _type_name(document, robot)
    table = tomlkit.table()
    calibrate_robots = {"odometry": toml_value.odometry, "sensor": toml_value.sensor}
    companions = _companion_settings(toml_value)
    for part, settings in companions.items():
        former[part] = {**former.get(part, {}), **settings}
    for key, value in former.items():
        if key not in calibrate_robots:
            table.add(key, value)
    for part, values in calibrate_robots.items():
        kept = {k: v for k, v in former.get(part, {}).items() if k not in values}
        if kept or values:
            table.add(part, _toml_table(part, kept, values))
    for part in ("odometry", "sensor", "localizer"):
        for key in (*calibrate_robots.get(part, ()), *companions.get(part, ())):
            own.get(part, {}).pop(key, None)
    types[type_name] = table
    own["type"] = type_name


def _type_name(document: TOMLDocument, robot: str) -> str:
    """The name of a robot's new type. Raises InputError if another robot has a type so named."""
    type_name = f"robot-{robot}" if len(robot) < 26 else robot
    robots: Any = document["robots"]
    for other, own in robots.items():
        if other != robot and own.get("type") == type_name:
            raise InputError(
                f"robots.{other}.type: {type_name}: robot {robot} gets a type of that name; rename"
                " the present one"
            )
    return type_name


def _companion_settings(toml_value: RobotCalibration) -> dict[str, dict[str, bool | float]]:
    """Settings that go with calibrated values: the meaning of a range, how often an object is used,
    and no self-calibration."""
    parts: dict[str, dict[str, bool | float]] = {}
    if toml_value.sensor:
        parts["sensor"] = {"range_is_depth": toml_value.range_is_depth}
        parts["localizer"] = {"object_interval_s": INTERVAL_S}
    if toml_value.odometry:
        parts.setdefault("localizer", {})["self_calibration"] = False
    return parts


def _with_margin(
    values: Mapping[str, Estimate], noise: Sequence[str], margin: float, correction_margin: float
) -> dict[str, Estimate]:
    """The values with larger sigmas, which include a share of each correction."""
    result = dict(values)
    for name in noise:
        if name in result:
            uncertainty = correction_margin * abs(_correction_size(values, name))
            sigma = math.hypot((1.0 + margin) * result[name].value, uncertainty)
            result[name] = Estimate(sigma, result[name].standard_error)
    return result


def _correction_size(values: Mapping[str, Estimate], noise: str) -> float:
    """The size of the correction of a reading, in the unit of this noise."""
    match noise:
        case "range_share" if "range_scale" in values:
            return 1.0 - values["range_scale"].value
        case "range_floor_m" if "range_bias_m" in values:
            return values["range_bias_m"].value
        case "bearing_sigma_deg" if "bearing_bias_deg" in values:
            return values["bearing_bias_deg"].value
        case odometry.CRAWL_NOISE if "least_speed_m_s" in values:
            return values["least_speed_m_s"].value * math.sqrt(WINDOW_S)  # for a window
    return 0.0


def _toml_table(part: str, kept: Mapping[str, Any], values: Mapping[str, Estimate]) -> Table:
    table = tomlkit.table()
    for key, value in kept.items():
        table.add(key, value)
    for key, estimate in values.items():
        digits = decimals(estimate.standard_error)
        least = MINIMUM.get(key, MINIMUM.get(f"{part}.{key}", -math.inf))
        number = round(estimate.value, digits)
        toml_value = tomlkit.item(max(number, least) + 0.0)
        toml_value.comment(f"± {estimate.standard_error:.{digits}f}")
        table.add(key, toml_value)
    return table
