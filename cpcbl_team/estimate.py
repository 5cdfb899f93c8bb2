"""The pose Gaussian of a robot and how evidence is merged into it.

The covariance is over (x, y, heading). `shared` is the part of it that a teammate's information
may be correlated with (split covariance intersection; Julier & Uhlmann 2001, Li & Nashashibi,
ITSC 2012): zero as long as nothing came from or went to a teammate.

Which part a merge may move is its `Scope`. In the paper heading and position are updated apart; the
covariance between the two is then only bookkeeping (a considered, not an estimated, state;
Schmidt 1966) and gives the correlated sideways drift (docs/paper.md, resolution b).
"""

import math
from collections.abc import Iterable
from enum import Enum
from math import log, sqrt
from typing import Final, NamedTuple

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, new, wrap_angle

Matrix3 = tuple[float, float, float, float, float, float, float, float, float]


class Covariance3(NamedTuple):
    """A symmetric 3 x 3 covariance over (x, y, heading); m^2, m rad, rad^2."""

    xx: float
    xy: float
    yy: float
    xh: float
    yh: float
    hh: float

    def position(self) -> Covariance2:
        return Covariance2(self.xx, self.xy, self.yy)

    def plus(self, other: "Covariance3", factor: float = 1.0) -> "Covariance3":
        xx, xy, yy, xh, yh, hh = self
        k, (oxx, oxy, oyy, oxh, oyh, ohh) = factor, other
        plus = xx + k * oxx, xy + k * oxy, yy + k * oyy, xh + k * oxh, yh + k * oyh, hh + k * ohh
        return new(Covariance3, plus)

    def scaled(self, factor: float) -> "Covariance3":
        xx, xy, yy, xh, yh, hh = self
        k = factor
        return new(Covariance3, (k * xx, k * xy, k * yy, k * xh, k * yh, k * hh))

    def times(self, h: "Row") -> tuple[float, float, float]:
        """C h."""
        x, y, a = h
        xx, xy, yy, xh, yh, hh = self
        return xx * x + xy * y + xh * a, xy * x + yy * y + yh * a, xh * x + yh * y + hh * a

    def projected(self, rows: tuple["Row", "Row"]) -> Covariance2:
        """H C H^T of two rows."""
        (a, b, c), (d, e, f) = rows
        px, py, ph = self.times(rows[0])
        qx, qy, qh = self.times(rows[1])
        xx, xy, yy = a * px + b * py + c * ph, d * px + e * py + f * ph, d * qx + e * qy + f * qh
        return Covariance2(xx, xy, yy)

    def determinant(self) -> float:
        a, b, d, c, e, f = self
        return a * (d * f - e * e) - b * (b * f - e * c) + c * (b * e - d * c)

    def inverse(self) -> "Covariance3":
        """Raises ZeroDivisionError when singular."""
        xx, xy, yy, xh, yh, hh = self
        a, b, c = yy * hh - yh * yh, xh * yh - xy * hh, xy * yh - xh * yy
        k = 1.0 / (xx * a + xy * b + xh * c)
        d, e, f = xx * hh - xh * xh, xy * xh - xx * yh, xx * yy - xy * xy
        return new(Covariance3, (k * a, k * b, k * d, k * c, k * e, k * f))

    def transformed(self, m: Matrix3) -> "Covariance3":
        """M C M^T."""
        a, b, c, d, e, f, g, h, i = m
        xx, xy, yy, xh, yh, hh = self
        ax, ay, ah = xx * a + xy * b + xh * c, xy * a + yy * b + yh * c, xh * a + yh * b + hh * c
        dx, dy, dh = xx * d + xy * e + xh * f, xy * d + yy * e + yh * f, xh * d + yh * e + hh * f
        gx, gy, gh = xx * g + xy * h + xh * i, xy * g + yy * h + yh * i, xh * g + yh * h + hh * i
        product = (
            a * ax + b * ay + c * ah,
            d * ax + e * ay + f * ah,
            d * dx + e * dy + f * dh,
            g * ax + h * ay + i * ah,
            g * dx + h * dy + i * dh,
            g * gx + h * gy + i * gh,
        )
        return new(Covariance3, product)


