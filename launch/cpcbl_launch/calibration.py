"""How a robot's odometry and sensor err, estimated against true poses: arrays in, values out.

Conventions are those of `OdometrySettings` and `SensorSettings`: true = scale x reading - bias.
Fits are robust (Huber 1964); standard errors are those of a jackknife over stretches of time,
because errors are alike for seconds (delete-a-group jackknife, Kott 2001).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from cpcbl_team.metrics import Floats

Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]
Rows = TypeVar("Rows", "OdometryRows", "SensorRows", "Pairs", "Fit")

LONGEST_GAP_S = 1.0  # truth is interpolated only between rows as near as this
STRETCH_S, STRETCHES = 10.0, (8, 20)  # of a log, left out one by one by the jackknife
WINDOW_S = 2.0
NOISE_WINDOWS_S = (1.0, 2.0, 4.0, 8.0)
LEAST_MOTION = 0.02  # m or rad in a window; less tells nothing of scales
DELAYS_S = np.arange(0.0, 1.001, 0.02)
NUDGE_S = 0.01
HUBER = 2.0
GROSS = 5.0  # sigmas; beyond, a residual is an outlier
LEAST_ROWS = 40
TOLD = 0.3  # a value counts when it is known so much better than its limit
ODOMETRY = ("distance_scale", "turn_scale", "delay_s")
ODOMETRY_LIMITS = (0.2, 0.2, 0.2)
ODOMETRY_NOISE = (
    "distance_sigma_m_per_sqrt_m",
    "turn_sigma_rad_per_sqrt_rad",
    "turn_sigma_rad_per_sqrt_m",
)
SENSOR = ("range_scale", "range_bias_m", "robot_range_bias_m", "bearing_bias_deg", "delay_s")
SLOPES = ("slope", "offset_m", "robot_offset_m", "bearing_bias_rad", "later_s")
SLOPE_LIMITS = (0.2, 0.3, 0.3, 0.1, 0.1)
SENSOR_NOISE = ("range_share", "range_floor_m", "bearing_sigma_deg")
LAGS_S = (0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
TIMES_S = np.geomspace(0.02, 200.0, 400)


class Estimate(msgspec.Struct, frozen=True):
    """A value with its standard error."""

    value: float
    standard_error: float


class RobotLog(NamedTuple):
    """What one robot reported in one log, and where everything truly was. Seconds, m, rad."""

    truth: Floats  # (n, 4): s, x, y, heading
    odometry: Floats  # (n, 4): from s, until s, distance, turn
    sightings: Floats  # (n, 4): stamp s, object (index of `objects`), range, bearing; NaN: none
    objects: tuple[Floats, ...]  # each its truth as (n, 3): s, x, y; one row: it stands still
    teammates: frozenset[int] = frozenset()  # those of `objects` that are robots


class OdometryRows(NamedTuple):
    """Windows of a drive, each beside what the truth says. Shapes (n,)."""

    stretch: Integers
    turn: Floats  # commanded
    turn_rate: Floats  # by how much `turn` falls for a second of delay
    true_turn: Floats
    way: Floats  # commanded way along the true headings
    way_rate: Floats
    true_way: Floats  # the part of the true displacement along it
    along: Floats  # sum of |distance| that errs along it: times cos^2 of the direction between
    path: Floats  # sum of |distance|
    turned: Floats  # sum of |turn|


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


class Fit(NamedTuple):
    """A linear fit of values (n,) by columns (n, k), in units of sigma."""

    stretch: Integers
    columns: Floats
    values: Floats


# Odometry ---------------------------------------------------------------------------------------


def odometry_rows(logs: Sequence[RobotLog], delay_s: float, length_s: float) -> OdometryRows:
    """Windows of about `length_s` that lie between rows of truth without long gaps."""
    parts = [_windows(log, i, delay_s, length_s) for i, log in enumerate(logs)]
    return OdometryRows(*map(np.concatenate, zip(*parts, strict=True)))


def _windows(log: RobotLog, number: int, delay_s: float, length_s: float) -> OdometryRows:
    stamps = log.truth[:, 0]
    x, y, heading = log.truth[:, 1], log.truth[:, 2], np.unwrap(log.truth[:, 3])
    first, last = _spans(stamps, log.odometry, delay_s, length_s)
    a, b = stamps[first], stamps[last]
    before, now, after = (
        _driven(log.odometry, stamps, heading, delay_s + nudge, a, b)
        for nudge in (-NUDGE_S, 0.0, NUDGE_S)
    )
    turn, px, py, path, turned, cos2, sin2 = now.T
    way = np.hypot(px, py)
    still = way < 1e-3
    ux = np.where(still, np.cos(heading[first]), px / np.maximum(way, 1e-9))
    uy = np.where(still, np.sin(heading[first]), py / np.maximum(way, 1e-9))
    rate = (after - before) / (2.0 * NUDGE_S)
    return OdometryRows(
        _stretches(a, stamps, number),
        turn,
        rate[:, 0],
        heading[last] - heading[first],
        ux * px + uy * py,
        ux * rate[:, 1] + uy * rate[:, 2],
        ux * (x[last] - x[first]) + uy * (y[last] - y[first]),
        0.5 * (path + (ux * ux - uy * uy) * cos2 + 2.0 * ux * uy * sin2),
        path,
        turned,
    )


def _spans(
    stamps: Floats, odometry: Floats, delay_s: float, length_s: float
) -> tuple[Integers, Integers]:
    """First and last truth row of each window; windows do not overlap."""
    begin, end = max(stamps[0], odometry[0, 0]) + 1.0, min(stamps[-1], odometry[-1, 1]) - 1.0
    grid = np.arange(begin, end - length_s, length_s)
    ends = odometry[:, 1] + delay_s
    first = _row_at_end(stamps, ends, grid)
    last = _row_at_end(stamps, ends, stamps[first] + length_s)
    gaps = np.concatenate(([0], np.cumsum(np.diff(stamps) > LONGEST_GAP_S)))
    seconds = stamps[last] - stamps[first]
    good = (gaps[first] == gaps[last]) & (stamps[first] - grid < 0.5 * length_s)
    good &= (seconds > 0.75 * length_s) & (seconds < 1.5 * length_s)
    return first[good], last[good]


def _row_at_end(stamps: Floats, ends: Floats, times_s: Floats) -> Integers:
    """Of the next rows of truth the one nearest to an end of odometry, within which there is only
    a mean speed.
    """
    rows = np.searchsorted(stamps, times_s)[:, None] + np.arange(6)
    rows = np.minimum(rows, len(stamps) - 1)
    after = np.clip(np.searchsorted(ends, stamps[rows]), 1, len(ends) - 1)
    aside = np.minimum(np.abs(ends[after] - stamps[rows]), np.abs(stamps[rows] - ends[after - 1]))
    late = stamps[rows] - stamps[rows[:, :1]] > 0.12
    return np.asarray(rows[np.arange(len(rows)), np.argmin(np.where(late, 9.0, aside), axis=1)])


def _driven(
    odometry: Floats, stamps: Floats, heading: Floats, delay_s: float, a: Floats, b: Floats
) -> Floats:
    """What was commanded from a to b: turn, way in x and y along the true headings, |way|, |turn|,
    |way| times cos and sin of twice the heading. Shape (n, 7).
    """
    from_s, until_s, distance, turn = odometry.T
    direction = np.interp(0.5 * (from_s + until_s) + delay_s, stamps, heading)
    pieces = np.stack(
        [
            turn,
            distance * np.cos(direction),
            distance * np.sin(direction),
            np.abs(distance),
            np.abs(turn),
            np.abs(distance) * np.cos(2.0 * direction),
            np.abs(distance) * np.sin(2.0 * direction),
        ]
    )
    knots = np.stack([from_s, until_s], axis=1).ravel() + delay_s
    sums = []
    for piece in pieces:
        total = np.cumsum(piece)
        levels = np.stack([total - piece, total], axis=1).ravel()
        sums.append(np.interp(b, knots, levels) - np.interp(a, knots, levels))
    return np.stack(sums, axis=1)


def odometry_delay_s(logs: Sequence[RobotLog]) -> float:
    """The delay on a grid with which turns and ways fit best, each with its own scale."""
    costs = []
    for delay_s in DELAYS_S:
        rows = odometry_rows(logs, float(delay_s), WINDOW_S)
        cost = 0.0
        for reading, true in ((rows.turn, rows.true_turn), (rows.way, rows.true_way)):
            moving = np.abs(reading) > LEAST_MOTION
            if moving.sum() >= LEAST_ROWS // 2:
                scale = robust_fit(reading[moving, None], true[moving])[0]
                error = float(np.abs(true[moving] - scale * reading[moving]).mean())
                cost += moving.sum() * math.log(max(error, 1e-9))
        costs.append(cost)
    return float(DELAYS_S[int(np.argmin(costs))])


def odometry_fit(rows: OdometryRows, scales: Floats, noise: Floats) -> Fit:
    """Moving windows as rows of a fit of changes of `ODOMETRY`, in units of their sigma.

    `scales`: of ways and turns at present; `noise`: see `odometry_noise`.
    """
    way_sigma, turn_sigma = odometry_sigmas(rows, scales, noise)
    ways, turns = np.abs(rows.way) > LEAST_MOTION, np.abs(rows.turn) > LEAST_MOTION
    of_ways = np.zeros((ways.sum(), 3))
    of_ways[:, 0], of_ways[:, 2] = rows.way[ways], scales[0] * rows.way_rate[ways]
    of_turns = np.zeros((turns.sum(), 3))
    of_turns[:, 1], of_turns[:, 2] = rows.turn[turns], scales[1] * rows.turn_rate[turns]
    sigma = np.concatenate([way_sigma[ways], turn_sigma[turns]])
    values = np.concatenate([(rows.true_way - rows.way)[ways], (rows.true_turn - rows.turn)[turns]])
    return Fit(
        np.concatenate([rows.stretch[ways], rows.stretch[turns]]),
        np.concatenate([of_ways, of_turns]) / sigma[:, None],
        values / sigma,
    )


def odometry_sigmas(rows: OdometryRows, scales: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Sigmas (m, rad) of the ways and turns of windows."""
    path, turned = scales[0] * rows.path, scales[1] * rows.turned
    way = noise[0] * scales[0] * rows.along + noise[3]
    turn = noise[1] * turned + noise[2] * path + noise[4]
    return np.sqrt(np.maximum(way, 1e-12)), np.sqrt(np.maximum(turn, 1e-12))


