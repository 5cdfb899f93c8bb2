"""How much less certain a robot is while its settings may be wrong.

The pose of a robot is right if its settings are. Those of its second filters
(`calibration_filter.py`) are right either way, but known less well. Until an error is clear enough
to be corrected, a robot reports the covariance that its pose has by the mixture of these hypotheses
(Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation,
2001, section 1.4.16), each with its probability.
"""

import math
from statistics import fmean
from typing import Final

from cpcbl_team.calibration_filter import (
    BEARING,
    DISTANCE,
    FIRST_SIGMAS,
    LEAST_INDEPENDENT,
    TURN,
    CalibrationFilter,
    Filters,
    Rows,
)
from cpcbl_team.estimate import (
    Covariance3,
    Estimate,
    dot,
    outer,
    pose_chi_square,
    pose_difference,
)
from cpcbl_team.filter_corrections import NONE, KindsOfError
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.miscalibration import Adaptation
from cpcbl_team.range_errors import NO_RANGE_ERRORS
from cpcbl_team.scale_errors import ScaleErrors

ODDS: Final = 0.03
"""Of wrong settings to right ones, before anything was seen; for each kind of error."""
CONTRADICTION: Final = 16.3  # chi-square of two poses, which 0.1 % of correct ones exceed
CHORD_FACTOR: Final = 2.0
"""On the variance of a scale: the filters know the odometry's noise on the chord of each way only,
which is less than on the way itself."""
LARGEST_LOG: Final = 50.0  # of a ratio of likelihoods
LEAST: Final = 0.2  # odds that are evidence: hardly ever those of a correct robot


def with_probabilities(
    filters: Filters,
    present: Adaptation,
    estimate: Estimate,
    place: Pose2,
    considered: KindsOfError = NONE,
) -> tuple[CalibrationFilter, ...]:
    """The filters that know how likely it is that the settings are wrong in the way in which each
    of them says. `present`: what of the settings is corrected already. Where they agree about
    another pose than the robot's own `estimate` (at `place` by odometry), one of both is wrong, and
    nothing says which: either the settings are, or the robot is elsewhere than it was led.
    `considered`: which errors are in the covariance of the `estimate`."""
    share = 1.0 / max(len(filters), 1)
    if _contradict(filters, estimate, place):
        odds = [share for _ in filters]
    else:
        odds = [share * ODDS * _ratio(f, present, considered) for f in filters]
    every = sum(odds)
    k = 1.0 / (1.0 + every) if every > LEAST else 0.0
    return tuple([f._replace(probability=k * o) for f, o in zip(filters, odds, strict=True)])


def with_doubt(estimate: Estimate, place: Pose2, filters: Filters, present: Adaptation) -> Estimate:
    """The estimate as it is if the settings may be wrong. `place`: of the robot by odometry;
    `present`: what of the settings is corrected already."""
    return with_mixture(with_remaining_errors(estimate, filters, present), place, filters)


def with_mixture(estimate: Estimate, place: Pose2, filters: Filters) -> Estimate:
    """The estimate with the covariance of the mixture. `place`: of the robot by odometry."""
    probability = sum([f.probability for f in filters])
    if probability == 0.0:
        return estimate
    covariance = estimate.covariance.scaled(1.0 - probability)
    for f in filters:
        other = f.estimate_at(place, estimate)
        apart = outer(pose_difference(estimate.pose, other.pose))
        covariance = covariance.plus(other.covariance.plus(apart), f.probability)
    return estimate._replace(covariance=covariance)


def with_remaining_errors(estimate: Estimate, filters: Filters, present: Adaptation) -> Estimate:
    """The estimate with what is not known yet of the errors of the sensor, where one of them is
    corrected: the part of the pose's covariance that is theirs in the first filter, P_xe P_ee^-1
    P_ex (as of the states that a Schmidt-Kalman filter considers; Jazwinski 1970, section 8.4)."""
    is_corrected = present.bearing_bias_rad != 0.0 or present.ranges != NO_RANGE_ERRORS
    if not filters or not is_corrected:
        return estimate
    rows, k = filters[0].covariance, filters[0].scatter
    errors = _sensor_covariance(rows)
    if _is_singular(errors):
        return estimate
    inverse = errors.inverse()
    x, y, heading = [inverse.times((a, b, c)) for _, _, _, a, b, c, _, _ in rows[:BEARING]]
    added = errors.transformed((*x, *y, *heading))
    return estimate._replace(covariance=estimate.covariance.plus(added, k))


