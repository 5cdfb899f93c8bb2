"""The pose Gaussian of a robot and how evidence is merged into it.

The covariance is over (x, y, heading). `shared` is the part of it that a teammate's information
may be correlated with (split covariance intersection; Julier & Uhlmann 2001, Li & Nashashibi,
ITSC 2012): zero as long as nothing came from or went to a teammate.

Which part a merge may move is its `Scope`. In the paper heading and position are updated apart; the
covariance between the two is then only bookkeeping (a considered, not an estimated, state;
Schmidt 1966) and gives the correlated sideways drift of resolution b.
"""

import math
from enum import Enum
from typing import NamedTuple

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, wrap_angle

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
        return Covariance3(*(a + factor * b for a, b in zip(self, other, strict=True)))

    def scaled(self, factor: float) -> "Covariance3":
        return Covariance3(*(factor * a for a in self))

    def times(self, h: "Row") -> tuple[float, float, float]:
        """C h."""
        x, y, a = h
        return (
            self.xx * x + self.xy * y + self.xh * a,
            self.xy * x + self.yy * y + self.yh * a,
            self.xh * x + self.yh * y + self.hh * a,
        )

    def determinant(self) -> float:
        a, b, d, c, e, f = self
        return a * (d * f - e * e) - b * (b * f - e * c) + c * (b * e - d * c)

    def transformed(self, m: Matrix3) -> "Covariance3":
        """M C M^T."""
        a, b, c, d, e, f, g, h, i = m
        ax, ay, ah = self.times((a, b, c))
        dx, dy, dh = self.times((d, e, f))
        gx, gy, gh = self.times((g, h, i))
        return Covariance3(
            a * ax + b * ay + c * ah,
            d * ax + e * ay + f * ah,
            d * dx + e * dy + f * dh,
            g * ax + h * ay + i * ah,
            g * dx + h * dy + i * dh,
            g * gx + h * gy + i * gh,
        )


SMALLEST_VARIANCE = 1e-10  # (10 um)^2, (10 urad)^2: what is called exact
SPREAD_SHARE = 0.25  # of an ellipse's spread that its circle keeps
ZERO3 = Covariance3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
Row = tuple[float, float, float]


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


class Scope(Enum):
    """What a merge may move."""

    POSE = "pose"
    POSITION = "position"
    HEADING = "heading"


class Information(NamedTuple):
    """Evidence about the offset from a prior: sum of h h^T / variance and of h e / variance."""

    matrix: Covariance3
    vector: Row

    @staticmethod
    def none() -> "Information":
        return Information(ZERO3, (0.0, 0.0, 0.0))

    def add(self, h: Row, residual: float, variance: float) -> "Information":
        """With one more scalar measurement: residual = h . offset + noise of this variance."""
        x, y, a = h
        m, v, w = self.matrix, self.vector, 1.0 / max(variance, SMALLEST_VARIANCE)
        r = residual * w
        return Information(
            Covariance3(
                m.xx + w * x * x,
                m.xy + w * x * y,
                m.yy + w * y * y,
                m.xh + w * x * a,
                m.yh + w * y * a,
                m.hh + w * a * a,
            ),
            (v[0] + r * x, v[1] + r * y, v[2] + r * a),
        )


def _gain(prior: Covariance3, information: Covariance3) -> Matrix3:
    """(I + P A)^-1, the share of the prior's error that survives the evidence A."""
    a, b, c = prior.times((information.xx, information.xy, information.xh))
    d, e, f = prior.times((information.xy, information.yy, information.yh))
    g, h, i = prior.times((information.xh, information.yh, information.hh))
    # columns of P A are (a b c), (d e f), (g h i)
    a, e, i = a + 1.0, e + 1.0, i + 1.0
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


def _product(m: Matrix3, p: Covariance3) -> Covariance3:
    """M P where it is known to be symmetric."""
    a, b, c, d, e, f, g, h, i = m
    return Covariance3(
        a * p.xx + b * p.xy + c * p.xh,
        d * p.xx + e * p.xy + f * p.xh,
        d * p.xy + e * p.yy + f * p.yh,
        g * p.xx + h * p.xy + i * p.xh,
        g * p.xy + h * p.yy + i * p.yh,
        g * p.xh + h * p.yh + i * p.hh,
    )


def _scoped(
    survive: Matrix3, prior: Covariance3, posterior: Covariance3, scope: Scope
) -> tuple[Matrix3, Covariance3]:
    """The merge restricted to `scope`: the other part keeps its estimate and its variance."""
    if scope is Scope.POSE:
        return survive, posterior
    if scope is Scope.POSITION:
        return (*survive[:6], 0.0, 0.0, 1.0), posterior._replace(hh=prior.hh)
    return (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, *survive[6:]), Covariance3(
        prior.xx, prior.xy, prior.yy, posterior.xh, posterior.yh, posterior.hh
    )