SMALLEST_VARIANCE: Final = 1e-10  # (10 um)^2, (10 urad)^2: what is called exact
SHARPEST_VARIANCE: Final = 1e-8  # of a measurement: sharper ones drown I + P A in rounding
ZERO3: Final = Covariance3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
Row = tuple[float, float, float]


def dot(a: Row, b: Row) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def row_sum(a: Row, b: Row, k: float = 1.0) -> Row:
    """a + k b."""
    return a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]


def outer(a: Row) -> Covariance3:
    """a a^T: the covariance of an error that is a times an error of variance 1."""
    x, y, h = a
    return Covariance3(x * x, x * y, y * y, x * h, y * h, h * h)


class Estimate(NamedTuple):
    """Pose (field_from_robot) and covariance; see the module's text for `shared`."""

    pose: Pose2
    covariance: Covariance3
    shared: Covariance3 = ZERO3

    @property
    def position_sigma_m(self) -> float:
        """The mean standard deviation along an axis of the plane."""
        return math.sqrt(0.5 * (self.covariance.xx + self.covariance.yy))

    @property
    def heading_sigma_rad(self) -> float:
        return math.sqrt(self.covariance.hh)


def pose_difference(pose: Pose2, other: Pose2) -> Row:
    """How far `other` is from `pose`: x, y (m) and heading (rad, within [-pi, pi])."""
    return other.x - pose.x, other.y - pose.y, wrap_angle(other.heading - pose.heading)


def pose_chi_square(estimate: Estimate, other: Estimate) -> float:
    """Of the difference of two independent estimates of one pose; three degrees of freedom. Raises
    ZeroDivisionError where the sum of their covariances is singular."""
    difference = pose_difference(estimate.pose, other.pose)
    information = estimate.covariance.plus(other.covariance).inverse()
    return dot(difference, information.times(difference))


class Scope(Enum):
    """What a merge may move."""

    POSE = "pose"
    POSITION = "position"
    HEADING = "heading"


# a look-up in an enum costs as much as a scalar update
POSE: Final = Scope.POSE
POSITION: Final = Scope.POSITION
HEADING: Final = Scope.HEADING


Six = tuple[float, float, float, float, float, float]
Sums = tuple[Six, Row]
"""The numbers of an `Information`, which is one."""


def sharpest(variance: float) -> float:
    """The variance (m^2 or rad^2) with which a measurement counts: at least what rounding
    allows."""
    return variance if variance > SHARPEST_VARIANCE else SHARPEST_VARIANCE


class FilteredOffset(NamedTuple):
    """The offset from a pose by a Kalman filter of scalar measurements, all linearized there."""

    covariance: Covariance3
    offset: Row = (0.0, 0.0, 0.0)
    cost: float = 0.0  # the chi-square of the innovations
    log_determinant: float = 0.0  # of their covariance

    def after(self, measurements: Iterable[tuple[Row, float, float]]) -> "FilteredOffset":
        """After more measurements: row, residual and variance of each."""
        covariance, (x, y, heading), cost, log_determinant = self
        for row, residual, variance in measurements:
            px, py, ph = covariance.times(row)
            of_innovation = row[0] * px + row[1] * py + row[2] * ph + variance
            log_determinant += log(of_innovation)
            k = 1.0 / of_innovation
            off = residual - row[0] * x - row[1] * y - row[2] * heading
            cost += k * off * off
            x, y, heading = x + k * off * px, y + k * off * py, heading + k * off * ph
            gained = px * px, px * py, py * py, px * ph, py * ph, ph * ph
            covariance = covariance.plus(new(Covariance3, gained), -k)
        return FilteredOffset(covariance, (x, y, heading), cost, log_determinant)


