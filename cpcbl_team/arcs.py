"""An uncertain heading puts the position on an arc, not on its tangent.

A robot that drives with an uncertain heading is somewhere on an arc about the place where it set
out. A robot that sees a single landmark is on an arc about that landmark. The covariance of
position and heading says where the arc's centre is. So an estimate can be written as the turn about
that centre, and an offset that turns with it. In these coordinates it is a Gaussian even where the
heading's sigma is large: they are the coordinates of the group of rigid motions (Barrau & Bonnabel,
The invariant extended Kalman filter as a stable observer, IEEE Transactions on Automatic Control
62, 2017). Without a turn they are those of the pose.
"""

import math
from math import cos, sin
from typing import Final, NamedTuple

from cpcbl_team.estimate import SMALLEST_VARIANCE, ZERO3, Covariance3, Estimate, Matrix3, Row
from cpcbl_team.geometry import Pose2, wrap_angle

STRAIGHT_RAD: Final = math.radians(1.0)  # of the heading's sigma: below, no arc bends visibly


class Arc(NamedTuple):
    """An estimate as a turn (rad) about the centre of its arc, and an offset (x, y; m) that turns
    with it: these are independent, and each has a mean of 0."""

    pose: Pose2
    x: float  # of the vector from the centre to the position, m
    y: float
    covariance: Covariance3  # of (offset x, offset y, turn)

    @staticmethod
    def of(estimate: Estimate) -> "Arc":
        """The arc on which an estimate lies. Raises ZeroDivisionError for a heading without
        variance."""
        xx, xy, yy, xh, yh, hh = estimate.covariance
        lever_x, lever_y = xh / hh, yh / hh  # d(position) / d(heading)
        xx += SMALLEST_VARIANCE - lever_x * xh
        yy += SMALLEST_VARIANCE - lever_y * yh
        apart = Covariance3(xx, xy - lever_x * yh, yy, 0.0, 0.0, hh)
        return Arc(estimate.pose, lever_y, -lever_x, apart)

    def at(self, offset: Row) -> Pose2:
        """The pose (field_from_robot) with this offset and turn."""
        px, py, turn = self.x + offset[0], self.y + offset[1], offset[2]
        c, s = cos(turn), sin(turn)
        x, y, heading = self.pose
        x, y = x + c * px - s * py - self.x, y + s * px + c * py - self.y
        return Pose2(x, y, wrap_angle(heading + turn))

    def jacobian(self, offset: Row) -> Matrix3:
        """d(pose) / d(offset, turn) there."""
        px, py, turn = self.x + offset[0], self.y + offset[1], offset[2]
        c, s = cos(turn), sin(turn)
        return c, -s, -s * px - c * py, s, c, c * px - s * py, 0.0, 0.0, 1.0

    def cost(self, offset: Row) -> float:
        """The squared Mahalanobis distance of an offset and a turn from the mean."""
        x, y, turn = offset
        xx, xy, yy, _, _, hh = self.covariance
        across = xx * y * y - 2.0 * xy * x * y + yy * x * x
        return across / (xx * yy - xy * xy) + turn * turn / hh

    def tangent_offset(self, offset: Row) -> Row:
        """How far the pose there is from the mean, along the tangent there."""
        a, b, c, d, e, f, _, _, _ = self.jacobian(offset)
        x, y, turn = offset
        return a * x + b * y + c * turn, d * x + e * y + f * turn, turn

    def tangent_map(self, offset: Row) -> Matrix3:
        """The matrix that turns an error of the estimate on the tangent at its mean into an error
        on the tangent there."""
        a, b, c, d, e, f, _, _, _ = self.jacobian(offset)
        to_x, to_y = -self.y, self.x  # the tangent at the mean
        return a, b, c - a * to_x - b * to_y, d, e, f - d * to_x - e * to_y, 0.0, 0.0, 1.0