def scale_variances(filters: Filters, first: ScaleErrors) -> tuple[float, float]:
    """The mean squares of the errors of the distance's and the turn's scale that these filters know
    of, about the present scales; `first`: as it is without filters."""
    if not filters:
        return first.distance.first, first.turn.first
    distance, turn = [
        fmean([e * e + CHORD_FACTOR * s * s for e, s in [f.error(place) for f in filters]])
        for place in (DISTANCE, TURN)
    ]
    return distance, turn


def _sensor_covariance(rows: Rows) -> Covariance3:
    """Of the bias of bearings, and the share and the bias of ranges."""
    bearing, share, offset = [row[BEARING:DISTANCE] for row in rows[BEARING:DISTANCE]]
    return Covariance3(bearing[0], share[0], share[1], offset[0], offset[1], offset[2])


def _is_singular(c: Covariance3) -> bool:
    """Whether nothing but rounding is left of a covariance's determinant."""
    return c.determinant() <= LEAST_INDEPENDENT * c.xx * c.yy * c.hh


def _contradict(filters: Filters, estimate: Estimate, place: Pose2) -> bool:
    """Whether the robot is elsewhere by all these filters, and at one place. Filters that only
    follow the odometry contradict nobody: the robot may know better by its teammates."""
    if any(f.is_blind for f in filters):
        return False
    known = [f.estimate_at(place, estimate) for f in filters]
    return all(_are_apart(k, estimate) and not _are_apart(k, known[0]) for k in known)


def _are_apart(one: Estimate, other: Estimate) -> bool:
    """Whether two poses cannot be one and the same."""
    if _is_singular(one.covariance.plus(other.covariance)):
        return False
    return pose_chi_square(one, other) > CONTRADICTION


def _ratio(f: CalibrationFilter, present: Adaptation, considered: KindsOfError) -> float:
    """How much likelier the sightings are with a bias of bearings, with that and wrong ranges, or
    with a wrong scale of the odometry, than with the settings as they are; what speaks for these
    does not count. Errors that are considered are not compared."""
    found, first = f.errors, FIRST_SIGMAS
    errors = (
        found[0] - present.bearing_bias_rad,
        found[1] - present.ranges.share,
        found[2] - present.ranges.bias_m,
    )
    covariance = _sensor_covariance(f.covariance).scaled(f.scatter)
    if min(covariance.xx, covariance.yy, covariance.hh) <= 0.0:
        return 0.0
    ratios = [0.0 if considered.bearing_bias else _single_ratio(errors[0], covariance.xx, first[0])]
    for place in () if considered.scales else (DISTANCE, TURN):
        error, sigma = f.error(place)
        variance = CHORD_FACTOR * sigma * sigma
        ratios.append(_single_ratio(error, variance, first[place - BEARING]))
    if considered.bearing_bias:
        ratios.append(_ranges_ratio(errors[1:], covariance))
    elif not _is_singular(covariance):
        chi_square = dot(errors, covariance.inverse().times(errors))
        shrunk = covariance.determinant() / (first[0] * first[1] * first[2]) ** 2
        ratios.append(_density_ratio(chi_square, shrunk))
    return sum([max(ratio - 1.0, 0.0) for ratio in ratios])


def _ranges_ratio(errors: tuple[float, float], covariance: Covariance3) -> float:
    """That of both errors of ranges alone. `covariance`: of the errors of the sensor."""
    _, of_share, of_offset, *_ = FIRST_SIGMAS
    ranges = Covariance2(covariance.yy, covariance.yh, covariance.hh)
    if ranges.determinant() <= LEAST_INDEPENDENT * ranges.xx * ranges.yy:
        return 0.0
    shrunk = ranges.determinant() / (of_share * of_offset) ** 2
    return _density_ratio(ranges.mahalanobis_squared(*errors), shrunk)


def _single_ratio(error: float, variance: float, first_sigma: float) -> float:
    """That of one error."""
    return _density_ratio(error * error / variance, variance / first_sigma**2)


def _density_ratio(chi_square: float, shrunk: float) -> float:
    """The ratio of the likelihoods of a hypothesis and of the one in it that some of its parameters
    are zero: of their density at zero before and after the measurements (J. M. Dickey, The weighted
    likelihood ratio, The Annals of Mathematical Statistics, 1971). `chi_square`: of the parameters
    after them; `shrunk`: the determinant of their covariance as a share of the one before."""
    return math.exp(min(0.5 * (chi_square + math.log(shrunk)), LARGEST_LOG))
