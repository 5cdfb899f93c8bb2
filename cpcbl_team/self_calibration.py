"""What a robot learns of its own odometry and camera while it drives.

Between two moments at which landmarks or teammates told it where it is, the robot compares how far
it came and turned with what its wheels said. Three numbers are learned, each by a scalar Kalman
filter: the scales of distance and turn, and the bias of bearings (a heading found by biased
bearings does not point where the robot drives).
"""

import math
from typing import NamedTuple

from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, wrap_angle

LEAST_WAY_M = 0.7
LEAST_TURN_RAD = 1.0
MOST_TURN_RAD = 0.7  # beyond, a chord says little of the way
LONGEST_NS = 30_000_000_000
RENEWED_SHARE = 0.5  # of the variance that odometry alone would leave
GATE = 9.0


class Learned(NamedTuple):
    """Values and variances; the corrected value is `scale x reading` and `reading - bias`."""

    distance_scale: float = 1.0
    turn_scale: float = 1.0
    bearing_bias_rad: float = 0.0
    distance_variance: float = 0.05**2
    turn_variance: float = 0.05**2
    bearing_variance: float = math.radians(1.5) ** 2


class Anchor(NamedTuple):
    """The moment from which the comparison counts."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2


def learned(
    so_far: Learned, anchor: Anchor, now: Anchor, noise: OdometryNoise
) -> tuple[Learned, Anchor]:
    """What is known after one more update, and the anchor for the next comparison.

    The anchor moves on when there was something to compare, or when it is too old to be.
    """
    wheels = anchor.odometry_from_robot.inverse() @ now.odometry_from_robot
    way, turn = math.hypot(wheels.x, wheels.y), abs(wheels.heading)
    compares_turn = turn >= LEAST_TURN_RAD
    compares_way = way >= LEAST_WAY_M and turn <= MOST_TURN_RAD
    if not (compares_turn or compares_way):
        return so_far, now if now.stamp_ns - anchor.stamp_ns > LONGEST_NS else anchor
    around = noise.turn_sigma_rad_per_sqrt_rad**2 * turn + noise.turn_sigma_rad_per_sqrt_m**2 * way
    along = noise.distance_sigma_m_per_sqrt_m**2 * way
    p, q = anchor.estimate.covariance, now.estimate.covariance
    found = anchor.estimate.pose.inverse() @ now.estimate.pose
    headings, places = p.hh + q.hh, 0.5 * (p.xx + p.yy + q.xx + q.yy)
    sideways = around * way * way / 3.0
    if q.hh > RENEWED_SHARE * (p.hh + around):
        compares_turn = False
    if 0.5 * (q.xx + q.yy) > RENEWED_SHARE * (0.5 * (p.xx + p.yy + p.hh * way * way) + along):
        compares_way = False
    if compares_turn:
        excess = wrap_angle(found.heading - wheels.heading)
        change, variance = _updated(so_far.turn_variance, wheels.heading, excess, headings + around)
        scale = so_far.turn_scale * (1.0 + change)
        so_far = so_far._replace(turn_scale=scale, turn_variance=variance)
    if compares_way:
        excess = math.hypot(found.x, found.y) - way
        change, variance = _updated(so_far.distance_variance, way, excess, places + along)
        scale = so_far.distance_scale * (1.0 + change)
        so_far = so_far._replace(distance_scale=scale, distance_variance=variance)
        aside = wrap_angle(math.atan2(found.y, found.x) - math.atan2(wheels.y, wheels.x))
        doubt = p.hh + (places + sideways) / (way * way)
        change, variance = _updated(so_far.bearing_variance, 1.0, aside, doubt)
        bias = so_far.bearing_bias_rad + change
        so_far = so_far._replace(bearing_bias_rad=bias, bearing_variance=variance)
    return so_far, now


def _updated(variance: float, h: float, excess: float, noise: float) -> tuple[float, float]:
    """(change of the value, its new variance) after `excess = h x error + noise`."""
    total = h * h * variance + noise
    if excess * excess > GATE * total:
        return 0.0, variance
    gain = variance * h / total
    return gain * excess, (1.0 - gain * h) * variance
