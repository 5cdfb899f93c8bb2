"""Merging the help of teammates: naively, as in the paper, or by split covariance intersection.

A teammate's own pose error is the same in all of its messages, and this robot's estimate may
contain it already. Split covariance intersection (S. Julier, J. Uhlmann 2001; H. Li, F. Nashashibi,
ITSC 2012) never counts this dependent part twice, whatever the correlation is. The sensor's part of
the noise is independent and merged as usual.
"""

import math
from collections.abc import Callable
from statistics import NormalDist
from typing import NamedTuple

from cpcbl_team.estimate import (
    HEADING,
    POSE,
    POSITION,
    SHARPEST_VARIANCE,
    SMALLEST_VARIANCE,
    ZERO3,
    Covariance3,
    Estimate,
    Information,
    Row,
    Scope,
    merge,
    offset_pose,
    outer,
    posterior_factor,
    sharpest,
    symmetric_product,
    within_scope,
)
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import new


class Observation(NamedTuple):
    """One or two scalar measurements that have one teammate's pose error in common.

    residuals = rows . offset + noise. The noise has two parts: the sensor's (independent), and that
    of the teammate's pose (dependent: the prior may contain it already).
    """

    rows: tuple[Row, ...]
    residuals: tuple[float, ...]
    independent: Covariance2
    dependent: Covariance2

    def noise(self, dependent_factor: float = 1.0) -> Covariance2:
        """The covariance of the residuals, with the dependent part times `dependent_factor`."""
        k = dependent_factor
        xx, xy, yy = self.independent
        dxx, dxy, dyy = self.dependent
        return new(Covariance2, _noise(xx + k * dxx, xy + k * dxy, yy + k * dyy))

    def shifted(self, dx: float, dy: float, turn: float) -> "Observation":
        """The same observation about an estimate at this distance from the present one (m, rad in
        the field's frame)."""
        residuals = tuple(
            e - x * dx - y * dy - a * turn
            for (x, y, a), e in zip(self.rows, self.residuals, strict=True)
        )
        return Observation(self.rows, residuals, self.independent, self.dependent)

    def information(self, noise: Covariance2 | None = None) -> Information:
        """The evidence with this covariance of the residuals; default: `noise()`."""
        return Information.none().with_all(self.independent_scalars(noise or self.noise()))

    def independent_scalars(self, r: Covariance2) -> tuple[tuple[Row, float, float], ...]:
        """Row, residual and variance of one or two independent scalars, with this covariance of the
        residuals (R = L L^T)."""
        if len(self.rows) == 1:
            return ((self.rows[0], self.residuals[0], r.xx),)
        (first, second), (e, f) = self.rows, self.residuals
        k = r.xy / r.xx
        second = (second[0] - k * first[0], second[1] - k * first[1], second[2] - k * first[2])
        return (first, e, r.xx), (second, f - k * e, r.yy - k * r.xy)

    def normalized_innovation_squared(self, prior: Covariance3) -> float:
        """e^T (H P H^T + R)^-1 e: chi-square with as many degrees of freedom as rows."""
        return chi_square(prior, self.noise(), self.rows, self.residuals)


def _noise(xx: float, xy: float, yy: float) -> tuple[float, float, float]:
    """(xx, xy, yy) no sharper than evidence may be along any axis. Otherwise rounding could make a
    part of the evidence exceed the whole."""
    xx, yy = sharpest(xx + SMALLEST_VARIANCE), yy + SMALLEST_VARIANCE
    least = xy * xy / xx + SHARPEST_VARIANCE
    return xx, xy, yy if yy > least else least


def chi_square(
    prior: Covariance3,
    noise: tuple[float, float, float],
    rows: tuple[Row, ...],
    residuals: tuple[float, ...],
) -> float:
    """e^T (H P H^T + R)^-1 e of one or two scalar measurements; `noise` is xx, xy, yy of R."""
    xx, xy, yy, xh, yh, hh = prior
    rxx, rxy, ryy = noise
    x, y, a = rows[0]
    px, py, ph = xx * x + xy * y + xh * a, xy * x + yy * y + yh * a, xh * x + yh * y + hh * a
    sxx = x * px + y * py + a * ph + rxx
    e = residuals[0]
    if len(rows) == 1:
        return e * e / sxx
    x, y, a = rows[1]
    sxy = x * px + y * py + a * ph + rxy
    px, py, ph = xx * x + xy * y + xh * a, xy * x + yy * y + yh * a, xh * x + yh * y + hh * a
    syy = x * px + y * py + a * ph + ryy
    f = residuals[1]
    return (syy * e * e - 2.0 * sxy * e * f + sxx * f * f) / (sxx * syy - sxy * sxy)


def chi_square_bounds(probability: float) -> tuple[float, float]:
    """The quantiles of the chi-square distributions of one and of two degrees of freedom."""
    return NormalDist().inv_cdf(0.5 + 0.5 * probability) ** 2, -2.0 * math.log(1.0 - probability)


