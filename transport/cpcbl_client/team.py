"""What a driver or a consumer must know of a team file. `cpcbl-team check` checks all of it."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from cpcbl_team.config import Team, TransportSettings
from cpcbl_team.errors import InputError, nearest_name
from cpcbl_team.inputs import Name


class ClientTeam(NamedTuple):
    """A team as its drivers and consumers see it."""

    path: str
    team: Team  # without its robots: its name, and how to reach its router
    sources: dict[str, str]  # of each robot: simulated, mrclam or external
    objects: frozenset[str]  # landmarks, walls and robots


class _Map(msgspec.Struct, frozen=True):
    landmarks: dict[str, Any] = {}
    walls: dict[str, Any] = {}


class _Layer(msgspec.Struct, frozen=True):
    source: str = ""
    type: str = ""


class _File(msgspec.Struct, frozen=True):
    name: Name
    robots: dict[str, _Layer]
    types: dict[str, _Layer] = {}
    defaults: _Layer = _Layer()
    map: _Map = _Map()
    transport: TransportSettings = TransportSettings()


# At import: msgspec describes a type at its first use, and crashes if two threads do that at once
msgspec.json.Decoder(_File)


def read_team(path: str | Path) -> ClientTeam:
    """The team in a file. Raises InputError for one that cannot be used."""
    path = Path(path)
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
        file = msgspec.convert(raw, _File)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; name the team file") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not TOML: {error}") from error
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {error}; see `cpcbl-team check {path}`") from None
    transport = msgspec.structs.replace(
        file.transport,
        connect=file.transport.connect
        if "connect" in raw.get("transport", {})
        else file.transport.usual,
        keys=str((path.parent / file.transport.keys).absolute()),
    )
    sources = {
        name: own.source
        or file.types.get(own.type, _Layer()).source
        or file.defaults.source
        or "simulated"
        for name, own in file.robots.items()
    }
    objects = frozenset(file.map.landmarks) | frozenset(file.map.walls) | frozenset(sources)
    return ClientTeam(
        str(path), Team(name=file.name, robots={}, transport=transport), sources, objects
    )


def name_hint(name: str, known: Iterable[str]) -> str:
    """`did you mean 'door'?`, or which names there are."""
    names = sorted(known)
    near = nearest_name(name, names)
    return f"did you mean {near!r}?" if near else f"there are {', '.join(names)}"
