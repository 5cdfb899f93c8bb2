"""What each source says of the robot's position on average, and how far sources disagree.

An error that grows slowly hides in the noise of each report, and the estimate follows it, so that
the innovations of the honest senders become suspicious instead. The mean of many signed offsets
from the estimate is far more precise than one of them, and the difference between the means of two
sources is free of the error of the estimate, which both have in common: nobody can hide a drift by
dragging the estimate along. (It is the test of a mean against a reference; the mean fades
exponentially: S. W. Roberts, Technometrics 1, 1959.)
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from cpcbl_team.estimate import ZERO3, Covariance3, Sums
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import new
from cpcbl_team.mean_headings import MOST_SIGMA, MeanTurn

FAST_NS: Final = 1_500_000_000  # time constants with which reports fade: a fast drift shows sooner
SLOW_NS: Final = 6_000_000_000  # in the mean of a short time, a slow one in that of a long time
FAST: Final = 0  # places of both means in a record
SLOW: Final = 1
DIRECT: Final = 2  # not in a record: how senders differ from each other, instead of the estimate
LEAST_REPORTS: Final = 5.0  # with fewer, fading, a source has no mean
MOST_SIGMA_M: Final = 0.15  # a source whose mean is less certain has no vote
FAST_COMMON_M: Final = 0.01
SLOW_COMMON_M: Final = 0.01
"""Sigmas of what two correct sources may disagree by for ever: calibration, map, and the error of
the estimate, which differs between the times of their reports, the more the longer the mean."""
CONFLICT: Final = 18.0
"""Two sources contradict each other beyond this chi-square (two degrees of freedom)."""
ALTERNATING_NS: Final = 200_000_000  # between two sources whose reports alternate
USUAL: Final = 6.0  # 95 % of correct sources differ by less (chi-square, two degrees of freedom)
HEADING_VARIANCE: Final = math.radians(5.0) ** 2
"""rad^2: the heading of an estimate that was led astray may be wrong by more than its variance."""
NOTHING: Final = Covariance2(0.0, 0.0, 0.0)
Offset = tuple[float, float]


class MeanOffset(NamedTuple):
    """The mean offset of the positions that a source reports from the estimate, m, and its
    covariance, m^2."""

    x: float
    y: float
    covariance: Covariance2
    common_m: float = FAST_COMMON_M  # sigma of an error that never averages away
    stamp_ns: int = 0  # of its last report, and the variance (m^2, both axes) of the estimate then
    estimate_variance: float = 0.0
    sender: str = ""  # by which others find their direct difference from it
    apart: Mapping[str, "MeanOffset"] = MappingProxyType({})
    """Its difference from the means of other senders by name, where that was measured directly."""

    @property
    def length_m(self) -> float:
        return math.hypot(self.x, self.y)

    def is_within(self, sigma_m: float) -> bool:
        """Whether it is as certain as this, in the mean of the axes."""
        return self.covariance.xx + self.covariance.yy <= 2.0 * sigma_m * sigma_m

    @property
    def is_precise(self) -> bool:
        """Whether it is certain enough for a vote."""
        return self.is_within(MOST_SIGMA_M)

    @property
    def can_be_wrong(self) -> bool:
        """Whether it is certain enough along any axis for others to contradict it: the smaller
        eigenvalue of its covariance. One that is vague along the other axis has no vote, for it
        would agree with anybody there, but as much weight along this one."""
        smaller, _ = self.covariance.eigenvalues()
        return smaller <= MOST_SIGMA_M * MOST_SIGMA_M


def about_position(evidence: Sums, heading_variance: float) -> tuple[Covariance2, Offset]:
    """What evidence of the offset of the estimate says of its position: matrix and vector. The
    heading is marginalized (the Schur complement); `heading_variance` (rad^2): that of the
    estimate, for what a bearing says of the position depends on the heading."""
    (xx, xy, yy, xh, yh, hh), (x, y, h) = evidence
    k = 1.0 / (hh + 1.0 / (heading_variance + HEADING_VARIANCE))
    matrix = Covariance2(xx - k * xh * xh, xy - k * xh * yh, yy - k * yh * yh)
    return matrix, (x - k * xh * h, y - k * yh * h)


def with_heading_error(evidence: Sums, variance: float) -> Sums:
    """The evidence of one report, whose heading has an error of its own of this variance (rad^2):
    that of the estimate changes from one report to the next, with odometry and corrections. What
    bearings of several frames would tell of the position together otherwise is that change."""
    (xx, xy, yy, xh, yh, hh), (x, y, h) = evidence
    k = variance / (1.0 + variance * hh)
    rest = 1.0 - k * hh
    return (
        (xx - k * xh * xh, xy - k * xh * yh, yy - k * yh * yh, rest * xh, rest * yh, rest * hh),
        (x - k * xh * h, y - k * yh * h, rest * h),
    )


def with_position_error(evidence: Sums, covariance: Covariance2) -> Sums:
    """The evidence of one report, to which the error of the position of the estimate adds this
    covariance (m^2). That error too changes from one report to the next, with odometry and
    corrections. Without it, reports that are precise along lines that are nearly parallel, like the
    ranges of a teammate that is followed, would meet far from all of them."""
    (xx, xy, yy, xh, yh, hh), (x, y, h) = evidence
    vxx, vxy, vyy = covariance
    # K = V (I + A V)^-1, with the part A of the matrix that is about the position
    a, b = 1.0 + xx * vxx + xy * vxy, xx * vxy + xy * vyy
    c, d = xy * vxx + yy * vxy, 1.0 + xy * vxy + yy * vyy
    k = 1.0 / (a * d - b * c)
    kxx, kxy, kyy = k * (vxx * d - vxy * c), k * (vxy * a - vxx * b), k * (vyy * a - vxy * b)
    # The rest is (I - A K) times the evidence.
    rxx, rxy = 1.0 - xx * kxx - xy * kxy, -xx * kxy - xy * kyy
    ryx, ryy = -xy * kxx - yy * kxy, 1.0 - xy * kxy - yy * kyy
    gx, gy = kxx * xh + kxy * yh, kxy * xh + kyy * yh
    matrix = Covariance3(
        rxx * xx + rxy * xy,
        rxx * xy + rxy * yy,
        ryx * xy + ryy * yy,
        rxx * xh + rxy * yh,
        ryx * xh + ryy * yh,
        hh - xh * gx - yh * gy,
    )
    return matrix, (rxx * x + rxy * y, ryx * x + ryy * y, h - gx * x - gy * y)


def product(a: Covariance2, d: Covariance2) -> Covariance2:
    """A D A of two symmetric matrices."""
    (xx, xy, yy), (dxx, dxy, dyy) = a, d
    px, py = xx * dxx + xy * dxy, xx * dxy + xy * dyy  # rows of A D
    qx, qy = xy * dxx + yy * dxy, xy * dxy + yy * dyy
    return new(Covariance2, (px * xx + py * xy, px * xy + py * yy, qx * xy + qy * yy))


def by_whole_noise(evidence: Sums, dependent: Covariance2) -> tuple[Sums, Covariance2]:
    """The evidence of one report by the whole of its noise, and what it adds to
    `FadingOffsets.dependent`. `evidence`: by the independent part of its noise; `dependent` (m^2):
    the other part. A source has weight along the axes along which it is certain, and only there."""
    if dependent is not NOTHING:
        evidence = with_position_error(evidence, dependent)
    return evidence, product(Covariance2(*evidence[0][:3]), dependent)


def weighted(evidence: Sums, weight: float) -> Sums:
    """The evidence with this weight, below one for what may be an outlier."""
    matrix, (x, y, h) = evidence
    return Covariance3(*(weight * a for a in matrix)), (weight * x, weight * y, weight * h)


class FadingOffsets(NamedTuple):
    """Fading sums over the reports of one source."""

    stamp_ns: int = 0
    reports: float = 0.0
    squares: float = 0.0  # of the weights of the reports
    evidence: Sums = (ZERO3, (0.0, 0.0, 0.0))
    """About the offset (m, m, rad) of the estimate, by the whole noise of each report."""
    dependent: Covariance2 = NOTHING
    """The sum of A D A, 1/m^2: the information A of each report about the position, and the part D
    of its noise that all reports of the source have in common."""

    def with_report(
        self, stamp_ns: int, fading_ns: int, evidence: Sums, dependent: Covariance2 = NOTHING
    ) -> "FadingOffsets":
        """The sums with one more report, which `by_whole_noise` gives for the sums of all fading
        times. A report that is older than the last fades nothing."""
        elapsed_ns = stamp_ns - self.stamp_ns
        fade = math.exp(-elapsed_ns / fading_ns) if elapsed_ns > 0 else 1.0
        (xx, xy, yy, xh, yh, hh), (x, y, h) = self.evidence
        (axx, axy, ayy, axh, ayh, ahh), (ax, ay, ah) = evidence
        matrix = (
            fade * xx + axx,
            fade * xy + axy,
            fade * yy + ayy,
            fade * xh + axh,
            fade * yh + ayh,
            fade * hh + ahh,
        )
        fields = (
            max(stamp_ns, self.stamp_ns),
            fade * self.reports + 1.0,
            fade * fade * self.squares + 1.0,
            (new(Covariance3, matrix), (fade * x + ax, fade * y + ay, fade * h + ah)),
            self.dependent.scaled(fade) + dependent,
        )
        return new(FadingOffsets, fields)

    def mean(
        self,
        heading_variance: float,
        common_m: float = FAST_COMMON_M,
        estimate_variance: float = 0.0,
        *,
        least: float = LEAST_REPORTS,
    ) -> MeanOffset | None:
        """The mean of the reports, if they are enough to determine one: at least `least`, fading.
        `heading_variance` (rad^2) and `estimate_variance` (m^2, both axes): those of the
        estimate."""
        if self.reports < least:
            return None
        (xx, xy, yy), (x, y) = about_position(self.evidence, heading_variance)
        determinant = xx * yy - xy * xy
        if determinant <= 1e-9 * xx * yy or xx <= 0.0 or yy <= 0.0:
            return None
        inverse = cxx, cxy, cyy = yy / determinant, -xy / determinant, xx / determinant
        # The variance of a weighted mean: old reports fade, so their errors do too. The dependent
        # parts are correlated in any way: covariance intersection, with the weights of the reports.
        once = self.squares / self.reports
        common = product(Covariance2(*inverse), self.dependent).scaled(self.reports - once)
        covariance = Covariance2(*inverse).scaled(once) + common
        offset = cxx * x + cxy * y, cxy * x + cyy * y
        return MeanOffset(*offset, covariance, common_m, self.stamp_ns, estimate_variance)

    def turn(self) -> MeanTurn | None:
        """What the reports say of the heading of the estimate, whatever its position is; None if
        they do not determine it well."""
        (xx, xy, yy, xh, yh, hh), (x, y, h) = self.evidence
        determinant = xx * yy - xy * xy
        if self.reports < LEAST_REPORTS or determinant <= 1e-9 * xx * yy:
            return None
        # The position is marginalized: the Schur complement.
        kx, ky = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
        information = hh - kx * xh - ky * yh
        if information <= 1e-6 * hh:
            return None
        variance = self.squares / self.reports / information
        if variance > MOST_SIGMA * MOST_SIGMA:
            return None
        return MeanTurn((h - kx * x - ky * y) / information, variance)


Means = Mapping[str, MeanOffset]
"""The means of some sources, by name."""


# How far two sources disagree ---------------------------------------------------------------------


def disagreement(one: MeanOffset, other: MeanOffset) -> float:
    """The chi-square of the difference of two means (two degrees of freedom)."""
    x, y, (xx, xy, yy), growth = _difference(one, other)
    common = one.common_m * one.common_m + other.common_m * other.common_m + growth
    sum_ = new(Covariance2, (xx + common, xy, yy + common))
    return sum_.mahalanobis_squared(x, y)


def _difference(one: MeanOffset, other: MeanOffset) -> tuple[float, float, Covariance2, float]:
    """The difference of two means, its covariance, and by how much the estimate may have changed
    between the two; if it was measured directly, that difference."""
    direct = one.apart.get(other.sender)
    if direct is not None:
        return direct.x, direct.y, direct.covariance, 0.0
    covariance = one.covariance + other.covariance
    return one.x - other.x, one.y - other.y, covariance, _growth(one, other)


def contradicts(one: MeanOffset, other: MeanOffset) -> bool:
    """Whether noise and usual errors of calibration do not explain the difference of two means."""
    return disagreement(one, other) > CONFLICT


def bias_variance(one: MeanOffset, other: MeanOffset, *, apart: float | None = None) -> float:
    """The square of the bias (m^2) by which the noise of two means does not explain their
    difference d, along the direction w = C^-1 d in which they disagree most: (d w)^2 / w^2, less
    the part 2 / chi-square of it that two degrees of freedom have on average. With the same noise
    C along both axes this is d^2 less the trace of C. `apart`: their disagreement, if known."""
    if (disagreement(one, other) if apart is None else apart) <= USUAL:
        return 0.0
    dx, dy, covariance, growth = _difference(one, other)
    (xx, xy, yy) = covariance + Covariance2(growth, 0.0, growth)
    wx, wy = yy * dx - xy * dy, xx * dy - xy * dx  # times the determinant
    determinant, along = xx * yy - xy * xy, wx * dx + wy * dy
    excess = along * (along - 2.0 * determinant) / (wx * wx + wy * wy)
    return excess if excess > 0.0 else 0.0


def lead(one: MeanOffset, other: MeanOffset, own: MeanOffset) -> float:
    """By how much `one` is nearer to the robot's own sensors than `other`: the difference of two
    chi-squares (one degree of freedom) along the direction w = C^-1 d in which the two disagree
    most, by the same variance for both. Chi-squares of the whole plane would favour who is vague:
    the errors of own sensors along an axis of which it says nothing would count only against who
    is certain there."""
    dx, dy = one.x - other.x, one.y - other.y
    common = one.common_m * one.common_m + other.common_m * other.common_m + _growth(one, other)
    both_ = one.covariance + other.covariance
    xx, xy, yy = both_ + Covariance2(common, 0.0, common)
    wx, wy = yy * dx - xy * dy, xx * dy - xy * dx  # times the determinant
    growth = max(_growth(one, own), _growth(other, own))
    more = common + own.common_m * own.common_m + growth
    xx, xy, yy = both_ + own.covariance + Covariance2(more, 0.0, more)
    variance = wx * wx * xx + 2.0 * wx * wy * xy + wy * wy * yy
    if variance <= 0.0:  # both are at the same place
        return 0.0
    of_one = wx * (one.x - own.x) + wy * (one.y - own.y)
    of_other = wx * (other.x - own.x) + wy * (other.y - own.y)
    return (of_other * of_other - of_one * of_one) / variance


def _growth(one: MeanOffset, other: MeanOffset) -> float:
    """By how much the variance (m^2) of the estimate grew between the last reports of two sources,
    one of which is silent: so far odometry alone may have changed the estimate's error. Sources
    whose reports alternate have all changes of it in common."""
    earlier, later = (one, other) if one.stamp_ns <= other.stamp_ns else (other, one)
    if later.stamp_ns - earlier.stamp_ns <= ALTERNATING_NS:
        return 0.0
    return max(0.0, later.estimate_variance - earlier.estimate_variance)
