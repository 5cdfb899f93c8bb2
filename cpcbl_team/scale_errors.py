"""The scales of the odometry, where the settings may be wrong about them.

A robot whose tyres or floor differ from those of the day on which it was calibrated drives another
share of each distance, and turns another share of each turn, than its odometry says. Such an error
does not average out as noise does: it grows with the way. The covariance of the pose contains both
shares (S. F. Schmidt 1966; A. H. Jazwinski, Stochastic Processes and Filtering Theory, 1970,
section 8.4): it grows by what they do to the pose, and what an update takes of it, it takes of
their part.

No reading depends on the scales but through the pose. So an update of the pose says all that it
says of them: one that takes a pose of the covariance P to Q, and corrects it by d, corrects the
scales by X^T P^-1 d, and leaves Q P^-1 X of their covariance X with the pose. The filter of the
pose need not know of them. They are estimated beside it, as B. Friedland does with a bias (IEEE
Transactions on Automatic Control, 1969), and corrected as far as an error is likely.
"""

from math import cos, exp, sin, sqrt
from typing import Final, NamedTuple

from cpcbl_team.estimate import (
    SMALLEST_VARIANCE,
    ZERO3,
    Covariance3,
    Estimate,
    Row,
    dot,
    outer,
    pose_difference,
)

INDEPENDENT: Final[Row] = (0.0, 0.0, 0.0)
NO_OFFSET: Final[Row] = (0.0, 0.0, 0.0)
LARGEST_LOG: Final = 50.0  # of a ratio of likelihoods
LEAST_VARIANCE: Final = 0.005**2  # of a share: no floor is alike everywhere
LEAST_SHARE: Final = 0.1**2
"""Of the stated variance of a scale that always stays: no floor is alike everywhere, and wheels
slip in one curve more than in another."""
MOST_SIGMAS: Final = 3.0  # by which one correction of the pose changes a scale
ODDS: Final = 0.25  # of wheels of another day to those of the calibration
SAME_DAY: Final = 0.1**2  # the variance of the scales on its days, as a share of the stated one
MOST_HEADING_VARIANCE: Final = 1.0**2  # rad^2: beyond, no way is as straight as its linear form
MOST_CHANGE: Final = 0.5  # of a scale at once: what is more is another unit, no other tyre


class Scale(NamedTuple):
    """What is known of one scale of the odometry.

    `factor`: by which its readings are corrected. `error`: the share by which they are too short
    all the same, as far as that is known; it is not corrected before it is clear. `offset`: what it
    has moved the pose by (m, m, rad). `covariance`: of the share with (x, y, heading) of the pose.
    """

    factor: float = 1.0
    error: float = 0.0
    offset: Row = NO_OFFSET
    covariance: Row = INDEPENDENT


