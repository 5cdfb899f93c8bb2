"""Errors of a robot's sensor: sightings compared with true ranges and bearings.

The conventions are those of `SensorSettings`. The readings have errors, not the truth, so readings
are fitted as functions of the truth.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.logs import RobotLog, has_truth_at, wrap_angles
from cpcbl_launch.calibration.statistics import (
    MIN_ROWS,
    ErrorPairs,
    Estimate,
    Integers,
    LinearFit,
    Mask,
    correlation_time_s,
    determined_coefficients,
    error_pairs,
    jackknife,
    join_rows,
    robust_sigma,
    select_rows,
    sigma_estimates,
    solve,
    stretch_numbers,
    variance_components,
)
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.sensors import LEAST_COSINE

NUDGE_S = 0.01
DEPTH_SPREAD = 0.8  # readings are depths if that reduces the errors below this share
CORRECTIONS = {  # with their limits; of two that a log cannot separate the larger stays
    "range_scale": 0.2,
    "range_bias_m": 0.3,
    "robot_range_bias_m": 0.3,
    "optical_axis_deg": 0.1,  # rad, as the bearing
    "bearing_scale": 0.05,
    "bearing_bias_deg": 0.1,
    "delay_s": 0.1,
}
STEPS, MOST_STEP = 5, 0.1  # of axis (rad) and delay (s), which are not linear
MOST_CHANGE = STEPS * MOST_STEP
NOISE = ("range_share", "range_floor_m", "bearing_sigma_deg")


class SightingRows(NamedTuple):
    """Sightings with their true values; NaN: not measured, or not known. Shapes (n,)."""

    stretch: Integers
    stamp_s: Floats
    object: Integers  # over all logs
    teammate: Mask
    range_m: Floats  # reading
    bearing: Floats
    true_range: Floats
    true_bearing: Floats
    range_rate: Floats
    bearing_rate: Floats


class SensorCorrections(NamedTuple):
    """Values named as in `SensorSettings`; angles in rad."""

    range_scale: float = 1.0
    range_bias_m: float = 0.0
    robot_range_bias_m: float = 0.0
    optical_axis: float = 0.0
    bearing_scale: float = 1.0
    bearing_bias: float = 0.0
    delay_s: float = 0.0
    is_depth: bool = False

    def angle_from_axis(self, rows: SightingRows) -> Floats:
        """The angle between sighting and optical axis; 0 if ranges are not depths."""
        if not self.is_depth:
            return np.zeros_like(rows.bearing)
        return np.nan_to_num(rows.bearing - self.optical_axis)

    def line_of_sight_range(self, rows: SightingRows) -> Floats:
        """Range readings along the line of sight, before scale and bias."""
        cosine = np.maximum(np.cos(self.angle_from_axis(rows)), LEAST_COSINE)
        return np.asarray(rows.range_m / cosine)

    def range_errors(self, rows: SightingRows) -> Floats:
        """Corrected minus true range."""
        bias = np.where(rows.teammate, self.robot_range_bias_m, self.range_bias_m)
        corrected = self.range_scale * self.line_of_sight_range(rows) - bias
        return np.asarray(corrected - rows.true_range)

    def bearing_errors(self, rows: SightingRows) -> Floats:
        """Corrected minus true bearing."""
        corrected = self.bearing_scale * rows.bearing - self.bearing_bias
        return wrap_angles(corrected - rows.true_bearing)


def sighting_rows(logs: Sequence[RobotLog], delay_s: float) -> SightingRows:
    """The plausible sightings for which observer and object have ground truth at the exposure."""
    rows = join_rows([all_sighting_rows(log, i, delay_s) for i, log in enumerate(logs)])
    plausible = np.isnan(rows.range_m) | (rows.range_m > 0.0)
    plausible &= np.isnan(rows.bearing) | (np.abs(rows.bearing) <= math.pi)
    return select_rows(rows, plausible & (rows.true_range > 0.05) & np.isfinite(rows.range_rate))


def all_sighting_rows(log: RobotLog, number: int, delay_s: float) -> SightingRows:
    """A row for each sighting of a log. `number`: of the log."""
    stamp_s, which = log.sightings[:, 0], log.sightings[:, 1].astype(np.int64)
    now, earlier, later = (
        _true_measurements(log, which, stamp_s - delay_s + nudge)
        for nudge in (0.0, -NUDGE_S, NUDGE_S)
    )
    return SightingRows(
        stretch_numbers(stamp_s, log.truth[:, 0], number),
        stamp_s,
        which + 1000 * number,
        np.isin(which, list(log.teammates)),
        log.sightings[:, 2],
        log.sightings[:, 3],
        *now,
        (later[0] - earlier[0]) / (2.0 * NUDGE_S),
        wrap_angles(later[1] - earlier[1]) / (2.0 * NUDGE_S),
    )


def _true_measurements(log: RobotLog, which: Integers, times_s: Floats) -> tuple[Floats, Floats]:
    """True ranges (m) and bearings (rad) of objects at times; NaN where the truth is not known."""
    stamps = log.truth[:, 0]
    has_truth = has_truth_at(stamps, times_s)
    x, y = np.empty_like(times_s), np.empty_like(times_s)
    for i, place in enumerate(log.objects):
        mine = which == i
        x[mine], y[mine] = (np.interp(times_s[mine], place[:, 0], c) for c in place[:, 1:].T)
        if len(place) > 1:
            has_truth[mine] &= has_truth_at(place[:, 0], times_s[mine])
    own = [np.interp(times_s, stamps, c) for c in (log.truth[:, 1], log.truth[:, 2])]
    heading = np.interp(times_s, stamps, np.unwrap(log.truth[:, 3]))
    dx, dy = np.where(has_truth, (x - own[0], y - own[1]), math.nan)
    return np.hypot(dx, dy), wrap_angles(np.arctan2(dy, dx) - heading)


def sensor_fit(
    rows: SightingRows, now: SensorCorrections, range_sigma: Floats, bearing_sigma: float
) -> LinearFit:
    """Readings minus truth as rows of a fit, in units of their sigma.

    The model is reading = (1 + slope) x true + offset for ranges (along the line of sight) and
    bearings. Axis and delay are fitted as differences from the present ones. An exposure at another
    time changes ranges and bearings together.
    """
    r, b = np.isfinite(rows.range_m), np.isfinite(rows.bearing)
    of_ranges, of_bearings = np.zeros((r.sum(), 7)), np.zeros((b.sum(), 7))
    of_ranges[:, 0] = rows.true_range[r]
    of_ranges[:, 1], of_ranges[:, 2] = ~rows.teammate[r], rows.teammate[r]
    of_ranges[:, 3] = (now.line_of_sight_range(rows) * np.tan(now.angle_from_axis(rows)))[r]
    of_bearings[:, 4], of_bearings[:, 5] = rows.true_bearing[b], 1.0
    of_ranges[:, 6], of_bearings[:, 6] = -rows.range_rate[r], -rows.bearing_rate[b]
    sigma, ranges = range_sigma[r], now.line_of_sight_range(rows) - rows.true_range
    bearings = wrap_angles(rows.bearing - rows.true_bearing)[b] / bearing_sigma
    range_fit = LinearFit(rows.stretch[r], of_ranges / sigma[:, None], ranges[r] / sigma)
    return join_rows([range_fit, LinearFit(rows.stretch[b], of_bearings / bearing_sigma, bearings)])


def corrections_from_fit(now: SensorCorrections, fitted: Floats) -> SensorCorrections:
    """The corrections that undo fitted slopes, offsets and differences."""
    slope, offset, robot_offset, axis, bearing_slope, bearing_offset, later_s = fitted.tolist()
    scale, bearing_scale = 1.0 / max(1.0 + slope, 0.1), 1.0 / max(1.0 + bearing_slope, 0.1)
    optical_axis = now.optical_axis + min(max(axis, -MOST_STEP), MOST_STEP)
    delay_s = now.delay_s + min(max(later_s, -MOST_STEP), MOST_STEP)
    ranges = scale, scale * offset, scale * robot_offset
    bearings = bearing_scale, bearing_scale * bearing_offset
    return SensorCorrections(*ranges, optical_axis, *bearings, delay_s, now.is_depth)


def sensor_noise(rows: SightingRows, now: SensorCorrections) -> Floats:
    """Variances of the residuals: m^2 per m^2 of range, m^2, rad^2. Shape (2, 3), NaN: no rows."""
    ranges, bearings = now.range_errors(rows), now.bearing_errors(rows)
    r, b = np.isfinite(ranges), np.isfinite(bearings)
    columns = np.stack([rows.true_range**2, np.ones_like(ranges)], axis=1)
    of_ranges = variance_components(ranges[r], columns[r])
    return np.hstack([of_ranges, variance_components(bearings[b], np.ones((b.sum(), 1)))])


def sensor_sigmas(rows: SightingRows, noise: Floats) -> tuple[Floats, float]:
    """Sigmas of the ranges (n,) in m, and of bearings in rad."""
    share, floor, bearing = np.nan_to_num(noise[0], nan=1e-4)
    ranges = np.sqrt(share * rows.true_range**2 + floor)
    return np.maximum(ranges, 1e-9), max(math.sqrt(bearing), 1e-9)


class SensorFit(NamedTuple):
    """The best corrections, and the data of their fit."""

    rows: SightingRows
    before: SensorCorrections  # the fit gives differences from these
    fit: LinearFit
    known: Mask  # of `CORRECTIONS`
    after: SensorCorrections


def _fit_corrections(logs: Sequence[RobotLog], is_depth: bool) -> SensorFit | None:
    """The corrections, weighted by the noise of the residuals; None with too few sightings."""
    now = SensorCorrections(is_depth=is_depth)
    for _ in range(STEPS):
        rows = sighting_rows(logs, now.delay_s)
        if len(rows.stamp_s) < MIN_ROWS:
            return None
        fit = sensor_fit(rows, now, *sensor_sigmas(rows, sensor_noise(rows, now)))
        known = determined_coefficients(fit.columns, CORRECTIONS.values())
        before, now = now, corrections_from_fit(now, solve(fit, known))
    return SensorFit(rows, before, fit, known, now)


def fit_sensor(logs: Sequence[RobotLog]) -> SensorFit | None:
    """The fit with ranges or with depths, whichever is better; None with too few sightings."""
    plain, depth = _fit_corrections(logs, False), _fit_corrections(logs, True)
    if plain is None or depth is None:
        return None
    return depth if _range_error_sigma(depth) < DEPTH_SPREAD * _range_error_sigma(plain) else plain


def _range_error_sigma(found: SensorFit) -> float:
    errors = found.after.range_errors(found.rows) / found.rows.true_range
    return robust_sigma(np.abs(errors[np.isfinite(errors)]))


def calibrate_sensor(logs: Sequence[RobotLog]) -> tuple[dict[str, Estimate], SensorFit | None]:
    """Values named as in `SensorSettings`, without those that the logs do not determine, and their
    fit (None: too few sightings)."""
    best = fit_sensor(logs)
    if best is None:
        return {}, None
    rows, before, fit, known, now = best
    corrections = jackknife(
        lambda keep: np.array(
            corrections_from_fit(before, solve(select_rows(fit, keep(fit.stretch)), known))[:7]
        ),
        fit.stretch,
    )
    noise = sigma_estimates(
        lambda keep: sensor_noise(select_rows(rows, keep(rows.stretch)), now), rows.stretch
    )
    pairs = sensor_error_pairs(rows, now)
    correlation_time = jackknife(
        lambda keep: np.array([correlation_time_s(select_rows(pairs, keep(pairs.stretch)))]),
        rows.stretch,
    )
    result = {name: v for name, v, k in zip(CORRECTIONS, corrections, known, strict=True) if k}
    if not now.is_depth:
        result.pop("optical_axis_deg", None)
    result |= zip((*NOISE, "correlation_s"), (*noise, *correlation_time), strict=True)
    for name in result:
        if name.endswith("_deg"):
            value, error = result[name].value, result[name].standard_error
            result[name] = Estimate(math.degrees(value), math.degrees(error))
    return {name: v for name, v in result.items() if math.isfinite(v.value)}, best


def sensor_error_pairs(rows: SightingRows, now: SensorCorrections) -> ErrorPairs:
    """Errors of the same object at two times, of ranges and of bearings, in units of sigma."""
    range_sigma, bearing_sigma = sensor_sigmas(rows, sensor_noise(rows, now))
    errors = now.range_errors(rows) / range_sigma, now.bearing_errors(rows) / bearing_sigma
    return error_pairs(rows.stretch, rows.stamp_s, rows.object, errors)
