"""The scales of the odometry, where the settings may be wrong about them.

If a robot's tyres or floor differ from those of the day on which it was calibrated, it drives
another share of each distance, and turns another share of each turn, than its odometry says. Such
an error does not average out as noise does: it grows with the way. So the covariance of the pose
contains both shares (S. F. Schmidt 1966; A. H. Jazwinski, Stochastic Processes and Filtering
Theory, 1970, section 8.4). It grows by what they do to the pose, and an update reduces their part
with the rest.

A reading depends on the scales only through the pose. So an update of the pose contains all that a
reading says about them. If it takes the covariance of the pose from P to Q, and corrects the pose
by d, then it corrects the scales by X^T P^-1 d, and leaves Q P^-1 X of X, their covariance with the
pose. The filter of the pose need not know about the scales: they are estimated beside it, as B.
Friedland does with a bias (IEEE Transactions on Automatic Control, 1969). They are corrected only
as far as an error is likely.
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
    row_sum,
)
from cpcbl_team.parameters import NO_COVARIANCE

LARGEST_LOG: Final = 50.0  # of a ratio of likelihoods
LEAST_VARIANCE: Final = 0.005**2  # of a share, where one divides by it
LEAST_SHARE: Final = 0.1**2
"""Of the stated variance of a scale that always stays: no floor is alike everywhere, and wheels
slip in one curve more than in another."""
MOST_SIGMAS: Final = 3.0  # by which one correction of the pose changes a scale
ODDS: Final = 0.25  # of wheels of another day to those of the calibration
SAME_DAY: Final = 0.1**2  # the variance of the scales on its days, as a share of the stated one
SETTINGS_SIGMAS: Final = 3.0  # of the stated sigma; beyond, the settings do not explain a scale
MOST_HEADING_VARIANCE: Final = 1.0**2  # rad^2: beyond, no way is as straight as its linear form
MOST_CHANGE: Final = 0.5  # of a scale at once: what is more is another unit, no other tyre


class Scale(NamedTuple):
    """What is known of one scale of the odometry, beside what the settings say.

    `first`: the variance, as a share, that the settings state; 0: the scale is exact. `variance`:
    what is left of it by the updates of the pose. `considered`: what the covariance of the pose
    contains. That does not fall with what is found here: wheels slip in one curve more than in
    another.

    `factor`: by which readings are corrected. `error`: the share by which they are too short all
    the same, as far as that is known; as much of it as is likely moves to `factor`. `offset`: what
    that error has moved the pose by (m, m, rad). `covariance`: of the share with (x, y, heading).
    """

    first: float = 0.0
    variance: float = 0.0
    considered: float = 0.0
    factor: float = 1.0
    error: float = 0.0
    offset: Row = NO_COVARIANCE
    covariance: Row = NO_COVARIANCE

    @staticmethod
    def of_sigma(sigma: float) -> "Scale":
        """Of a scale with this sigma, as a share of it."""
        variance = sigma * sigma
        return Scale(variance, variance, variance)

    @property
    def contradicts_settings(self) -> bool:
        """Whether it is corrected by more than its settings explain (3 sigma)."""
        change = self.factor - 1.0
        return change * change > SETTINGS_SIGMAS**2 * self.first

    @property
    def doubt(self) -> Covariance3:
        """What the covariance of the pose lacks if `error` is there all the same."""
        _, probability = _mixture(self.factor * (1.0 + self.error) - 1.0, self.variance, self.first)
        return outer(self.offset).scaled(probability)

    def at_new_pose(self) -> "Scale":
        """At a pose that does not follow from the odometry until now."""
        return self._replace(offset=NO_COVARIANCE, covariance=NO_COVARIANCE)

    def after_update(self, inverse: Covariance3, left: Covariance3) -> "Scale":
        """After an update of the pose, which multiplies its error by 1 - K H = Q P^-1. Both
        covariances of the pose: the inverse of P, and Q."""
        return self._replace(
            offset=left.times(inverse.times(self.offset)),
            covariance=left.times(inverse.times(self.covariance)),
        )

    def with_correction(self, before: "Scale", inverse: Covariance3, news: Row) -> "Scale":
        """With what an update says of it. `before`: the scale before that; `inverse`: of the
        covariance of the pose then; `news`: the correction of the pose without what was expected.
        """
        share = self.variance / max(self.considered, SMALLEST_VARIANCE)
        of_pose = _times(inverse.times(before.covariance), share)
        taken = share * dot(of_pose, row_sum(before.covariance, self.covariance, -1.0))
        change = _bounded_change(dot(of_pose, news), taken)
        variance = max(self.variance - max(taken, 0.0), LEAST_SHARE * self.first)
        return self._replace(variance=variance, error=self.error + change)

    def corrected(self) -> tuple["Scale", Row]:
        """With as much of its error corrected as is likely; and what that moves the pose by."""
        whole = self.factor * (1.0 + self.error)
        if whole == self.factor:
            return self, NO_COVARIANCE
        factor = 1.0 + _mixture(whole - 1.0, self.variance, self.first)[0]
        share = min(max((factor - self.factor) / (whole - self.factor), -1.0), 1.0)
        left = _times(self.offset, 1.0 - share)
        known = self._replace(factor=factor, error=whole / factor - 1.0, offset=left)
        return known, _times(self.offset, share)

    def after_motion(
        self, by_share: Row, dx: float, dy: float, beside: Covariance3 | None
    ) -> tuple["Scale", Covariance3]:
        """After a motion by (dx, dy) in the field's frame, in which a share of one moves the pose
        by `by_share`; and what that has added to the covariance of the pose. `beside`: of the pose,
        if that may not be negative."""
        led = _led(self.covariance, dx, dy)
        # X g^T + g X^T, of which half of g B g^T is in each
        half = row_sum(led, by_share, 0.5 * self.considered)
        if beside is None:
            added = _symmetric(half, by_share)
        else:
            added = _positive_part(half, by_share, beside)
        known = self._replace(
            offset=row_sum(_led(self.offset, dx, dy), by_share, self.error),
            covariance=row_sum(led, by_share, self.considered),
        )
        return known, added

    def pose_offset(self, error: float) -> Row:
        """By how much (m, m, rad) a share that was too short by this has moved the pose."""
        return _times(self.covariance, error / max(self.considered, LEAST_VARIANCE))

    def with_considered(self, variance: float) -> "Scale":
        """With another variance in the covariance of the pose, of which somebody else knows."""
        k = variance / self.considered if self.considered > 0.0 else 0.0
        return self._replace(considered=variance, covariance=_times(self.covariance, k))


class ScaleErrors(NamedTuple):
    """What is known of both scales of the odometry. `estimate`: of the pose after its last motion,
    or None before the first one from a pose."""

    distance: Scale = Scale()
    turn: Scale = Scale()
    estimate: Estimate | None = None

    @staticmethod
    def of_sigmas(distance: float, turn: float) -> "ScaleErrors":
        """Of scales with these sigmas, as shares of them."""
        return ScaleErrors(Scale.of_sigma(distance), Scale.of_sigma(turn))

    @property
    def are_exact(self) -> bool:
        """Whether the scales are as the settings say."""
        return self.distance.first == self.turn.first == 0.0

    @property
    def contradict_settings(self) -> bool:
        """Whether one of them is corrected by more than its settings explain."""
        return self.distance.contradicts_settings or self.turn.contradicts_settings

    @property
    def factors(self) -> tuple[float, float]:
        """By which distances and turns are corrected."""
        return self.distance.factor, self.turn.factor

    @property
    def offset(self) -> Row:
        """What errors of the scales that are not corrected have moved the pose by."""
        return row_sum(self.distance.offset, self.turn.offset)

    def at_new_pose(self) -> "ScaleErrors":
        """At a pose that does not follow from the odometry until now."""
        return ScaleErrors(self.distance.at_new_pose(), self.turn.at_new_pose())

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
        distance, turn = (s.after_update(inverse, left) for s in (self.distance, self.turn))
        known = ScaleErrors(distance, turn, now)
        if estimates and covariance.hh <= MOST_HEADING_VARIANCE:
            # What is known already to be wrong with the pose was expected
            expected = row_sum(self.offset, known.offset, -1.0)
            news = row_sum(pose_difference(before.pose, now.pose), expected, -1.0)
            distance = distance.with_correction(self.distance, inverse, news)
            turn = turn.with_correction(self.turn, inverse, news)
            known = ScaleErrors(distance, turn, now)
        return known._bounded(left)

    def corrected(self) -> tuple["ScaleErrors", Row]:
        """With their errors corrected, as far as these are likely; and what that moves the pose
        by."""
        distance, by_distance = self.distance.corrected()
        turn, by_turn = self.turn.corrected()
        if distance is self.distance and turn is self.turn:
            return self, NO_COVARIANCE
        return ScaleErrors(distance, turn, self.estimate), row_sum(by_distance, by_turn)

    def after_motion(
        self, before: Estimate, distance: float, turn: float, takes_nothing: bool = False
    ) -> tuple["ScaleErrors", Covariance3]:
        """After an arc of `distance` metres that turns by `turn` (rad), from this estimate; and
        what the scales have added to the covariance of the pose in it. `takes_nothing`: this is
        never negative. (The way back takes away what the way there has added. But nobody knows the
        covariance of the scales with other errors that are estimated beside the pose, or with the
        components of a mixture.)"""
        direction = before.pose.heading + 0.5 * turn
        dx, dy = distance * cos(direction), distance * sin(direction)
        beside = before.covariance if takes_nothing else None
        of_distance, added = self.distance.after_motion((dx, dy, 0.0), dx, dy, beside)
        by_turn = -0.5 * turn * dy, 0.5 * turn * dx, turn
        of_turn, more = self.turn.after_motion(by_turn, dx, dy, beside)
        return ScaleErrors(of_distance, of_turn, self.estimate), added.plus(more)

    def pose_offset(self, now: Estimate, distance: float, turn: float) -> Row:
        """By how much (m, m, rad) shares that were too short by this have moved the pose. The
        scales are only considered."""
        known = self.after_updates(now, estimates=False)
        return row_sum(known.distance.pose_offset(distance), known.turn.pose_offset(turn))

    def with_considered(self, distance: float, turn: float, now: Estimate) -> "ScaleErrors":
        """With other variances in the covariance of the pose, of which somebody else knows; `now`
        is the estimate, whose covariance stays as it is."""
        of_distance = self.distance.with_considered(distance)
        known = ScaleErrors(of_distance, self.turn.with_considered(turn), self.estimate)
        if now.covariance.determinant() <= SMALLEST_VARIANCE**3:
            return known.at_new_pose()
        return known._bounded(now.covariance)

    def _bounded(self, left: Covariance3) -> "ScaleErrors":
        """Where something else has changed the covariance of the pose: no more of it than the whole
        is due to the scales."""
        inverse, (distance, turn, _) = left.inverse(), self
        of_distance, of_turn = distance.covariance, turn.covariance
        xx, yy = max(distance.considered, LEAST_VARIANCE), max(turn.considered, LEAST_VARIANCE)
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
        return self._replace(
            distance=distance._replace(covariance=_times(of_distance, k)),
            turn=turn._replace(covariance=_times(of_turn, k)),
        )


EXACT: Final = ScaleErrors()


def with_scales_doubted(estimate: Estimate, scales: ScaleErrors) -> Estimate:
    """The estimate as it is if errors of the scales that are not corrected are there."""
    for scale in (scales.distance, scales.turn):
        if scale.offset != NO_COVARIANCE:
            covariance = estimate.covariance.plus(scale.doubt)
            estimate = estimate._replace(covariance=covariance)
    return estimate


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


def _is_smaller(covariance: Covariance3, before: Covariance3) -> bool:
    """Whether an update has made a covariance smaller; else something has made it larger."""
    is_smaller = covariance.xx + covariance.yy <= before.xx + before.yy
    return is_smaller and covariance.hh <= before.hh


def _led(row: Row, dx: float, dy: float) -> Row:
    """F row, with F the Jacobian of a motion by (dx, dy)."""
    x, y, heading = row
    return x - dy * heading, y + dx * heading, heading


def _times(row: Row, k: float) -> Row:
    return k * row[0], k * row[1], k * row[2]


def _positive_part(a: Row, b: Row, covariance: Covariance3) -> Covariance3:
    """a b^T + b a^T without its negative part: it is (c c^T - d d^T) / 2 with c, d = k a +- b / k,
    where k makes d small beside a `covariance`."""
    position = max(covariance.xx + covariance.yy, SMALLEST_VARIANCE)
    heading = max(covariance.hh, SMALLEST_VARIANCE)
    of_a, of_b = ((x * x + y * y) / position + h * h / heading for x, y, h in (a, b))
    if min(of_a, of_b) == 0.0:
        return ZERO3
    k = (of_b / of_a) ** 0.25
    return outer(row_sum(_times(a, k), b, 1.0 / k)).scaled(0.5)


def _symmetric(a: Row, b: Row) -> Covariance3:
    """a b^T + b a^T."""
    (ax, ay, ah), (bx, by, bh) = a, b
    return Covariance3(
        2.0 * ax * bx,
        ax * by + ay * bx,
        2.0 * ay * by,
        ax * bh + ah * bx,
        ay * bh + ah * by,
        2.0 * ah * bh,
    )
