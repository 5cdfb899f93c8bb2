"""Checks of a team's map: what contradicts itself, and what will disappoint."""

import math
from collections.abc import Iterator

from cpcbl_team.common_error_filter import considers_common_errors
from cpcbl_team.config import LandmarkPosition, Team
from cpcbl_team.errors import nearest_name
from cpcbl_team.frames import knows_field

LARGEST_SHARE = 0.25  # of the map's size, that its own errors may have


def map_problems(team: Team) -> Iterator[str]:
    """The contradictions in a map, each as `key: problem; fix`."""
    field = team.map
    names = [*field.landmarks, *field.unsurveyed, *field.walls, *field.unsurveyed_walls]
    for twice in sorted({n for n in names if names.count(n) > 1 or n in team.robots}):
        yield f"map: {twice!r} names two things; rename one of them"
    yield from _frame_problems(team)
    for name, wall in team.map.walls.items():
        if wall.from_m == wall.to_m:
            yield f"map.walls.{name}: has no length; move to_m away from from_m"
    for name, mark in team.map.landmarks.items():
        yield from _covariance_problems(f"map.landmarks.{name}", mark)
    for robot, settings in team.robots.items():
        for name, place in settings.known_landmarks.items():
            key = f"robots.{robot}.known_landmarks.{name}"
            yield from _covariance_problems(key, place)
            if name not in team.map.unsurveyed:
                near = nearest_name(name, team.map.unsurveyed)
                yield f"{key}: map.unsurveyed has no {name!r}; write {near or 'it there, too'}"
    simulated = [n for n, robot in team.robots.items() if robot.source == "simulated"]
    for name, unsurveyed in team.map.unsurveyed.items():
        if simulated and unsurveyed.true_m is None:
            yield (
                f"map.unsurveyed.{name}.true_m: the simulated field needs it; write where the"
                " landmark stands, which no robot is told"
            )
    for name, hidden in team.map.unsurveyed_walls.items():
        ends = hidden.true_from_m, hidden.true_to_m
        if simulated and (None in ends or ends[0] == ends[1]):
            yield (
                f"map.unsurveyed_walls.{name}: the simulated field needs true_from_m and true_to_m;"
                " write where the wall stands, which no robot is told"
            )


def _frame_problems(team: Team) -> Iterator[str]:
    if not team.map.is_frame_agreed:
        return
    if team.map.has_surveyed:
        yield (
            "map.frame: agreed is for a team without a map, and every robot knows the landmarks and"
            " walls of this one; remove the key"
        )
    for name, robot in team.robots.items():
        if robot.localizer.variant == "weighted":
            yield (
                f"robots.{name}.localizer.variant: weighted knows no covariance, without which no"
                " robot can join a frame; use variant joint"
            )


def _covariance_problems(key: str, mark: LandmarkPosition) -> Iterator[str]:
    if mark.covariance_m2 is None:
        return
    key, (xx, xy, yy) = f"{key}.covariance_m2", mark.covariance_m2
    if min(xx, yy) < 0.0 or xy * xy > xx * yy:
        yield f"{key}: [{xx:g}, {xy:g}, {yy:g}] is no covariance; write xx, xy, yy in m^2"
    elif mark.sigma_m:
        yield f"{key}: there is sigma_m, too; remove one of the two"


def map_warnings(team: Team) -> Iterator[str]:
    """What is no contradiction, but will disappoint, each as `key: what; fix`."""
    x0, y0, x1, y1 = team.map.bounds()
    size_m = math.hypot(x1 - x0, y1 - y0)
    for name, mark in team.map.landmarks.items():
        if mark.sigma_m > LARGEST_SHARE * size_m > 0.0:
            yield (
                f"map.landmarks.{name}.sigma_m: {mark.sigma_m:g} m is a large part of a map of"
                f" {size_m:.1f} m; if it is in millimetres, write {1e-3 * mark.sigma_m:g}"
            )
    is_agreed = team.map.is_frame_agreed
    links = team.map.unsurveyed or any(r.sensor.sees_robots for r in team.robots.values())
    if is_agreed and not links:
        yield (
            "map.frame: robots see neither each other nor landmarks, so nobody joins another's"
            " frame; name landmarks in map.unsurveyed, or set sensor.sees_robots = true"
        )
    if not team.map.unsurveyed:
        return
    for name, robot in team.robots.items():
        has_all = team.map.unsurveyed.keys() <= robot.known_landmarks.keys()
        if robot.sensor.sees_landmarks and not has_all and not considers_common_errors(robot):
            yield (
                f"robots.{name}.localizer.variant: {robot.localizer.variant} does not find"
                " landmarks that nobody has surveyed; use variant joint"
            )
    has_frame = is_agreed or any(knows_field(team, name) for name in team.robots)
    if not has_frame and all(robot.source != "mrclam" for robot in team.robots.values()):
        yield (
            "map.unsurveyed: no robot knows its start, and nothing else is on the map, so robots"
            ' stay lost; give a robot a start, or write frame = "agreed" in [map]'
        )
