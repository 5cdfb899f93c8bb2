"""Teams on the circuit (`teams/circuit.toml`), put together for each configuration."""

from collections.abc import Collection

import msgspec

from cpcbl_launch.lab.experiments.runs import LOOPS, Case
from cpcbl_launch.team_file import builtin_path, load_team
from cpcbl_team.config import Team

LIMIT_S = 400.0  # five loops take 70 s
ODOMETRY_ONLY = {"lost_position_sigma_m": 1e3, "lost_heading_sigma_deg": 1e5}  # it drives on


def circuit_team(robots: Collection[str], beacons: bool = False) -> Team:
    """These robots among the four landmarks, with or without the four bearing-only beacons."""
    team = load_team(builtin_path("circuit"))
    marks = {n: m for n, m in team.map.landmarks.items() if beacons or m.gives == "both"}
    return msgspec.structs.replace(
        team,
        robots={name: team.robots[name] for name in robots},
        map=msgspec.structs.replace(team.map, landmarks=marks),
    )


def with_settings(team: Team, robot: str, **tables: dict[str, object]) -> Team:
    """The team with keys of some tables of one robot set: `sensor={"rate_hz": 5.0}`."""
    replace = msgspec.structs.replace
    old = team.robots[robot]
    new = {name: replace(getattr(old, name), **keys) for name, keys in tables.items()}
    return replace(team, robots={**team.robots, robot: replace(old, **new)})


def loop_case(team: Team, driver: str, truth: Team | None = None) -> Case:
    """Five loops of one driver."""
    return Case(team, (driver,), LIMIT_S, LOOPS, truth)