def _shifted(pose: Pose2, offset: Row, scope: Scope) -> Pose2:
    dx, dy, dh = offset
    if scope is Scope.POSITION:
        return Pose2(pose.x + dx, pose.y + dy, pose.heading)
    if scope is Scope.HEADING:
        return Pose2(pose.x, pose.y, wrap_angle(pose.heading + dh))
    return Pose2(pose.x + dx, pose.y + dy, wrap_angle(pose.heading + dh))


def merge(prior: Estimate, evidence: Information, scope: Scope = Scope.POSE) -> Estimate:
    """Bayes' product of a prior and independent evidence (equations 3 and 4 in three dimensions).

    Works for evidence of any rank: one range says nothing along the tangent of its circle.
    """
    survive = _gain(prior.covariance, evidence.matrix)
    posterior = _product(survive, prior.covariance)
    pose = _shifted(prior.pose, posterior.times(evidence.vector), scope)
    survive, posterior = _scoped(survive, prior.covariance, posterior, scope)
    shared = prior.shared
    return Estimate(pose, posterior, shared if shared is ZERO3 else shared.transformed(survive))


class Observation(NamedTuple):
    """One or two scalar measurements with one teammate's pose error in common.

    residuals = rows . offset + noise; the noise has a part of the sensor (independent) and a part
    of the teammate's pose (dependent: it may already be in the prior).
    """

    rows: tuple[Row, ...]
    residuals: tuple[float, ...]
    independent: Covariance2
    dependent: Covariance2

    def noise(self, dependent_factor: float = 1.0) -> Covariance2:
        """The covariance of the residuals, with the dependent part times `dependent_factor`."""
        i, d, k = self.independent, self.dependent, dependent_factor
        return Covariance2(
            i.xx + k * d.xx + SMALLEST_VARIANCE,
            i.xy + k * d.xy,
            i.yy + k * d.yy + SMALLEST_VARIANCE,
        )

    def information(self, dependent_factor: float = 1.0) -> Information:
        """The evidence with the dependent part of its covariance times `dependent_factor`."""
        r = self.noise(dependent_factor)
        if len(self.rows) == 1:
            return Information.none().add(self.rows[0], self.residuals[0], r.xx)
        # Two correlated scalars become two independent ones (r = L L^T).
        (first, second), (e, f) = self.rows, self.residuals
        k = r.xy / r.xx
        second = (second[0] - k * first[0], second[1] - k * first[1], second[2] - k * first[2])
        evidence = Information.none().add(first, e, r.xx)
        return evidence.add(second, f - k * e, r.yy - k * r.xy)

    def normalized_innovation_squared(self, prior: Covariance3) -> float:
        """e^T (H P H^T + R)^-1 e: chi-square with as many degrees of freedom as rows."""
        r = self.noise()
        first = prior.times(self.rows[0])
        sxx = _dot(self.rows[0], first) + r.xx
        if len(self.rows) == 1:
            return self.residuals[0] ** 2 / sxx
        sxy = _dot(self.rows[1], first) + r.xy
        syy = _dot(self.rows[1], prior.times(self.rows[1])) + r.yy
        return Covariance2(sxx, sxy, syy).mahalanobis_squared(*self.residuals)


def _dot(a: Row, b: Row) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def merge_naive(prior: Estimate, seen: Observation, scope: Scope = Scope.POSE) -> Estimate:
    """The paper's collaboration: the teammate's error is compounded and taken as fresh noise."""
    return merge(prior, seen.information(), scope)


_GOLDEN = 0.6180339887498949


def merge_split(prior: Estimate, seen: Observation, scope: Scope = Scope.POSE) -> Estimate:
    """Split covariance intersection: consistent for any correlation of the dependent parts.

    P1 = P_d / w + P_i, R = R_d / (1 - w) + R_i, w chosen by golden section for the smallest merged
    determinant (POSE; a trace of the position alone would give the heading away), trace of the
    position or variance of the heading. Scopes other than POSE expect a prior of which nothing or
    all is shared.
    """
    low, high = 0.02, 0.98
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    best_left, best_right = (_split(prior, seen, scope, w) for w in (left, right))
    for _ in range(6):
        if best_left[0] <= best_right[0]:
            high, right, best_right = right, left, best_left
            left = high - _GOLDEN * (high - low)
            best_left = _split(prior, seen, scope, left)
        else:
            low, left, best_left = left, right, best_right
            right = low + _GOLDEN * (high - low)
            best_right = _split(prior, seen, scope, right)
    _, weight = min(best_left, best_right)
    return _merge_split_at(prior, seen, scope, weight)