def arc_variance(heading_variance: float) -> float:
    """The mean square by which a point at distance 1 comes nearer when its direction turns by an
    error e: E[(1 - cos e)^2] of a Gaussian e, by E[cos n e] = exp(-n^2 variance / 2). It is about
    3/4 of the square of the variance while that is small."""
    return -2.0 * math.expm1(-0.5 * heading_variance) + 0.5 * math.expm1(-2.0 * heading_variance)


def with_arc_width(estimate: Estimate) -> Estimate:
    """The estimate with a covariance of the position that contains the whole arc, not only its
    tangent. Others are told this estimate. It is no prior of an update, because the next update
    would count its own bend again."""
    _, _, _, xh, yh, hh = estimate.covariance
    if hh < STRAIGHT_RAD * STRAIGHT_RAD or xh == yh == 0.0:
        return estimate
    return _with_bend(estimate, arc_variance(hh) / (hh * hh))


def _with_bend(estimate: Estimate, k: float) -> Estimate:
    """With k times the squared covariance of position and heading, along the radius of its arc."""
    _, _, _, xh, yh, _ = estimate.covariance
    added = Covariance3(k * yh * yh, -k * xh * yh, k * xh * xh, 0.0, 0.0, 0.0)
    shared = estimate.shared
    shared = shared if shared is ZERO3 else shared.plus(added)
    return Estimate(estimate.pose, estimate.covariance.plus(added), shared)


def with_lost_bend(estimate: Estimate) -> Estimate:
    """The prior of an update along an arc, with the bend that its arc does not contain.

    If all of the heading's error e is as old as the way, the way ends nearer by b^2 / 2 l, with b =
    l e aside of it, and the arc contains that. But of the variance of b a turn since then, or the
    noise on the way, leaves the share rho^2 to e alone. Then rho^4 is how much of the variance of
    b^2 (of normal errors) e explains; the rest is added along the radius.
    """
    xx, xy, yy, xh, yh, hh = estimate.covariance
    squared = xh * xh + yh * yh
    if hh < STRAIGHT_RAD * STRAIGHT_RAD or squared == 0.0:
        return estimate
    aside = (xx * xh * xh + 2.0 * xy * xh * yh + yy * yh * yh) / squared
    explained = min(squared / (aside * hh), 1.0)
    return _with_bend(estimate, arc_variance(hh) / (hh * hh) * (1.0 - explained * explained))


def lever_change(dx: float, dy: float) -> Matrix3:
    """The matrix that an error (x, y, heading) is multiplied by when its pose moves by (dx, dy) and
    it stays the same turn about the origin: that turn moves the position by (-dy, dx) more."""
    return 1.0, 0.0, -dy, 0.0, 1.0, dx, 0.0, 0.0, 1.0


def about_own_pose(estimate: Estimate, linearized_at: Pose2) -> Estimate:
    """The estimate with a covariance about its own pose, not about the one at which its
    measurements were linearized.

    A turn about the only landmark changes no reading. What its error does to the position depends
    on where the robot is. So when an update moves the estimate, the covariance has to follow. Else
    updates would make certainty of that turn, of which nothing is measured (Huang, Mourikis &
    Roumeliotis, IJRR 29, 2010). This is the right-invariant error of Barrau & Bonnabel (2017), to
    first order.
    """
    pose, covariance, shared = estimate
    change = lever_change(pose.x - linearized_at.x, pose.y - linearized_at.y)
    shared = shared if shared is ZERO3 else shared.transformed(change)
    return Estimate(pose, covariance.transformed(change), shared)


def square_root(covariance: Covariance3) -> tuple[Row, Row, Row]:
    """The columns of a square root of a covariance: the sum of their outer products is the
    covariance (the Cholesky decomposition)."""
    xx, xy, yy, xh, yh, hh = covariance
    x = math.sqrt(max(xx, SMALLEST_VARIANCE))
    a, b = xy / x, xh / x
    y = math.sqrt(max(yy - a * a, SMALLEST_VARIANCE))
    c = (yh - a * b) / y
    return (x, a, b), (0.0, y, c), (0.0, 0.0, math.sqrt(max(hh - b * b - c * c, SMALLEST_VARIANCE)))
