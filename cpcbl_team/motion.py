"""Differential odometry: the pose moves, its uncertainty is compounded as J C J^T (paper, sec. 4).

C is the joint covariance of the estimate and of the differential motion; J is the Jacobian of the
compounding with respect to both. Motion noise is white, so its variance grows with the way.
"""

import math
from math import cos, remainder, sin, tau

from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import ZERO3, Covariance3, Estimate, Matrix3, circle_variance, new
from cpcbl_team.geometry import Pose2

_Entries = tuple[float, float, float, float, float, float]  # of a Covariance3


def motion_jacobian(heading: float, distance: float, turn: float) -> Matrix3:
    """d(pose after) / d(pose before)."""
    direction = heading + 0.5 * turn
    return (
        1.0,
        0.0,
        -distance * math.sin(direction),
        0.0,
        1.0,
        distance * math.cos(direction),
        0.0,
        0.0,
        1.0,
    )


def motion_noise(heading: float, distance: float, turn: float, noise: OdometryNoise) -> Covariance3:
    """The differential motion's covariance, rotated into the field's frame."""
    direction = heading + 0.5 * turn
    return Covariance3(
        *_noise_along(math.cos(direction), math.sin(direction), distance, turn, noise)
    )


def _noise_along(
    c: float, s: float, distance: float, turn: float, noise: OdometryNoise
) -> _Entries:
    """The noise of an arc whose chord has the direction with cosine `c` and sine `s`."""
    way, turned = abs(distance), abs(turn)
    slip, wobble = noise.distance_sigma_m_per_sqrt_m, noise.distance_sigma_m_per_sqrt_rad
    along = slip * slip * way + wobble * wobble * turned
    slip, wobble = noise.turn_sigma_rad_per_sqrt_m, noise.turn_sigma_rad_per_sqrt_rad
    around = slip * slip * way + wobble * wobble * turned
    lx, ly = -0.5 * distance * s, 0.5 * distance * c  # where a turn error leads
    ac, ax, ay = along * c, around * lx, around * ly
    return ac * c + ax * lx, ac * s + ax * ly, along * s * s + ay * ly, ax, ay, around


def move(
    estimate: Estimate, distance: float, turn: float, noise: OdometryNoise, as_circle: bool = False
) -> Estimate:
    """The estimate after the wheels report an arc of `distance` metres that turns by `turn`.

    `as_circle`: the position's covariance is kept as a circle.
    """
    (x, y, heading), covariance, shared = estimate
    direction = heading + 0.5 * turn
    c, s = cos(direction), sin(direction)
    # where a heading error of one radian leads, in metres: the last column of the Jacobian
    lx, ly = -distance * s, distance * c
    pose = new(Pose2, (x + ly, y - lx, remainder(heading + turn, tau)))
    xx, xy, yy, xh, yh, hh = _sheared(covariance, lx, ly)
    nxx, nxy, nyy, nxh, nyh, nhh = _noise_along(c, s, distance, turn, noise)
    xx, xy, yy, xh, yh, hh = xx + nxx, xy + nxy, yy + nyy, xh + nxh, yh + nyh, hh + nhh
    if as_circle:
        xx = yy = circle_variance(xx, xy, yy, xh, yh, hh)
        xy = 0.0
    if shared is not ZERO3:
        shared = Covariance3(*_sheared(shared, lx, ly))
    return new(Estimate, (pose, new(Covariance3, (xx, xy, yy, xh, yh, hh)), shared))


def _sheared(p: Covariance3, lx: float, ly: float) -> _Entries:
    """F P F^T for F = [1 0 lx; 0 1 ly; 0 0 1], written out: it runs for every odometry step."""
    xx, xy, yy, xh, yh, hh = p
    ahx, ahy = xh + lx * hh, yh + ly * hh
    return (
        xx + lx * (xh + ahx),
        xy + lx * yh + ly * ahx,
        yy + ly * (yh + ahy),
        ahx,
        ahy,
        hh,
    )