def odometry_noise(windows: Sequence[OdometryRows], scales: Floats) -> Floats:
    """Variances by how residuals grow, shape (2, 5) as of `variance_parts`: m^2 per m of the way,
    rad^2 per rad and per m, and what is constant (m^2, rad^2): the truth's own errors.
    """
    along = scales[0] * np.concatenate([w.along for w in windows])
    path = scales[0] * np.concatenate([w.path for w in windows])
    turned = scales[1] * np.concatenate([w.turned for w in windows])
    ways = np.concatenate([w.true_way - scales[0] * w.way for w in windows])
    turns = np.concatenate([w.true_turn - scales[1] * w.turn for w in windows])
    one = np.ones_like(path)
    driven = along > LEAST_MOTION
    moving = driven | (turned > LEAST_MOTION)
    of_ways = variance_parts(ways[driven], np.stack([along, one], axis=1)[driven])
    of_turns = variance_parts(turns[moving], np.stack([turned, path, one], axis=1)[moving])
    return np.concatenate([of_ways, of_turns], axis=1)[:, [0, 2, 3, 1, 4]]


def calibrate_odometry(logs: Sequence[RobotLog]) -> dict[str, Estimate]:
    """Values by the names of `OdometrySettings`; those that the logs do not tell are missing."""
    logs = [log for log in logs if len(log.odometry)]
    if not logs:
        return {}
    change, values = np.zeros(3), np.array([1.0, 1.0, odometry_delay_s(logs)])
    for _ in range(4):
        windows = [odometry_rows(logs, values[2], length_s) for length_s in NOISE_WINDOWS_S]
        noise = odometry_noise(windows, values[:2])
        if np.isnan(noise).all():
            return {}
        noise = np.nan_to_num(noise)
        rows = odometry_rows(logs, values[2], WINDOW_S)
        fit = odometry_fit(rows, values[:2], noise[0])
        known = told(fit.columns, ODOMETRY_LIMITS)
        change = solved(fit, known)
        later_s = float(np.clip(change[2], -0.05, 0.05)) if known[2] else -values[2]
        values = np.array([1.0 + change[0], 1.0 + change[1], values[2] + later_s])
    changes = jackknife(lambda keep: solved(_kept(fit, keep(fit.stretch)), known), fit.stretch)
    found = [Estimate(float(v), c.standard_error) for v, c in zip(values, changes, strict=True)]
    grown = sigmas(
        lambda keep: odometry_noise([_kept(w, keep(w.stretch)) for w in windows], values[:2]),
        windows[0].stretch,
    )
    result = {name: v for name, v, k in zip(ODOMETRY, found, known, strict=True) if k}
    return result | dict(zip(ODOMETRY_NOISE, grown, strict=False))


