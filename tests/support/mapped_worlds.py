"""Places of a map beside the true ones, and places that are known roughly, for tests of mapping."""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.mapper import Mapped
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Landmark, Wall
from support.mapping_worlds import Ends, World


class Errors(NamedTuple):
    errors: Floats  # (2 n,) of the places that were not known exactly
    covariance: Floats  # (2 n, 2 n)

    @property
    def nees(self) -> float:
        """Of each degree of freedom: 1 is consistent."""
        return float(self.errors @ np.linalg.solve(self.covariance, self.errors) / len(self.errors))


def true_wall(mapped: Mapped, name: str, ends: Ends) -> Floats:
    """The true offset and direction of a wall (2,), as the map would have them."""
    (ax, ay), (bx, by) = ends
    found = mapped.wall(name)[0][1]
    direction = found + math.remainder(math.atan2(by - ay, bx - ax) - found, math.pi)
    x, y = np.subtract(ends[0], mapped.pivot(name)).tolist()
    return np.array([math.cos(direction) * y - math.sin(direction) * x, direction])


def errors_of(mapped: Mapped, world: World) -> Errors:
    """Of all landmarks and walls of a map that has the frame of the world."""
    errors, columns, known = [np.empty(0)], list[int](), mapped.frame.known_names
    for i, name in enumerate((*mapped.names, *mapped.walls)):
        if name not in known:
            is_wall = i >= len(mapped.names)
            truth = true_wall(mapped, name, world.walls[name]) if is_wall else world.places[name]
            errors.append(mapped.places[i] - truth)
            columns += [2 * i, 2 * i + 1]
    return Errors(np.concatenate(errors), mapped.covariance[np.ix_(columns, columns)])


def exact_walls(walls: Mapping[str, Ends]) -> dict[str, Wall]:
    return {name: Wall(from_m=begin, to_m=end) for name, (begin, end) in walls.items()}


def moved(wall: Wall, x_m: float = 0.0, y_m: float = 0.0, times: float = 1.0) -> Wall:
    """The wall in a map that is so many times as large, and then moved."""
    ends = times * np.array([wall.from_m, wall.to_m]) + (x_m, y_m)
    (ax, ay), (bx, by) = ends.tolist()
    return Wall(from_m=(ax, ay), to_m=(bx, by))


def rough_walls(
    rng: np.random.Generator, walls: Mapping[str, Ends], sigma_m: float, sigma_deg: float
) -> dict[str, Wall]:
    """Walls as somebody has measured them with these errors."""
    found = {}
    for name, ends in walls.items():
        (middle, arm), (offset, turn) = _middle_and_arm(ends), rng.standard_normal(2)
        angle = math.radians(sigma_deg) * turn
        c, s = math.cos(angle), math.sin(angle)
        turned = np.array([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]])
        normal = np.array([-arm[1], arm[0]]) / math.hypot(*arm)
        there = middle + sigma_m * offset * normal
        (ax, ay), (bx, by) = (there - turned).tolist(), (there + turned).tolist()
        found[name] = Wall(
            from_m=(ax, ay), to_m=(bx, by), sigma_m=sigma_m, direction_sigma_deg=sigma_deg
        )
    return found


def _middle_and_arm(ends: Ends) -> tuple[Floats, Floats]:
    begin, end = np.array(ends)
    return 0.5 * (begin + end), 0.5 * (end - begin)


def rough_landmarks(
    rng: np.random.Generator,
    places: Mapping[str, tuple[float, float]],
    names: Iterable[str],
    sigma_m: float,
) -> dict[str, Landmark]:
    """Landmarks as somebody has measured them with this error along each axis."""
    found = {}
    for name in names:
        x, y = (np.array(places[name]) + sigma_m * rng.standard_normal(2)).tolist()
        found[name] = Landmark(x_m=x, y_m=y, sigma_m=sigma_m)
    return found
