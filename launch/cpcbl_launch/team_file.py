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

from cpcbl_team.config import (
    LIKE_MIRRORED,
    MARKERS,
    Field,
    GuestSettings,
    Landmark,
    MatchSettings,
    RobotSettings,
    SimulationSettings,
    Table,
    Team,
    TransportSettings,
    VisionSettings,
    Wall,
)
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import NAME_PATTERN, Name
from cpcbl_transport.security import PROTOCOL

Layer = dict[str, Any]


class TeamFileError(InputError):
    """A team file that cannot be used; the text names file, key and fix."""


class _Map(Table, frozen=True, kw_only=True):
    landmarks: Layer = msgspec.field(default_factory=dict)
    walls: Layer = msgspec.field(default_factory=dict)


class _File(Table, frozen=True, kw_only=True):
    """The file's own tables; what has names of its own is converted name by name."""

    name: Name
    robots: Layer
    map: _Map = _Map()
    transport: TransportSettings = TransportSettings()
    vision: VisionSettings = VisionSettings()
    match: MatchSettings = MatchSettings()
    simulation: SimulationSettings = SimulationSettings()
    guests: GuestSettings = GuestSettings()
    calibrated_on: tuple[str, ...] = ()
    data: str = ""
    defaults: Layer = msgspec.field(default_factory=dict)
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
    return load_team(own if is_name and own.exists() else path)