# Sensor -----------------------------------------------------------------------------------------


def sensor_rows(logs: Sequence[RobotLog], delay_s: float) -> SensorRows:
    """The sightings for which viewer and object have truth at the exposure."""
    parts = [_sighted(log, i, delay_s) for i, log in enumerate(logs)]
    return SensorRows(*map(np.concatenate, zip(*parts, strict=True)))


def _sighted(log: RobotLog, number: int, delay_s: float) -> SensorRows:
    stamp_s, which = log.sightings[:, 0], log.sightings[:, 1].astype(np.int64)
    readings, bearings = log.sightings[:, 2], log.sightings[:, 3]
    (range_m, bearing, good), earlier, later = (
        _seen(log, which, stamp_s - delay_s + nudge) for nudge in (0.0, -NUDGE_S, NUDGE_S)
    )
    rows = SensorRows(
        _stretches(stamp_s, log.truth[:, 0], number),
        stamp_s,
        which + 1000 * number,
        np.isin(which, list(log.teammates)),
        readings,
        bearings,
        range_m,
        bearing,
        (later[0] - earlier[0]) / (2.0 * NUDGE_S),
        _wrapped(later[1] - earlier[1]) / (2.0 * NUDGE_S),
    )
    plausible = (np.isnan(readings) | (readings > 0.0)) & (range_m > 0.05)
    plausible &= np.isnan(bearings) | (np.abs(bearings) <= math.pi)
    return _kept(rows, good & earlier[2] & later[2] & plausible)


