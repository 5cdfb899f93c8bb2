"""How a robot's camera errs: sightings against true ranges and bearings.

Conventions are those of `SensorSettings`. It is readings that err, so they are fitted against the
truth, not the other way round.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.correlation import Pairs, correlation_s, lagged_products
from cpcbl_launch.calibration.robot_log import RobotLog, known, wrapped
from cpcbl_launch.calibration.statistics import (
    LEAST_ROWS,
    Estimate,
    Fit,
    Integers,
    Mask,
    jackknife,
    kept,
    sigmas,
    solved,
    spread,
    stretches,
    times,
    told,
    variance_parts,
)
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.sensors import LEAST_COSINE

NUDGE_S = 0.01
DEPTH_SPREAD = 0.8  # readings are depths when that leaves so much less
CORRECTIONS = (
    "range_scale",
    "range_bias_m",
    "robot_range_bias_m",
    "optical_axis_deg",
    "bearing_scale",
    "bearing_bias_deg",
    "delay_s",
)
LIMITS = (0.2, 0.3, 0.3, 0.1, 0.05, 0.1, 0.1)
NOISE = ("range_share", "range_floor_m", "bearing_sigma_deg")


class SensorRows(NamedTuple):
    """Sightings, each beside what the truth says. Shapes (n,)."""

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


class Corrections(NamedTuple):
    """Values by the names of `SensorSettings`; angles in rad."""

    range_scale: float = 1.0
    range_bias_m: float = 0.0
    robot_range_bias_m: float = 0.0
    optical_axis: float = 0.0
    bearing_scale: float = 1.0
    bearing_bias: float = 0.0
    delay_s: float = 0.0
    is_depth: bool = False

    def off_axis(self, rows: SensorRows) -> Floats:
        """The angle between sighting and optical axis; 0 where ranges are no depths."""
        if not self.is_depth:
            return np.zeros_like(rows.bearing)
        return np.nan_to_num(rows.bearing - self.optical_axis)

    def along_sight(self, rows: SensorRows) -> Floats:
        """Range readings along the line of sight, before scale and bias."""
        cosine = np.maximum(np.cos(self.off_axis(rows)), LEAST_COSINE)
        return np.asarray(rows.range_m / cosine)

    def range_errors(self, rows: SensorRows) -> Floats:
        """Corrected minus true range."""
        bias = np.where(rows.teammate, self.robot_range_bias_m, self.range_bias_m)
        return np.asarray(self.range_scale * self.along_sight(rows) - bias - rows.true_range)

    def bearing_errors(self, rows: SensorRows) -> Floats:
        """Corrected minus true bearing."""
        corrected = self.bearing_scale * rows.bearing - self.bearing_bias
        return wrapped(corrected - rows.true_bearing)


def sensor_rows(logs: Sequence[RobotLog], delay_s: float) -> SensorRows:
    """The sightings for which viewer and object have truth at the exposure."""
    parts = [_sighted(log, i, delay_s) for i, log in enumerate(logs)]
    return SensorRows(*map(np.concatenate, zip(*parts, strict=True)))


def _sighted(log: RobotLog, number: int, delay_s: float) -> SensorRows:
    stamp_s, which = log.sightings[:, 0], log.sightings[:, 1].astype(np.int64)
    readings, bearings = log.sightings[:, 2], log.sightings[:, 3]
    (range_m, bearing, good), earlier, later = (
        truly_seen(log, which, stamp_s - delay_s + nudge) for nudge in (0.0, -NUDGE_S, NUDGE_S)
    )
    rows = SensorRows(
        stretches(stamp_s, log.truth[:, 0], number),
        stamp_s,
        which + 1000 * number,
        np.isin(which, list(log.teammates)),
        readings,
        bearings,
        range_m,
        bearing,
        (later[0] - earlier[0]) / (2.0 * NUDGE_S),
        wrapped(later[1] - earlier[1]) / (2.0 * NUDGE_S),
    )
    plausible = (np.isnan(readings) | (readings > 0.0)) & (range_m > 0.05)
    plausible &= np.isnan(bearings) | (np.abs(bearings) <= math.pi)
    return kept(rows, good & earlier[2] & later[2] & plausible)


def truly_seen(log: RobotLog, which: Integers, times_s: Floats) -> tuple[Floats, Floats, Mask]:
    """True range and bearing of objects at times, and where the truth is known."""
    stamps = log.truth[:, 0]
    good = known(stamps, times_s)
    x, y = np.empty_like(times_s), np.empty_like(times_s)
    for i, place in enumerate(log.objects):
        mine = which == i
        x[mine], y[mine] = (np.interp(times_s[mine], place[:, 0], c) for c in place[:, 1:].T)
        if len(place) > 1:
            good[mine] &= known(place[:, 0], times_s[mine])
    own = [np.interp(times_s, stamps, c) for c in (log.truth[:, 1], log.truth[:, 2])]
    heading = np.interp(times_s, stamps, np.unwrap(log.truth[:, 3]))
    dx, dy = x - own[0], y - own[1]
    return np.hypot(dx, dy), wrapped(np.arctan2(dy, dx) - heading), good


def sensor_fit(
    rows: SensorRows, now: Corrections, range_sigma: Floats, bearing_sigma: float
) -> Fit:
    """Readings minus truth as rows of a fit, in units of their sigma.

    reading = (1 + slope) x true + offset for ranges (along the line of sight) and bearings; axis
    and delay are fitted as differences from the present. An exposure at another time would have
    been elsewhere: ranges and bearings share that change.
    """
    r, b = np.isfinite(rows.range_m), np.isfinite(rows.bearing)
    of_ranges, of_bearings = np.zeros((r.sum(), 7)), np.zeros((b.sum(), 7))
    of_ranges[:, 0] = rows.true_range[r]
    of_ranges[:, 1], of_ranges[:, 2] = ~rows.teammate[r], rows.teammate[r]
    of_ranges[:, 3] = (now.along_sight(rows) * np.tan(now.off_axis(rows)))[r]
    of_bearings[:, 4], of_bearings[:, 5] = rows.true_bearing[b], 1.0
    of_ranges[:, 6], of_bearings[:, 6] = -rows.range_rate[r], -rows.bearing_rate[b]
    values = [
        (now.along_sight(rows) - rows.true_range)[r] / range_sigma[r],
        wrapped(rows.bearing - rows.true_bearing)[b] / bearing_sigma,
    ]
    return Fit(
        np.concatenate([rows.stretch[r], rows.stretch[b]]),
        np.concatenate([of_ranges / range_sigma[r, None], of_bearings / bearing_sigma]),
        np.concatenate(values),
    )


def corrected(now: Corrections, fitted: Floats) -> Corrections:
    """The corrections that undo fitted slopes, offsets and differences."""
    slope, offset, robot_offset, axis, bearing_slope, bearing_offset, later_s = fitted.tolist()
    scale, bearing_scale = 1.0 / max(1.0 + slope, 0.1), 1.0 / max(1.0 + bearing_slope, 0.1)
    return Corrections(
        scale,
        scale * offset,
        scale * robot_offset,
        now.optical_axis + min(max(axis, -0.1), 0.1),
        bearing_scale,
        bearing_scale * bearing_offset,
        now.delay_s + min(max(later_s, -0.1), 0.1),
        now.is_depth,
    )


def sensor_noise(rows: SensorRows, now: Corrections) -> Floats:
    """Variances of what is left: m^2 per m^2 of range, m^2, rad^2. Shape (2, 3), NaN: no rows."""
    ranges, bearings = now.range_errors(rows), now.bearing_errors(rows)
    r, b = np.isfinite(ranges), np.isfinite(bearings)
    columns = np.stack([rows.true_range**2, np.ones_like(ranges)], axis=1)
    return np.concatenate(
        [
            variance_parts(ranges[r], columns[r]),
            variance_parts(bearings[b], np.ones((b.sum(), 1))),
        ],
        axis=1,
    )


def sensor_sigmas(rows: SensorRows, noise: Floats) -> tuple[Floats, float]:
    """Sigmas of the ranges (n,) in m, and of bearings in rad."""
    share, floor, bearing = np.nan_to_num(noise[0], nan=1e-4)
    ranges = np.sqrt(share * rows.true_range**2 + floor)
    return np.maximum(ranges, 1e-9), max(math.sqrt(bearing), 1e-9)


class _Fitted(NamedTuple):
    rows: SensorRows
    before: Corrections  # of which the fit gives differences
    fit: Fit
    known: Mask
    after: Corrections


def _fitted(logs: Sequence[RobotLog], is_depth: bool) -> _Fitted | None:
    """The corrections, with the noise that they leave as weights; None with too few sightings."""
    now = Corrections(is_depth=is_depth)
    for _ in range(5):
        rows = sensor_rows(logs, now.delay_s)
        if len(rows.stamp_s) < LEAST_ROWS:
            return None
        fit = sensor_fit(rows, now, *sensor_sigmas(rows, sensor_noise(rows, now)))
        told_by = told(fit.columns, LIMITS)
        before, now = now, corrected(now, solved(fit, told_by))
    return _Fitted(rows, before, fit, told_by, now)


def _best(logs: Sequence[RobotLog]) -> _Fitted | None:
    """With ranges as they are or as depths, whichever explains them; None: too few sightings."""
    plain, depth = _fitted(logs, False), _fitted(logs, True)
    if plain is None or depth is None:
        return None
    return depth if _range_spread(depth) < DEPTH_SPREAD * _range_spread(plain) else plain


def _range_spread(found: _Fitted) -> float:
    errors = found.after.range_errors(found.rows) / found.rows.true_range
    return spread(np.abs(errors[np.isfinite(errors)]))


def corrections(logs: Sequence[RobotLog]) -> Corrections:
    """Those that `calibrate_sensor` tells; none with too few sightings."""
    best = _best(logs)
    return Corrections() if best is None else best.after


def calibrate_sensor(logs: Sequence[RobotLog]) -> tuple[dict[str, Estimate], bool]:
    """Values by the names of `SensorSettings`, and whether ranges are depths; values that the logs
    do not tell are missing.
    """
    best = _best(logs)
    if best is None:
        return {}, False
    rows, before, fit, told_by, now = best
    values = jackknife(
        lambda keep: np.array(corrected(before, solved(kept(fit, keep(fit.stretch)), told_by))[:7]),
        fit.stretch,
    )
    in_degrees = (3, 5)
    values = [times(math.degrees(1.0), v) if i in in_degrees else v for i, v in enumerate(values)]
    result = {name: v for name, v, k in zip(CORRECTIONS, values, told_by, strict=True) if k}
    if not now.is_depth:
        result.pop("optical_axis_deg", None)
    noise = sigmas(lambda keep: sensor_noise(kept(rows, keep(rows.stretch)), now), rows.stretch)
    noise[2] = times(math.degrees(1.0), noise[2])
    pairs = pairs_of(rows, now)
    fade = jackknife(
        lambda keep: np.array([correlation_s(kept(pairs, keep(pairs.stretch)))]), rows.stretch
    )
    more = dict(zip((*NOISE, "correlation_s"), (*noise, *fade), strict=True))
    return result | {name: v for name, v in more.items() if math.isfinite(v.value)}, now.is_depth


def pairs_of(rows: SensorRows, now: Corrections) -> Pairs:
    """Errors of the same object at two times, of ranges and of bearings, in units of sigma."""
    range_sigma, bearing_sigma = sensor_sigmas(rows, sensor_noise(rows, now))
    errors = now.range_errors(rows) / range_sigma, now.bearing_errors(rows) / bearing_sigma
    return lagged_products(rows.stretch, rows.stamp_s, rows.object, errors)


class SensorResiduals(NamedTuple):
    """What a calibrated sensor leaves; see `SensorRows`."""

    true_range: Floats
    range_m: Floats
    bearing: Floats
    pairs: Pairs


def sensor_residuals(logs: Sequence[RobotLog]) -> SensorResiduals | None:
    """Corrected minus true readings of a robot; None where it sees too little."""
    best = _best(logs)
    if best is None:
        return None
    rows, now = best.rows, best.after
    return SensorResiduals(
        rows.true_range, now.range_errors(rows), now.bearing_errors(rows), pairs_of(rows, now)
    )
