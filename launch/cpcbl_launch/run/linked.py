"""Who is linked to a router, by what it has declared there, and who publishes to nobody.

Nothing is subscribed to and no robot is asked: Zenoh's router says what its clients declared.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from cpcbl_agents.input_problems import nearest_name
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.topics import namespace

ROBOT, FIELD, DRIVER = "robot", "field", "driver"
_SPACE = namespace("")  # cpcbl/


class Declared(NamedTuple):
    """A publisher or a liveliness token: its whole key, and the clients that declared it."""

    key: str
    clients: tuple[str, ...] = ()

    @property
    def team(self) -> str:
        return self.key.removeprefix(_SPACE).partition("/")[0]

    @property
    def topic(self) -> str:
        return self.key.removeprefix(_SPACE).partition("/")[2]


def client_names(publishers: Iterable[Declared], tokens: Iterable[Declared]) -> dict[str, str]:
    """What each client is, as far as it is known: `robot r1 of team lab`."""
    found: dict[str, set[str]] = {}
    for declared in (*publishers, *tokens):
        if (name := _name(declared)) is not None:
            for client in declared.clients:
                found.setdefault(client, set()).add(f"{name} of team {declared.team}")
    return {client: _most_telling(names) for client, names in found.items()}


def _name(declared: Declared) -> str | None:
    chunks = declared.topic.split("/")
    if robot := _robot_of_token(declared):
        return f"{ROBOT} {robot}"
    if declared.topic == topics.TRUTH.key:
        return FIELD
    return f"{DRIVER} of {chunks[1]}" if chunks[0] == "in" and len(chunks) == 3 else None


def _most_telling(names: set[str]) -> str:
    """A robot may be its own driver, and a field drives all robots."""
    for kind in (ROBOT, FIELD):
        if telling := sorted(name for name in names if name.startswith(kind)):
            return ", ".join(telling)
    return ", ".join(sorted(names))


def _robot_of_token(token: Declared) -> str:
    names = topics.ALIVE.names(token.topic) or topics.RAN.names(token.topic) or {}
    return names.get("robot", "")


def stray_inputs(
    team: Team, publishers: Iterable[Declared], tokens: Iterable[Declared]
) -> tuple[str, ...]:
    """Who publishes inputs to a team or a robot that is not there, as sentences for people."""
    there = {(token.team, _robot_of_token(token)) for token in tokens}
    teams = {name for name, robot in there if robot} | {team.name}
    robots = frozenset(team.robots) | {robot for name, robot in there if name == team.name}
    said = _strays(team, list(publishers), teams, robots)
    return tuple(dict.fromkeys(said))


def _strays(
    team: Team, publishers: list[Declared], teams: set[str], robots: frozenset[str]
) -> Iterator[str]:
    for declared in publishers:
        kind, _, rest = declared.topic.partition("/")
        robot = rest.partition("/")[0]
        if kind != "in":
            continue
        if declared.team not in teams:
            yield (
                f"this team is `{team.name}`; somebody publishes to `{declared.team}` (in/{robot})"
            )
        elif declared.team == team.name and robot not in robots:
            near = nearest_name(robot, team.robots)
            guess = f"; is it `{near}`?" if near else ""
            yield f"somebody publishes to in/{robot}; no robot `{robot}` is there{guess}"


def declared_at(found: Mapping[str, tuple[str, ...]]) -> list[Declared]:
    """Of keys and their clients those of teams."""
    return [Declared(*item) for item in found.items() if item[0].startswith(_SPACE)]