def _seen(log: RobotLog, which: Integers, times_s: Floats) -> tuple[Floats, Floats, Mask]:
    """True range and bearing of objects at times, and where the truth is known."""
    stamps = log.truth[:, 0]
    good = _known(stamps, times_s)
    x, y = np.empty_like(times_s), np.empty_like(times_s)
    for i, place in enumerate(log.objects):
        mine = which == i
        x[mine], y[mine] = (np.interp(times_s[mine], place[:, 0], c) for c in place[:, 1:].T)
        if len(place) > 1:
            good[mine] &= _known(place[:, 0], times_s[mine])
    own = [np.interp(times_s, stamps, c) for c in (log.truth[:, 1], log.truth[:, 2])]
    heading = np.interp(times_s, stamps, np.unwrap(log.truth[:, 3]))
    dx, dy = x - own[0], y - own[1]
    return np.hypot(dx, dy), _wrapped(np.arctan2(dy, dx) - heading), good


def sensor_fit(rows: SensorRows, range_sigma: Floats, bearing_sigma: float) -> Fit:
    """Readings minus truth as rows of a fit of `SLOPES`, in units of their sigma.

    It is readings that err, so they are fitted against the truth, not the other way round. An
    exposure at another time would have been elsewhere: ranges and bearings share that change.
    """
    r, b = np.isfinite(rows.range_m), np.isfinite(rows.bearing)
    of_ranges, of_bearings = np.zeros((r.sum(), 5)), np.zeros((b.sum(), 5))
    of_ranges[:, 0] = rows.true_range[r]
    of_ranges[:, 1], of_ranges[:, 2] = ~rows.teammate[r], rows.teammate[r]
    of_bearings[:, 3] = 1.0
    of_ranges[:, 4], of_bearings[:, 4] = -rows.range_rate[r], -rows.bearing_rate[b]
    return Fit(
        np.concatenate([rows.stretch[r], rows.stretch[b]]),
        np.concatenate([of_ranges / range_sigma[r, None], of_bearings / bearing_sigma]),
        np.concatenate(
            [
                (rows.range_m - rows.true_range)[r] / range_sigma[r],
                _bearing_errors(rows)[b] / bearing_sigma,
            ]
        ),
    )


def _corrections(slopes: Floats) -> Floats:
    """`SENSOR` (angles in rad) of `SLOPES`: reading = (1 + slope) x true + offset."""
    slope, offset, robot_offset, bearing_bias, later_s = slopes
    scale = 1.0 / max(1.0 + slope, 0.1)
    return np.array([scale, scale * offset, scale * robot_offset, bearing_bias, later_s])


def range_errors(rows: SensorRows, corrections: Floats) -> Floats:
    """Corrected minus true range."""
    scale, bias_m, robot_bias_m = corrections[:3]
    bias = np.where(rows.teammate, robot_bias_m, bias_m)
    return np.asarray(scale * rows.range_m - bias - rows.true_range)


