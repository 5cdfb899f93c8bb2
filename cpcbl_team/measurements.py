"""Steps 2 to 4 of the cycle, the general path: from a sighting to a measurement, its constraints,
and their evidence."""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import msgspec

from cpcbl_team import config
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.constraints import (
    CURVED_SHARE,
    Constraint,
    bearing_heading,
    bearing_position,
    bearing_ray,
    curvature,
    curved_variance,
    range_circle,
    wall_heading,
    wall_line,
)
from cpcbl_team.estimate import (
    HEADING,
    POSITION,
    SMALLEST_VARIANCE,
    Covariance3,
    Estimate,
    Information,
    Scope,
)
from cpcbl_team.fusion import Observation, chi_square
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Belief, HeadingBelief, LandmarkBelief, Sighting
from cpcbl_team.parameters import Sensitivity
from cpcbl_team.places import EXACT, NO_BELIEFS, ObjectPosition, map_object
from cpcbl_team.range_errors import RangeErrors
from cpcbl_team.sensors import sighting_sigmas

BELIEF_VALID_BEFORE_NS = 500_000_000
"""A belief is also used for sightings of up to this time before it: a robot subscribes to a
teammate's beliefs when it sees it, and what it saw before the first one came must not be lost."""

DRIVES_ON_M = 1.0  # a robot that turns by a radian a second may drive on at a metre a second


# Where a teammate is: one whose belief was received is one more landmark --------------------------


def extrapolated(belief: Belief, at_ns: int) -> Pose2:
    """The pose of a belief's robot at another time, by its speed and turn rate."""
    age = (at_ns - belief.stamp_ns) * 1e-9
    pose = Pose2(belief.x_m, belief.y_m, belief.heading_rad)
    return step(pose, belief.speed_m_s * age, belief.turn_rate_rad_s * age)


def nearest_belief(
    beliefs: Iterable[Belief], at_ns: int, settings: config.CollaborationSettings
) -> tuple[float, Belief] | None:
    """The belief nearest to a time, and its age then (s); None if all are too old, or too late."""
    before_s, max_age_s = BELIEF_VALID_BEFORE_NS * 1e-9, settings.max_age_s
    ages = [((at_ns - b.stamp_ns) * 1e-9, b) for b in beliefs]
    usable = [aged for aged in ages if -before_s <= aged[0] <= max_age_s]
    return min(usable, key=lambda pair: abs(pair[0])) if usable else None


def position_by_belief(belief: Belief, at_ns: int) -> ObjectPosition:
    """The position of a belief's robot at another time.

    A third of the extrapolated distance is added to its sigma, because the robot may have stopped
    or turned. The same is added for a distance of `DRIVES_ON_M` times its turn rate, because a
    robot that turned on the spot may drive on. Its next belief may not come: with a wide heading it
    soon helps nobody.
    """
    pose, age = extrapolated(belief, at_ns), (at_ns - belief.stamp_ns) * 1e-9
    covariance = Covariance3(*belief.covariance)
    jacobian = (1.0, 0.0, belief.y_m - pose.y, 0.0, 1.0, pose.x - belief.x_m, 0.0, 0.0, 1.0)
    xx, xy, yy, *_ = covariance.transformed(jacobian)
    possible_m_s = math.hypot(belief.speed_m_s, DRIVES_ON_M * belief.turn_rate_rad_s)
    growth = (possible_m_s * age / 3.0) ** 2
    return ObjectPosition(pose.x, pose.y, Covariance2(xx + growth, xy, yy + growth))


# What is measured -------------------------------------------------------------------------------


