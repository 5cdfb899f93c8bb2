"""Whether a mistake in sightings explains evidence that contradicts the pose of a robot.

A robot that knew its pose and rejects what it measures was carried elsewhere, or its driver got
something wrong: bearings that are mirrored look like another pose. The pose from before the
rejections, brought to the present by odometry, tells the two apart: if the evidence fits it once a
mistake is undone, nothing may move the robot.
"""

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.relocalization import (
    OUTLIER,
    PropagatedEvidence,
    chi_square_bound,
    readings_of,
)
from cpcbl_team.state import Evidence

LEAST_READINGS: Final = 4
LEAST_SHARE: Final = 0.75  # of the pieces, that a mistake must explain
NOISE_FACTORS: Final = (1.0, 2.0)  # sensors may be worse than their settings say
MOST_SIGMA_M: Final = 0.5  # of a pose by which evidence can be judged
MOST_SIGMA_RAD: Final = 0.25
MOST_TURN_RAD: Final = 1.0  # since a piece of evidence: beyond, odometry errs too much to tell,
MOST_WAY_M: Final = 2.0  # and beyond this
FOOT_M: Final = 0.3048


class SensorMistake(NamedTuple):
    """What a driver may have done to sightings, and what undoes it."""

    text: str
    bearing: Callable[[float, float], float]  # of the bearing as it came, and of the heading then
    range_scale: float = 1.0


MIRRORED: Final = "bearings look mirrored; left is positive"
QUARTER_OFF: Final = "bearings are 90° off; ahead is 0, left is positive"
HALF_OFF: Final = "bearings are 180° off; ahead is 0"
FIXED: Final = (
    "landmarks do not turn as odometry does: bearings that count from x of the field or from"
    " north, headings in place of turns, or wheels that slip"
)
IN_FEET: Final = "ranges look like feet"
MISTAKES: Final = (
    SensorMistake(MIRRORED, lambda b, h: -b),
    SensorMistake(QUARTER_OFF, lambda b, h: b + 0.5 * math.pi),
    SensorMistake(QUARTER_OFF, lambda b, h: b - 0.5 * math.pi),
    SensorMistake(HALF_OFF, lambda b, h: b + math.pi),
    SensorMistake(FIXED, lambda b, h: b - h),
    SensorMistake(FIXED, lambda b, h: 0.5 * math.pi - b - h),
    SensorMistake(IN_FEET, lambda b, h: b, FOOT_M),
)


class ExplainingMistake(NamedTuple):
    """A mistake that explains evidence, and the pose (field_from_robot) once it is undone."""

    text: str
    pose: Pose2


def mistake_in_evidence(
    known: Estimate, evidence: Sequence[Evidence], odometry_from_robot: Pose2
) -> ExplainingMistake | None:
    """The mistake that, once undone, lets evidence of the robot's own sensors fit a pose that is
    `known` without it; None if there is none, or if the evidence fits as it is."""
    c = known.covariance
    if 0.5 * (c.xx + c.yy) > MOST_SIGMA_M**2 or c.hh > MOST_SIGMA_RAD**2:
        return None
    own = [e for e in evidence if _is_usable(e, odometry_from_robot)]
    if sum(map(readings_of, own)) < LEAST_READINGS:
        return None
    for noise_factor in NOISE_FACTORS:
        if _misfit(known, own, odometry_from_robot, noise_factor) is not None:
            return None
        best, least = None, math.inf
        for mistake in MISTAKES:
            corrected = [_without(mistake, e, known.pose, odometry_from_robot) for e in own]
            fit = _misfit(known, corrected, odometry_from_robot, noise_factor)
            if fit is not None and fit[0] < least:
                least, best = fit[0], ExplainingMistake(mistake.text, fit[1])
        if best is not None:
            return best
    return None


def _is_usable(e: Evidence, place: Pose2) -> bool:
    """Whether it is of the robot's own sensors, and dead reckoning since then is good enough."""
    if e.from_teammate or e.bearing_rad is None:
        return False
    since = e.odometry_from_robot.inverse() @ place
    return abs(since.heading) < MOST_TURN_RAD and math.hypot(since.x, since.y) < MOST_WAY_M


def _without(mistake: SensorMistake, e: Evidence, now: Pose2, place: Pose2) -> Evidence:
    """The piece of evidence with the mistake undone, for a robot at the pose `now`."""
    then = now @ (place.inverse() @ e.odometry_from_robot)
    bearing = wrap_angle(mistake.bearing(e.bearing_rad or 0.0, then.heading))
    scale = mistake.range_scale
    range_m = None if e.range_m is None else scale * e.range_m
    return e._replace(range_m=range_m, bearing_rad=bearing, range_sigma_m=scale * e.range_sigma_m)


def _misfit(
    known: Estimate, evidence: Sequence[Evidence], place: Pose2, noise_factor: float
) -> tuple[float, Pose2] | None:
    """The chi-square of the evidence by a Kalman filter that begins at the known pose, and the pose
    then; None if it is beyond the bound, or if too many pieces do not fit at all. `noise_factor`:
    on the sigmas of the evidence."""
    estimate, cost, used, readings = known, 0.0, 0, 0
    for piece in [PropagatedEvidence(e, place, 0) for e in evidence]:
        updated, of_piece = _updated(estimate, piece, noise_factor)
        if of_piece < OUTLIER:
            estimate, cost = updated, cost + of_piece
            used, readings = used + 1, readings + readings_of(piece.evidence)
    if used < LEAST_SHARE * len(evidence) or cost > chi_square_bound(readings):
        return None
    return cost + OUTLIER * (len(evidence) - used), estimate.pose


def _updated(
    estimate: Estimate, piece: PropagatedEvidence, noise_factor: float
) -> tuple[Estimate, float]:
    """The estimate after a piece of evidence, and the chi-square of its innovations."""
    cost, (x, y, h), covariance = 0.0, (0.0, 0.0, 0.0), estimate.covariance
    for row, residual, variance in piece.rows(estimate.pose):
        px, py, ph = covariance.times(row)
        variance *= noise_factor * noise_factor
        k = 1.0 / (row[0] * px + row[1] * py + row[2] * ph + variance)
        off = residual - row[0] * x - row[1] * y - row[2] * h
        cost += k * off * off
        x, y, h = x + k * off * px, y + k * off * py, h + k * off * ph
        gained = Covariance3(px * px, px * py, py * py, px * ph, py * ph, ph * ph)
        covariance = covariance.plus(gained, -k)
    pose = estimate.pose
    moved = Pose2(pose.x + x, pose.y + y, wrap_angle(pose.heading + h))
    return Estimate(moved, covariance), cost