def bearing_errors(rows: SensorRows, corrections: Floats) -> Floats:
    """Corrected minus true bearing."""
    return np.asarray(_bearing_errors(rows) - corrections[3])


def _bearing_errors(rows: SensorRows) -> Floats:
    return _wrapped(rows.bearing - rows.true_bearing)


def sensor_noise(rows: SensorRows, corrections: Floats) -> Floats:
    """Variances of what is left: m^2 per m^2 of range, m^2, rad^2. Shape (2, 3), NaN: no rows."""
    ranges, bearings = range_errors(rows, corrections), bearing_errors(rows, corrections)
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


def _iterated(rows: SensorRows) -> tuple[Fit, Mask, Floats]:
    """The fit, what it tells, and the slopes, with the noise that they leave as weights."""
    known, slopes = np.zeros(5, bool), np.zeros(5)
    for _ in range(3):
        sigma = sensor_sigmas(rows, sensor_noise(rows, _corrections(slopes)))
        fit = sensor_fit(rows, *sigma)
        known = told(fit.columns, SLOPE_LIMITS)
        slopes = solved(fit, known)
    return fit, known, slopes


def calibrate_sensor(logs: Sequence[RobotLog]) -> dict[str, Estimate]:
    """Values by the names of `SensorSettings`; those that the logs do not tell are missing."""
    delay_s = 0.0
    for _ in range(3):
        rows = sensor_rows(logs, delay_s)
        if len(rows.stamp_s) < LEAST_ROWS:
            return {}
        fit, known, slopes = _iterated(rows)
        delay_s += float(np.clip(slopes[4], -0.1, 0.1))
    rows = sensor_rows(logs, delay_s)
    fit, known, slopes = _iterated(rows)
    values = jackknife(
        lambda keep: _corrections(solved(_kept(fit, keep(fit.stretch)), known)), fit.stretch
    )
    corrections = _corrections(slopes)
    values[3], values[4] = _times(math.degrees(1.0), values[3]), _plus(delay_s, values[4])
    result = {name: v for name, v, k in zip(SENSOR, values, known, strict=True) if k}
    noise = sigmas(
        lambda keep: sensor_noise(_kept(rows, keep(rows.stretch)), corrections), rows.stretch
    )
    noise[2] = _times(math.degrees(1.0), noise[2])
    pairs = lagged_products(rows, corrections)
    time = jackknife(
        lambda keep: np.array([correlation_s(_kept(pairs, keep(pairs.stretch)))]), rows.stretch
    )
    more = dict(zip((*SENSOR_NOISE, "correlation_s"), (*noise, *time), strict=True))
    return result | {name: v for name, v in more.items() if math.isfinite(v.value)}


# Pictures ------------------------------------------------------------------------------------


class SensorResiduals(NamedTuple):
    """What a calibrated sensor leaves; see `SensorRows`."""

    true_range: Floats
    range_m: Floats
    bearing: Floats
    pairs: "Pairs"


def sensor_residuals(logs: Sequence[RobotLog], found: Mapping[str, Estimate]) -> SensorResiduals:
    """Corrected minus true readings of a robot whose sensor was calibrated."""
    neutral = {"range_scale": 1.0}
    values = [found[name].value if name in found else neutral.get(name, 0.0) for name in SENSOR]
    corrections = np.array([*values[:3], math.radians(values[3]), 0.0])
    rows = sensor_rows(logs, values[4])
    return SensorResiduals(
        rows.true_range,
        range_errors(rows, corrections),
        bearing_errors(rows, corrections),
        lagged_products(rows, corrections),
    )


def turn_residuals(logs: Sequence[RobotLog], turn_scale: float) -> Floats:
    """Mean absolute error of the turn in a window, rad, for each of `DELAYS_S`."""
    windows = [odometry_rows(logs, float(delay_s), WINDOW_S) for delay_s in DELAYS_S]
    return np.array([np.abs(w.true_turn - turn_scale * w.turn).mean() for w in windows])


# Correlation ------------------------------------------------------------------------------------


class Pairs(NamedTuple):
    """Errors of the same object at two times. Shapes (n,)."""

    stretch: Integers
    lag_s: Floats
    product: Floats
    square: Floats  # mean of both