class Measurement(msgspec.Struct, frozen=True, gc=False):
    """A sighting of an object whose position is known; a reading is None where it is not used."""

    source: str
    position: ObjectPosition  # for a wall: a point of it
    wall: config.Wall | None
    is_teammate: bool
    range_m: float | None
    bearing: float | None  # rad, in the robot's frame
    range_sigma: float
    bearing_sigma: float
    is_for_heading: bool = False
    """Whether it may change the heading alone; it has no range then."""
    is_estimated: bool = False
    """Whether the robot estimates the object's place with its own pose."""
    turned_variance: float = 0.0
    """Of the direction of the sensor (rad^2), which errs by the same in all bearings, where it is
    not estimated."""
    sender: str = ""
    """The teammate whose belief the position is; empty: the map's, or the robot's own."""

    @property
    def is_dependent(self) -> bool:
        """Whether its object's place, or the direction of the sensor, has an error that the
        estimate may contain already, and that is not estimated beside it."""
        is_uncertain = not self.is_estimated and any(self.position.covariance)
        is_turned = self.bearing is not None and self.turned_variance > 0.0
        return bool(self.sender) or is_uncertain or is_turned

    @property
    def has_reading(self) -> bool:
        return self.range_m is not None or self.bearing is not None

    @property
    def has_point_bearing(self) -> bool:
        return self.bearing is not None and self.wall is None

    def independent_parts(self) -> "tuple[Measurement, ...]":
        """The range and the bearing of an object of the map each for itself if only the bearing has
        an error that the estimate may contain already."""
        if self.turned_variance == 0.0 or self.sender or None in (self.range_m, self.bearing):
            return (self,)
        replace = msgspec.structs.replace
        return replace(self, bearing=None), replace(self, range_m=None)

    def inflated(self, factor: float) -> "Measurement":
        """With both variances times this factor."""
        k = math.sqrt(factor)
        sigmas = {"range_sigma": k * self.range_sigma, "bearing_sigma": k * self.bearing_sigma}
        return msgspec.structs.replace(self, **sigmas)

    def corrected(self, bearing_bias: float, ranges: RangeErrors) -> "Measurement":
        """Without this bias of its bearing (rad), and without these errors of its range. (Ranges to
        teammates have another bias.)"""
        bearing = None if self.bearing is None else wrap_angle(self.bearing - bearing_bias)
        range_m = self.range_m
        if range_m is not None:
            range_m = ranges.scale * range_m + (0.0 if self.is_teammate else ranges.offset_m)
        return msgspec.structs.replace(self, bearing=bearing, range_m=range_m)


class GatedObject(NamedTuple):
    """An object with its constraints, and their normalized innovation squared: chi-square, with a
    degree of freedom a constraint."""

    measurement: Measurement
    constraints: list[Constraint]
    nis: float
    observation: Observation | None = None
    """Of a dependent one (see `Measurement`): the constraints as one observation of the prior."""
    sensitivities: tuple[Sensitivity, ...] = ()
    """How the residuals follow the common errors, where they are considered."""


class GatedObjects(NamedTuple):
    """What the gate makes of the objects of a frame."""

    accepted: list[GatedObject]
    rejected: list[GatedObject]


def measurement_of(
    sighting: Sighting,
    stamp_ns: int,
    pose: Pose2,
    field: config.Field,
    teammates: Mapping[str, tuple[Belief, ...]],
    settings: config.LocalizationSettings,
    common: CommonErrors | None = None,
    landmark_beliefs: Mapping[str, LandmarkBelief] = NO_BELIEFS,
) -> Measurement | None:
    """The measurement of a sighting from about `pose`: its used readings with the position of its
    object. None if that position is not known. `landmark_beliefs`: as in `map_object`."""
    name, is_for_heading, wall, gives = sighting.id, False, None, "both"
    on_map, sender = map_object(field, name, common, landmark_beliefs), name
    if on_map is not None:
        position, wall, gives, sender = on_map
    elif name in teammates and settings.collaboration.passive:
        nearest = nearest_belief(teammates[name], stamp_ns, settings.collaboration)
        if nearest is None:
            return None
        _, belief = nearest
        position = position_by_belief(belief, stamp_ns)
        if isinstance(belief, HeadingBelief):
            gives, is_for_heading = "bearing", True
    else:
        return None
    range_m, bearing, sensor = sighting.range_m, sighting.bearing_rad, settings.sensor
    if gives == "bearing" or gives == "none" or (range_m or 0.0) > sensor.max_range_for_range_m:
        range_m = None
    if gives == "range" or gives == "none":
        bearing = None
    sigmas = sighting_sigmas(sighting, sensor, _expected_range(pose, position, wall))
    read = on_map is None, range_m, bearing, *sigmas
    is_estimated = common is not None and name in common.objects and not sender
    about = is_for_heading, is_estimated, settings.turned_variance, sender
    return Measurement(name, position, wall, *read, *about)


