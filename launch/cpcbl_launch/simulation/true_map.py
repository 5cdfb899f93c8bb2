"""Where the objects of a map truly are: somewhere within what the map says of its own errors."""

import numpy as np
from msgspec.structs import replace

from cpcbl_team.config import Field, Landmark, Team, Wall
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.places import moved_wall, place_covariance

_SEED = 2**29  # apart from robots' own noise


def true_map(team: Team, seed: int) -> Field:
    """The true places of all objects, also of those that nobody has surveyed. Those of the map have
    an error each: its standard deviations are the map's times the simulation's noise."""
    if team.map.is_exact and not team.map.unsurveyed_walls:
        return team.map
    noise = team.simulation.noise
    found = {
        name: Landmark(
            x_m=mark.true_m[0], y_m=mark.true_m[1], gives=mark.gives, colours=mark.colours
        )
        for name, mark in team.map.unsurveyed.items()
        if mark.true_m is not None
    }
    landmarks = {
        n: _true_landmark(team.map, n, m, seed, noise) for n, m in team.map.landmarks.items()
    }
    walls = {n: _true_wall(team.map, n, wall, seed, noise) for n, wall in team.map.walls.items()}
    walls |= {
        name: Wall(from_m=hidden.true_from_m, to_m=hidden.true_to_m, gives=hidden.gives)
        for name, hidden in team.map.unsurveyed_walls.items()
        if hidden.true_from_m is not None and hidden.true_to_m is not None
    }
    return Field(landmarks=landmarks | found, walls=walls)


def _true_landmark(field: Field, name: str, mark: Landmark, seed: int, noise: float) -> Landmark:
    dx, dy = _error(place_covariance(field, name), name, seed, noise)
    return replace(mark, x_m=mark.x_m + dx, y_m=mark.y_m + dy, sigma_m=0.0, covariance_m2=None)


def _true_wall(field: Field, name: str, wall: Wall, seed: int, noise: float) -> Wall:
    moved = moved_wall(wall, *_error(place_covariance(field, name), name, seed, noise))
    return replace(moved, sigma_m=0.0, direction_sigma_deg=0.0)


def _error(covariance: Covariance2, name: str, seed: int, noise: float) -> tuple[float, float]:
    """A draw from the covariance; the same for the same seed and name."""
    xx, xy, yy = covariance
    first, second = np.random.default_rng((seed, _SEED, *name.encode())).normal(size=2)
    along = xx**0.5
    across = xy / along if along else 0.0
    rest = max(yy - across * across, 0.0) ** 0.5
    return noise * along * float(first), noise * (across * float(first) + rest * float(second))