def lagged_products(rows: SensorRows, corrections: Floats) -> Pairs:
    """All pairs of one object and one kind, up to the longest lag apart, in units of sigma."""
    range_sigma, bearing_sigma = sensor_sigmas(rows, sensor_noise(rows, corrections))
    units = range_errors(rows, corrections) / range_sigma, bearing_errors(rows, corrections)
    parts = []
    for unit in (units[0], units[1] / bearing_sigma):
        error = np.where(np.abs(unit) < GROSS, unit, np.nan)
        for name in np.unique(rows.object):
            mine = np.flatnonzero((rows.object == name) & np.isfinite(error))
            mine = mine[np.argsort(rows.stamp_s[mine], kind="stable")]
            times, values, stretch = rows.stamp_s[mine], error[mine], rows.stretch[mine]
            for ahead in range(1, len(mine)):
                lag = times[ahead:] - times[:-ahead]
                near = (lag <= LAGS_S[-1]) & (lag > 0.0)
                if not near.any():
                    break
                one, two = values[:-ahead][near], values[ahead:][near]
                square = 0.5 * (one * one + two * two)
                parts.append(Pairs(stretch[:-ahead][near], lag[near], one * two, square))
    if not parts:
        return Pairs(np.empty(0, np.int64), *(np.empty(0) for _ in range(3)))
    return Pairs(*map(np.concatenate, zip(*parts, strict=True)))


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
    """The time constant of exp(-lag / time) through the autocorrelation; 0: white; NaN: no pairs.

    Short lags count most: there a correlation is known best.
    """
    lag, ratio, n = autocorrelation(pairs)
    if len(lag) == 0:
        return math.nan
    decay = np.exp(-lag / TIMES_S[:, None])
    weight = 1.0 / (1.0 - np.clip(ratio, 0.0, 0.98) ** 2 + 1.0 / np.sqrt(n))
    costs = (weight * (ratio - decay) ** 2).sum(axis=1)
    best = float(TIMES_S[int(np.argmin(costs))])
    return best if math.exp(-lag[0] / best) > 0.05 else 0.0


# Statistics -------------------------------------------------------------------------------------


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
        size = errors / _spread(errors)
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


def variance_parts(errors: Floats, columns: Floats) -> Floats:
    """Parts with E[error^2] = columns (n, k) @ parts, shape (2, k); NaN with too few errors.

    First those of maximum likelihood for independent normal errors (Fisher scoring), none of them
    negative; then those that one more step would give if they might be. Gross errors do not count.
    """
    if len(errors) < LEAST_ROWS:
        return np.full((2, columns.shape[1]), np.nan)
    square = errors * errors
    shape = (columns / np.maximum(columns.mean(axis=0), 1e-16)).mean(axis=1)
    level = max(float(np.median(square / shape)) / 0.455, 1e-16)  # the median of a chi-square of 1
    parts = np.zeros(columns.shape[1])
    expected, free = level * shape, np.ones(columns.shape[1], bool)
    for _ in range(20):
        good = square < GROSS**2 * expected
        weight = np.where(good, 1.0 / expected, 0.0)
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


def _plus(value: float, change: Estimate) -> Estimate:
    return Estimate(value + change.value, change.standard_error)


def _times(factor: float, estimate: Estimate) -> Estimate:
    return Estimate(factor * estimate.value, factor * estimate.standard_error)


def _stretches(times_s: Floats, stamps: Floats, number: int) -> Integers:
    """Names of the stretches of one log: long enough for errors to be no more alike."""
    seconds = max(float(stamps[-1] - stamps[0]), 1e-9)
    count = int(np.clip(seconds / STRETCH_S, *STRETCHES))
    within = np.clip(count * (times_s - stamps[0]) / seconds, 0, count - 1)
    return np.asarray(STRETCHES[1] * number + within, dtype=np.int64)


def _known(stamps: Floats, times_s: Floats) -> Mask:
    """Whether times lie between rows of truth that are near to each other."""
    after = np.searchsorted(stamps, times_s)
    inside = (after > 0) & (after < len(stamps))
    after = np.clip(after, 1, len(stamps) - 1)
    return inside & (stamps[after] - stamps[after - 1] <= LONGEST_GAP_S)


def _spread(errors: Floats) -> float:
    return max(1.4826 * float(np.median(np.abs(errors))), 1e-9) if len(errors) else 1.0


def _wrapped(angles: Floats) -> Floats:
    return np.asarray((angles + math.pi) % math.tau - math.pi)


def _kept(rows: Rows, keep: Mask) -> Rows:
    return type(rows)(*(column[keep] for column in rows))  # type: ignore[arg-type]