def _expected_range(pose: Pose2, position: ObjectPosition, wall: config.Wall | None) -> float:
    dx, dy = position.x - pose.x, position.y - pose.y
    if wall is None:
        return math.hypot(dx, dy)
    direction = wall.direction_rad
    return abs(dy * math.cos(direction) - dx * math.sin(direction))


def constrains(m: Measurement, scope: Scope | None, rules: config.LocalizerSettings) -> bool:
    """Whether an object says anything about the part of the pose that is to be updated."""
    if scope is POSITION:
        if m.is_for_heading:
            return False
        return m.range_m is not None or (rules.bearing_for_position and m.has_point_bearing)
    if scope is HEADING:
        return m.bearing is not None
    return scope is not None and m.has_reading


def constraints_of(
    pose: Pose2, m: Measurement, scope: Scope, rules: config.LocalizerSettings
) -> list[Constraint]:
    """Step 3: the constraints of one object on position or heading. If both are updated, each
    reading gives one constraint."""
    x, y, _ = m.position
    range_m, bearing, wall = m.range_m, m.bearing, m.wall
    by_range = by_bearing = None
    if m.is_for_heading and scope is POSITION:
        return []
    as_drawn = rules.paper_uncertainty or rules.variant == "weighted"
    if range_m is not None and scope is not HEADING:
        if wall is None:
            by_range = range_circle(pose, x, y, range_m, m.range_sigma)
        else:
            by_range = wall_line(pose, x, y, wall.direction_rad, range_m, m.range_sigma)
    if bearing is not None and scope is not POSITION:
        if wall is None:
            by_bearing = bearing_heading(pose, x, y, bearing, m.bearing_sigma)
        else:
            by_bearing = wall_heading(pose, x, y, wall.direction_rad, bearing, m.bearing_sigma)
    elif bearing is not None and wall is None and rules.bearing_for_position:
        on_position = bearing_ray if as_drawn else bearing_position
        by_bearing = on_position(pose, x, y, bearing, m.bearing_sigma)
    found = [c for c in (by_range, by_bearing) if c is not None]
    return [c.uncoupled() for c in found] if as_drawn else found


def left_out(prior: Estimate, m: Measurement, cs: list[Constraint]) -> list[float]:
    """The mean square of what each linear constraint leaves out (see `curvature`); 0 where that
    does not matter."""
    x, y, place = m.position
    (own_x, own_y, _), own, _ = prior
    dx, dy, variances = x - own_x, y - own_y, own.xx + place.xx + (own.yy + place.yy)
    if m.wall is not None or variances <= CURVED_SHARE * (dx * dx + dy * dy):
        return [0.0] * len(cs)
    of_range, of_bearing = curvature(own.plus(Covariance3(*place, 0.0, 0.0, 0.0)), dx, dy)
    return [of_bearing * c.row[2] ** 2 if c.is_bearing else of_range for c in cs]


