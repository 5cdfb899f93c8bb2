"""Steps 2 to 4 of the cycle: from sightings to measurements, to constraints, to one evidence."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from cpcbl_team.collaboration import Place, placed
from cpcbl_team.config import Field, LocalizationSettings, LocalizerSettings, Wall
from cpcbl_team.constraints import (
    Constraint,
    bearing_heading,
    bearing_ray,
    range_circle,
    wall_heading,
    wall_line,
)
from cpcbl_team.estimate import Estimate, Information, Scope
from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, wrap_angle
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

    def doubted(self, factor: float) -> "Measured":
        """With both variances grown by this factor."""
        k = math.sqrt(factor)
        return self._replace(range_sigma=k * self.range_sigma, bearing_sigma=k * self.bearing_sigma)

    def turned(self, angle: float) -> "Measured":
        """Seen so much further to the left."""
        if self.bearing is None:
            return self
        return self._replace(bearing=wrap_angle(self.bearing + angle))

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


def constraints_of(
    pose: Pose2, m: Measured, turn: Scope, rules: LocalizerSettings
) -> list[Constraint]:
    """Step 3: what one object says about position or heading; about both, each reading once."""
    x, y, _ = m.place
    found: list[Constraint | None] = []
    if m.range_m is not None and turn is not Scope.HEADING:
        if m.wall is None:
            found.append(range_circle(pose, x, y, m.range_m, m.range_sigma))
        else:
            direction = m.wall.direction_rad
            found.append(wall_line(pose, x, y, direction, m.range_m, m.range_sigma))
    if m.bearing is not None and turn is not Scope.POSITION:
        if m.wall is None:
            found.append(bearing_heading(pose, x, y, m.bearing, m.bearing_sigma))
        else:
            direction = m.wall.direction_rad
            found.append(wall_heading(pose, x, y, direction, m.bearing, m.bearing_sigma))
    across = turn is Scope.POSITION and m.wall is None and rules.bearing_for_position
    if m.bearing is not None and across:
        found.append(bearing_ray(pose, x, y, m.bearing, m.bearing_sigma))
    plain = rules.paper_uncertainty or rules.variant == "weighted"
    return [c.uncoupled() if plain else c for c in found if c is not None]


def combined(accepted: list[Constraint]) -> Information:
    """Step 4: the Gaussians at the closest points of all constraints, as one."""
    return Information.none().with_all((c.row, c.residual, c.sigma * c.sigma) for c in accepted)


def observation_of(
    prior: Estimate, m: Measured, cs: list[Constraint], now: Estimate
) -> Observation:
    """The constraints of one object, about the estimate `now` though linearized at the prior.

    A teammate's pose covariance is compounded with the sensor's (row 39), as the dependent part.
    """
    dx, dy = now.pose.x - prior.pose.x, now.pose.y - prior.pose.y
    dh = wrap_angle(now.pose.heading - prior.pose.heading)
    rows = tuple(c.row for c in cs)
    residuals = tuple(c.residual - c.row[0] * dx - c.row[1] * dy - c.row[2] * dh for c in cs)
    sensor = [c.sigma * c.sigma for c in cs]
    place = m.place.covariance
    (ax, ay), (bx, by) = cs[0].place_row, cs[-1].place_row
    return Observation(
        rows,
        residuals,
        Covariance2(sensor[0], 0.0, sensor[-1]),
        Covariance2(
            place.along(ax, ay),
            place.xx * ax * bx + place.xy * (ax * by + ay * bx) + place.yy * ay * by,
            place.along(bx, by),
        ),
    )
