"""Whether a robot's stated uncertainty holds, judged by the number of its independent samples.

Errors that follow each other are correlated, so a window of 8 s has 80 tracks and perhaps 5
independent samples. Their number is the window's length over the integrated autocorrelation time of
the errors in sigmas (of the whole run; A. Sokal, Monte Carlo Methods in Statistical Mechanics,
1997). With n of them, n times the mean NEES is chi-square distributed with 2 n degrees of freedom,
and the number outside 3 sigma has a Poisson distribution.
"""

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from cpcbl_launch.reporting import metrics
from cpcbl_launch.reporting.metrics import Samples

ALARM = 1e-4  # probability with which a consistent robot fails one judgement
USUAL_NEES = 2.5  # 2 in a linear world; robots of the demonstration have 0.8 to 2.5
USUAL_OUTSIDE = 0.025  # 0.011 in a linear world; up to 0.021 in the demonstration
SHORTEST_S = 1.0  # errors are correlated for so long at least
_NO_LONGER = 0.05  # an autocorrelation below this counts as none


class Consistency(NamedTuple):
    """How well one robot's stated uncertainty fits its errors in a window."""

    robot: str
    nees: float  # mean, of the position
    outside: float  # the share of tracks outside 3 sigma
    independent: float  # number of independent samples

    @property
    def nees_bound(self) -> float:
        """What a consistent robot exceeds with the probability `ALARM`."""
        freedom = 2.0 * self.independent
        return 0.5 * USUAL_NEES * chi_square_quantile(freedom, 1.0 - ALARM) / self.independent

    @property
    def outside_bound(self) -> float:
        most = poisson_quantile(USUAL_OUTSIDE * self.independent, 1.0 - ALARM)
        return min(1.0, most / self.independent)


def consistency(robot: str, window: Samples, whole: Samples, rate_hz: float) -> Consistency | None:
    """The consistency in a window of a run; None without samples."""
    nees = metrics.position_nees(window)
    if nees is None or not len(nees):
        return None
    independent = len(nees) / max(SHORTEST_S * rate_hz, correlation_samples(whole))
    outside = float(np.mean(nees > 9.0))
    return Consistency(robot, float(nees.mean()), outside, max(1.0, independent))


def correlation_samples(samples: Samples) -> float:
    """The integrated autocorrelation time of the errors in sigmas, in samples, at least 1."""
    assert samples.covariance is not None
    sigmas = np.sqrt(np.maximum(samples.covariance[:, (0, 2)], 1e-12))
    errors = metrics.pose_errors(samples)[:, :2] / sigmas
    variance, time = float(np.mean(errors * errors)), 1.0
    for lag in range(1, len(errors) // 2):
        correlation = float(np.mean(errors[lag:] * errors[:-lag])) / max(variance, 1e-12)
        if correlation < _NO_LONGER:
            break
        time += 2.0 * correlation
    return time


def chi_square_quantile(freedom: float, probability: float) -> float:
    """By the cube root (E. B. Wilson, M. M. Hilferty 1931), which is 5 % too large at most."""
    part = 2.0 / (9.0 * freedom)
    z = NormalDist().inv_cdf(probability)
    return freedom * (1.0 - part + z * math.sqrt(part)) ** 3


def poisson_quantile(mean: float, probability: float) -> int:
    """The least count that is not exceeded with this probability."""
    count, term = 0, math.exp(-mean)
    total = term
    while total < probability and count < 10.0 * mean + 50.0:
        count += 1
        term *= mean / count
        total += term
    return count
