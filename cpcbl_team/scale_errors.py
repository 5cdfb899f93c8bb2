"""How much less certain dead reckoning is because the scales of the odometry are not known exactly.

A robot whose tyres or floor differ from those of the day on which it was calibrated drives another
share of each distance, and turns another share of each turn, than its odometry says. Such an error
does not average out as noise does: it grows with the way. Both shares are considered, but not
estimated here (S. F. Schmidt 1966; A. H. Jazwinski, Stochastic Processes and Filtering Theory,
1970, section 8.4): the covariance of the pose grows by what they do to it, and what an update takes
of that covariance it takes of their part in the pose. `calibration_filter.py` estimates them.
"""

from math import cos, sin, sqrt
from typing import Final, NamedTuple

from cpcbl_team.constant_errors import (
    INSENSITIVE,
    matrix_of,
    matrix_product,
    sensitivity_after,
)
from cpcbl_team.estimate import SMALLEST_VARIANCE, Covariance3, Matrix3, outer
from cpcbl_team.geometry import Pose2
from cpcbl_team.motion import motion_jacobian


class ScaleErrors(NamedTuple):
    """What is not known of the scales of the odometry, and what that has done to the pose.

    The variances are those of the shares by which distances and turns are too short; 0: the scales
    are exact. `sensitivity`: the error of the pose for an error of one in each constant error
    (columns: distance, turn, and one that is not used). `covariance`: of the pose after its last
    motion, or None before the first one from a pose.
    """

    distance: float = 0.0
    turn: float = 0.0
    sensitivity: Matrix3 = INSENSITIVE
    covariance: Covariance3 | None = None

    @property
    def are_considered(self) -> bool:
        """Whether the scales may be wrong."""
        return self.distance > 0.0 or self.turn > 0.0

    def at_new_pose(self) -> "ScaleErrors":
        """At a pose that does not follow from the odometry until now."""
        return self._replace(sensitivity=INSENSITIVE, covariance=None)

    def after_motion(
        self, pose: Pose2, covariance: Covariance3, distance: float, turn: float
    ) -> tuple["ScaleErrors", Covariance3]:
        """After an arc of `distance` metres that turns by `turn` (rad), from a pose with this
        covariance; and what the scales have added to the covariance in it."""
        direction = pose.heading + 0.5 * turn
        dx, dy = distance * cos(direction), distance * sin(direction)
        before, variances = self.sensitivity_at(covariance), (self.distance, self.turn)
        carried = matrix_product(motion_jacobian(pose.heading, distance, turn), before)
        now = sensitivity_after(before, dx, dy, turn)
        added = _covariance(now, *variances).plus(_covariance(carried, *variances), -1.0)
        return self._replace(sensitivity=now), added

    def with_variances(
        self, distance: float, turn: float, covariance: Covariance3
    ) -> tuple["ScaleErrors", Covariance3]:
        """With other variances of the scales, at a pose with this covariance; and that covariance,
        which is larger if one of the scales is known less well than before."""
        sensitivity = self.sensitivity_at(covariance)
        more = max(distance - self.distance, 0.0), max(turn - self.turn, 0.0)
        covariance = covariance.plus(_covariance(sensitivity, *more))
        return ScaleErrors(distance, turn, sensitivity, covariance), covariance

    def sensitivity_at(self, covariance: Covariance3) -> Matrix3:
        """The sensitivity of a pose with this covariance, which differs from that after the last
        motion by updates since: with the gain K they leave 1 - K H of both. No more than the whole
        covariance is due to the scales."""
        before, sensitivity = self.covariance, self.sensitivity
        if before is None or covariance == before:
            return sensitivity
        if min(before.determinant(), covariance.determinant()) <= SMALLEST_VARIANCE**3:
            return INSENSITIVE
        if _is_smaller(covariance, before):
            left = matrix_product(matrix_of(covariance), matrix_of(before.inverse()))
            sensitivity = matrix_product(left, sensitivity)
        part = _covariance(sensitivity, self.distance, self.turn)
        k = 1.0 / sqrt(max(_trace_of_product(covariance.inverse(), part), 1.0))
        return matrix_product((k, 0.0, 0.0, 0.0, k, 0.0, 0.0, 0.0, k), sensitivity)


EXACT: Final = ScaleErrors()


def _covariance(sensitivity: Matrix3, distance: float, turn: float) -> Covariance3:
    """Of a pose with this sensitivity, by scales with these variances."""
    xd, xt, _, yd, yt, _, hd, ht, _ = sensitivity
    return outer((xd, yd, hd)).scaled(distance).plus(outer((xt, yt, ht)), turn)


def _trace_of_product(one: Covariance3, other: Covariance3) -> float:
    xx, xy, yy, xh, yh, hh = one
    _xx, _xy, _yy, _xh, _yh, _hh = other
    return xx * _xx + yy * _yy + hh * _hh + 2.0 * (xy * _xy + xh * _xh + yh * _yh)


def _is_smaller(covariance: Covariance3, before: Covariance3) -> bool:
    """Whether an update has made a covariance smaller; else something has made it larger."""
    is_smaller = covariance.xx + covariance.yy <= before.xx + before.yy
    return is_smaller and covariance.hh <= before.hh
