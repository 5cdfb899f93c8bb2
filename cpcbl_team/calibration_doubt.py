"""How much less certain a robot is while its settings may be wrong.

The pose of a robot is right if its settings are. Those of its second filters
(`calibration_filter.py`) are right either way, but known less well. Until an error is clear enough
to be corrected, a robot reports the covariance that its pose has by the mixture of these hypotheses
(Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation,
2001, section 1.4.16), each with its probability.
"""

import math
from typing import Final

from cpcbl_team.calibration_filter import (
    BEARING,
    FIRST_SIGMAS,
    OFFSET,
    SHARE,
    CalibrationFilter,
    Filters,
)
from cpcbl_team.estimate import Covariance3, Estimate, dot, outer
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.miscalibration import Adaptation

ODDS: Final = 0.03
"""Of wrong settings to right ones, before anything was seen; for each kind of error."""
LARGEST_LOG: Final = 50.0  # of a ratio of likelihoods
LEAST: Final = 0.2  # odds that are evidence: hardly ever those of a correct robot
LEAST_INDEPENDENT: Final = 1e-9  # of a determinant, as a share of the product of the variances


def with_probabilities(filters: Filters, present: Adaptation) -> tuple[CalibrationFilter, ...]:
    """The filters that know how likely it is that the settings are wrong in the way in which each
    of them says. `present`: what of the settings is corrected already."""
    each = ODDS / max(len(filters), 1)
    odds = [each * _ratio(f, present) for f in filters]
    every = sum(odds)
    k = 1.0 / (1.0 + every) if every > LEAST else 0.0
    return tuple([f._replace(probability=k * o) for f, o in zip(filters, odds, strict=True)])


def with_mixture(estimate: Estimate, place: Pose2, filters: Filters) -> Estimate:
    """The estimate with the covariance of the mixture. `place`: of the robot by odometry."""
    probability = sum([f.probability for f in filters])
    if probability == 0.0:
        return estimate
    covariance = estimate.covariance.scaled(1.0 - probability)
    for f in filters:
        other = f.estimate_at(place, estimate)
        x, y = other.pose.x - estimate.pose.x, other.pose.y - estimate.pose.y
        apart = outer((x, y, wrap_angle(other.pose.heading - estimate.pose.heading)))
        covariance = covariance.plus(other.covariance.plus(apart), f.probability)
    return estimate._replace(covariance=covariance)


def _ratio(f: CalibrationFilter, present: Adaptation) -> float:
    """How much likelier the sightings are with a bias of bearings, and with that and wrong ranges,
    than with the settings as they are; what speaks for these does not count."""
    bias, share, offset, _, _ = f.errors
    k, rows = f.scatter, f.covariance
    bias -= present.bearing_bias_rad
    share, offset = share - present.ranges.share, offset - present.ranges.bias_m
    bb, bs, bo = rows[BEARING][BEARING], rows[BEARING][SHARE], rows[BEARING][OFFSET]
    ss, so, oo = rows[SHARE][SHARE], rows[SHARE][OFFSET], rows[OFFSET][OFFSET]
    if min(bb, ss, oo) <= 0.0:
        return 0.0
    first_bias, first_share, first_offset, _, _ = FIRST_SIGMAS
    ratio = max(_density_ratio(bias * bias / (k * bb), k * bb / first_bias**2) - 1.0, 0.0)
    covariance = Covariance3(bb, bs, ss, bo, so, oo).scaled(k)
    determinant = covariance.determinant()
    if determinant <= LEAST_INDEPENDENT * k**3 * bb * ss * oo:  # nothing but rounding
        return ratio
    errors = bias, share, offset
    of_all = dot(errors, covariance.inverse().times(errors))
    shrunk = determinant / (first_bias * first_share * first_offset) ** 2
    return ratio + max(_density_ratio(of_all, shrunk) - 1.0, 0.0)


def _density_ratio(chi_square: float, shrunk: float) -> float:
    """The ratio of the likelihoods of a hypothesis and of the one in it that some of its parameters
    are zero: of their density at zero before and after the measurements (J. M. Dickey, The weighted
    likelihood ratio, The Annals of Mathematical Statistics, 1971). `chi_square`: of the parameters
    after them; `shrunk`: the determinant of their covariance as a share of the one before."""
    return math.exp(min(0.5 * (chi_square + math.log(shrunk)), LARGEST_LOG))
