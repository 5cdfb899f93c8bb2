"""Team files: TOML in layers (defaults, then robot types, then robots), typed and checked.

Whatever is wrong is one `TeamFileError` with a line for each fault: the file, the key and the fix.
"""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from cpcbl_launch.team.checks import problems
from cpcbl_launch.team.faults import layer_faults, number_faults, one_line, table_faults
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.errors import InputError

# At import: msgspec describes a type at its first use, and crashes if two threads do that at once
_team_decoder = msgspec.json.Decoder(Team)

Layer = dict[str, Any]
MOST_LINES = 20  # of an error
MOST_ROUNDS = 20  # of removing keys that have faults: what is left may lack something


class TeamFileError(InputError):
    """A team file that cannot be used; each line of the text names file, key and fix."""

    @classmethod
    def of(cls, name: str, faults: Iterable[object]) -> "TeamFileError":
        """The error with a line for each fault in the file `name`."""
        lines = [f"{name}: {one_line(str(fault))}" for fault in faults]
        if len(lines) > MOST_LINES:
            rest = len(lines) - MOST_LINES + 1
            lines[MOST_LINES - 1 :] = [f"{name}: and {rest} more faults"]
        return cls("\n".join(lines))


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
        return decode_resolved(text.encode(), str(path))
    team = parse_team(text, str(path))
    robots = dict(team.robots)
    for name, robot in team.robots.items():
        if robot.camera.frames and not robot.camera.live:  # relative to the file
            frames = str((path.parent / robot.camera.frames).absolute())
            robots[name] = replace(robot, camera=replace(robot.camera, frames=frames))
    if team.transport.secured:
        team = replace(team, transport=replace(team.transport, keys=str(key_folder(team, path))))
    if team.gateway is not None:
        tokens = str((path.parent / team.gateway.tokens).absolute())
        team = replace(team, gateway=replace(team.gateway, tokens=tokens))
    if team.recording.folder:
        folder = str((path.parent / team.recording.folder).absolute())
        team = replace(team, recording=replace(team.recording, folder=folder))
    if team.ros2 is not None and team.ros2.keys:
        keys = str((path.parent / team.ros2.keys).absolute())
        team = replace(team, ros2=replace(team.ros2, keys=keys))
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


def decode_resolved(data: bytes, name: str) -> Team:
    """The team in what `save_resolved` wrote, or a recording holds. Raises TeamFileError."""
    try:
        team = _team_decoder.decode(data)
        faults: list[object] = [*number_faults(msgspec.json.decode(data))]
    except (msgspec.MsgspecError, RecursionError, UnicodeError) as error:
        raise TeamFileError.of(name, [error]) from error
    # Endpoints may be those of one run
    faults = faults or [p for p in problems(team) if not p.startswith("transport.")]
    if faults:
        raise TeamFileError.of(name, faults)
    return team


def parse_team(text: str, name: str = "team file") -> Team:
    """The team in a TOML text; `name` is what errors call it. Raises TeamFileError."""
    raw = _parse_toml(text, name)
    if faults := table_faults(raw):
        raise TeamFileError.of(name, faults)
    team = _team_from_tables(raw)
    if found := list(problems(team)):
        raise TeamFileError.of(name, found)
    return team


def _team_from_tables(raw: Layer) -> Team:
    """The team of tables without faults: its layers are merged."""
    tables = {key: value for key, value in raw.items() if key != "types"}
    tables["robots"] = {
        robot: _merge(
            raw.get("defaults", {}),
            raw.get("types", {}).get(layer.get("type"), {}),
            {key: value for key, value in layer.items() if key != "type"},
        )
        for robot, layer in raw["robots"].items()
    }
    team = msgspec.convert(tables, Team)
    if "connect" not in raw.get("transport", {}):  # the endpoint that is usual
        usual = team.transport.usual
        team = replace(team, transport=replace(team.transport, connect=usual))
    return team


def without_faulty_keys(path: Path) -> Team | None:
    """The team of a file without the keys that have faults, for what else is to be said of it; None
    if no team is left."""
    try:
        raw = _parse_toml(read_text(path), str(path))
        for _ in range(MOST_ROUNDS):
            faults = table_faults(raw)
            if not faults:
                return _team_from_tables(raw)
            for fault in faults:
                _remove_key(raw, fault.key)
    except TeamFileError:
        pass
    return None


def _remove_key(raw: Layer, key: str) -> None:
    """Removes a key, or the table that lacks it."""
    table, above = raw, list[tuple[Layer, str]]()
    for part in key.partition("[")[0].split("."):
        above.append((table, part))
        if not isinstance(table.get(part), dict):
            break
        table = table[part]
    while above:
        table, part = above.pop()
        if part in table:
            del table[part]
            return


def read_layer(path: Path) -> Layer:
    """A TOML file with the keys of a robot's type, not yet checked. Raises TeamFileError."""
    return _parse_toml(read_text(path), str(path))


def read_text(path: Path) -> str:
    """The text of a team file. Raises TeamFileError."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise TeamFileError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: not UTF-8, or a path with a zero byte
        raise TeamFileError(f"{path}: cannot be read: {error}") from error


def _parse_toml(text: str, name: str) -> Layer:
    try:
        return tomllib.loads(text)
    except RecursionError:
        error: object = "too many tables in each other"
    except tomllib.TOMLDecodeError as reason:
        error = reason
    except ValueError:
        error = "a number has too many digits"
    raise TeamFileError.of(name, [f"not TOML: {error}"])


def with_added_robot(team: Team, name: str, layers: Sequence[Layer], source: str) -> Team:
    """The team with one more robot, by layers over the team's defaults. Its name must be new.

    `source` is what errors call the layers. Raises TeamFileError.
    """
    merged = _merge(msgspec.to_builtins(team.defaults), *layers)
    if faults := layer_faults(merged):
        raise TeamFileError.of(source, faults)
    robot = msgspec.convert(merged, RobotSettings)
    more = replace(team, robots={**team.robots, name: robot})
    if found := list(problems(more)):
        raise TeamFileError.of(source, found)
    return more


def _merge(*layers: Mapping[str, Any]) -> Layer:
    result: Layer = {}
    for layer in layers:
        for key, value in layer.items():
            old = result.get(key)
            deeper = isinstance(old, dict) and isinstance(value, dict)
            result[key] = _merge(old or {}, value) if deeper else value
    return result
