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
MOST_TOLD_RAD = math.radians(170.0)  # beyond half a circle two headings tell another turn
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
    """A moment at which the robot knew its place."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2
    turned_rad: float  # by the wheels since the start: more than a circle is more than none


class Anchors(NamedTuple):
    """From where turns are compared, from where distances are."""

    turned: Anchor
    drove: Anchor


def learned(
    so_far: Learned, anchors: Anchors, now: Anchor, noise: OdometryNoise
) -> tuple[Learned, Anchors]:
    """What is known after one more update, and the anchors of the next comparisons.

    An anchor moves on when there was something to compare, or when there can be no more: it is too
    old, or the robot has turned too far since for a chord, or to tell by how much.
    """
    turned, drove = anchors
    turn = abs(now.turned_rad - turned.turned_rad)
    if turn > MOST_TOLD_RAD:
        turned = now
    elif turn >= LEAST_TURN_RAD:
        wheels = turned.odometry_from_robot.inverse() @ now.odometry_from_robot
        so_far, turned = _turn_compared(so_far, turned, now, wheels, noise), now
    wheels = drove.odometry_from_robot.inverse() @ now.odometry_from_robot
    way = math.hypot(wheels.x, wheels.y)
    if abs(now.turned_rad - drove.turned_rad) > MOST_TURN_RAD:
        drove = now
    elif way >= LEAST_WAY_M:
        so_far, drove = _way_compared(so_far, drove, now, wheels, noise), now
    turned, drove = (now if now.stamp_ns - a.stamp_ns > LONGEST_NS else a for a in (turned, drove))
    return so_far, Anchors(turned, drove)


def _turn_compared(
    so_far: Learned, then: Anchor, now: Anchor, wheels: Pose2, noise: OdometryNoise
) -> Learned:
    around = _turn_variance(wheels, noise)
    p, q = then.estimate.covariance.hh, now.estimate.covariance.hh
    if q > RENEWED_SHARE * (p + around):
        return so_far
    turn = wrap_angle(now.estimate.pose.heading - then.estimate.pose.heading)
    excess = wrap_angle(turn - wheels.heading)
    change, variance = _updated(so_far.turn_variance, wheels.heading, excess, p + q + around)
    scale = so_far.turn_scale * (1.0 + change)
    return so_far._replace(turn_scale=scale, turn_variance=variance)


def _way_compared(
    so_far: Learned, then: Anchor, now: Anchor, wheels: Pose2, noise: OdometryNoise
) -> Learned:
    way = math.hypot(wheels.x, wheels.y)
    along = noise.distance_sigma_m_per_sqrt_m**2 * way
    p, q = then.estimate, now.estimate
    before, after = p.position_sigma_m**2, q.position_sigma_m**2
    if after > RENEWED_SHARE * (before + along + p.covariance.hh * way * way):
        return so_far
    found = p.pose.inverse() @ q.pose
    # along the wheels' direction: an error across it would only ever lengthen the way
    excess = (found.x * wheels.x + found.y * wheels.y) / way - way
    noise_m2 = before + after + along
    change, variance = _updated(so_far.distance_variance, way, excess, noise_m2)
    scale = so_far.distance_scale * (1.0 + change)
    so_far = so_far._replace(distance_scale=scale, distance_variance=variance)
    aside = wrap_angle(math.atan2(found.y, found.x) - math.atan2(wheels.y, wheels.x))
    doubt = p.covariance.hh + (before + after) / (way * way) + _turn_variance(wheels, noise) / 3.0
    change, variance = _updated(so_far.bearing_variance, 1.0, aside, doubt)
    bias = so_far.bearing_bias_rad + change
    return so_far._replace(bearing_bias_rad=bias, bearing_variance=variance)


def _turn_variance(wheels: Pose2, noise: OdometryNoise) -> float:
    return noise.turn_sigma_rad_per_sqrt_rad**2 * abs(
        wheels.heading
    ) + noise.turn_sigma_rad_per_sqrt_m**2 * math.hypot(wheels.x, wheels.y)


def _updated(variance: float, h: float, excess: float, noise: float) -> tuple[float, float]:
    """(change of the value, its new variance) after `excess = h x error + noise`."""
    total = h * h * variance + noise
    if excess * excess > GATE * total:
        return 0.0, variance
    gain = variance * h / total
    return gain * excess, (1.0 - gain * h) * variance
