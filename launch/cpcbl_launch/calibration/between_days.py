"""What differs between days: a random effect on the readings of a robot.

Corrections that were fitted on some days err on another one: cameras are bumped, tyres wear. The
corrections of each day are applied to the same readings, because errors of a scale and of a bias
belong together. Their variance between the days, beyond their standard errors, is that of the
random-effects model (Hedges 1983, "A random effects model for effect sizes"; for two days it is the
estimate of DerSimonian & Laird 1986). One robot has few days, so the robots are pooled.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Final

import msgspec
import numpy as np

from cpcbl_launch.calibration import odometry, sensor, statistics
from cpcbl_launch.calibration.statistics import Estimate, RowFilter, select_rows
from cpcbl_launch.reporting.metrics import Floats

NOISE: Final = {  # what differs, and the noise that grows by it
    "distance": ("distance_sigma_m_per_sqrt_m", "distance_sigma_m_per_sqrt_rad"),
    "turn": ("turn_sigma_rad_per_sqrt_rad", "turn_sigma_rad_per_sqrt_m"),
    "range": ("range_floor_m",),
    "bearing": ("bearing_sigma_deg",),
}
SENSOR_UNITS: Final = {"range": 1.0, "bearing": math.degrees(1.0)}
READINGS = 200  # so many are compared
ANOTHER_DAY: Final = {"distance_scale_sigma": 0.1, "turn_scale_sigma": 0.2}
"""How far the scales of wheels, as shares, may differ on a day that no log is of: on another floor,
with other tyres or batteries. A few days do not tell how far the next one is off. The scales of
the UTIAS robots hardly differ on three of their days, and by 0.15 and 0.3 on another."""


class DayVariance(msgspec.Struct, frozen=True):
    """Mean variances of one robot's corrected readings, m^2 or rad^2."""

    days: int
    between: float  # of one day about the mean of all; by chance below 0
    noise: float  # of single readings


def odometry_day_variances(found: odometry.OdometryFit) -> dict[str, DayVariance]:
    """Those of distance and turn, in the longest windows."""
    now, known, fit, (*_, rows) = found

    def motion(keep: RowFilter) -> Floats:
        changes = statistics.solve(select_rows(fit, keep(fit.stretch)), known)
        scale, turn_scale, later_s, loss, bias = changes.tolist()
        day = odometry.OdometryCorrections(1.0 + scale, 1.0 + turn_scale, 0.0, loss, bias)
        ways = day.displacement(rows) + later_s * now.distance_scale * rows.displacement_rate
        return np.stack([ways, day.turn(rows) + later_s * now.turn_scale * rows.turn_rate])

    errors = rows.true_displacement - now.displacement(rows), rows.true_turn - now.turn(rows)
    noise = dict(zip(("distance", "turn"), errors, strict=True))
    return _day_variances(motion, fit, known, odometry.CORRECTIONS.values(), noise)


