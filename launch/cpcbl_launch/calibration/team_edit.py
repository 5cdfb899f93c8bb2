"""What was calibrated, written into a team file: all else stays as it is, with its comments."""

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit
from tomlkit.items import InlineTable, Table

from cpcbl_launch.calibration.statistics import Estimate, decimals
from cpcbl_launch.team_file import TeamFileError, builtin_path, parse_team
from cpcbl_team.errors import InputError


class Written(NamedTuple):
    """A value as it is written, and a remark beside it."""

    value: Any
    remark: str = ""


def written(estimate: Estimate) -> Written:
    """Rounded to what its standard error allows, which is said beside."""
    if estimate.standard_error == 0.0:
        return Written(estimate.value)
    digits = decimals(estimate.standard_error)
    return Written(round(estimate.value, digits) + 0.0, f"± {estimate.standard_error:.{digits}f}")


class Place(NamedTuple):
    """A table of a team file, as in `[types.eye.camera]`: the path of its name."""

    path: tuple[str, ...]

    def __str__(self) -> str:
        return ".".join(self.path)


def robot_place(team_file: Path | None, robot: str | None, kind: str | None, part: str) -> Place:
    """The part of a robot's or a type's table; without a team file that of a type `eye`.

    Raises InputError unless one of them is named.
    """
    if team_file is None and robot is None and kind is None:
        return Place(("types", "eye", part))
    if (robot is None) == (kind is None):
        raise InputError("--team: say whose table it is: --robot NAME or --type NAME")
    return Place(("robots", robot, part) if robot is not None else ("types", str(kind), part))


def team_source(path: Path, output: Path | None) -> tuple[str, Path]:
    """The text of a team file, or of a built-in one by its name, and where to write it: into
    `output`, else into the file itself. Raises TeamFileError."""
    if not path.exists() and builtin_path(path.name).exists():
        if output is None:
            raise TeamFileError(f"{path}: a built-in team stays as it is; name --output FILE")
        path = builtin_path(path.name)
    try:
        return path.read_text(encoding="utf-8"), output or path
    except FileNotFoundError:
        raise TeamFileError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise TeamFileError(f"{path}: cannot be read: {error}") from error


def edited(text: str, name: str, places: Mapping[Place, Mapping[str, Written]]) -> str:
    """A team file with these values in these tables. Raises TeamFileError.

    `name`: what errors call the file. A robot or type must be there; other tables are added.
    """
    try:
        document = tomlkit.parse(text)
    except tomlkit.exceptions.TOMLKitError as error:
        raise TeamFileError(f"{name}: not TOML: {error}") from error
    for place, values in places.items():
        _must_be_there(document, place, name)
        table: Any = document
        for i, part in enumerate(place.path):
            table = _inside(table, part, bare=i < len(place.path) - 1)
        fresh = isinstance(table, Table) and not len(table)
        for key, value in values.items():
            table[key] = _item(value, table)
        if fresh:
            table.add(tomlkit.nl())
    changed = tomlkit.dumps(document)
    parse_team(changed, name)
    return changed


def as_toml(places: Mapping[Place, Mapping[str, Written]]) -> str:
    """The tables alone, to be copied."""
    document = tomlkit.document()
    for place, values in places.items():
        table: Any = document
        for part in place.path[:-1]:
            table = table.setdefault(part, tomlkit.table(is_super_table=True))
        own = tomlkit.table()
        for key, value in values.items():
            own.add(key, _item(value, own))
        table.add(place.path[-1], own)
    return tomlkit.dumps(document)


def replace_file(path: Path, text: str) -> None:
    """All of it or nothing: a full disk must not cost the file that was there. Raises OSError."""
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


def shadowed(text: str, place: Place, keys: Sequence[str]) -> list[str]:
    """What robots of a type say themselves, and so do not take from the type."""
    if place.path[0] != "types":
        return []
    _, kind, part = place.path
    found = []
    for robot, own in tomlkit.parse(text).get("robots", {}).items():
        if own.get("type") == kind:
            found += [f"robots.{robot}.{part}.{key}" for key in keys if key in own.get(part, {})]
    return found


def _must_be_there(document: Mapping[str, Any], place: Place, name: str) -> None:
    layer, *rest = place.path
    if layer not in ("robots", "types"):
        return
    known = document.get(layer, {})
    if rest[0] not in known:
        there = ", ".join(known) or "none"
        raise TeamFileError(f"{name}: {layer}.{rest[0]}: not in the file; name one of: {there}")


def _inside(table: Any, part: str, bare: bool) -> Any:
    """The table of this name within another, made if it is not there; `bare`: of tables only."""
    if part not in table:
        inline = isinstance(table, InlineTable)
        table[part] = tomlkit.inline_table() if inline else tomlkit.table(is_super_table=bare)
    return table[part]


def _item(value: Written, table: Any) -> Any:
    item = tomlkit.item(value.value)
    if value.remark and isinstance(table, Table):
        item.comment(value.remark)
    return item
