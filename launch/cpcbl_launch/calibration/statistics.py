"""Robust fits with standard errors, for errors that are correlated over seconds.

The fits are robust (Huber 1964). Standard errors are those of a jackknife over stretches of time
(delete-a-group jackknife, Kott 2001).
"""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from cpcbl_launch.reporting.metrics import Floats

Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]
Rows = TypeVar("Rows", bound=tuple[Any, ...])

STRETCH_S, STRETCHES = 10.0, (8, 20)  # length and number of the stretches of a log
HUBER_SIGMAS = 2.0
OUTLIER_SIGMAS = 5.0  # a larger residual has no weight
MIN_ROWS = 40
DETERMINED_SHARE = 0.3  # a coefficient counts if its error is below this share of its limit
LAGS_S = (0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)


class Estimate(msgspec.Struct, frozen=True):
    """A value with its standard error."""

    value: float
    standard_error: float


class LinearFit(NamedTuple):
    """A linear fit of values (n,) by columns (n, k), in units of sigma."""

    stretch: Integers
    columns: Floats
    values: Floats


def robust_fit(columns: Floats, values: Floats) -> Floats:
    """Coefficients (k,) with values ~ columns (n, k) @ coefficients. The weights are Huber's,
    iterated. Residuals beyond OUTLIER_SIGMAS have no weight."""
    weight = np.ones(len(values))
    coefficients: Floats = np.zeros(columns.shape[1])
    for _ in range(12):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(columns * root[:, None], values * root, rcond=None)[0]
        coefficients = np.asarray(solution, dtype=np.float64)
        errors = np.abs(values - columns @ coefficients)
        size = errors / robust_sigma(errors)
        huber = np.minimum(1.0, HUBER_SIGMAS / np.maximum(size, 1e-9))
        weight = np.where(size > OUTLIER_SIGMAS, 0.0, huber)
    return coefficients


def determined_coefficients(columns: Floats, limits: Iterable[float]) -> Mask:
    """Which coefficients (k,) the rows (in units of their sigma) determine well within the limits.

    The worst one is removed and keeps its neutral value until the others are good: ranges at one
    distance, for example, determine either the scale or the bias, not both.
    """
    known, in_limits = np.ones(columns.shape[1], bool), columns * np.array([*limits])
    while known.any():
        scaled = in_limits[:, known]
        error = np.sqrt(np.diag(np.linalg.inv(scaled.T @ scaled + np.eye(known.sum()))))
        if error.max() < DETERMINED_SHARE:
            break
        known[np.flatnonzero(known)[int(np.argmax(error))]] = False
    return known


def solve(fit: LinearFit, known: Mask) -> Floats:
    """The coefficients (k,) of a fit, 0 for those that are not known."""
    result = np.zeros(len(known))
    result[known] = robust_fit(fit.columns[:, known], fit.values)
    return result


def variance_components(errors: Floats, columns: Floats, weights: Floats | None = None) -> Floats:
    """Parts with E[error^2] = columns (n, k) @ parts, shape (2, k); NaN with too few errors.

    `weights` (n,) multiply the rows of the fit; default: 1. The first row of the result is the
    maximum likelihood for independent normal errors (Fisher scoring) with no negative part. The
    second row is what one more step gives without that bound. Outliers have no weight.
    """
    if len(errors) < MIN_ROWS:
        return np.full((2, columns.shape[1]), np.nan)
    square = errors * errors
    given = np.ones_like(square) if weights is None else weights
    shape = (columns / np.maximum(columns.mean(axis=0), 1e-16)).mean(axis=1)
    level = max(float(np.median(square / shape)) / 0.455, 1e-16)  # the median of a chi-square of 1
    parts = np.zeros(columns.shape[1])
    expected, free = level * shape, np.ones(columns.shape[1], bool)
    for _ in range(20):
        good = square < OUTLIER_SIGMAS**2 * expected
        weight = np.where(good, given / expected, 0.0)
        parts[:] = 0.0
        parts[free] = _weighted_least_squares(columns[:, free], square, weight)
        if (parts < 0.0).any():
            free[int(np.argmin(parts))] = False
            continue
        expected = np.maximum(columns @ parts, 1e-4 * level)
    return np.stack([np.maximum(parts, 0.0), _weighted_least_squares(columns, square, weight)])


def _weighted_least_squares(columns: Floats, values: Floats, weight: Floats) -> Floats:
    X = columns * weight[:, None]
    return np.asarray(np.linalg.lstsq(X, values * weight, rcond=None)[0])


RowFilter = Callable[[Integers], Mask]


def jackknife(estimate: Callable[[RowFilter], Floats], stretch_numbers: Integers) -> list[Estimate]:
    """Each value over all data, with a standard error from leaving out one stretch after another.
    `estimate` receives a function from the rows' stretch numbers to the mask of rows to use."""
    whole = estimate(lambda s: np.ones(len(s), bool))
    names = np.unique(stretch_numbers)
    each = np.array([estimate(lambda s, n=n: s != n) for n in names])  # type: ignore[misc]
    error = np.sqrt((len(names) - 1) * np.var(each, axis=0))
    return [Estimate(float(v), float(e)) for v, e in zip(whole, error, strict=True)]