def _widened(prior: Estimate, weight: float) -> Covariance3:
    return prior.covariance.plus(prior.shared, 1.0 / weight - 1.0)


def _split(prior: Estimate, seen: Observation, scope: Scope, weight: float) -> tuple[float, float]:
    """(what is to be small, the weight)."""
    widened = _widened(prior, weight)
    evidence = seen.information(1.0 / (1.0 - weight)).matrix
    merged = _product(_gain(widened, evidence), widened)
    if scope is Scope.POSE:
        return merged.determinant(), weight
    return (merged.hh if scope is Scope.HEADING else merged.xx + merged.yy), weight


def _merge_split_at(prior: Estimate, seen: Observation, scope: Scope, weight: float) -> Estimate:
    widened = _widened(prior, weight)
    evidence = seen.information(1.0 / (1.0 - weight))
    survive = _gain(widened, evidence.matrix)
    merged = _product(survive, widened)
    pose = _shifted(prior.pose, merged.times(evidence.vector), scope)
    if scope is Scope.POSE:
        own = prior.covariance.plus(prior.shared, -1.0).transformed(survive)
        fresh = _sensor_part(seen, weight, merged)
        return Estimate(pose, merged, merged.plus(own, -1.0).plus(fresh, -1.0))
    _, scoped = _scoped(survive, prior.covariance, merged, scope)
    # The part out of scope was not widened after all, so neither is what it has in common.
    kept = 1.0 if prior.shared is ZERO3 else weight
    scoped = scoped._replace(xh=kept * scoped.xh, yh=kept * scoped.yh)
    return Estimate(pose, scoped, scoped)


def _sensor_part(seen: Observation, weight: float, merged: Covariance3) -> Covariance3:
    """K R_i K^T with K = P' H^T R^-1: what of the merged covariance is fresh sensor noise."""
    r = seen.noise(1.0 / (1.0 - weight))
    gains = [merged.times(row) for row in seen.rows]
    if len(gains) == 1:
        k, (gx, gy, gh) = seen.independent.xx / (r.xx * r.xx), gains[0]
        return Covariance3(gx * gx, gx * gy, gy * gy, gx * gh, gy * gh, gh * gh).scaled(k)
    inverse, i = r.inverse(), seen.independent
    wxx = inverse.xx * i.xx + inverse.xy * i.xy
    wxy = inverse.xx * i.xy + inverse.xy * i.yy
    wyx = inverse.xy * i.xx + inverse.yy * i.xy
    wyy = inverse.xy * i.xy + inverse.yy * i.yy
    c = Covariance2(
        wxx * inverse.xx + wxy * inverse.xy,
        wxx * inverse.xy + wxy * inverse.yy,
        wyx * inverse.xy + wyy * inverse.yy,
    )
    f, g = gains

    def entry(a: int, b: int) -> float:
        return c.xx * f[a] * f[b] + c.xy * (f[a] * g[b] + g[a] * f[b]) + c.yy * g[a] * g[b]

    return Covariance3(entry(0, 0), entry(0, 1), entry(1, 1), entry(0, 2), entry(1, 2), entry(2, 2))


def told(estimate: Estimate) -> Estimate:
    """After a belief has left the robot: all of it may be in a teammate's pose from now on."""
    return estimate._replace(shared=estimate.covariance)


def with_all_shared(estimate: Estimate) -> Estimate:
    """For variants that keep heading and position apart: all of the covariance is shared as soon
    as any of it is (the split of a part that is not updated is not defined)."""
    return estimate if estimate.shared is ZERO3 else told(estimate)


def circular(estimate: Estimate) -> Estimate:
    """Position covariance reduced to a circle: the mean variance, and a part of the spread.

    The mean alone claims too much along the major axis (98.0 % inside 3 sigma where 98.9 % are due,
    99.3 % so). Never less than what the drift alone explains.
    """
    pose, c, shared = estimate
    variance = 0.5 * (c.xx + c.yy) + SPREAD_SHARE * math.hypot(0.5 * (c.xx - c.yy), c.xy)
    if c.hh > 0.0:
        variance = max(variance, (c.xh * c.xh + c.yh * c.yh) / c.hh)
    return Estimate(pose, c._replace(xx=variance, xy=0.0, yy=variance), shared)