def curved(prior: Estimate, m: Measurement, cs: list[Constraint]) -> list[Constraint]:
    """The constraints on an object of the map, each with the variance that its linear form deserves
    (see `curved_variance`)."""
    found = []
    for c, square in zip(cs, left_out(prior, m, cs), strict=True):
        px, py, ph = prior.covariance.times(c.row)
        predicted = c.row[0] * px + c.row[1] * py + c.row[2] * ph
        variance = curved_variance(c.sigma * c.sigma, predicted, square)
        found.append(c if square == 0.0 else c._replace(sigma=math.sqrt(variance)))
    return found


def combine(evidence: Information, accepted: Iterable[GatedObject]) -> Information:
    """Step 4: `evidence` and the Gaussians at the closest points of all constraints on the map's
    objects, as one sum. Dependent measurements (see `Measurement`) are not in it, because they are
    merged one by one."""
    return evidence.with_all(
        (c.row, c.residual, c.sigma * c.sigma)
        for found in accepted
        if found.observation is None
        for c in found.constraints
    )


def gated_object(
    prior: Estimate, m: Measurement, cs: list[Constraint], common: CommonErrors | None = None
) -> GatedObject:
    """One object with the normalized innovation squared of its constraints."""
    covariance = prior.covariance
    added = EXACT
    sensitivities: tuple[Sensitivity, ...] = ()
    if common is not None:
        sensitivities = sensitivities_of(m, cs, common)
        added = common.innovation(tuple(c.row for c in cs), sensitivities)
    if m.is_dependent:
        observation = observation_of(prior, m, cs)
        if common is not None:
            observation = observation._replace(dependent=observation.dependent + added)
        nis = observation.normalized_innovation_squared(covariance)
        return GatedObject(m, cs, nis, observation, sensitivities)
    first, last = cs[0], cs[-1]
    rxx, ryy = first.sigma * first.sigma, last.sigma * last.sigma
    noise = rxx + SMALLEST_VARIANCE, 0.0, ryy + SMALLEST_VARIANCE
    if common is not None:
        noise = noise[0] + added.xx, added.xy, noise[2] + added.yy
    if first is last:
        nis = chi_square(covariance, noise, (first.row,), (first.residual,))
    else:
        rows, residuals = (first.row, last.row), (first.residual, last.residual)
        nis = chi_square(covariance, noise, rows, residuals)
    return GatedObject(m, cs, nis, None, sensitivities)


def sensitivities_of(
    m: Measurement, cs: list[Constraint], common: CommonErrors
) -> tuple[Sensitivity, ...]:
    """How much the residuals of constraints change with the common errors."""
    estimated = m.source if m.is_estimated else ""
    return tuple(
        common.sensitivity(estimated, c.place_row, c.is_bearing, c.row[2], m.range_m, m.bearing)
        for c in cs
    )


def observation_of(prior: Estimate, m: Measurement, cs: list[Constraint]) -> Observation:
    """The constraints of one object as an observation of the prior, at which they are linearized.

    The covariance of the object's place is compounded with the sensor's as the dependent part, as
    for a teammate's place (docs/paper.md, row 39). So is that of the sensor's direction, which acts
    on bearings as the heading does.
    """
    rows, residuals = tuple(c.row for c in cs), tuple(c.residual for c in cs)
    sensor = [c.sigma * c.sigma for c in cs]
    place = m.position.covariance
    (ax, ay), (bx, by) = cs[0].place_row, cs[-1].place_row
    common = place.xx * ax * bx + place.xy * (ax * by + ay * bx) + place.yy * ay * by
    first, last = place.along(ax, ay), place.along(bx, by)
    curves = left_out(prior, m, cs)  # the same in each repetition, as the teammate's error is
    dependent = Covariance2(first + curves[0], common, last + curves[-1])
    if m.turned_variance > 0.0:
        a, b, turned = cs[0].row[2], cs[-1].row[2], m.turned_variance
        dependent += Covariance2(turned * a * a, turned * a * b, turned * b * b)
    return Observation(rows, residuals, Covariance2(sensor[0], 0.0, sensor[-1]), dependent)
