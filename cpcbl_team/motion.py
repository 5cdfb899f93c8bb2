"""Differential odometry: the pose moves, its uncertainty is compounded as J C J^T (paper, sec. 4).

C is the joint covariance of the estimate and of the differential motion; J is the Jacobian of the
compounding with respect to both. Motion noise is white, so its variance grows with the way.
"""

import math
from math import cos, sin
from typing import Final, NamedTuple

import msgspec

from cpcbl_team.arcs import lever_change
from cpcbl_team.config import OdometryNoise, OdometrySettings
from cpcbl_team.estimate import ZERO3, Covariance3, Estimate, Matrix3, Six, circle_variance
from cpcbl_team.geometry import Pose2, new, wrap_angle
from cpcbl_team.inputs import Odometry

_astuple: Final = msgspec.structs.astuple  # see `constraints._atan2`


class MotionVariance(NamedTuple):
    """How far a motion may be wrong beyond the odometry's noise: variances."""

    distance: float  # m^2
    turn: float  # rad^2


class PoseTimes(NamedTuple):
    """A time of the position and one of the heading, s."""

    position_s: float
    heading_s: float


DRIFT_SHARE: Final = 0.1  # of the way: how far dead reckoning errs, roughly
NO_VARIANCE: Final = MotionVariance(0.0, 0.0)
AT_REST: Final = Estimate(Pose2(0.0, 0.0, 0.0), ZERO3)
FASTEST: Final = 50.0  # m/s and rad/s: a piece of odometry that is faster is too short to tell


def motion_jacobian(heading: float, distance: float, turn: float) -> Matrix3:
    """d(pose after) / d(pose before)."""
    direction = heading + 0.5 * turn
    return lever_change(distance * math.cos(direction), distance * math.sin(direction))


def motion_noise(
    heading: float, distance: float, turn: float, noise: OdometryNoise, crawl_s: float = 0.0
) -> Covariance3:
    """The differential motion's covariance, rotated into the field's frame."""
    certain = Estimate(Pose2(0.0, 0.0, heading), ZERO3)
    return move(certain, distance, turn, noise, crawl_s).covariance


def distance_variance(distance: float, turn: float, noise: OdometryNoise, crawl_s: float) -> float:
    """The variance (m^2) of the distance of an arc that turns by `turn`."""
    per_m, per_rad = noise.distance_sigma_m_per_sqrt_m, noise.distance_sigma_m_per_sqrt_rad
    along = per_m * per_m * abs(distance)
    if crawl_s > 0.0:
        along = max(along, noise.crawl_sigma_m_per_sqrt_s**2 * crawl_s)
    return along + per_rad * per_rad * abs(turn)


def turn_variance(distance: float, turn: float, noise: OdometryNoise) -> float:
    """The variance (rad^2) of the turn of an arc of `distance` metres."""
    per_m, per_rad = noise.turn_sigma_rad_per_sqrt_m, noise.turn_sigma_rad_per_sqrt_rad
    return per_m * per_m * abs(distance) + per_rad * per_rad * abs(turn)


def covariance_after(
    covariance: Six, distance: float, c: float, s: float, along: float, around: float
) -> Six:
    """The covariance after an arc of `distance` metres in the direction (c, s), with these
    variances of its length and its turn: F P F^T + C, written out, for every step needs it."""
    xx, xy, yy, xh, yh, hh = covariance
    # where a heading error of one radian leads, in metres: the last column of F
    lx, ly = -distance * s, distance * c
    # where a turn error leads: half of it; and its covariance with the position
    wx, wy = 0.5 * around * lx, 0.5 * around * ly
    nxh, nyh = xh + lx * hh, yh + ly * hh
    xx += lx * (xh + nxh + 0.5 * wx) + along * c * c
    xy += lx * yh + ly * nxh + 0.5 * lx * wy + along * c * s
    yy += ly * (yh + nyh + 0.5 * wy) + along * s * s
    return xx, xy, yy, nxh + wx, nyh + wy, hh + around


