"""What one measurement says about the pose: a curve, its point closest to the estimate, its width.

Range to a point gives a circle, bearing a ray or one heading, distance to a wall a parallel line
(paper, section 3 and figure 3). Every constraint is linearized at the same prior:

    residual = row . (true pose - prior pose) + noise of `sigma`

so that `row` is the curve's normal with, where the heading matters, its lever (resolution a).
"""

import math
from typing import Final

import msgspec

from cpcbl_team.estimate import Row
from cpcbl_team.geometry import Pose2, wrap_angle

NEAREST_M: Final = 1e-3  # nearer than this a direction means nothing


class Constraint(msgspec.Struct, frozen=True, gc=False):
    """One scalar constraint on a pose, relative to an object: moving that moves the curve."""

    row: Row
    residual: float  # metres for a position, radians for a heading
    sigma: float  # of the sensor, in the residual's unit
    distance_m: float  # robot to object; non-probabilistic weights are its inverse
    on_heading: bool
    place_row: tuple[float, float]  # how the residual follows an error in the object's place

    def uncoupled(self) -> "Constraint":
        """As the paper prints it: heading and position know nothing of each other's error."""
        x, y, h = self.row
        row = (0.0, 0.0, h) if self.on_heading else (x, y, 0.0)
        return msgspec.structs.replace(self, row=row)

    def closest_point(self, pose: Pose2) -> tuple[float, float]:
        """The point of a position constraint that is closest to the estimate (figure 1 c)."""
        return pose.x + self.residual * self.row[0], pose.y + self.residual * self.row[1]


def range_circle(
    pose: Pose2, x: float, y: float, range_m: float, sigma_m: float
) -> Constraint | None:
    """Range to a point: a circle. Width sigma_r along its normal, nothing along its tangent."""
    dx, dy = pose.x - x, pose.y - y
    distance = math.hypot(dx, dy)
    if distance < NEAREST_M:
        return None
    u, v = dx / distance, dy / distance
    weighed = max(range_m, NEAREST_M)
    return Constraint((u, v, 0.0), range_m - distance, sigma_m, weighed, False, (u, v))


def bearing_ray(pose: Pose2, x: float, y: float, bearing: float, sigma: float) -> Constraint | None:
    """Bearing to a point, heading taken as right: a ray from the point. Width d sin(sigma_a).

    None when the estimate lies on the other side of the point: no ray passes there.
    """
    direction = pose.heading + bearing
    ux, uy = math.cos(direction), math.sin(direction)
    dx, dy = x - pose.x, y - pose.y
    ahead = ux * dx + uy * dy
    if ahead < NEAREST_M:
        return None
    distance = math.hypot(dx, dy)
    residual = ux * dy - uy * dx
    width = distance * math.sin(min(sigma, 0.5 * math.pi))
    return Constraint((-uy, ux, ahead), residual, width, distance, False, (-uy, ux))


def bearing_heading(
    pose: Pose2, x: float, y: float, bearing: float, sigma: float
) -> Constraint | None:
    """Bearing to a point, position taken as right: one heading."""
    dx, dy = x - pose.x, y - pose.y
    distance = math.hypot(dx, dy)
    if distance < NEAREST_M:
        return None
    residual = wrap_angle(math.atan2(dy, dx) - bearing - pose.heading)
    q = distance**2
    u, v = -dy / q, dx / q
    return Constraint((u, v, 1.0), residual, sigma, distance, True, (u, v))


def wall_line(
    pose: Pose2, x: float, y: float, wall_direction: float, distance_m: float, sigma_m: float
) -> Constraint:
    """Perpendicular distance to a wall through (x, y): the parallel line on the robot's side."""
    nx, ny = -math.sin(wall_direction), math.cos(wall_direction)
    offset = nx * (pose.x - x) + ny * (pose.y - y)
    side = 1.0 if offset >= 0.0 else -1.0
    u, v = side * nx, side * ny
    weighed = max(distance_m, NEAREST_M)
    return Constraint((u, v, 0.0), distance_m - abs(offset), sigma_m, weighed, False, (u, v))


def wall_heading(
    pose: Pose2, x: float, y: float, wall_direction: float, bearing: float, sigma: float
) -> Constraint:
    """Direction of the perpendicular to a wall: one heading, wherever the robot is."""
    nx, ny = -math.sin(wall_direction), math.cos(wall_direction)
    offset = nx * (pose.x - x) + ny * (pose.y - y)
    towards = wall_direction - math.copysign(0.5 * math.pi, offset)
    residual = wrap_angle(towards - bearing - pose.heading)
    weighed = max(abs(offset), NEAREST_M)
    return Constraint((0.0, 0.0, 1.0), residual, sigma, weighed, True, (0.0, 0.0))
