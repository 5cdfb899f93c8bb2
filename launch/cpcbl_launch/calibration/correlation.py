"""For how long errors of sightings of the same object stay alike."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import GROSS, LEAST_ROWS, Integers
from cpcbl_launch.reporting.metrics import Floats

LAGS_S = (0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)


class Pairs(NamedTuple):
    """Errors of the same object at two times. Shapes (n,)."""

    stretch: Integers
    lag_s: Floats
    product: Floats
    square: Floats  # mean of both


def lagged_products(
    stretch: Integers, stamp_s: Floats, name: Integers, errors: Sequence[Floats]
) -> Pairs:
    """All pairs of one object and one kind of error (in units of sigma), up to the longest lag."""
    parts = []
    for unit in errors:
        error = np.where(np.abs(unit) < GROSS, unit, np.nan)
        for one in np.unique(name):
            mine = np.flatnonzero((name == one) & np.isfinite(error))
            mine = mine[np.argsort(stamp_s[mine], kind="stable")]
            parts += _pairs_of_one(stretch[mine], stamp_s[mine], error[mine])
    if not parts:
        return Pairs(np.empty(0, np.int64), *(np.empty(0) for _ in range(3)))
    return Pairs(*map(np.concatenate, zip(*parts, strict=True)))


def _pairs_of_one(stretch: Integers, stamp_s: Floats, error: Floats) -> list[Pairs]:
    parts = []
    for ahead in range(1, len(error)):
        lag = stamp_s[ahead:] - stamp_s[:-ahead]
        near = (lag <= LAGS_S[-1]) & (lag > 0.0)
        if not near.any():
            break
        one, two = error[:-ahead][near], error[ahead:][near]
        square = 0.5 * (one * one + two * two)
        parts.append(Pairs(stretch[:-ahead][near], lag[near], one * two, square))
    return parts


def autocorrelation(pairs: Pairs) -> tuple[Floats, Floats, Floats]:
    """(mean lag in s, correlation, number of pairs) of each bin of lags that has enough."""
    result = []
    for low, high in pairwise((0.0, *LAGS_S)):
        mine = (pairs.lag_s > low) & (pairs.lag_s <= high)
        if (n := int(mine.sum())) >= LEAST_ROWS:
            ratio = pairs.product[mine].sum() / max(pairs.square[mine].sum(), 1e-12)
            result.append((pairs.lag_s[mine].mean(), ratio, n))
    lag, ratios, counts = np.array(result).reshape(-1, 3).T
    return lag, ratios, counts


def correlation_s(pairs: Pairs) -> float:
    """The time for which errors stay alike: the integral of the autocorrelation, up to its first
    zero. 0: white; NaN: no pairs.

    It is the integral that says what a mean of many readings is worth; for errors that fade as
    exp(-lag / time) it is that time.
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