class InformationSum:
    """Adds up evidence about the offset from a prior (step 4)."""

    def __init__(self, start: Sums | None = None) -> None:
        self.xx = self.xy = self.yy = self.xh = self.yh = self.hh = 0.0
        self.x = self.y = self.h = 0.0
        if start is not None:
            matrix, vector = start
            self.xx, self.xy, self.yy, self.xh, self.yh, self.hh = matrix
            self.x, self.y, self.h = vector

    def add(self, u: float, v: float, a: float, residual: float, weight: float) -> None:
        """Adds a scalar measurement with row (u, v, a); `weight` is the inverse of its variance."""
        wu, wv, wa = weight * u, weight * v, weight * a
        self.xx += wu * u
        self.xy += wu * v
        self.yy += wv * v
        self.xh += wu * a
        self.yh += wv * a
        self.hh += wa * a
        self.x += wu * residual
        self.y += wv * residual
        self.h += wa * residual

    def sums(self) -> Sums:
        """The matrix (xx, xy, yy, xh, yh, hh) and the vector (x, y, h)."""
        matrix = self.xx, self.xy, self.yy, self.xh, self.yh, self.hh
        return matrix, (self.x, self.y, self.h)


class Information(NamedTuple):
    """Evidence about the offset from a prior: sum of h h^T / variance and of h e / variance."""

    matrix: Covariance3
    vector: Row

    @staticmethod
    def none() -> "Information":
        return new(Information, (ZERO3, (0.0, 0.0, 0.0)))

    @staticmethod
    def of(sums: Sums) -> "Information":
        matrix, vector = sums
        return new(Information, (new(Covariance3, matrix), vector))

    def add(self, h: Row, residual: float, variance: float) -> "Information":
        """With one more scalar measurement: residual = h . offset + noise of this variance."""
        return self.with_all(((h, residual, variance),))

    def with_all(self, measurements: Iterable[tuple[Row, float, float]]) -> "Information":
        """With these (row, residual, variance) of scalar measurements."""
        total = InformationSum(self)
        for (x, y, a), residual, variance in measurements:
            total.add(x, y, a, residual, 1.0 / sharpest(variance))
        return Information.of(total.sums())


def posterior_factor(prior: Covariance3, information: Six) -> Matrix3:
    """(I + P A)^-1, the share of the prior's error that survives the evidence A."""
    xx, xy, yy, xh, yh, hh = prior
    axx, axy, ayy, axh, ayh, ahh = information
    # columns of I + P A are (a b c), (d e f), (g h i)
    a = xx * axx + xy * axy + xh * axh + 1.0
    b = xy * axx + yy * axy + yh * axh
    c = xh * axx + yh * axy + hh * axh
    d = xx * axy + xy * ayy + xh * ayh
    e = xy * axy + yy * ayy + yh * ayh + 1.0
    f = xh * axy + yh * ayy + hh * ayh
    g = xx * axh + xy * ayh + xh * ahh
    h = xy * axh + yy * ayh + yh * ahh
    i = xh * axh + yh * ayh + hh * ahh + 1.0
    A, B, C = e * i - h * f, g * f - d * i, d * h - g * e
    det = a * A + b * B + c * C
    k = 1.0 / det
    return (
        k * A,
        k * B,
        k * C,
        k * (h * c - b * i),
        k * (a * i - g * c),
        k * (g * b - a * h),
        k * (b * f - e * c),
        k * (d * c - a * f),
        k * (a * e - d * b),
    )


def symmetric_product(m: Matrix3, p: Covariance3) -> Covariance3:
    """M P where it is known to be symmetric."""
    a, b, c, d, e, f, g, h, i = m
    xx, xy, yy, xh, yh, hh = p
    product = (
        a * xx + b * xy + c * xh,
        d * xx + e * xy + f * xh,
        d * xy + e * yy + f * yh,
        g * xx + h * xy + i * xh,
        g * xy + h * yy + i * yh,
        g * xh + h * yh + i * hh,
    )
    return new(Covariance3, product)