def load_team(path: Path) -> Team:
    """The team in a TOML file, or in a JSON file that `save_resolved` wrote.

    Raises TeamFileError.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise TeamFileError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise TeamFileError(f"{path}: cannot be read: {error}") from error
    if path.suffix == ".json":
        try:
            return msgspec.json.decode(text, type=Team)
        except msgspec.MsgspecError as error:
            raise TeamFileError(f"{path}: {error}") from error
    team = _with_frames_beside(parse_team(text, str(path)), path)
    if not team.transport.secured:
        return team
    transport = msgspec.structs.replace(team.transport, keys=str(key_folder(team, path)))
    return msgspec.structs.replace(team, transport=transport)


def _with_frames_beside(team: Team, path: Path) -> Team:
    """The videos and folders of cameras are relative to the file."""
    robots = dict(team.robots)
    for name, robot in team.robots.items():
        camera = robot.camera
        if camera.frames and not camera.live:
            there = str((path.parent / camera.frames).absolute())
            camera = msgspec.structs.replace(camera, frames=there)
            robots[name] = msgspec.structs.replace(robot, camera=camera)
    return msgspec.structs.replace(team, robots=robots)


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
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TeamFileError(f"{name}: not TOML: {error}") from error
    for key in _not_finite(raw):
        raise TeamFileError(f"{name}: {key}: not a finite number; write a finite one")
    file = _convert(raw, _File, "", name)
    defaults = _convert(file.defaults, RobotSettings, "defaults", name)
    for kind, layer in _named_tables(file.types, "types", name):
        _convert(layer, RobotSettings, f"types.{kind}", name)
    robots = {}
    for robot, layer in _named_tables(file.robots, "robots", name):
        kind = layer.pop("type", None)
        if kind is not None and not (isinstance(kind, str) and kind in file.types):
            known = ", ".join(file.types) or "none"
            raise TeamFileError(
                f"{name}: robots.{robot}.type: no type {kind!r}; use a type that has its table"
                f" [types.NAME], here: {known}"
            )
        _convert(layer, RobotSettings, f"robots.{robot}", name)
        merged = _merge(file.defaults, file.types.get(kind, {}), layer)
        robots[robot] = _convert(merged, RobotSettings, f"robots.{robot}", name)
    field = Field(
        landmarks={
            mark: _convert(table, Landmark, f"map.landmarks.{mark}", name)
            for mark, table in _named_tables(file.map.landmarks, "map.landmarks", name)
        },
        walls={
            wall: _convert(table, Wall, f"map.walls.{wall}", name)
            for wall, table in _named_tables(file.map.walls, "map.walls", name)
        },
    )
    team = Team(
        name=file.name,
        robots=robots,
        map=field,
        vision=file.vision,
        transport=_transport(file.transport, raw),
        match=file.match,
        simulation=file.simulation,
        guests=file.guests,
        defaults=defaults,
        calibrated_on=file.calibrated_on,
        data=file.data,
    )
    for problem in problems(team):
        raise TeamFileError(f"{name}: {problem}")
    return team


def _transport(transport: TransportSettings, raw: Layer) -> TransportSettings:
    """With the endpoint that is usual, where the file does not name one."""
    if "connect" in raw.get("transport", {}):
        return transport
    return msgspec.structs.replace(transport, connect=transport.usual)


def read_layer(path: Path) -> Layer:
    """A TOML file with the keys of a robot's type, not yet checked. Raises TeamFileError."""
    try:
        layer = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise TeamFileError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise TeamFileError(f"{path}: cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise TeamFileError(f"{path}: not TOML: {error}") from error
    for key in _not_finite(layer):
        raise TeamFileError(f"{path}: {key}: not a finite number; write a finite one")
    return layer


def with_added_robot(team: Team, name: str, layers: Sequence[Layer], source: str) -> Team:
    """The team with one more robot, by layers over the team's defaults. Its name must be new.

    `source` is what errors call the layers. Raises TeamFileError.
    """
    merged = _merge(msgspec.to_builtins(team.defaults), *layers)
    robot = _convert(merged, RobotSettings, "", source)
    more = msgspec.structs.replace(team, robots={**team.robots, name: robot})
    for problem in problems(more):
        raise TeamFileError(f"{source}: {problem}")
    return more


def problems(team: Team) -> Iterator[str]:
    """What no single key is to blame for: `key: problem; fix`."""
    if not team.robots:
        yield "robots: there is none; add a table [robots.r1]"
    names = [*team.map.landmarks, *team.map.walls]
    for twice in sorted({n for n in names if names.count(n) > 1 or n in team.robots}):
        yield f"map: {twice!r} names two things; rename one of them"
    for name, wall in team.map.walls.items():
        if wall.from_m == wall.to_m:
            yield f"map.walls.{name}: has no length; move to_m away from from_m"
    for name, robot in team.robots.items():
        if robot.source == "simulated" and robot.start is None:
            yield f"robots.{name}.start: a simulated robot needs one; add x_m, y_m, heading_deg"
        if robot.localizer.variant == "joint" and robot.localizer.paper_uncertainty:
            yield (
                f"robots.{name}.localizer.paper_uncertainty: the joint variant cannot do"
                " without the covariance; use variant circular or oval"
            )
        if robot.localizer.alternate is False and robot.localizer.variant != "joint":
            yield (
                f"robots.{name}.localizer.alternate: only the joint variant can update both at"
                " once; remove the key"
            )
    yield from _vision_problems(team)
    yield from _guard_problems(team)
    yield from _event_problems(team)
    if not team.transport.connect:
        yield "transport.connect: is empty; name an endpoint such as tcp/192.168.1.10:7447"
    for key in ("listen", "connect"):
        for endpoint in getattr(team.transport, key):
            reason = endpoint_problem(endpoint) or _insecure(endpoint, team.transport.secured)
            if reason:
                yield f"transport.{key}: {endpoint!r}: {reason}"


def endpoint_problem(text: str) -> str:
    """Why Zenoh cannot listen or connect there; empty if it can."""
    if re.fullmatch(r"(tcp|tls|quic|udp|ws)/.+:\d{1,5}", text):
        return ""
    return "no endpoint; write it as tcp/192.168.1.10:7447"


def _vision_problems(team: Team) -> Iterator[str]:
    """Colours have thresholds, landmarks have bands of their own."""
    known = ", ".join(team.vision.colours)
    bands = {f"map.landmarks.{n}": m.colours for n, m in team.map.landmarks.items()}
    bands.update({f"robots.{n}": r.colours for n, r in team.robots.items()})
    for name, robot in team.robots.items():
        if robot.source == "simulated" and robot.camera.frames:
            yield f"robots.{name}.camera.frames: simulated frames are the field's; remove the key"
    for key, colours in bands.items():
        for colour in set(colours or ()) - team.vision.colours.keys():
            yield f"{key}.colours: no colour {colour!r}; use one of {known}, or add its thresholds"
        if colours is not None and colours[0] == colours[1]:
            yield f"{key}.colours: both bands are {colours[0]}; use two colours"
    if team.cameras:
        marks = [m.colours for m in team.map.landmarks.values() if m.colours is not None]
        for twice in sorted({c for c in marks if marks.count(c) > 1}):
            yield f"map.landmarks: two have the colours {list(twice)}; give each its own"
    yield from _marker_problems(team)


def _marker_problems(team: Team) -> Iterator[str]:
    """Markers are of the family, and tell a robot's sides apart. Two robots may carry the same
    ones: that is said when they are seen."""
    family = team.vision.family
    mirrored = LIKE_MIRRORED.get(family, frozenset())
    for name, robot in team.robots.items():
        ids = list(robot.markers.values())
        for side, number in robot.markers.items():
            key = f"robots.{name}.markers.{side}"
            if not 0 <= number < MARKERS[family]:
                yield f"{key}: {family} has no marker {number}; use 0 to {MARKERS[family] - 1}"
            elif number in mirrored:
                yield f"{key}: marker {number} of {family} is its own mirror image; use another"
            elif ids.count(number) > 1:
                yield f"{key}: marker {number} is on two sides; give each side its own"


def _insecure(endpoint: str, secured: bool) -> str:
    """Why an endpoint does not go with the team's security; empty if it does."""
    protocol, _, where = endpoint.partition("/")
    if secured and protocol != PROTOCOL:
        return f'with security = "mtls" every link is TLS; write it as {PROTOCOL}/{where}'
    if not secured and protocol in ("tls", "quic"):
        return f'needs certificates; add security = "mtls", or write it as tcp/{where}'
    return ""


def _event_problems(team: Team) -> Iterator[str]:
    """An event is of one kind, and whole; clocks are those of robots."""
    for name in team.simulation.clocks_ahead_s.keys() - team.robots.keys():
        known = ", ".join(team.robots)
        yield f"simulation.clocks_ahead_s.{name}: no robot {name!r}; name one of {known}"
    for i, event in enumerate(team.simulation.events):
        key = f"simulation.events[{i}]"
        if bool(event.kidnap) == bool(event.hide_landmarks_s):
            yield f"{key}: is of one kind; write kidnap and to, or hide_landmarks_s"
        elif event.kidnap and event.kidnap not in team.robots:
            known = ", ".join(team.robots)
            yield f"{key}.kidnap: no robot {event.kidnap!r}; name one of {known}"
        elif bool(event.kidnap) != (event.to is not None):
            yield f"{key}.to: goes with kidnap; write to = [x_m, y_m, heading_deg]"


def _guard_problems(team: Team) -> Iterator[str]:
    """A guard must not bother a healthy robot, and messages come unevenly."""
    guards = team.transport.guards
    for name, robot in team.robots.items() if guards.enabled else ():
        for key, allowed_hz, own_hz in (
            ("fix_rate_hz", guards.fix_rate_hz, robot.sensor.rate_hz),
            ("belief_rate_hz", guards.belief_rate_hz, robot.collaboration.belief_rate_hz),
        ):
            if allowed_hz < 2.0 * own_hz:
                yield (
                    f"transport.guards.{key}: robots.{name} has {own_hz:g} Hz; raise it to"
                    f" {2.0 * own_hz:g} or more"
                )


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
    unknown = re.search(r"unknown field `(.+)`", problem)
    if unknown:
        field, known = unknown.group(1), _fields_at(kind, path)
        close = difflib.get_close_matches(field, known, n=1)
        fix = f"did you mean {close[0]!r}?" if close else f"known here: {', '.join(known)}"
        return f"{'.'.join(p for p in (key, field) if p)}: unknown key; {fix}"
    missing = re.search(r"missing required field `(.+)`", problem)
    if missing:
        return f"{'.'.join(p for p in (key, missing.group(1)) if p)}: missing; add it"
    return f"{key}: {problem[:1].lower()}{problem[1:]}; correct the value"


def _fields_at(kind: Any, path: str) -> list[str]:
    """The keys that a table at `path` knows."""
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
