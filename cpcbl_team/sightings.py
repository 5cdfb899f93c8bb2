"""Step 2 of the cycle: which sightings can be used, for what, and with which sigma."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from cpcbl_team.collaboration import Place, placed
from cpcbl_team.config import Field, LocalizationSettings, Wall
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Belief, Sighting
from cpcbl_team.sensors import sighting_sigmas

_EXACT = Covariance2(0.0, 0.0, 0.0)


class Measured(NamedTuple):
    """A sighting of an object whose place is known; a quantity is None where it is not usable."""

    source: str
    place: Place  # for a wall: a point of it
    wall: Wall | None
    teammate: bool
    range_m: float | None
    bearing: float | None
    range_sigma: float
    bearing_sigma: float

    @property
    def usable(self) -> bool:
        return self.range_m is not None or self.bearing is not None

    @property
    def gives_point_bearing(self) -> bool:
        return self.bearing is not None and self.wall is None


def measured(
    sighting: Sighting,
    stamp_ns: int,
    pose: Pose2,
    field: Field,
    teammates: Mapping[str, Belief],
    settings: LocalizationSettings,
) -> Measured | None:
    """The sighting, seen from about `pose`, with its object's place; None if that is not known."""
    wall = field.walls.get(sighting.id)
    landmark = field.landmarks.get(sighting.id)
    gives = "both"
    if landmark is not None:
        place: Place | None = Place(landmark.x_m, landmark.y_m, _EXACT)
        gives = landmark.gives
    elif wall is not None:
        place, gives = Place(*wall.from_m, _EXACT), wall.gives
    elif sighting.id in teammates and settings.collaboration.passive:
        place = placed(teammates[sighting.id], stamp_ns, settings.collaboration)
    else:
        return None
    if place is None:
        return None
    range_m = sighting.range_m if gives in ("both", "range") else None
    if range_m is not None and range_m > settings.sensor.max_range_for_range_m:
        range_m = None
    return Measured(
        sighting.id,
        place,
        wall,
        landmark is None and wall is None,
        range_m,
        sighting.bearing_rad if gives in ("both", "bearing") else None,
        *sighting_sigmas(sighting, settings.sensor, _expected_range(pose, place, wall)),
    )


def _expected_range(pose: Pose2, place: Place, wall: Wall | None) -> float:
    dx, dy = place.x - pose.x, place.y - pose.y
    if wall is None:
        return math.hypot(dx, dy)
    direction = wall.direction_rad
    return abs(dy * math.cos(direction) - dx * math.sin(direction))