def sigma_estimates(
    variances: Callable[[RowFilter], Floats], stretch_numbers: Integers
) -> list[Estimate]:
    """Square roots of variances (2, k), as of `variance_components`, with standard errors."""
    parts = jackknife(lambda keep: variances(keep).ravel(), stretch_numbers)
    half = len(parts) // 2
    result = []
    for variance, unbounded in zip(parts[:half], parts[half:], strict=True):
        value = math.sqrt(variance.value)
        upper = math.sqrt(variance.value + unbounded.standard_error)
        result.append(Estimate(value, upper - value))
    return result


def stretch_numbers(times_s: Floats, stamps: Floats, number: int) -> Integers:
    """Numbers of the stretches of one log, which are longer than errors are correlated."""
    seconds = max(float(stamps[-1] - stamps[0]), 1e-9)
    count = int(np.clip(seconds / STRETCH_S, *STRETCHES))
    within = np.clip(count * (times_s - stamps[0]) / seconds, 0, count - 1)
    return np.asarray(STRETCHES[1] * number + within, dtype=np.int64)


def robust_sigma(errors: Floats) -> float:
    """A standard deviation from the median of absolute errors."""
    return max(1.4826 * float(np.median(np.abs(errors))), 1e-9) if len(errors) else 1.0


def select_rows(rows: Rows, keep: Mask) -> Rows:
    """The same record of columns with some of its rows."""
    return type(rows)(*(column[keep] for column in rows))


def join_rows(parts: Sequence[Rows]) -> Rows:
    """One record of columns with the rows of all parts."""
    return type(parts[0])(*map(np.concatenate, zip(*parts, strict=True)))


def decimals(standard_error: float) -> int:
    """The decimals to print of a value: rounding adds at most a sixth of the standard error."""
    if not 0.0 < standard_error < math.inf:
        return 4
    return min(max(math.ceil(-math.log10(standard_error / 3.0)), 0), 6)


class ErrorPairs(NamedTuple):
    """Errors of the same object at two times. Shapes (n,)."""

    stretch: Integers
    lag_s: Floats
    product: Floats
    square: Floats  # mean of both


def error_pairs(
    stretch: Integers, stamp_s: Floats, name: Integers, errors: Sequence[Floats]
) -> ErrorPairs:
    """All pairs of one object and one kind of error (in units of sigma), up to the longest lag."""
    parts = [ErrorPairs(np.empty(0, np.int64), *np.empty((3, 0)))]
    for unit in errors:
        error = np.where(np.abs(unit) < OUTLIER_SIGMAS, unit, np.nan)
        for one in np.unique(name):
            mine = np.flatnonzero((name == one) & np.isfinite(error))
            mine = mine[np.argsort(stamp_s[mine], kind="stable")]
            parts += _pairs_of_object(stretch[mine], stamp_s[mine], error[mine])
    return join_rows(parts)


def _pairs_of_object(stretch: Integers, stamp_s: Floats, error: Floats) -> list[ErrorPairs]:
    parts = []
    for ahead in range(1, len(error)):
        lag = stamp_s[ahead:] - stamp_s[:-ahead]
        near = (lag <= LAGS_S[-1]) & (lag > 0.0)
        if not near.any():
            break
        one, two = error[:-ahead][near], error[ahead:][near]
        square = 0.5 * (one * one + two * two)
        parts.append(ErrorPairs(stretch[:-ahead][near], lag[near], one * two, square))
    return parts


def autocorrelation(pairs: ErrorPairs) -> tuple[Floats, Floats, Floats]:
    """(mean lag in s, correlation, number of pairs) of each bin of lags that has enough."""
    result = []
    for low, high in pairwise((0.0, *LAGS_S)):
        mine = (pairs.lag_s > low) & (pairs.lag_s <= high)
        if (n := int(mine.sum())) >= MIN_ROWS:
            ratio = pairs.product[mine].sum() / max(pairs.square[mine].sum(), 1e-12)
            result.append((pairs.lag_s[mine].mean(), ratio, n))
    lag, ratios, counts = np.array(result).reshape(-1, 3).T
    return lag, ratios, counts


def correlation_time_s(pairs: ErrorPairs) -> float:
    """The correlation time of errors: the integral of the autocorrelation up to its first zero.

    0: white noise; NaN: no pairs. The integral determines the variance of a mean of many readings.
    For a correlation of exp(-lag / time) it is that time.
    """
    lag, ratio, n = autocorrelation(pairs)
    if len(lag) == 0:
        return math.nan
    significant = ratio > 2.0 / np.sqrt(n)
    end = len(lag) if significant.all() else int(np.argmin(significant))
    if end == 0:
        return 0.0
    between = 0.5 * (ratio[1:end] + ratio[: end - 1]) * np.diff(lag[:end])
    return float(lag[0] * ratio[0] + between.sum())
