"""Step 3 of the cycle: what one measurement says about the pose, as a curve (paper, section 3).

A range to a point gives a circle, a bearing gives a ray or one heading, a distance to a wall gives
a parallel line (figure 3). Every constraint is linearized at the same prior:

    residual = row . (true pose - prior pose) + noise of `sigma`

`row` is the normal of the curve at its point closest to the prior (figure 1 c); where the heading
matters, the row's third entry is its lever (docs/paper.md, resolution a).

`circle` and `heading` are the formulas. They take (dx, dy), the object's position minus the
robot's in the field's frame (m), and return plain numbers, for the loop over landmarks; the other
functions return a `Constraint`.
"""

import math
from math import cos, sin, sqrt
from typing import Final, NamedTuple

from cpcbl_team.estimate import Covariance3, Row
from cpcbl_team.gaussian import width_per_m
from cpcbl_team.geometry import Pose2, new, wrap_angle

_atan2: Final = math.atan2  # compiled code finds a constant faster than a global name
NEAREST_M: Final = 1e-3  # nearer than this a direction means nothing
FARTHEST_RAD: Final = 0.5 * math.pi  # the object of a ray is not behind the robot


def circle(dx: float, dy: float, distance_m: float, range_m: float) -> Row:
    """The circle of a range: its unit normal (u, v), and the residual (m)."""
    return -dx / distance_m, -dy / distance_m, range_m - distance_m


def heading(dx: float, dy: float, distance_squared: float, bearing: float, prior: float) -> Row:
    """The one heading that a bearing leaves where the position is right.

    Returns the change of the expected bearing with the position (rad/m), and the residual against
    the `prior` heading (rad).
    """
    residual = wrap_angle(_atan2(dy, dx) - bearing - prior)
    return -dy / distance_squared, dx / distance_squared, residual


TELLS_NOTHING: Final = 1e12  # m^2, rad^2
CURVED_SHARE: Final = 1e-3
"""Below this ratio of the position's variance to the squared distance, curves count as straight."""


class SecondOrder(NamedTuple):
    """Mean and variance of what the linear form of a reading leaves out."""

    mean: float
    variance: float

    @property
    def mean_square(self) -> float:
        return self.mean * self.mean + self.variance


def second_order_terms(
    xx: float, xy: float, yy: float, dx: float, dy: float
) -> tuple[SecondOrder, SecondOrder]:
    """Of the range (m) and the bearing (rad) of an object (dx, dy) away, from a position with the
    covariance ((xx, xy), (xy, yy)) (m^2).

    With errors a across (to the left of) and r along the line of sight, and the distance d, these
    are a^2 / 2 d and -a r / d^2: the second-order terms (Jazwinski 1970, section 9.3).
    """
    squared = dx * dx + dy * dy
    along = (dx * dx * xx + 2.0 * dx * dy * xy + dy * dy * yy) / squared
    across = xx + yy - along
    common = (dx * dy * (yy - xx) + (dx * dx - dy * dy) * xy) / squared
    of_range = 0.5 * across / sqrt(squared), 0.5 * across * across / squared
    of_bearing = -common / squared, (along * across + common * common) / (squared * squared)
    return new(SecondOrder, of_range), new(SecondOrder, of_bearing)


def curvature(prior: Covariance3, dx: float, dy: float) -> tuple[float, float]:
    """The mean squares of what a linear range (m^2) and a linear bearing (rad^2) leave out."""
    xx, xy, yy, _, _, _ = prior
    of_range, of_bearing = second_order_terms(xx, xy, yy, dx, dy)
    return of_range.mean_square, of_bearing.mean_square


def curved_variance(variance: float, predicted: float, curvature: float) -> float:
    """The variance with which a measurement counts if its linear form is not exact within the
    prior.

    `predicted` is the variance of the measurement that the prior predicts, H P H^T. The error of
    the linear form is the same in each repetition while the robot stands. So that part of the
    prior's variance stays (as that of a considered state; Schmidt 1966), and only the rest is
    reduced. Without a rest the measurement tells nothing.
    """
    if curvature <= 0.01 * predicted:
        return variance
    rest = predicted - curvature
    if rest <= 0.0:
        return TELLS_NOTHING
    after = curvature + rest * variance / (rest + variance)
    return min(after * predicted / (predicted - after), TELLS_NOTHING)