def move(
    estimate: Estimate,
    distance: float,
    turn: float,
    noise: OdometryNoise,
    crawl_s: float = 0.0,
    extra: MotionVariance = NO_VARIANCE,
    as_circle: bool = False,
) -> Estimate:
    """The estimate after odometry reports an arc of `distance` metres that turns by `turn`.

    For `crawl_s` seconds of it the robot drove at its least speed; `extra` is of odometry that was
    lost. `as_circle`: the position's covariance is kept as a circle.
    """
    pose, covariance, shared = estimate
    x, y, heading = pose
    extra_distance, extra_turn = extra
    direction = heading + 0.5 * turn
    c, s = cos(direction), sin(direction)
    along = distance_variance(distance, turn, noise, crawl_s) + extra_distance
    around = turn_variance(distance, turn, noise) + extra_turn
    lx, ly = -distance * s, distance * c
    xx, xy, yy, xh, yh, hh = covariance_after(covariance, distance, c, s, along, around)
    if as_circle:
        xx = yy = circle_variance(xx, xy, yy)
        xy = 0.0
    if shared is not ZERO3:
        shared = shared.transformed(motion_jacobian(heading, distance, turn))
    pose = new(Pose2, (x + ly, y - lx, wrap_angle(heading + turn)))
    return new(Estimate, (pose, new(Covariance3, (xx, xy, yy, xh, yh, hh)), shared))


def rotation(c: float, s: float) -> Matrix3:
    """The matrix that turns an error (x, y, heading) into a frame turned by an angle with this
    cosine and sine."""
    return c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0


def after_motion(estimate: Estimate, motion: Estimate) -> Estimate:
    """The estimate after a motion of many steps, which is with its covariance in the frame of the
    robot before it."""
    (x, y, heading), covariance, shared = estimate
    way, added, _ = motion
    c, s = cos(heading), sin(heading)
    dx, dy = c * way.x - s * way.y, s * way.x + c * way.y
    lever = lever_change(dx, dy)
    covariance = covariance.transformed(lever).plus(added.transformed(rotation(c, s)))
    shared = shared if shared is ZERO3 else shared.transformed(lever)
    there = Pose2(x + dx, y + dy, wrap_angle(heading + way.heading))
    return Estimate(there, covariance, shared)


def part_of_piece(piece: Odometry, from_ns: int, until_ns: int) -> tuple[float, float, float]:
    """The part of a piece of odometry within these times: distance (m), turn (rad), seconds."""
    numbers: tuple[int, int, float, float] = _astuple(piece)
    begin_ns, end_ns, distance, turn = numbers
    part_ns = whole_ns = end_ns - begin_ns
    if begin_ns != from_ns or end_ns > until_ns:
        part_ns = max(0, min(end_ns, until_ns) - max(from_ns, begin_ns))
        share = part_ns / whole_ns
        distance, turn = share * distance, share * turn
    return distance, turn, part_ns * 1e-9


def is_gap(pause_ns: int, before: Odometry, after: Odometry) -> bool:
    """Whether odometry was lost in a pause. A pause below half of the shorter piece only means that
    stamps are inexact."""
    shorter_ns = min(before.stamp_ns - before.from_ns, after.stamp_ns - after.from_ns)
    return 2 * pause_ns >= shorter_ns


def bridge(
    before: Odometry | None,
    after: Odometry | None,
    from_s: float,
    until_s: float,
    settings: OdometrySettings,
) -> tuple[float, float, MotionVariance]:
    """The motion in a part of a gap between two pieces of odometry, if a part was lost: distance
    (m), turn (rad), and how far they may be wrong.

    The times are since the end of `before`. The robot drives on as before, for `timeout_s` at most.
    If `after` is known in that time, the change of speed took place at any time within the gap. The
    sigma grows with the time, by `gap_speed_m_s` but not faster than the robot drove; half of that
    if both ends are known.
    """
    if until_s > settings.timeout_s:
        until_s, after = settings.timeout_s, None
    if before is None or until_s <= from_s:
        return 0.0, 0.0, NO_VARIANCE
    seconds, squared = until_s - from_s, until_s * until_s - from_s * from_s
    speed, rate = _speeds(before)
    if after is None:
        slowest = min(settings.gap_speed_m_s, max(abs(speed), abs(rate)))
        growth = slowest * slowest * squared
        return speed * seconds, rate * seconds, MotionVariance(growth, growth)
    then, then_rate = _speeds(after)
    slowest = min(settings.gap_speed_m_s, max(map(abs, (speed, rate, then, then_rate))))
    growth = 0.25 * slowest * slowest
    of_distance = growth + (then - speed) ** 2 / 12.0
    of_turn = growth + (then_rate - rate) ** 2 / 12.0
    distance, turn = 0.5 * (speed + then) * seconds, 0.5 * (rate + then_rate) * seconds
    return distance, turn, MotionVariance(of_distance * squared, of_turn * squared)


