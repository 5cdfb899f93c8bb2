"""Calibrated values as tables of a team file. The rest of the file, with its comments, stays."""

import math
import os
import shutil
import tomllib
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import tomlkit
from tomlkit.items import InlineTable, Table

from cpcbl_launch.calibration.camera_accuracy import CameraAccuracy
from cpcbl_launch.calibration.colours import ColourCalibration
from cpcbl_launch.calibration.lens import DISTORTION, LensCalibration
from cpcbl_launch.calibration.statistics import Estimate, decimals
from cpcbl_launch.team.file import TeamFileError, builtin_path, parse_team, read_text
from cpcbl_team.config import COLOURS, CameraSettings, Colour
from cpcbl_team.errors import InputError

THRESHOLDS = ("hue", "saturation", "value")
CAMERA_SIGMAS = (
    "edge_sigma_px",
    "tilt_sigma_deg",
    "roll_sigma_deg",
    "yaw_sigma_deg",
    "focal_share",
    "centre_share",
)
UNSURVEYED = {"landmarks": "unsurveyed", "walls": "unsurveyed_walls"}
MAX_SIGMA_ERROR = 0.1  # stated sigmas that differ from the errors by less stay
MINIMUM = {  # a filter without any noise would trust a measurement without bounds
    "odometry.delay_s": 0.0,
    "distance_loss_m_per_rad": 0.0,
    "distance_sigma_m_per_sqrt_m": 1e-3,
    "turn_sigma_rad_per_sqrt_rad": 1e-3,
    "turn_sigma_rad_per_sqrt_m": 1e-3,
    "range_floor_m": 1e-3,
    "bearing_sigma_deg": 0.01,
}


class TomlValue(NamedTuple):
    """A value of a team file, and the comment behind it."""

    value: Any
    remark: str = ""


def toml_value(estimate: Estimate, least: float = -math.inf) -> TomlValue:
    """The value, rounded to what its standard error allows, with that error as the remark."""
    if estimate.standard_error == 0.0:
        return TomlValue(max(estimate.value, least))
    digits = decimals(estimate.standard_error)
    value = max(round(estimate.value, digits) + 0.0, least)
    return TomlValue(value, f"± {estimate.standard_error:.{digits}f}")


class TablePath(NamedTuple):
    """The name of a table of a team file in its parts, as in `[types.eye.camera]`."""

    names: tuple[str, ...]

    def __str__(self) -> str:
        return ".".join(self.names)


Tables = Mapping[TablePath, Mapping[str, TomlValue]]


def robot_table(
    team_file: Path | None, robot: str | None, type_name: str | None, part: str
) -> TablePath:
    """The table `part` of a robot or of a type; without a team file that of a type `eye`. Raises
    InputError unless exactly one of `robot` and `type_name` is given."""
    if team_file is None and robot is None and type_name is None:
        return TablePath(("types", "eye", part))
    if (robot is None) == (type_name is None):
        raise InputError(
            f"{team_file or 'table'}: name one table to write: --robot NAME or --type NAME"
        )
    owner = ("robots", robot) if robot is not None else ("types", str(type_name))
    return TablePath((*owner, part))


def team_source(path: Path, output: Path | None) -> tuple[str, Path]:
    """The text of a team file, or of a built-in one by its name, and the file to write. That is
    `output` if it is given, else the file itself. Raises TeamFileError."""
    if not path.exists() and builtin_path(path.name).exists():
        if output is None:
            raise TeamFileError(f"{path}: a built-in team cannot be changed; name --output FILE")
        path = builtin_path(path.name)
    return read_text(path), output or path


def edit_team(text: str, name: str, tables: Tables) -> str:
    """The text of a team file with these values in these tables. Raises TeamFileError. `name` is
    the file's name in errors. A robot or type must exist; other tables are added. A landmark
    or wall that has a place now is no longer one that nobody has surveyed."""
    try:
        document = tomlkit.parse(text)
    except tomlkit.exceptions.TOMLKitError as error:
        raise TeamFileError(f"{name}: not TOML: {error}") from error
    for table_path, values in tables.items():
        layer, owner, *_ = table_path.names
        known = document.get(layer, {})
        if layer in ("robots", "types") and owner not in known:
            available = ", ".join(known) or "none"
            raise TeamFileError(
                f"{name}: {layer}.{owner}: not in the file; name one of: {available}"
            )
        table: Any = document
        for i, part in enumerate(table_path.names, 1):
            if part not in table:
                empty = tomlkit.table(is_super_table=i < len(table_path.names))
                table[part] = tomlkit.inline_table() if isinstance(table, InlineTable) else empty
            table = table[part]
        fresh = isinstance(table, Table) and not len(table)
        for key, value in {**_taken_over(document, table_path, values), **values}.items():
            table[key] = _item(value, table)
        if fresh:
            table.add(tomlkit.nl())
    changed = tomlkit.dumps(document)
    parse_team(changed, name)
    return changed


def _taken_over(
    document: Any, table_path: TablePath, values: Mapping[str, TomlValue]
) -> dict[str, TomlValue]:
    """What a landmark or wall keeps of its entry among those that nobody has surveyed, which is
    taken out; and a former covariance, or sigma, that is not among its new values is void."""
    *table, name = table_path.names
    if table not in (["map", "landmarks"], ["map", "walls"]):
        return {}
    for key in {"sigma_m", "covariance_m2"} - values.keys():
        document["map"][table[1]][name].pop(key, None)
    others = UNSURVEYED[table[1]]
    unsurveyed = document["map"].get(others, {})
    former = unsurveyed.pop(name, {})
    if not unsurveyed:
        document["map"].pop(others, None)
    return {key: TomlValue(former[key]) for key in ("gives", "colours") if key in former}


