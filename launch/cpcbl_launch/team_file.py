"""Team files: TOML in layers (defaults, then robot types, then robots), typed and checked.

Whatever is wrong is one `TeamFileError` that names the file, the key and the fix.
"""

import difflib
import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import msgspec
from msgspec.structs import replace

from cpcbl_launch.team_checks import problems
from cpcbl_team.config import Field, Landmark, RobotSettings, Team, Wall
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import NAME_PATTERN

Layer = dict[str, Any]


class TeamFileError(InputError):
    """A team file that cannot be used; the text names file, key and fix."""


class _NamedTables(Field, frozen=True, kw_only=True):
    landmarks: Layer = msgspec.field(default_factory=dict)
    walls: Layer = msgspec.field(default_factory=dict)


class _File(Team, frozen=True, kw_only=True):
    """The file's own tables; what has names of the user's own is converted name by name."""

    robots: Layer
    map: _NamedTables = _NamedTables()
    types: Layer = msgspec.field(default_factory=dict)


def builtin_path(name: str) -> Path:
    """The path of a team file that comes with the package."""
    return Path(str(resources.files("cpcbl_launch") / "teams" / f"{name}.toml"))


def find_team(path: Path) -> Team:
    """The team in this file, or the one of this name that comes with the package.

    Raises TeamFileError.
    """
    own = builtin_path(path.name)
    is_name = path == Path(path.name) and not path.exists()
    if is_name and not own.exists() and not path.suffix:
        known = sorted(other.stem for other in own.parent.glob("*.toml"))
        raise TeamFileError(f"{path}: no such file; the built-in teams are {', '.join(known)}")
    return load_team(own if is_name and own.exists() else path)


def load_team(path: Path) -> Team:
    """The team in a TOML file, or in a JSON file that `save_resolved` wrote.

    Raises TeamFileError.
    """
    text = read_text(path)
    if path.suffix == ".json":
        try:
            return msgspec.json.decode(text, type=Team)
        except msgspec.MsgspecError as error:
            raise TeamFileError(f"{path}: {error}") from error
    team = parse_team(text, str(path))
    robots = dict(team.robots)
    for name, robot in team.robots.items():
        if robot.camera.frames and not robot.camera.live:  # relative to the file
            frames = str((path.parent / robot.camera.frames).absolute())
            robots[name] = replace(robot, camera=replace(robot.camera, frames=frames))
    if team.transport.secured:
        team = replace(team, transport=replace(team.transport, keys=str(key_folder(team, path))))
    return replace(team, robots=robots)


def key_folder(team: Team, path: Path) -> Path:
    """Where the keys of the team in a file are."""
    return (path.parent / team.transport.keys).absolute()


def save_resolved(team: Team, path: Path) -> None:
    """Writes a team with its layers merged, for the processes of one run. Raises TeamFileError."""
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(team), indent=1))
    except OSError as error:
        reason = f"{error.strerror}; the processes of a run read their team there"
        raise TeamFileError(f"{path}: not written: {reason}") from error


def parse_team(text: str, name: str = "team file") -> Team:
    """The team in a TOML text; `name` is what errors call it. Raises TeamFileError."""
    raw = _parse_toml(text, name)
    file = _convert(raw, _File, "", name)
    _convert_named(file.types, RobotSettings, "types", name)
    layers: dict[str, Layer] = {}
    for robot, layer in _named_tables(file.robots, "robots", name):
        kind = layer.pop("type", None)
        if kind is not None and not (isinstance(kind, str) and kind in file.types):
            known = ", ".join(file.types) or "none"
            raise TeamFileError(
                f"{name}: robots.{robot}.type: no type {kind!r}; use a type that has its table"
                f" [types.NAME], here: {known}"
            )
        _convert(layer, RobotSettings, f"robots.{robot}", name)
        layers[robot] = _merge(raw.get("defaults", {}), file.types.get(kind, {}), layer)
    whole = msgspec.structs.asdict(file)
    del whole["types"]
    whole["robots"] = _convert_named(layers, RobotSettings, "robots", name)
    whole["map"] = Field(
        landmarks=_convert_named(file.map.landmarks, Landmark, "map.landmarks", name),
        walls=_convert_named(file.map.walls, Wall, "map.walls", name),
    )
    if "connect" not in raw.get("transport", {}):  # the endpoint that is usual
        whole["transport"] = replace(file.transport, connect=file.transport.usual)
    team = Team(**whole)
    for problem in problems(team):
        raise TeamFileError(f"{name}: {problem}")
    return team