def chi_square_bound(freedom: int) -> float:
    """About the 99.9 % quantile (Wilson & Hilferty 1931)."""
    k = max(freedom, 1)
    return k * (1.0 - 2.0 / (9.0 * k) + 3.09 * math.sqrt(2.0 / (9.0 * k))) ** 3


def merge_naive(prior: Estimate, observation: Observation, scope: Scope = POSE) -> Estimate:
    """The paper's collaboration: the teammate's error is treated as independent noise."""
    return merge(prior, observation.information(), scope)


_GOLDEN = 0.6180339887498949
DECADES = -math.log10(0.02), 5.0  # 1 - w of weights near one, as powers of ten
WIDE_RAD = math.radians(10.0)  # sigma of a heading
LEAST_TIED = 0.02  # share of its variance that the position explains


def merge_split(prior: Estimate, observation: Observation, scope: Scope = POSE) -> Estimate:
    """Split covariance intersection: consistent for any correlation of the dependent parts.

    P1 = P_d / w + P_i, R = R_d / (1 - w) + R_i. Golden section chooses the w with the smallest
    determinant (POSE; a trace would neglect the heading), trace of the position, or variance of the
    heading. If no w makes that smaller, the result is the prior, because repeated inflation without
    a gain would lose information. Scopes other than POSE expect a prior of which nothing or all is
    shared.
    """
    goal = (
        _determinant(prior, observation) if scope is POSE else _variance(prior, observation, scope)
    )
    before = _size(prior.covariance, scope)
    weight, extent = best_weight(goal, before)
    if extent >= before:
        return prior
    merged = _merge_with_weight(prior, observation, scope, weight)
    is_wider = scope is POSE and merged.covariance.hh > prior.covariance.hh > WIDE_RAD**2
    if not is_wider or _tells_of_heading(prior.covariance, observation):
        return merged
    # Else each report would inflate a heading of which it tells nothing, until the robot is lost
    apart = merge_split(with_all_shared(prior), observation, POSITION)
    return apart if apart.covariance.determinant() < extent else merged


def _tells_of_heading(covariance: Covariance3, observation: Observation) -> bool:
    """Whether the observation tells the heading: directly, or because the robot has driven since it
    knew its position."""
    apart = covariance.position().determinant() * covariance.hh
    is_tied = covariance.determinant() < (1.0 - LEAST_TIED) * apart
    return is_tied or any(a for _, _, a in observation.rows)


def best_weight(
    objective: Callable[[float], float], before: float = math.inf
) -> tuple[float, float]:
    """The weight of covariance intersection with the smallest value of `objective`, and that value.
    The weight is between 0.02 and 0.98, or between 0.98 and 0.99999 if none of those has a value
    below `before`: what is little beside the estimate still counts. If it did not, the random part
    of its covariance would select, and the mean of what is selected would not be that of all."""
    found = _least(objective, 0.02, 0.98)
    if found[1] < before:
        return found
    decades, value = _least(lambda n: objective(1.0 - 10.0**-n), *DECADES)
    return 1.0 - 10.0**-decades, value