def within_scope(
    survive: Matrix3, prior: Covariance3, posterior: Covariance3, scope: Scope
) -> tuple[Matrix3, Covariance3]:
    """The merge restricted to `scope`: the other part keeps its estimate and its variance."""
    if scope is POSE:
        return survive, posterior
    if scope is POSITION:
        xx, xy, yy, xh, yh, _ = posterior
        return (*survive[:6], 0.0, 0.0, 1.0), Covariance3(xx, xy, yy, xh, yh, prior.hh)
    return (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, *survive[6:]), Covariance3(
        prior.xx, prior.xy, prior.yy, posterior.xh, posterior.yh, posterior.hh
    )


def offset_pose(pose: Pose2, offset: Row, scope: Scope) -> Pose2:
    """The pose moved by an offset, within `scope`."""
    dx, dy, dh = offset
    if scope is POSITION:
        return Pose2(pose.x + dx, pose.y + dy, pose.heading)
    if scope is HEADING:
        return Pose2(pose.x, pose.y, wrap_angle(pose.heading + dh))
    return Pose2(pose.x + dx, pose.y + dy, wrap_angle(pose.heading + dh))


def merge(
    prior: Estimate, evidence: Sums, scope: Scope = POSE, as_circle: bool = False
) -> Estimate:
    """Bayes' product of a prior and independent evidence (equations 3 and 4 in three dimensions).

    Works for evidence of any rank: one range says nothing along the tangent of its circle. Evidence
    that is so much sharper than the prior that I + P A cannot be computed in floating point changes
    nothing. `as_circle`: the position's covariance is kept as a circle.
    """
    pose, covariance, shared = prior
    x, y, heading = pose
    xx, xy, yy, xh, yh, hh = covariance
    matrix, vector = evidence
    ex, ey, eh = vector
    survive = posterior_factor(covariance, matrix)
    a, b, c, d, e, f, g, h, i = survive
    # survive times covariance, as in `product`, of it what is in scope
    xh_after = g * xx + h * xy + i * xh
    yh_after = g * xy + h * yy + i * yh
    if scope is not POSITION:
        hh = g * xh + h * yh + i * hh
        heading = wrap_angle(heading + xh_after * ex + yh_after * ey + hh * eh)
    if scope is not HEADING:
        xx, xy, yy = a * xx + b * xy + c * xh, d * xx + e * xy + f * xh, d * xy + e * yy + f * yh
        x += xx * ex + xy * ey + xh_after * eh
        y += xy * ex + yy * ey + yh_after * eh
    if xx < 0.0 or yy < 0.0 or hh < 0.0:
        return prior
    if as_circle:
        xx = yy = circle_variance(xx, xy, yy)
        xy = 0.0
    if shared is not ZERO3:
        survive, _ = within_scope(survive, covariance, covariance, scope)
        shared = shared.transformed(survive)
    posterior = new(Covariance3, (xx, xy, yy, xh_after, yh_after, hh))
    return new(Estimate, (new(Pose2, (x, y, heading)), posterior, shared))


def circle_variance(xx: float, xy: float, yy: float) -> float:
    """The variance of the circle that stands for an ellipse: that of its major axis. A smaller
    circle would create certainty from nothing: each reduction would shorten the major axis, of
    which one range says nothing however often it comes."""
    variance = 0.5 * (xx + yy)
    if xy != 0.0 or xx != yy:
        half = 0.5 * (xx - yy)
        variance += sqrt(half * half + xy * xy)
    return variance


def with_circular_position(estimate: Estimate) -> Estimate:
    """The estimate with its position's covariance reduced to a circle."""
    pose, covariance, shared = estimate
    xx, xy, yy, xh, yh, hh = covariance
    variance = circle_variance(xx, xy, yy)
    return new(Estimate, (pose, new(Covariance3, (variance, 0.0, variance, xh, yh, hh)), shared))
