"""What was calibrated, written down as robot types of a team file."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import tomlkit
from msgspec.structs import replace
from tomlkit.items import Table
from tomlkit.toml_document import TOMLDocument

from cpcbl_launch.calibration import dead_zone, odometry, sensor
from cpcbl_launch.calibration.robots import Calibration, RobotCalibration
from cpcbl_launch.calibration.statistics import Estimate, decimals
from cpcbl_launch.calibration.windows import WINDOW_S
from cpcbl_launch.reporting.recording import read_recording
from cpcbl_launch.team_file import TeamFileError, builtin_path, parse_team
from cpcbl_team.errors import InputError

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


def base_text(logs: Sequence[Path], team_file: Path | None) -> tuple[str, str]:
    """The team file to add types to, and what to call it: the given one (or a built-in one by its
    name), the recorded team, or the built-in mrclam-uncalibrated. Raises TeamFileError, LogError.
    """
    if team_file is None and logs[0].suffix == ".mcap":
        return tomlkit.dumps(changed_keys(read_recording(logs[0]).team)), str(logs[0])
    path = team_file or builtin_path("mrclam-uncalibrated")
    if not path.exists() and builtin_path(path.name).exists():
        path = builtin_path(path.name)
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
    calibration: Calibration,
    base: str,
    name: str = "team file",
    *,
    margin: float,
    correction_margin: float,
) -> str:
    """The base team file with a type for each calibrated robot. Raises TeamFileError, InputError.

    A robot's former type goes into its new one; keys of its own that were calibrated are taken out.
    `margin`: all sigmas are written larger by this share. `correction_margin`: this share of each
    correction (range, bearing, least speed), which may be another one on another day, is added to
    its noise.
    """
    parse_team(base, name)
    document = tomlkit.parse(base)
    there = [n for n in calibration.robots if n in document["robots"]]
    if not there:
        raise InputError(f"{name}: has none of the robots {', '.join(calibration.robots)}")
    for robot in there:
        found = calibration.robots[robot]
        noise = (*odometry.NOISE, dead_zone.CRAWL_NOISE)
        driving = _with_margin(found.odometry, noise, margin, correction_margin)
        seeing = _with_margin(found.sensor, sensor.NOISE, margin, correction_margin)
        _add_type(document, robot, replace(found, odometry=driving, sensor=seeing))
    document["calibrated_on"] = list(calibration.logs)
    text = f"# Calibrated by `cpcbl-team calibrate` from {', '.join(calibration.logs)}.\n"
    text += tomlkit.dumps(document)
    parse_team(text, name)
    return text


def _add_type(document: TOMLDocument, robot: str, written: RobotCalibration) -> None:
    own: Any = document["robots"][robot]
    types: Any = document.setdefault("types", tomlkit.table(is_super_table=True))
    former = dict(types.get(own.get("type", ""), {}))
    kind = _type_of(document, robot)
    table = tomlkit.table()
    calibrated = {"odometry": written.odometry, "sensor": written.sensor}
    besides = _besides(written)
    for part, said in besides.items():
        former[part] = {**former.get(part, {}), **said}
    for key, value in former.items():
        if key not in calibrated:
            table.add(key, value)
    for part, values in calibrated.items():
        kept = {k: v for k, v in former.get(part, {}).items() if k not in values}
        if kept or values:
            table.add(part, _part(part, kept, values))
    for part in ("odometry", "sensor", "localizer"):
        for key in (*calibrated.get(part, ()), *besides.get(part, ())):
            own.get(part, {}).pop(key, None)
    types[kind] = table
    own["type"] = kind


def _type_of(document: TOMLDocument, robot: str) -> str:
    """The name of a robot's new type. Raises InputError where others have a type of that name."""
    kind = f"robot-{robot}" if len(robot) < 26 else robot
    robots: Any = document["robots"]
    for other, own in robots.items():
        if other != robot and own.get("type") == kind:
            raise InputError(
                f"robots.{other}.type: {kind}: robot {robot} gets a type of that name; give the"
                " present one another"
            )
    return kind


def _besides(written: RobotCalibration) -> dict[str, dict[str, bool | float]]:
    """What goes with calibrated values: what a range is, how often to use one, not to learn."""
    parts: dict[str, dict[str, bool | float]] = {}
    if written.sensor:
        parts["sensor"] = {"range_is_depth": written.range_is_depth}
        parts["localizer"] = {"object_interval_s": INTERVAL_S}
    if written.odometry:
        parts.setdefault("localizer", {})["self_calibration"] = False
    return parts


def _with_margin(
    values: Mapping[str, Estimate],
    noise: Sequence[str],
    margin: float,
    correction_margin: float,
) -> dict[str, Estimate]:
    """With noise as of another day: sigmas grown, and a share of each correction in them."""
    result = dict(values)
    for name in noise:
        if name in result:
            doubt = correction_margin * abs(_corrected_by(values, name))
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
        case dead_zone.CRAWL_NOISE if "least_speed_m_s" in values:
            return values["least_speed_m_s"].value * math.sqrt(WINDOW_S)  # for a window
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
