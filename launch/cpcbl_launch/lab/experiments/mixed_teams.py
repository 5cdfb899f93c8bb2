"""Simulated teams of mixed quality, on which budgets are measured: their robots meet now and then.

One robot in five is a guide: it sees landmarks, and has good sensors. The others see teammates
only, and half of them have poor odometry. Each drives from point to point on a field with 20 m² for
each, and sees 6 m ahead. Worlds differ from this one in one thing each.
"""

import math
from itertools import cycle
from random import Random

from msgspec.structs import replace

from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team import config
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.errors import InputError

ROBOT_AREA_M2 = 20.0
LANDMARK_AREA_M2 = {"mixed": 12.0, "few-landmarks": 60.0, "one-observer": 12.0, "chain": 12.0}
WORLDS = tuple(LANDMARK_AREA_M2)
"""As above; landmarks that guides see now and then; in place of all guides one robot that stands in
the middle, knows its pose and looks all round; a corridor in which each robot has a part of its own
and meets its neighbours at the ends, and only the first sees landmarks."""
PART_M, WIDTH_M = 6.0, 2.5  # of the corridor


def known_world(name: str) -> str:
    """The name, if there is such a world; raises InputError."""
    if name not in WORLDS:
        raise InputError(f"--world {name}: unknown; write one of {', '.join(WORLDS)}")
    return name


def mixed_team(size: int, seed: int, world: str = "mixed") -> Team:
    """A team of so many robots of the kinds in `teams/mixed.toml`; the seed determines their ways
    and the map."""
    random, side_m = Random(f"{seed} {size}"), math.sqrt(ROBOT_AREA_M2 * size)
    base, robots = load_team(builtin_path("mixed")), {}
    for i, kind in zip(range(size), cycle(base.robots.values()), strict=False):
        places = _part(random, i) if world == "chain" else _places(random, 8, side_m, side_m)
        heading_deg = random.uniform(-180.0, 180.0)
        robots[f"r{i:02}"] = _on_its_way(kind, places, heading_deg)
    if world in ("one-observer", "chain"):
        robots = _with_one_guide(robots)
    if world == "one-observer":
        robots["r00"] = _observer_at(robots["r00"], side_m / 2.0)
    area = (PART_M, WIDTH_M) if world == "chain" else (side_m, side_m)
    number = max(1, round(ROBOT_AREA_M2 * size / LANDMARK_AREA_M2[world]))
    places = _places(random, 4 if world == "chain" else number, *area)
    marks = {f"m{i}": config.Landmark(x_m=x, y_m=y) for i, (x, y) in enumerate(places)}
    return replace(base, name=f"mixed{size}", robots=robots, map=config.Field(landmarks=marks))


def _places(random: Random, number: int, x_m: float, y_m: float) -> list[tuple[float, float]]:
    return [(random.uniform(0.0, x_m), random.uniform(0.0, y_m)) for _ in range(number)]


def _part(random: Random, number: int) -> list[tuple[float, float]]:
    """A way up and down one part of the corridor, and a little into the next ones."""
    places = []
    for end in (1, 0) * 4:
        x_m = PART_M * (number + end) + random.uniform(-1.5, 1.5)
        places.append((x_m, random.uniform(0.0, WIDTH_M)))
    return places


def _on_its_way(
    robot: RobotSettings, places: list[tuple[float, float]], heading_deg: float
) -> RobotSettings:
    first, *others = places
    start = config.Start(x_m=first[0], y_m=first[1], heading_deg=heading_deg)
    return replace(robot, start=start, waypoints_m=(*others, first))


def _with_one_guide(robots: dict[str, RobotSettings]) -> dict[str, RobotSettings]:
    """Guides but the first have the sensor of the robot after the first, and see no landmarks."""
    blind = robots["r01"].sensor
    return {
        name: replace(robot, sensor=blind) if robot.sensor.sees_landmarks and i else robot
        for i, (name, robot) in enumerate(robots.items())
    }


def _observer_at(robot: RobotSettings, at_m: float) -> RobotSettings:
    start = config.Start(x_m=at_m, y_m=at_m, heading_deg=0.0, sigma_m=0.01)
    sensor = replace(robot.sensor, field_of_view_deg=360.0)
    odometry = replace(robot.odometry, moves=False)
    return replace(robot, start=start, waypoints_m=(), sensor=sensor, odometry=odometry)