class ScaleErrors(NamedTuple):
    """What is known of both scales of the odometry, beside what the settings say.

    `variances`: of the shares of distances and turns. `estimate`: of the pose after its last
    motion, or None before the first one from a pose. `first`: the variances that the settings
    state; 0: the scales are exact. `considered`: those that the covariance of the pose contains.
    They do not fall with what is found here: wheels slip in one curve more than in another.
    """

    distance: Scale = Scale()
    turn: Scale = Scale()
    variances: tuple[float, float] = (0.0, 0.0)
    estimate: Estimate | None = None
    first: tuple[float, float] = (0.0, 0.0)
    considered: tuple[float, float] = (0.0, 0.0)

    @staticmethod
    def of_sigmas(distance: float, turn: float) -> "ScaleErrors":
        """Of scales with these sigmas, as shares of them."""
        first = distance * distance, turn * turn
        return ScaleErrors(variances=first, first=first, considered=first)

    @property
    def are_exact(self) -> bool:
        """Whether the scales are as the settings say."""
        return self.first == (0.0, 0.0)

    @property
    def offset(self) -> Row:
        """What errors of the scales that are not corrected have moved the pose by."""
        return _sum(self.distance.offset, self.turn.offset, 1.0, NO_OFFSET, 0.0)

    @property
    def doubt(self) -> Covariance3:
        """What the covariance of the pose lacks if those errors are there all the same."""
        doubt, variances = ZERO3, self.variances
        scales = self.distance, self.turn
        for (factor, error, offset, _), variance, first in zip(
            scales, variances, self.first, strict=True
        ):
            if offset != NO_OFFSET:
                _, probability = _mixture(factor * (1.0 + error) - 1.0, variance, first)
                doubt = doubt.plus(outer(offset), probability)
        return doubt

    def at_new_pose(self) -> "ScaleErrors":
        """At a pose that does not follow from the odometry until now."""
        distance, turn = (
            s._replace(offset=NO_OFFSET, covariance=INDEPENDENT) for s in (self.distance, self.turn)
        )
        return self._replace(distance=distance, turn=turn, estimate=None)

    def after_updates(self, now: Estimate, estimates: bool = True) -> "ScaleErrors":
        """After the updates of the pose since its last motion, that have led to this estimate.
        `estimates`: else the scales are only considered (Schmidt 1966), as they are where the
        heading is too uncertain for the linear form of the way."""
        before = self.estimate
        if before is None or before.covariance == now.covariance:
            return self
        (_, covariance, _), (_, left, _) = before, now
        if min(covariance.determinant(), left.determinant()) <= SMALLEST_VARIANCE**3:
            return self.at_new_pose()
        if not _is_smaller(left, covariance):
            return self._bounded(left)
        inverse = covariance.inverse()
        distance, turn = (_after_update(s, inverse, left) for s in (self.distance, self.turn))
        known = self._replace(distance=distance, turn=turn, estimate=now)
        if estimates and covariance.hh <= MOST_HEADING_VARIANCE:
            known = self._with_correction(known, inverse, pose_difference(before.pose, now.pose))
        return known._bounded(left)

    def _with_correction(
        self, after: "ScaleErrors", inverse: Covariance3, correction: Row
    ) -> "ScaleErrors":
        """With what this correction of the pose says of both scales. `inverse`: of its covariance
        before that."""
        parts = []
        for i, (scale, now) in enumerate(zip(self[:2], after[:2], strict=True)):
            share = self.variances[i] / max(self.considered[i], SMALLEST_VARIANCE)
            of_pose = _scaled(inverse.times(scale.covariance), share)
            taken = share * dot(of_pose, _difference(scale.covariance, now.covariance))
            # What is known already to be wrong with the pose was expected
            expected = _difference(self.offset, after.offset)
            change = _bounded_change(dot(of_pose, _difference(correction, expected)), taken)
            variance = _left_of(self.variances[i], taken, self.first[i])
            parts.append((now._replace(error=now.error + change), variance))
        (distance, of_distance), (turn, of_turn) = parts
        return after._replace(distance=distance, turn=turn, variances=(of_distance, of_turn))

    def corrected(self) -> tuple["ScaleErrors", Row]:
        """With their errors corrected, as far as these are likely; and what that moves the pose
        by."""
        distance, by_distance = _corrected(self.distance, self.variances[0], self.first[0])
        turn, by_turn = _corrected(self.turn, self.variances[1], self.first[1])
        if distance is self.distance and turn is self.turn:
            return self, NO_OFFSET
        known = self._replace(distance=distance, turn=turn)
        return known, _sum(by_distance, by_turn, 1.0, NO_OFFSET, 0.0)

    def after_motion(
        self, before: Estimate, distance: float, turn: float
    ) -> tuple["ScaleErrors", Covariance3]:
        """After an arc of `distance` metres that turns by `turn` (rad), from this estimate; and
        what the scales have added to the covariance of the pose in it."""
        direction = before.pose.heading + 0.5 * turn
        dx, dy = distance * cos(direction), distance * sin(direction)
        # A share of one moves the pose by `g`, and a pose that is turned leads aside
        g_distance, g_turn = (dx, dy, 0.0), (-0.5 * turn * dy, 0.5 * turn * dx, turn)
        (_, error, off, of_distance), (_, turn_error, turn_off, of_turn) = self[:2]
        led_distance, led_turn = _led(of_distance, dx, dy), _led(of_turn, dx, dy)
        dd, tt = self.considered
        by_distance = self.distance._replace(
            offset=_sum(_led(off, dx, dy), g_distance, error, NO_OFFSET, 0.0),
            covariance=_sum(led_distance, g_distance, dd, NO_OFFSET, 0.0),
        )
        by_turn = self.turn._replace(
            offset=_sum(_led(turn_off, dx, dy), g_turn, turn_error, NO_OFFSET, 0.0),
            covariance=_sum(led_turn, g_turn, tt, NO_OFFSET, 0.0),
        )
        # X g^T + g X^T of both, of which half of g B g^T is in each
        added = _symmetric(
            (_sum(led_distance, g_distance, 0.5 * dd, NO_OFFSET, 0.0), g_distance),
            (_sum(led_turn, g_turn, 0.5 * tt, NO_OFFSET, 0.0), g_turn),
        )
        return self._replace(distance=by_distance, turn=by_turn), added

    def pose_offset(self, now: Estimate, distance: float, turn: float) -> Row:
        """By how much (m, m, rad) shares that were too short by this have moved the pose. The
        scales are only considered."""
        xx, yy = self.considered
        by_distance, by_turn, *_ = self.after_updates(now, estimates=False)
        k, m = distance / max(xx, LEAST_VARIANCE), turn / max(yy, LEAST_VARIANCE)
        return _sum(INDEPENDENT, by_distance.covariance, k, by_turn.covariance, m)

    def with_variances(self, distance: float, turn: float) -> "ScaleErrors":
        """With other variances in the covariance of the pose, of which somebody else knows."""
        xx, yy = self.considered
        k = distance / xx if xx > 0.0 else 0.0
        m = turn / yy if yy > 0.0 else 0.0
        return self._scaled(k, m)._replace(considered=(distance, turn))

    def _scaled(self, k: float, m: float) -> "ScaleErrors":
        """With covariances of distances and turns with the pose times these factors."""
        distance, turn, *_ = self
        return self._replace(
            distance=distance._replace(covariance=_scaled(distance.covariance, k)),
            turn=turn._replace(covariance=_scaled(turn.covariance, m)),
        )

    def _bounded(self, left: Covariance3) -> "ScaleErrors":
        """Where something else has changed the covariance of the pose: no more of it than the whole
        is due to the scales."""
        xx, yy = [max(variance, LEAST_VARIANCE) for variance in self.considered]
        inverse = left.inverse()
        of_distance, of_turn = self.distance.covariance, self.turn.covariance
        a, b = (
            dot(inverse.times(of_distance), of_distance),
            dot(inverse.times(of_distance), of_turn),
        )
        c = dot(inverse.times(of_turn), of_turn)
        half = 0.5 * (a / xx + c / yy)
        largest = half + sqrt(max(half * half - (a * c - b * b) / (xx * yy), 0.0))
        if largest <= 1.0:
            return self
        k = 1.0 / sqrt(largest)
        return self._scaled(k, k)


