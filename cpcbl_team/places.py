"""Where the objects of the map are, as far as a robot knows, and how certain that is."""

import math
from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Final, NamedTuple

from msgspec.structs import replace

from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.config import Field, Gives, Landmark, Wall
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.inputs import LandmarkBelief

EXACT = Covariance2(0.0, 0.0, 0.0)
NO_BELIEFS: Final[Mapping[str, LandmarkBelief]] = MappingProxyType({})


class ObjectPosition(NamedTuple):
    """The position of an object in the field's frame (m), and the covariance of its error: of x and
    y (m^2), or of a wall's offset along its normal (m^2) and its direction (rad^2)."""

    x: float
    y: float
    covariance: Covariance2


class MapObject(NamedTuple):
    """A landmark or wall as a robot takes it to be."""

    position: ObjectPosition  # of a wall: where it begins
    wall: Wall | None
    gives: Gives
    sender: str = ""  # the teammate whose belief its place is; empty: the map's, or the robot's own


def map_object(
    field: Field,
    name: str,
    common: CommonErrors | None = None,
    beliefs: Mapping[str, LandmarkBelief] = NO_BELIEFS,
) -> MapObject | None:
    """The object of this name; None if its place is not known. `common`: of a robot that estimates
    the places of objects with its pose. `beliefs`: of teammates, about unsurveyed landmarks; they
    count for those that it does not estimate."""
    is_estimated = common is not None and name in common.objects
    unsurveyed = field.unsurveyed.get(name)
    if unsurveyed is not None:
        if common is not None and is_estimated:
            position = ObjectPosition(*common.place_error(name), common.place_covariance(name))
            return MapObject(position, None, unsurveyed.gives)
        belief = beliefs.get(name)
        if belief is None:
            return None
        position = ObjectPosition(belief.x_m, belief.y_m, Covariance2(*belief.covariance))
        return MapObject(position, None, unsurveyed.gives, belief.robot)
    landmark = field.landmarks.get(name)
    if landmark is not None:
        x, y, covariance = _point(landmark)
        if common is not None and is_estimated:
            dx, dy = common.place_error(name)
            x, y, covariance = x + dx, y + dy, common.place_covariance(name)
        return MapObject(ObjectPosition(x, y, covariance), None, landmark.gives)
    wall = field.walls.get(name)
    if wall is None:
        return None
    covariance = wall_covariance(wall)
    if common is not None and is_estimated:
        wall = moved_wall(wall, *common.place_error(name))
        covariance = common.place_covariance(name)
    return MapObject(ObjectPosition(*wall.from_m, covariance), wall, wall.gives)


def place_covariance(field: Field, name: str) -> Covariance2:
    """How uncertain the place of an object is on the map. Raises KeyError if it is not on it."""
    landmark = field.landmarks.get(name)
    return wall_covariance(field.walls[name]) if landmark is None else _point(landmark)[2]


@lru_cache(1024)
def _point(landmark: Landmark) -> ObjectPosition:
    variance, covariance = landmark.sigma_m**2, landmark.covariance_m2
    of_place = Covariance2(*covariance) if covariance else Covariance2(variance, 0.0, variance)
    return ObjectPosition(landmark.x_m, landmark.y_m, of_place if any(of_place) else EXACT)


@lru_cache(1024)
def wall_covariance(wall: Wall) -> Covariance2:
    """The covariance of a wall's offset (m^2) where it begins, and of its direction (rad^2). Those
    of its middle are independent."""
    turn = math.radians(wall.direction_sigma_deg) ** 2
    half_m = 0.5 * math.dist(wall.from_m, wall.to_m)
    if wall.sigma_m == 0.0 and turn == 0.0:
        return EXACT
    return Covariance2(wall.sigma_m**2 + half_m * half_m * turn, -half_m * turn, turn)


def moved_wall(wall: Wall, offset_m: float, turn_rad: float) -> Wall:
    """The wall moved along its normal (to the left of its direction), and turned about where it
    begins then."""
    (ax, ay), direction = wall.from_m, wall.direction_rad
    length = math.dist(wall.from_m, wall.to_m)
    ax, ay = ax - offset_m * math.sin(direction), ay + offset_m * math.cos(direction)
    turned = direction + turn_rad
    to_m = ax + length * math.cos(turned), ay + length * math.sin(turned)
    return replace(wall, from_m=(ax, ay), to_m=to_m)
