"""Robust fits with standard errors, for errors that are alike for seconds.

Fits are robust (Huber 1964); standard errors are those of a jackknife over stretches of time
(delete-a-group jackknife, Kott 2001).
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from cpcbl_launch.reporting.metrics import Floats

Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]
Rows = TypeVar("Rows", bound=tuple[Any, ...])

STRETCH_S, STRETCHES = 10.0, (8, 20)  # of a log, left out one by one by the jackknife
HUBER = 2.0
GROSS = 5.0  # sigmas; beyond, a residual is an outlier
LEAST_ROWS = 40
TOLD = 0.3  # a value counts when it is known so much better than its limit


class Estimate(msgspec.Struct, frozen=True):
    """A value with its standard error."""

    value: float
    standard_error: float


class Fit(NamedTuple):
    """A linear fit of values (n,) by columns (n, k), in units of sigma."""

    stretch: Integers
    columns: Floats
    values: Floats


def robust_fit(columns: Floats, values: Floats) -> Floats:
    """Coefficients (k,) with values ~ columns (n, k) @ coefficients.

    Huber's weights, iterated; residuals beyond GROSS sigmas do not count.
    """
    weight = np.ones(len(values))
    coefficients: Floats = np.zeros(columns.shape[1])
    for _ in range(12):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(columns * root[:, None], values * root, rcond=None)[0]
        coefficients = np.asarray(solution, dtype=np.float64)
        errors = np.abs(values - columns @ coefficients)
        size = errors / spread(errors)
        weight = np.where(size > GROSS, 0.0, np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))
    return coefficients


def told(columns: Floats, limits: Sequence[float]) -> Mask:
    """Which coefficients rows (in units of their sigma) tell much better than their limit.

    The worst one is taken out, which keeps its neutral value, until the others are good: a range
    at one distance, say, tells either the scale or the bias, not both.
    """
    known = np.ones(columns.shape[1], bool)
    while known.any():
        scaled = (columns * np.asarray(limits))[:, known]
        error = np.sqrt(np.diag(np.linalg.inv(scaled.T @ scaled + np.eye(known.sum()))))
        if error.max() < TOLD:
            break
        known[np.flatnonzero(known)[int(np.argmax(error))]] = False
    return known


def solved(fit: Fit, known: Mask) -> Floats:
    """The coefficients of a fit, 0 for those that are not known."""
    result = np.zeros(len(known))
    result[known] = robust_fit(fit.columns[:, known], fit.values)
    return result


def variance_parts(errors: Floats, columns: Floats, weights: Floats | None = None) -> Floats:
    """Parts with E[error^2] = columns (n, k) @ parts, shape (2, k); NaN with too few errors.

    `weights` (n,): by what each row is multiplied in the fit; default: 1.

    First those of maximum likelihood for independent normal errors (Fisher scoring), none of them
    negative; then those that one more step would give if they might be. Gross errors do not count.
    """
    if len(errors) < LEAST_ROWS:
        return np.full((2, columns.shape[1]), np.nan)
    square = errors * errors
    given = np.ones_like(square) if weights is None else weights
    shape = (columns / np.maximum(columns.mean(axis=0), 1e-16)).mean(axis=1)
    level = max(float(np.median(square / shape)) / 0.455, 1e-16)  # the median of a chi-square of 1
    parts = np.zeros(columns.shape[1])
    expected, free = level * shape, np.ones(columns.shape[1], bool)
    for _ in range(20):
        good = square < GROSS**2 * expected
        weight = np.where(good, given / expected, 0.0)
        parts[:] = 0.0
        parts[free] = _weighted(columns[:, free], square, weight)
        if (parts < 0.0).any():
            free[int(np.argmin(parts))] = False
            continue
        expected = np.maximum(columns @ parts, 1e-4 * level)
    return np.stack([np.maximum(parts, 0.0), _weighted(columns, square, weight)])


def _weighted(columns: Floats, values: Floats, weight: Floats) -> Floats:
    X = columns * weight[:, None]
    return np.asarray(np.linalg.lstsq(X, values * weight, rcond=None)[0])


Keep = Callable[[Integers], Mask]


def jackknife(estimate: Callable[[Keep], Floats], stretches: Integers) -> list[Estimate]:
    """Each value over all data, its standard error from leaving out one stretch after another.

    `estimate` is given a function that says of rows' stretches which rows count.
    """
    whole = estimate(lambda s: np.ones(len(s), bool))
    names = np.unique(stretches)
    each = np.array([estimate(lambda s, n=n: s != n) for n in names])  # type: ignore[misc]
    error = np.sqrt((len(names) - 1) * np.var(each, axis=0))
    return [Estimate(float(v), float(e)) for v, e in zip(whole, error, strict=True)]


def sigmas(variances: Callable[[Keep], Floats], stretches: Integers) -> list[Estimate]:
    """Square roots of variances of shape (2, k), as of `variance_parts`, with standard errors."""
    parts = jackknife(lambda keep: variances(keep).ravel(), stretches)
    half = len(parts) // 2
    result = []
    for variance, unbounded in zip(parts[:half], parts[half:], strict=True):
        value = math.sqrt(variance.value)
        upper = math.sqrt(variance.value + unbounded.standard_error)
        result.append(Estimate(value, upper - value))
    return result


def stretches(times_s: Floats, stamps: Floats, number: int) -> Integers:
    """Names of the stretches of one log: long enough for errors to be no more alike."""
    seconds = max(float(stamps[-1] - stamps[0]), 1e-9)
    count = int(np.clip(seconds / STRETCH_S, *STRETCHES))
    within = np.clip(count * (times_s - stamps[0]) / seconds, 0, count - 1)
    return np.asarray(STRETCHES[1] * number + within, dtype=np.int64)


def times(factor: float, estimate: Estimate) -> Estimate:
    """In another unit."""
    return Estimate(factor * estimate.value, factor * estimate.standard_error)


def spread(errors: Floats) -> float:
    """A standard deviation by the median of absolute errors."""
    return max(1.4826 * float(np.median(np.abs(errors))), 1e-9) if len(errors) else 1.0


def kept(rows: Rows, keep: Mask) -> Rows:
    """The same struct of columns with some of its rows."""
    return type(rows)(*(column[keep] for column in rows))


def decimals(standard_error: float) -> int:
    """How many decimals a value is worth: rounding adds at most a sixth of the standard error."""
    if not 0.0 < standard_error < math.inf:
        return 4
    return min(max(math.ceil(-math.log10(standard_error / 3.0)), 0), 6)