EXACT: Final = ScaleErrors()


def _after_update(scale: Scale, inverse: Covariance3, left: Covariance3) -> Scale:
    """A scale after an update of the pose, which multiplies its error by 1 - K H = Q P^-1. Both
    covariances of the pose: the inverse of P, and Q."""
    factor, error, offset, covariance = scale
    offset = left.times(inverse.times(offset))
    return Scale(factor, error, offset, left.times(inverse.times(covariance)))


def _corrected(scale: Scale, variance: float, first: float) -> tuple[Scale, Row]:
    """A scale of which as much is corrected as `_mixture` says, and what moves the pose."""
    factor, error, offset, covariance = scale
    whole = factor * (1.0 + error)
    if whole == factor:
        return scale, NO_OFFSET
    corrected = 1.0 + _mixture(whole - 1.0, variance, first)[0]
    share = min(max((corrected - factor) / (whole - factor), -1.0), 1.0)
    left = Scale(corrected, whole / corrected - 1.0, _scaled(offset, 1.0 - share), covariance)
    return left, _scaled(offset, share)


def _mixture(error: float, variance: float, first: float) -> tuple[float, float]:
    """The mean of a scale's error that is of another day, whose variance was `first`, or of the
    calibration's days, by the likelihood of each; and the probability of another day. By that
    hypothesis alone the error is `error`, with this variance."""
    information = 1.0 / variance - 1.0 / first
    if information <= 0.0:
        return 0.0, ODDS / (1.0 + ODDS)
    measured, of_measured = error / (variance * information), 1.0 / information
    same = SAME_DAY * first
    of_other, of_same = of_measured + first, of_measured + same
    exponent = 0.5 * measured * measured * (1.0 / of_same - 1.0 / of_other)
    odds = ODDS * sqrt(of_same / of_other) * exp(min(exponent, LARGEST_LOG))
    mean = (odds * error + measured * same / of_same) / (1.0 + odds)
    return mean, odds / (1.0 + odds)


def _bounded_change(change: float, taken: float) -> float:
    """The change of a scale, of which an update has taken this variance."""
    most = min(MOST_SIGMAS * sqrt(max(taken, 0.0)), MOST_CHANGE)
    return min(max(change, -most), most)


def _left_of(variance: float, taken: float, first: float) -> float:
    """The variance of a scale after an update; `first`: of the settings."""
    return max(variance - max(taken, 0.0), LEAST_SHARE * first)


def _is_smaller(covariance: Covariance3, before: Covariance3) -> bool:
    """Whether an update has made a covariance smaller; else something has made it larger."""
    is_smaller = covariance.xx + covariance.yy <= before.xx + before.yy
    return is_smaller and covariance.hh <= before.hh


def _led(row: Row, dx: float, dy: float) -> Row:
    """F row, with F the Jacobian of a motion by (dx, dy)."""
    x, y, heading = row
    return x - dy * heading, y + dx * heading, heading


def _difference(one: Row, other: Row) -> Row:
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


def _scaled(row: Row, k: float) -> Row:
    return k * row[0], k * row[1], k * row[2]


def _sum(row: Row, one: Row, k: float, other: Row, m: float) -> Row:
    """row + k one + m other."""
    return (
        row[0] + k * one[0] + m * other[0],
        row[1] + k * one[1] + m * other[1],
        row[2] + k * one[2] + m * other[2],
    )


def _symmetric(first: tuple[Row, Row], second: tuple[Row, Row]) -> Covariance3:
    """The sum of a b^T + b a^T of both pairs."""
    (a, b), (c, d) = first, second
    return Covariance3(
        2.0 * (a[0] * b[0] + c[0] * d[0]),
        a[0] * b[1] + a[1] * b[0] + c[0] * d[1] + c[1] * d[0],
        2.0 * (a[1] * b[1] + c[1] * d[1]),
        a[0] * b[2] + a[2] * b[0] + c[0] * d[2] + c[2] * d[0],
        a[1] * b[2] + a[2] * b[1] + c[1] * d[2] + c[2] * d[1],
        2.0 * (a[2] * b[2] + c[2] * d[2]),
    )
