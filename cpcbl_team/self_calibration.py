"""Calibration of a robot's own odometry and bearings while it drives.

Between two times at which landmarks or teammates gave it an accurate pose, the robot compares how
far it moved and turned with what its odometry measured. Three numbers result, each by a scalar
Kalman filter: the scale of distances, the scale of turns, and the bias of bearings (a heading from
biased bearings does not point where the robot drives).
"""

import math
from typing import NamedTuple

from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, wrap_angle

LEAST_DISTANCE_M = 0.7
LEAST_TURN_RAD = 1.0
MOST_TURN_RAD = math.radians(170.0)  # beyond half a circle two headings give another turn
MOST_TURN_OF_CHORD_RAD = 0.7  # beyond, the chord is much shorter than the path
LONGEST_NS = 30_000_000_000
RENEWED_SHARE = 0.5  # an accurate pose has at most this share of the variance by odometry alone
GATE = 9.0  # 3 sigma


class SelfCalibration(NamedTuple):
    """Values and variances: a corrected value is `scale x reading`, or `reading - bias`."""

    distance_scale: float = 1.0
    turn_scale: float = 1.0
    bearing_bias_rad: float = 0.0
    distance_variance: float = 0.05**2
    turn_variance: float = 0.05**2
    bearing_variance: float = math.radians(1.5) ** 2


class ReferencePose(NamedTuple):
    """A time at which the robot's pose was updated, with which a later pose is compared."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2
    total_turn_rad: float  # by odometry since the start, without wrapping


class ReferencePoses(NamedTuple):
    """The poses from which the next turn and the next distance are measured."""

    turn: ReferencePose
    distance: ReferencePose


def self_calibrate(
    known: SelfCalibration, references: ReferencePoses, now: ReferencePose, noise: OdometryNoise
) -> tuple[SelfCalibration, ReferencePoses]:
    """The calibration after one more update of the pose, and the references of the next ones.

    A reference is replaced when it was compared, and when it can no longer be: because it is too
    old, or because the robot has turned too far since for a chord, or for an unambiguous turn.
    """
    turned, driven = references
    turn = abs(now.total_turn_rad - turned.total_turn_rad)
    if turn > MOST_TURN_RAD:
        turned = now
    elif turn >= LEAST_TURN_RAD:
        known, turned = _with_turn(known, turned, now, noise), now
    x, y, _ = _motion(driven, now)
    if abs(now.total_turn_rad - driven.total_turn_rad) > MOST_TURN_OF_CHORD_RAD:
        driven = now
    elif math.hypot(x, y) >= LEAST_DISTANCE_M:
        known, driven = _with_distance(known, driven, now, noise), now
    turned, driven = (
        now if now.stamp_ns - r.stamp_ns > LONGEST_NS else r for r in (turned, driven)
    )
    return known, ReferencePoses(turned, driven)


def _motion(then: ReferencePose, now: ReferencePose) -> Pose2:
    """The motion between two times by odometry, in the robot's frame then."""
    return then.odometry_from_robot.inverse() @ now.odometry_from_robot


def _with_turn(
    known: SelfCalibration, then: ReferencePose, now: ReferencePose, noise: OdometryNoise
) -> SelfCalibration:
    """The calibration after a turn was compared with that of odometry."""
    odometry = _motion(then, now)
    odometry_variance = _turn_variance(odometry, noise)
    p, q = then.estimate.covariance.hh, now.estimate.covariance.hh
    if q > RENEWED_SHARE * (p + odometry_variance):
        return known
    turn = wrap_angle(now.estimate.pose.heading - then.estimate.pose.heading)
    excess = wrap_angle(turn - odometry.heading)
    total = p + q + odometry_variance
    change, variance = _kalman_update(known.turn_variance, odometry.heading, excess, total)
    scale = known.turn_scale * (1.0 + change)
    return known._replace(turn_scale=scale, turn_variance=variance)


def _with_distance(
    known: SelfCalibration, then: ReferencePose, now: ReferencePose, noise: OdometryNoise
) -> SelfCalibration:
    """The calibration after a distance, and its direction, were compared with those of odometry."""
    odometry = _motion(then, now)
    distance = math.hypot(odometry.x, odometry.y)
    along = noise.distance_sigma_m_per_sqrt_m**2 * distance
    p, q = then.estimate, now.estimate
    before, after = p.position_sigma_m**2, q.position_sigma_m**2
    if after > RENEWED_SHARE * (before + along + p.covariance.hh * distance * distance):
        return known
    moved = p.pose.inverse() @ q.pose
    # Only along odometry's direction: an error across it would always lengthen the distance.
    excess = (moved.x * odometry.x + moved.y * odometry.y) / distance - distance
    total = before + after + along
    change, variance = _kalman_update(known.distance_variance, distance, excess, total)
    scale = known.distance_scale * (1.0 + change)
    known = known._replace(distance_scale=scale, distance_variance=variance)
    aside = wrap_angle(math.atan2(moved.y, moved.x) - math.atan2(odometry.y, odometry.x))
    turn_part = _turn_variance(odometry, noise) / 3.0
    total = p.covariance.hh + (before + after) / (distance * distance) + turn_part
    change, variance = _kalman_update(known.bearing_variance, 1.0, aside, total)
    bias = known.bearing_bias_rad + change
    return known._replace(bearing_bias_rad=bias, bearing_variance=variance)


def _turn_variance(odometry: Pose2, noise: OdometryNoise) -> float:
    """The variance (rad^2) of the heading of this motion."""
    by_turn = noise.turn_sigma_rad_per_sqrt_rad**2 * abs(odometry.heading)
    return by_turn + noise.turn_sigma_rad_per_sqrt_m**2 * math.hypot(odometry.x, odometry.y)


def _kalman_update(variance: float, h: float, excess: float, noise: float) -> tuple[float, float]:
    """(change of the value, its new variance) after `excess = h x error + noise`; none if the gate
    rejects it."""
    total = h * h * variance + noise
    if excess * excess > GATE * total:
        return 0.0, variance
    gain = variance * h / total
    return gain * excess, (1.0 - gain * h) * variance