def read_layer(path: Path) -> Layer:
    """A TOML file with the keys of a robot's type, not yet checked. Raises TeamFileError."""
    return _parse_toml(read_text(path), str(path))


def read_text(path: Path) -> str:
    """The text of a team file. Raises TeamFileError."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise TeamFileError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise TeamFileError(f"{path}: cannot be read: {error}") from error


def _parse_toml(text: str, name: str) -> Layer:
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TeamFileError(f"{name}: not TOML: {error}") from error
    for key in _not_finite(table):
        raise TeamFileError(f"{name}: {key}: not a finite number; write a finite one")
    return table


def with_added_robot(team: Team, name: str, layers: Sequence[Layer], source: str) -> Team:
    """The team with one more robot, by layers over the team's defaults. Its name must be new.

    `source` is what errors call the layers. Raises TeamFileError.
    """
    merged = _merge(msgspec.to_builtins(team.defaults), *layers)
    robot = _convert(merged, RobotSettings, "", source)
    more = replace(team, robots={**team.robots, name: robot})
    for problem in problems(more):
        raise TeamFileError(f"{source}: {problem}")
    return more


def _named_tables(tables: Layer, where: str, name: str) -> Iterator[tuple[str, Layer]]:
    """The tables with names of the user's own, which become part of keys on the bus."""
    for own, table in tables.items():
        if not re.fullmatch(NAME_PATTERN, own):
            raise TeamFileError(
                f"{name}: {where}.{own}: a name has 1 to 32 letters, digits, _, . or -; rename it"
            )
        if not isinstance(table, dict):
            raise TeamFileError(f"{name}: {where}.{own}: is no table; write [{where}.{own}]")
        yield own, table


def _convert_named(tables: Layer, kind: type[Any], where: str, name: str) -> dict[str, Any]:
    named = _named_tables(tables, where, name)
    return {own: _convert(table, kind, f"{where}.{own}", name) for own, table in named}


def _merge(*layers: Mapping[str, Any]) -> Layer:
    result: Layer = {}
    for layer in layers:
        for key, value in layer.items():
            old = result.get(key)
            deeper = isinstance(old, dict) and isinstance(value, dict)
            result[key] = _merge(old or {}, value) if deeper else value
    return result


def _convert(raw: Any, kind: type[Any], prefix: str, name: str) -> Any:
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        raise TeamFileError(f"{name}: {_error_text(str(error), kind, prefix)}") from None


def _error_text(error: str, kind: type[Any], prefix: str) -> str:
    """msgspec's text as `key: problem; fix`."""
    problem, _, where = error.partition(" - at `")
    path = where.removeprefix("key` in `").rstrip("`").removeprefix("$").lstrip(".")
    key = ".".join(part for part in (prefix, path) if part)
    if about := re.search(r"(unknown|missing required) field `(.+)`", problem):
        field, known = about[2], _fields_at(kind, path)
        key = f"{key}.{field}" if key else field
        if about[1] != "unknown":
            return f"{key}: missing; add it"
        close = difflib.get_close_matches(field, known, n=1)
        fix = f"did you mean {close[0]!r}?" if close else f"known here: {', '.join(known)}"
        return f"{key}: unknown key; {fix}"
    return f"{key}: {problem[:1].lower()}{problem[1:]}; correct the value"


def _fields_at(kind: Any, path: str) -> list[str]:
    for part in filter(None, re.sub(r"\[[^]]*\]", "", path).split(".")):
        kind = get_type_hints(kind)[part]
        if type(None) in get_args(kind) or get_origin(kind) is tuple:
            kind = get_args(kind)[0]
        elif get_origin(kind) is dict:
            kind = get_args(kind)[1]
    return sorted(kind.__struct_fields__)


def _not_finite(raw: Any, key: str = "") -> Iterator[str]:
    if isinstance(raw, float) and not math.isfinite(raw):
        yield key
    elif isinstance(raw, dict):
        for name, value in raw.items():
            yield from _not_finite(value, f"{key}.{name}" if key else name)
    elif isinstance(raw, list):
        for i, value in enumerate(raw):
            yield from _not_finite(value, f"{key}[{i}]")