class Constraint(NamedTuple):
    """One scalar constraint on a pose, relative to an object: if that moves, the curve moves."""

    row: Row
    residual: float  # metres for a position, radians for a heading
    sigma: float  # of the sensor, in the residual's unit
    distance_m: float  # robot to object; non-probabilistic weights are its inverse
    on_heading: bool
    place_row: tuple[float, float]
    """By how much the residual falls with the error of the object's place: of x and y (m), or of a
    wall's offset along its normal (m) and its direction (rad)."""

    @property
    def is_bearing(self) -> bool:
        """Whether the heading matters: not for ranges and distances, nor where it is ignored."""
        return self.row[2] != 0.0

    def uncoupled(self) -> "Constraint":
        """As the paper prints it: heading and position ignore each other's error."""
        x, y, h = self.row
        return self._replace(row=(0.0, 0.0, h) if self.on_heading else (x, y, 0.0))

    def closest_point(self, pose: Pose2) -> tuple[float, float]:
        """The point of a position constraint that is closest to the estimate (figure 1 c)."""
        return pose.x + self.residual * self.row[0], pose.y + self.residual * self.row[1]


def range_circle(
    pose: Pose2, x: float, y: float, range_m: float, sigma_m: float
) -> Constraint | None:
    """A range to the point (x, y). Its width is sigma_r along the normal; a circle says nothing
    along its tangent (docs/paper.md, row 35). None where the estimate is at the point."""
    dx, dy = x - pose.x, y - pose.y
    distance = math.hypot(dx, dy)
    if distance < NEAREST_M:
        return None
    u, v, residual = circle(dx, dy, distance, range_m)
    weighed = max(range_m, NEAREST_M)
    return Constraint((u, v, 0.0), residual, sigma_m, weighed, False, (u, v))


def bearing_ray(pose: Pose2, x: float, y: float, bearing: float, sigma: float) -> Constraint | None:
    """A bearing to the point (x, y), the heading taken as right: the ray as the paper draws it. Its
    width is d sin(sigma_a) (equation 1b). None where the estimate is on the other side of the
    point."""
    dx, dy = x - pose.x, y - pose.y
    c, s = cos(pose.heading + bearing), sin(pose.heading + bearing)
    ahead, residual = c * dx + s * dy, c * dy - s * dx
    if ahead < NEAREST_M:
        return None
    distance = math.hypot(dx, dy)
    width = distance * width_per_m(sigma)
    return Constraint((-s, c, ahead), residual, width, distance, False, (-s, c))


def bearing_position(
    pose: Pose2, x: float, y: float, bearing: float, sigma: float
) -> Constraint | None:
    """A bearing to the point (x, y), linearized at the estimate. The normal of a ray errs with its
    bearing, and so does the heading, so this is the constraint on the heading, in metres across the
    line of sight."""
    c = bearing_heading(pose, x, y, bearing, sigma)
    if c is None or abs(c.residual) > FARTHEST_RAD:
        return None
    d = c.distance_m
    u, v = d * c.row[0], d * c.row[1]
    return Constraint((u, v, d), d * c.residual, d * width_per_m(sigma), d, False, (u, v))


def bearing_heading(
    pose: Pose2, x: float, y: float, bearing: float, sigma: float
) -> Constraint | None:
    """A bearing to the point (x, y), the position taken as right. None where the estimate is at
    the point."""
    dx, dy = x - pose.x, y - pose.y
    distance = math.hypot(dx, dy)
    if distance < NEAREST_M:
        return None
    u, v, residual = heading(dx, dy, distance**2, bearing, pose.heading)
    return Constraint((u, v, 1.0), residual, sigma, distance, True, (u, v))


def wall_line(
    pose: Pose2, x: float, y: float, wall_direction: float, distance_m: float, sigma_m: float
) -> Constraint:
    """Perpendicular distance to a wall through (x, y): the parallel line on the robot's side."""
    nx, ny = -sin(wall_direction), cos(wall_direction)
    offset = nx * (pose.x - x) + ny * (pose.y - y)
    side = 1.0 if offset >= 0.0 else -1.0
    u, v = side * nx, side * ny
    weighed = max(distance_m, NEAREST_M)
    of_place = side, v * (pose.x - x) - u * (pose.y - y)
    return Constraint((u, v, 0.0), distance_m - abs(offset), sigma_m, weighed, False, of_place)


def wall_heading(
    pose: Pose2, x: float, y: float, wall_direction: float, bearing: float, sigma: float
) -> Constraint:
    """Direction of the perpendicular to a wall: one heading, wherever the robot is."""
    nx, ny = -sin(wall_direction), cos(wall_direction)
    offset = nx * (pose.x - x) + ny * (pose.y - y)
    towards = wall_direction - math.copysign(0.5 * math.pi, offset)
    residual = wrap_angle(towards - bearing - pose.heading)
    weighed = max(abs(offset), NEAREST_M)
    return Constraint((0.0, 0.0, 1.0), residual, sigma, weighed, True, (0.0, 1.0))
