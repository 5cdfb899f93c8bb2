"""Differential odometry: the pose moves, its uncertainty is compounded as J C J^T (paper, sec. 4).

C is the joint covariance of the estimate and of the differential motion; J is the Jacobian of the
compounding with respect to both. Motion noise is white, so its variance grows with the way.
"""

import math
from operator import add

from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import ZERO3, Covariance3, Estimate, Matrix3
from cpcbl_team.geometry import Pose2, wrap_angle

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
    way = abs(distance)
    turned = abs(turn)
    along = (
        noise.distance_sigma_m_per_sqrt_m**2 * way + noise.distance_sigma_m_per_sqrt_rad**2 * turned
    )
    around = (
        noise.turn_sigma_rad_per_sqrt_rad**2 * turned + noise.turn_sigma_rad_per_sqrt_m**2 * way
    )
    lx, ly = -0.5 * distance * s, 0.5 * distance * c  # where a turn error leads
    return (
        along * c * c + around * lx * lx,
        along * c * s + around * lx * ly,
        along * s * s + around * ly * ly,
        around * lx,
        around * ly,
        around,
    )


def move(estimate: Estimate, distance: float, turn: float, noise: OdometryNoise) -> Estimate:
    """The estimate after the wheels report an arc of `distance` metres that turns by `turn`."""
    pose, covariance, shared = estimate
    x, y, heading = pose
    direction = heading + 0.5 * turn
    c, s = math.cos(direction), math.sin(direction)
    # where a heading error of one radian leads, in metres: the last column of the Jacobian
    lx, ly = -distance * s, distance * c
    return Estimate(
        Pose2(x + distance * c, y + distance * s, wrap_angle(heading + turn)),
        Covariance3(
            *map(add, _sheared(covariance, lx, ly), _noise_along(c, s, distance, turn, noise))
        ),
        shared if shared is ZERO3 else Covariance3(*_sheared(shared, lx, ly)),
    )


def _sheared(p: Covariance3, lx: float, ly: float) -> _Entries:
    """F P F^T for F = [1 0 lx; 0 1 ly; 0 0 1], written out: it runs for every odometry step."""
    xx, xy, yy, xh, yh, hh = p
    return (
        xx + lx * (2.0 * xh + lx * hh),
        xy + lx * yh + ly * xh + lx * ly * hh,
        yy + ly * (2.0 * yh + ly * hh),
        xh + lx * hh,
        yh + ly * hh,
        hh,
    )