def tables_text(tables: Tables) -> str:
    """The tables alone, as text to be copied into a team file."""
    document = tomlkit.document()
    for table_path, values in tables.items():
        table: Any = document
        for part in table_path.names[:-1]:
            table = table.setdefault(part, tomlkit.table(is_super_table=True))
        own = tomlkit.table()
        for key, value in values.items():
            own.add(key, _item(value, own))
        table.add(table_path.names[-1], own)
    return tomlkit.dumps(document)


def replace_file(path: Path, text: str) -> None:
    """Replaces the file as a whole: a full disk must not destroy the old file. Raises OSError."""
    target = path.resolve()
    if target.exists() and not target.is_file():
        target.write_text(text, encoding="utf-8")
        return
    fresh = target.with_name(f".{target.name}.new")
    try:
        fresh.write_text(text, encoding="utf-8")
        if target.exists():
            shutil.copymode(target, fresh)
        os.replace(fresh, target)
    finally:
        fresh.unlink(missing_ok=True)


def overridden_keys(text: str, table_path: TablePath, keys: Sequence[str]) -> list[str]:
    """The keys that robots of this type set themselves and so do not take from the type."""
    if table_path.names[0] != "types":
        return []
    _, type_name, part = table_path.names
    robots = tomlkit.parse(text).get("robots", {})
    own = {robot: t.get(part, {}) for robot, t in robots.items() if t.get("type") == type_name}
    return [f"robots.{robot}.{part}.{key}" for robot in own for key in keys if key in own[robot]]


def _item(value: TomlValue, table: Any) -> Any:
    item = tomlkit.item(value.value)
    if value.remark and isinstance(table, Table):
        item.comment(value.remark)
    return item


def camera_table(lens: LensCalibration) -> dict[str, TomlValue]:
    """The keys of a team file's table `camera` that pictures of a board determine."""
    distortion = [toml_value(lens.distortion[name]) for name in DISTORTION]
    return {
        "width_px": TomlValue(lens.width_px),
        "height_px": TomlValue(lens.height_px),
        **{name: toml_value(estimate) for name, estimate in lens.intrinsics.items()},
        "distortion": TomlValue(
            [item.value for item in distortion],
            ", ".join(item.remark or "not determined" for item in distortion),
        ),
        "focal_share": TomlValue(round(lens.focal_share, 4)),
        "centre_share": TomlValue(round(lens.centre_share, 4)),
    }


def unsampled_colours(team_file: Path | None, sampled: Set[str]) -> tuple[dict[str, Colour], bool]:
    """The colours of a team that are not sampled, and whether its file has them already.

    The colours of a file replace the built-in ones, so those built-in colours that the file uses
    are added. Raises TeamFileError.
    """
    if team_file is None:
        return {}, True
    text, _ = team_source(team_file, team_file)
    try:
        raw = tomllib.loads(text)
        own = raw.get("vision", {}).get("colours")
        known = COLOURS if own is None else msgspec.convert(own, dict[str, Colour])
    except (tomllib.TOMLDecodeError, msgspec.ValidationError):
        parse_team(text, str(team_file))  # its error names the key
        raise
    used = known.keys() if own is not None else _used_colours(raw)
    kept = {name: known[name] for name in used if name in known and name not in sampled}
    return kept, own is not None


def _used_colours(raw: dict[str, Any]) -> list[str]:
    """The colours that landmarks and robots of a team file have."""
    tables = [raw.get("defaults", {}), *raw.get("map", {}).get("landmarks", {}).values()]
    tables += [*raw.get("types", {}).values(), *raw.get("robots", {}).values()]
    return sorted({name for table in tables for name in table.get("colours", ())})


def colour_tables(result: ColourCalibration, file_has_kept: bool) -> Tables:
    """A table for each colour. `file_has_kept`: the file already has the colours that are kept."""
    colours = {name: fit.thresholds for name, fit in result.colours.items()}
    if not file_has_kept:
        colours |= result.kept
    return {
        TablePath(("vision", "colours", name)): {
            key: TomlValue(list(getattr(colour, key))) for key in THRESHOLDS
        }
        for name, colour in colours.items()
    }


def sensor_tables(
    accuracy: CameraAccuracy, camera: CameraSettings, sensor_path: TablePath, camera_path: TablePath
) -> Tables:
    """Corrections and noise for the table `sensor_path`, and larger sigmas for `camera_path` if
    errors are larger than stated.

    The sigmas are never reduced: an error that is the same in all of these pictures, such as that
    of the camera's mounting, may be different on another day.
    """
    found = accuracy.sensor.items()
    corrections = {name: toml_value(value, MINIMUM.get(name, -math.inf)) for name, value in found}
    corrections["range_is_depth"] = TomlValue(accuracy.range_is_depth)
    tables: dict[TablePath, Mapping[str, TomlValue]] = {sensor_path: corrections}
    times = accuracy.times
    if times is not None and times.value > 1.0 and differ_from_stated_sigmas(times):
        larger = {key: f"{times.value * getattr(camera, key):.3g}" for key in CAMERA_SIGMAS}
        remark = f"x {times.value:.2f}"
        tables[camera_path] = {key: TomlValue(float(v), remark) for key, v in larger.items()}
    return tables


def differ_from_stated_sigmas(times: Estimate) -> bool:
    """Whether errors, as a multiple of the stated sigmas, differ from 1 by more than chance."""
    return abs(times.value - 1.0) > max(MAX_SIGMA_ERROR, 2.0 * times.standard_error)