def sensor_day_variances(found: sensor.SensorFit) -> dict[str, DayVariance]:
    """Those of ranges and bearings."""
    rows, before, fit, known, now = found
    rows = select_rows(rows, np.isfinite(now.range_errors(rows) + now.bearing_errors(rows)))
    rows = select_rows(rows, np.arange(len(rows.stretch)) % (len(rows.stretch) // READINGS + 1) < 1)

    def errors(keep: RowFilter) -> Floats:
        fitted = statistics.solve(select_rows(fit, keep(fit.stretch)), known)
        day = sensor.corrections_from_fit(before, fitted)
        return np.stack([day.range_errors(rows), day.bearing_errors(rows)])

    noise = {"range": now.range_errors(rows), "bearing": now.bearing_errors(rows)}
    return _day_variances(errors, fit, known, sensor.CORRECTIONS.values(), noise)


def _day_variances(
    corrected: Callable[[RowFilter], Floats],
    fit: statistics.LinearFit,
    known: statistics.Mask,
    limits: Iterable[float],
    errors: Mapping[str, Floats],
) -> dict[str, DayVariance]:
    """A row of `corrected` and an array of `errors` for each kind. Days that do not determine all
    corrections alone are left out."""
    day_of, within, each = fit.stretch // statistics.STRETCHES[1], np.array([*limits])[known], []
    for day in np.unique(day_of):
        own = select_rows(fit, day_of == day)
        if statistics.determined_coefficients(own.columns[:, known], within).all():
            of_day = partial(_on_day, corrected, int(day))
            found = statistics.jackknife(of_day, own.stretch)
            each.append([(estimate.value, estimate.standard_error**2) for estimate in found])
    between = np.zeros(len(errors))
    if len(each) > 1:
        values, squares = np.moveaxis(np.array(each), 2, 0)
        between = values.var(axis=0, ddof=1) - squares.mean(axis=0)
        between = between.reshape(len(errors), -1).mean(axis=1)
    return {
        kind: DayVariance(max(len(each), 1), variance, _variance_without_outliers(error))
        for (kind, error), variance in zip(errors.items(), between.tolist(), strict=True)
    }


def _variance_without_outliers(errors: Floats) -> float:
    most = statistics.OUTLIER_SIGMAS * statistics.robust_sigma(errors)
    return float(np.mean(np.minimum(errors * errors, most * most)))


def _on_day(corrected: Callable[[RowFilter], Floats], day: int, keep: RowFilter) -> Floats:
    return corrected(lambda s: keep(s) & (s // statistics.STRETCHES[1] == day)).ravel()


def pooled_variances(robots: Sequence[Mapping[str, DayVariance]]) -> dict[str, float]:
    """The variance between days of each kind over all robots; none of a kind with one day each.

    It is increased so that 3 sigma hold as much as 3 sigma of a variance that is known.
    """
    pooled = {}
    for kind in NOISE:
        found = [robot[kind] for robot in robots if kind in robot]
        if freedom := sum(f.days - 1 for f in found):
            variance = max(sum((f.days - 1) * f.between for f in found) / freedom, 0.0)
            pooled[kind] = coverage_factor(freedom) ** 2 * variance
    return pooled


def coverage_factor(freedom: int) -> float:
    """The quantile of Student's t over the normal distribution's at 3 sigma (Guide to the
    expression of uncertainty in measurement, G.3), by the expansion of Fisher & Cornish (1960),
    which is good to 2 % from 5 degrees of freedom on. Fewer than 3 count as 3."""
    z, n = 3.0, max(freedom, 3)
    second = (5.0 * z**4 + 16.0 * z**2 + 3.0) / 96.0
    third = (3.0 * z**6 + 19.0 * z**4 + 17.0 * z**2 - 15.0) / 384.0
    return 1.0 + (z**2 + 1.0) / (4.0 * n) + second / n**2 + third / n**3


def missing_variance(own: DayVariance, pooled: float) -> float:
    """What the noise of a fit over K days lacks on a new day: there the mean of the days errs by
    1 + 1/K of the variance between days, of which the fit's residuals hold 1 - 1/K."""
    return 2.0 / own.days * pooled


def with_day_variances(
    values: Mapping[str, Estimate], own: Mapping[str, DayVariance], pooled: Mapping[str, float]
) -> dict[str, Estimate]:
    """The values of a robot with noise that covers a new day, and with a longer `correlation_s`.

    The error of a day does not fade: its autocorrelation is 1 up to the longest lag. The integral
    of the sum's autocorrelation is the mean of both times, weighted by their variances.
    """
    result, times_s = dict(values), []
    for kind in sorted(own.keys() & pooled.keys()):
        missing, unit = missing_variance(own[kind], pooled[kind]), SENSOR_UNITS.get(kind)
        share = missing / (own[kind].noise + missing)
        for key in values.keys() & NOISE[kind]:
            sigma, error = values[key].value, values[key].standard_error
            grown = sigma / math.sqrt(1.0 - share)
            sigma = math.hypot(sigma, unit * math.sqrt(missing)) if unit else grown
            result[key] = Estimate(sigma, error)
        if unit and "correlation_s" in values:
            fading_s = values["correlation_s"].value
            times_s.append(fading_s + share * max(statistics.LAGS_S[-1] - fading_s, 0.0))
    if times_s:
        error_s = values["correlation_s"].standard_error
        result["correlation_s"] = Estimate(sum(times_s) / len(times_s), error_s)
    return result