def guess_variance(
    before: Odometry, after: Odometry, crossed_s: float, gap_s: float, updated: PoseTimes
) -> MotionVariance:
    """How far a robot may be from where it was guessed to be in the first `crossed_s` of a gap
    between two pieces, as if it drove on as before, now that its speed after the gap is known.
    `updated`: when sightings last told its position and its heading in the gap, since its begin."""
    (speed, rate), (then, then_rate) = _speeds(before), _speeds(after)
    of_distance = _mean_square_s2(crossed_s, gap_s, updated.position_s) * (then - speed) ** 2
    of_turn = _mean_square_s2(crossed_s, gap_s, updated.heading_s) * (then_rate - rate) ** 2
    return MotionVariance(of_distance, of_turn)


def _mean_square_s2(crossed_s: float, gap_s: float, updated_s: float) -> float:
    """The mean square of crossed - max(T, updated), for a change at any time T within the gap."""
    left_s = max(crossed_s - updated_s, 0.0)
    return left_s * left_s * (updated_s + left_s / 3.0) / gap_s


def _speeds(piece: Odometry) -> tuple[float, float]:
    """The speed (m/s) and the turn rate (rad/s) of a piece of odometry; 0 if that cannot be."""
    seconds = (piece.stamp_ns - piece.from_ns) * 1e-9
    speed, rate = piece.distance_m / seconds, piece.turn_rad / seconds
    return (speed, rate) if abs(speed) < FASTEST and abs(rate) < FASTEST else (0.0, 0.0)


def inflate_by_gap(
    estimate: Estimate, gap_ns: int, before: Odometry | None, gap_speed_m_s: float
) -> Estimate:
    """The estimate after a long time without odometry: a random walk. In one second it leads as far
    as `gap_speed_m_s` and the last speed do, each for a second. A robot that drove may have turned
    since then, and one that turned may have driven, so the larger of both speeds (m/s, rad/s)
    counts."""
    growth = (gap_speed_m_s**2 + _fastest(before) ** 2) * gap_ns * 1e-9
    return _grown(estimate, growth, growth)


def inflate_by_change(
    estimate: Estimate, silent: PoseTimes, before: Odometry, after: Odometry
) -> Estimate:
    """What `inflate_by_gap` gave becomes, when the speed after the gap is known: the larger one of
    both speeds counts. `silent`: for how long neither odometry nor sightings told the position, and
    the heading."""
    faster = max(_fastest(after) ** 2 - _fastest(before) ** 2, 0.0)
    return _grown(estimate, faster * silent.position_s, faster * silent.heading_s)


def _fastest(piece: Odometry | None) -> float:
    return 0.0 if piece is None else max(map(abs, _speeds(piece)))


def _grown(estimate: Estimate, of_position: float, of_heading: float) -> Estimate:
    """The estimate with so much more variance of each coordinate (m^2) and of the heading."""
    added = Covariance3(of_position, 0.0, of_position, 0.0, 0.0, of_heading)
    return estimate._replace(covariance=estimate.covariance.plus(added))


def drift_sigmas(moved: Pose2) -> tuple[float, float]:
    """Roughly how large the error of dead reckoning is over such a motion (m, rad)."""
    way, turn = math.hypot(moved.x, moved.y), abs(moved.heading)
    return DRIFT_SHARE * (way + 0.3 * turn), DRIFT_SHARE * (turn + 0.3 * way)


def shortening(squared_m2: float, hh: float, added: float) -> float:
    """The mean square (m^2) of how much shorter a straight way of this squared length becomes by an
    unknown heading, to second order. A way of d ends short by (1/2) the integral of e^2. The error
    e of the heading has the variance `hh` at its begin, and has gained `added` (rad^2) at its end
    by a random walk."""
    return 0.25 * squared_m2 * (3.0 * hh * hh + (7.0 * hh * added + 1.75 * added * added) / 3.0)