def _least(objective: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Where between two numbers a function is least, and its value there, by six steps of golden
    section."""
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    best_left, best_right = objective(left), objective(right)
    for _ in range(6):
        if best_left <= best_right:
            high, right, best_right = right, left, best_left
            left = high - _GOLDEN * (high - low)
            best_left = objective(left)
        else:
            low, left, best_left = left, right, best_right
            right = low + _GOLDEN * (high - low)
            best_right = objective(right)
    return (left, best_left) if best_left <= best_right else (right, best_right)


def _size(covariance: Covariance3, scope: Scope) -> float:
    """The quantity that a merge within this scope makes small."""
    if scope is POSE:
        return covariance.determinant()
    return covariance.hh if scope is HEADING else covariance.xx + covariance.yy


def _inflated(prior: Estimate, weight: float) -> Covariance3:
    """P_d / w + P_i, with P = P_d + P_i."""
    return prior.covariance.plus(prior.shared, 1.0 / weight - 1.0)


def _variance(prior: Estimate, observation: Observation, scope: Scope) -> Callable[[float], float]:
    """The trace of the merged position, or the variance of the merged heading, by the weight."""

    def variance(weight: float) -> float:
        inflated = _inflated(prior, weight)
        evidence = observation.information(observation.noise(1.0 / (1.0 - weight))).matrix
        merged = symmetric_product(posterior_factor(inflated, evidence), inflated)
        return _size(merged, scope)

    return variance


def _determinant(prior: Estimate, observation: Observation) -> Callable[[float], float]:
    """The determinant of the merged covariance, by the weight. det (P1^-1 + H^T R^-1 H)^-1 = det P1
    det R / det (R + H P1 H^T), the matrix determinant lemma."""
    # P1 = P + k P_d, so H P1 H^T = H P H^T + k H P_d H^T. Plain floats, because this runs often.
    p, d, alone = prior.covariance, prior.shared, len(observation.rows) == 1
    (pxx, pxy, pyy, pxh, pyh, phh), (dxx, dxy, dyy, dxh, dyh, dhh) = p, d
    p_xx, p_xy, p_yy = _projected(p, observation.rows)
    d_xx, d_xy, d_yy = _projected(d, observation.rows)
    (ixx, ixy, iyy), (oxx, oxy, oyy) = observation.independent, observation.dependent

    def determinant(weight: float) -> float:
        k, m = 1.0 / weight - 1.0, 1.0 / (1.0 - weight)
        xx, xy, xh = pxx + k * dxx, pxy + k * dxy, pxh + k * dxh
        yy, yh, hh = pyy + k * dyy, pyh + k * dyh, phh + k * dhh
        inflated = xx * (yy * hh - yh * yh) - xy * (xy * hh - yh * xh) + xh * (xy * yh - yy * xh)
        rxx, rxy, ryy = _noise(ixx + m * oxx, ixy + m * oxy, iyy + m * oyy)
        sxx = rxx + p_xx + k * d_xx
        if alone:
            return inflated * rxx / sxx
        sxy, syy = rxy + p_xy + k * d_xy, ryy + p_yy + k * d_yy
        return inflated * (rxx * ryy - rxy * rxy) / (sxx * syy - sxy * sxy)

    return determinant


def _projected(p: Covariance3, rows: tuple[Row, ...]) -> tuple[float, float, float]:
    """H P H^T as (xx, xy, yy); only xx for one row."""
    x, y, a = rows[0]
    px, py, ph = p.times(rows[0])
    xx = x * px + y * py + a * ph
    if len(rows) == 1:
        return xx, 0.0, 0.0
    x, y, a = rows[1]
    xy = x * px + y * py + a * ph
    px, py, ph = p.times(rows[1])
    return xx, xy, x * px + y * py + a * ph


def _merge_with_weight(
    prior: Estimate, observation: Observation, scope: Scope, weight: float
) -> Estimate:
    inflated = _inflated(prior, weight)
    noise = observation.noise(1.0 / (1.0 - weight))
    evidence = observation.information(noise)
    survive = posterior_factor(inflated, evidence.matrix)
    merged = symmetric_product(survive, inflated)
    if min(merged.xx, merged.yy, merged.hh) < 0.0:  # as in `merge`
        return prior
    pose = offset_pose(prior.pose, merged.times(evidence.vector), scope)
    if scope is POSE:
        own = prior.covariance.plus(prior.shared, -1.0).transformed(survive)
        fresh = _sensor_part(observation, noise, merged)
        return Estimate(pose, merged, merged.plus(own, -1.0).plus(fresh, -1.0))
    _, kept_apart = within_scope(survive, prior.covariance, merged, scope)
    # The part out of scope was not inflated, so its covariance with the rest is not either.
    kept = 1.0 if prior.shared is ZERO3 else weight
    kept_apart = kept_apart._replace(xh=kept * kept_apart.xh, yh=kept * kept_apart.yh)
    return Estimate(pose, kept_apart, kept_apart)


def _sensor_part(observation: Observation, r: Covariance2, merged: Covariance3) -> Covariance3:
    """K R_i K^T with K = P' H^T R^-1: the part of the merged covariance that is sensor noise."""
    gains = [merged.times(row) for row in observation.rows]
    if len(gains) == 1:
        return outer(gains[0]).scaled(observation.independent.xx / (r.xx * r.xx))
    inverse, i = r.inverse(), observation.independent
    wxx = inverse.xx * i.xx + inverse.xy * i.xy
    wxy = inverse.xx * i.xy + inverse.xy * i.yy
    wyx = inverse.xy * i.xx + inverse.yy * i.xy
    wyy = inverse.xy * i.xy + inverse.yy * i.yy
    xx = wxx * inverse.xx + wxy * inverse.xy
    xy = wxx * inverse.xy + wxy * inverse.yy
    yy = wyx * inverse.xy + wyy * inverse.yy
    f, g = gains

    def entry(a: int, b: int) -> float:
        return xx * f[a] * f[b] + xy * (f[a] * g[b] + g[a] * f[b]) + yy * g[a] * g[b]

    return Covariance3(entry(0, 0), entry(0, 1), entry(1, 1), entry(0, 2), entry(1, 2), entry(2, 2))


def mark_shared(estimate: Estimate) -> Estimate:
    """The estimate after a belief was sent: teammates may depend on all of it from now on."""
    return estimate._replace(shared=estimate.covariance)


def with_all_shared(estimate: Estimate) -> Estimate:
    """The estimate with all of its covariance shared, if any of it is. For the variants that update
    heading and position separately: the split of a part that is not updated is not defined."""
    return estimate if estimate.shared is ZERO3 else mark_shared(estimate)
