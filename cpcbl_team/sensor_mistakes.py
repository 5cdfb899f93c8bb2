"""Whether a mistake in sightings explains evidence that contradicts the pose of a robot.

A robot that knew its pose and rejects what it measures was carried elsewhere, or its driver got
something wrong: bearings that are mirrored look like another pose. The pose from before the
rejections, brought to the present by odometry, tells the two apart: if the evidence fits it once a
mistake is undone, nothing may move the robot.
"""

import cmath
import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from cpcbl_team.estimate import POSE, Estimate, FilteredOffset, offset_pose
from cpcbl_team.fusion import chi_square_bound
from cpcbl_team.geometry import Pose2, phase
from cpcbl_team.relocalization import (
    OUTLIER,
    PropagatedEvidence,
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
NEAR_SHARE: Final = 0.25  # of the way to a pose that was found: nearer is another explanation
NEAR_RAD: Final = 0.7


View = Callable[[complex, float], complex]
"""Where an object is in the robot's frame (x + i y), by where it seems to be and by the heading."""


class SensorMistake(NamedTuple):
    """What a driver may have done to sightings, and what undoes it."""

    text: str
    view: View
    group: str = ""
    """What is said where mistakes that look alike cannot be told apart; empty: the text."""


MIRRORED: Final = "bearings look mirrored; left is positive"
QUARTER_OFF: Final = "bearings are 90° off; ahead is 0, left is positive"
HALF_OFF: Final = "bearings are 180° off; ahead is 0"
FIXED: Final = (
    "landmarks do not turn as odometry does: bearings that count from x of the field or from"
    " north, headings in place of turns, or wheels that slip"
)
IN_FEET: Final = "ranges look like feet"
MISTAKES: Final[tuple[SensorMistake, ...]] = (
    SensorMistake(MIRRORED, lambda p, h: p.conjugate()),
    SensorMistake(QUARTER_OFF, lambda p, h: p * 1j),
    SensorMistake(QUARTER_OFF, lambda p, h: p / 1j),
    SensorMistake(HALF_OFF, lambda p, h: -p),
    SensorMistake(
        "bearings count from x of the field, not from ahead",
        lambda p, h: p * cmath.rect(1.0, -h),
        FIXED,
    ),
    SensorMistake(
        "bearings count from north, not from ahead",
        lambda p, h: 1j * p.conjugate() * cmath.rect(1.0, -h),
        FIXED,
    ),
    SensorMistake(IN_FEET, lambda p, h: p * FOOT_M),
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
                least, best = fit[0], ExplainingMistake(mistake.group or mistake.text, fit[1])
        if best is not None:
            return best
    return None


def mirrored(evidence: Sequence[Evidence]) -> tuple[Evidence, ...]:
    """The evidence of the robot's own bearings, with left and right exchanged."""
    own = (e for e in evidence if not e.from_teammate and e.bearing_rad is not None)
    return tuple(e._replace(bearing_rad=-(e.bearing_rad or 0.0)) for e in own)


def is_mirror_image(found: Pose2, of_mirrored: Pose2, expected: Estimate) -> bool:
    """Whether a robot that odometry expects at one pose, and whose evidence fits far from there, is
    rather where the mirrored evidence fits. Two landmarks fit both; that a robot was carried just
    to the mirror image of where it was is improbable."""
    (x, y, heading), c = expected.pose, expected.covariance
    most_m = NEAR_SHARE * math.hypot(found.x - x, found.y - y)
    is_known = 0.5 * (c.xx + c.yy) < most_m**2 and c.hh < NEAR_RAD**2
    turn = math.remainder(of_mirrored.heading - heading, math.tau)
    is_near = math.hypot(of_mirrored.x - x, of_mirrored.y - y) < most_m and abs(turn) < NEAR_RAD
    return is_known and is_near


def _is_usable(e: Evidence, place: Pose2) -> bool:
    """Whether it is of the robot's own sensors, and dead reckoning since then is good enough."""
    if e.from_teammate or e.bearing_rad is None:
        return False
    since = e.odometry_from_robot.inverse() @ place
    return abs(since.heading) < MOST_TURN_RAD and math.hypot(since.x, since.y) < MOST_WAY_M


def _without(mistake: SensorMistake, e: Evidence, now: Pose2, place: Pose2) -> Evidence:
    """The piece of evidence with the mistake undone, for a robot at the pose `now`."""
    then = now @ (place.inverse() @ e.odometry_from_robot)
    seen = cmath.rect(e.range_m or 1.0, e.bearing_rad or 0.0)
    real = mistake.view(seen, then.heading)
    scale = abs(real) / abs(seen)
    range_m = None if e.range_m is None else scale * e.range_m
    return e._replace(
        range_m=range_m, bearing_rad=phase(real), range_sigma_m=scale * e.range_sigma_m
    )


def _misfit(
    known: Estimate, evidence: Sequence[Evidence], place: Pose2, noise_factor: float
) -> tuple[float, Pose2] | None:
    """The chi-square of the evidence by a Kalman filter that begins at the known pose, and the pose
    then; None if it is beyond the bound, or if too many pieces do not fit at all. `noise_factor`:
    on the sigmas of the evidence."""
    pose, state, used, readings = known.pose, FilteredOffset(known.covariance), 0, 0
    for piece in [PropagatedEvidence(e, place, 0) for e in evidence]:
        rows = [(row, off, v * noise_factor * noise_factor) for row, off, v in piece.rows(pose)]
        after = FilteredOffset(state.covariance).after(rows)
        if after.cost < OUTLIER:
            pose = offset_pose(pose, after.offset, POSE)
            state = after._replace(cost=state.cost + after.cost)
            used, readings = used + 1, readings + readings_of(piece.evidence)
    if used < LEAST_SHARE * len(evidence) or state.cost > chi_square_bound(readings):
        return None
    return state.cost + OUTLIER * (len(evidence) - used), pose
