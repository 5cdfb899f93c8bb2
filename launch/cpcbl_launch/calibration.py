"""How a robot's odometry and sensor err, estimated against true poses: arrays in, values out.

Conventions are those of `OdometrySettings` and `SensorSettings`: true = scale x reading - bias.
Fits are robust (Huber 1964); standard errors are those of a jackknife over stretches of time,
because errors are alike for seconds (delete-a-group jackknife, Kott 2001).
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cpcbl_team.metrics import Floats

Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]
Rows = TypeVar("Rows", "OdometryRows", "SensorRows", "Pairs")

LONGEST_GAP_S = 1.0  # truth is interpolated only between rows as near as this
STRETCHES = 20  # of a log, left out one by one by the jackknife
WINDOW_S = 2.0
NOISE_WINDOWS_S = (1.0, 2.0, 5.0, 10.0)
LEAST_MOTION = 0.02  # m or rad in a window; less tells nothing of scales
DELAYS_S = np.arange(0.0, 1.001, 0.02)
NUDGE_S = 0.01
HUBER = 2.0
GROSS = 5.0  # sigmas; beyond, a residual is an outlier
LEAST_ROWS = 40
LAGS_S = (0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
TIMES_S = np.geomspace(0.02, 200.0, 400)


class Estimate(NamedTuple):
    """A value with its standard error; without one, what was measured does not tell it."""

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


# Odometry ---------------------------------------------------------------------------------------


def odometry_rows(logs: Sequence[RobotLog], delay_s: float, length_s: float) -> OdometryRows:
    """Windows of about `length_s` that lie between rows of truth without long gaps."""
    parts = [_windows(log, i, delay_s, length_s) for i, log in enumerate(logs)]
    return OdometryRows(*map(np.concatenate, zip(*parts, strict=True)))


def _windows(log: RobotLog, number: int, delay_s: float, length_s: float) -> OdometryRows:
    stamps = log.truth[:, 0]
    x, y, heading = log.truth[:, 1], log.truth[:, 2], np.unwrap(log.truth[:, 3])
    first, last = _spans(stamps, log.odometry, length_s)
    a, b = stamps[first], stamps[last]
    before, now, after = (
        _driven(log.odometry, stamps, heading, delay_s + nudge, a, b)
        for nudge in (-NUDGE_S, 0.0, NUDGE_S)
    )
    turn, px, py, path, turned = now.T
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
        path,
        turned,
    )


def _spans(stamps: Floats, odometry: Floats, length_s: float) -> tuple[Integers, Integers]:
    """First and last truth row of each window; windows do not overlap."""
    begin, end = max(stamps[0], odometry[0, 0]) + 1.0, min(stamps[-1], odometry[-1, 1]) - 1.0
    grid = np.arange(begin, end - length_s, length_s)
    first = np.searchsorted(stamps, grid)
    last = np.searchsorted(stamps, stamps[first] + length_s)
    last = np.minimum(last, len(stamps) - 1)
    gaps = np.concatenate(([0], np.cumsum(np.diff(stamps) > LONGEST_GAP_S)))
    seconds = stamps[last] - stamps[first]
    good = (gaps[first] == gaps[last]) & (stamps[first] - grid < 0.5 * length_s)
    good &= (seconds > 0.75 * length_s) & (seconds < 1.5 * length_s)
    return first[good], last[good]


def _driven(
    odometry: Floats, stamps: Floats, heading: Floats, delay_s: float, a: Floats, b: Floats
) -> Floats:
    """What was commanded from a to b: turn, way in x and y along the true headings, |way|, |turn|.

    Shape (n, 5).
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
            if moving.sum() >= LEAST_ROWS:
                fit = robust_fit(reading[moving, None], true[moving])
                cost += moving.sum() * math.log(_spread(true[moving] - reading[moving] * fit[0]))
        costs.append(cost)
    return float(DELAYS_S[int(np.argmin(costs))])


def odometry_fit(rows: OdometryRows) -> Floats:
    """(turn scale, distance scale, change of the delay in s) of moving windows."""
    turns, ways = np.abs(rows.turn) > LEAST_MOTION, np.abs(rows.way) > LEAST_MOTION
    turn_scale, distance_scale = 1.0, 1.0
    if turns.any():
        turn_scale = robust_fit(rows.turn[turns, None], rows.true_turn[turns])[0]
    if ways.any():
        distance_scale = robust_fit(rows.way[ways, None], rows.true_way[ways])[0]
    turn_spread = _spread(rows.true_turn[turns] - turn_scale * rows.turn[turns])
    way_spread = _spread(rows.true_way[ways] - distance_scale * rows.way[ways])
    zeros = np.zeros
    of_turns = np.stack(
        [rows.turn[turns], zeros(turns.sum()), turn_scale * rows.turn_rate[turns]], axis=1
    )
    of_ways = np.stack(
        [zeros(ways.sum()), rows.way[ways], distance_scale * rows.way_rate[ways]], axis=1
    )
    return robust_fit(
        np.concatenate([of_turns / turn_spread, of_ways / way_spread]),
        np.concatenate([rows.true_turn[turns] / turn_spread, rows.true_way[ways] / way_spread]),
    )


def odometry_noise(windows: Sequence[OdometryRows], turn_scale: float, scale: float) -> Floats:
    """Sigmas (m per sqrt m, rad per sqrt rad, rad per sqrt m) by how residuals grow."""
    path = scale * np.concatenate([w.path for w in windows])
    turned = turn_scale * np.concatenate([w.turned for w in windows])
    ways = np.concatenate([w.true_way - scale * w.way for w in windows])
    turns = np.concatenate([w.true_turn - turn_scale * w.turn for w in windows])
    one = np.ones_like(path)
    moving = (path > LEAST_MOTION) | (turned > LEAST_MOTION)
    of_ways = variance_parts(ways[moving], np.stack([path, one], axis=1)[moving])
    of_turns = variance_parts(turns[moving], np.stack([turned, path, one], axis=1)[moving])
    return np.sqrt([of_ways[0], of_turns[0], of_turns[1]])


def calibrate_odometry(logs: Sequence[RobotLog]) -> dict[str, Estimate]:
    """Values by the names of `OdometrySettings`; empty for a robot that does not move."""
    delay_s = odometry_delay_s(logs)
    for _ in range(3):
        rows = odometry_rows(logs, delay_s, WINDOW_S)
        moving = (np.abs(rows.turn) > LEAST_MOTION) | (np.abs(rows.way) > LEAST_MOTION)
        if moving.sum() < LEAST_ROWS:
            return {}
        delay_s += float(np.clip(odometry_fit(rows)[2], -0.05, 0.05))
    rows = odometry_rows(logs, delay_s, WINDOW_S)
    fitted = jackknife(lambda keep: odometry_fit(_kept(rows, keep(rows.stretch))), rows.stretch)
    turn_scale, distance_scale, _ = (e.value for e in fitted)
    windows = [odometry_rows(logs, delay_s, length_s) for length_s in NOISE_WINDOWS_S]
    noise = jackknife(
        lambda keep: odometry_noise(
            [_kept(w, keep(w.stretch)) for w in windows], turn_scale, distance_scale
        ),
        windows[0].stretch,
    )
    return {
        "distance_scale": fitted[1],
        "turn_scale": fitted[0],
        "delay_s": Estimate(delay_s + fitted[2].value, fitted[2].standard_error),
        "distance_sigma_m_per_sqrt_m": noise[0],
        "turn_sigma_rad_per_sqrt_rad": noise[1],
        "turn_sigma_rad_per_sqrt_m": noise[2],
    }


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


def sensor_fit(rows: SensorRows) -> Floats:
    """(range scale, bias, bias for robots, bearing bias in rad, change of the delay in s).

    Readings are fitted against the truth, not the other way round: it is they that err. NaN where
    nothing tells.
    """
    share, floor = 0.03, 0.03
    bearing_spread = _spread(_bearing_errors(rows)[np.isfinite(rows.bearing)])
    line = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(3):
        sigma = np.hypot(share * rows.true_range, floor)
        line = _joint_fit(rows, sigma, bearing_spread)
        scale = 1.0 / line[0] if line[0] > 0.1 else 1.0
        errors = range_errors(rows, scale, line[1] * scale, line[2] * scale)
        parts = _range_noise(rows, errors)
        share, floor = parts[0], max(parts[1], 1e-3)
    scale = 1.0 / line[0] if line[0] > 0.1 else math.nan
    return np.array([scale, line[1] * scale, line[2] * scale, line[3], line[4]])


def _joint_fit(rows: SensorRows, range_sigma: Floats, bearing_sigma: float) -> Floats:
    """Readings as slope x true range + bias (landmarks | robots) and true bearing + bias.

    A later exposure would have been elsewhere: both share the change of the delay.
    """
    r, b = np.isfinite(rows.range_m), np.isfinite(rows.bearing)
    columns = (
        rows.true_range,
        np.where(rows.teammate, 0.0, 1.0),
        np.where(rows.teammate, 1.0, 0.0),
        np.zeros_like(rows.true_range),
        -rows.range_rate,
    )
    of_ranges = (np.stack(columns, axis=1) / range_sigma[:, None])[r]
    nothing, one = np.zeros(b.sum()), np.ones(b.sum())
    columns = (nothing, nothing, nothing, one, -rows.bearing_rate[b])
    of_bearings = np.stack(columns, axis=1) / bearing_sigma
    return robust_fit(
        np.concatenate([of_ranges, of_bearings]),
        np.concatenate([(rows.range_m / range_sigma)[r], _bearing_errors(rows)[b] / bearing_sigma]),
    )


def range_errors(rows: SensorRows, scale: float, bias_m: float, robot_bias_m: float) -> Floats:
    """Corrected minus true range."""
    landmark_bias, robot_bias = np.nan_to_num(bias_m), np.nan_to_num(robot_bias_m)
    bias = np.where(rows.teammate, robot_bias, landmark_bias)
    return np.asarray(scale * rows.range_m - bias - rows.true_range)


def _bearing_errors(rows: SensorRows) -> Floats:
    return _wrapped(rows.bearing - rows.true_bearing)


def _range_noise(rows: SensorRows, errors: Floats) -> Floats:
    """(share, floor in m)."""
    there = np.isfinite(errors)
    square = rows.true_range[there] ** 2
    return np.sqrt(variance_parts(errors[there], np.stack([square, np.ones_like(square)], axis=1)))


def sensor_noise(rows: SensorRows, fit: Floats) -> Floats:
    """(share, floor in m, sigma of the bearing in rad) of errors that `fit` leaves."""
    share, floor = _range_noise(rows, range_errors(rows, *fit[:3]))
    bearing = _bearing_errors(rows) - fit[3]
    bearing = bearing[np.isfinite(bearing)]
    sigma = math.sqrt(variance_parts(bearing, np.ones((len(bearing), 1)))[0])
    return np.array([share, floor, sigma])


def unit_errors(rows: SensorRows, fit: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Errors of ranges and bearings in units of their sigma, gross ones as NaN."""
    sigma = np.hypot(noise[0] * rows.true_range, noise[1])
    ranges = range_errors(rows, *fit[:3]) / np.maximum(sigma, 1e-9)
    bearings = (_bearing_errors(rows) - fit[3]) / max(noise[2], 1e-9)
    return tuple(np.where(np.abs(e) < GROSS, e, np.nan) for e in (ranges, bearings))  # type: ignore[return-value]


def calibrate_sensor(logs: Sequence[RobotLog]) -> dict[str, Estimate]:
    """Values by the names of `SensorSettings`; empty without enough sightings."""
    delay_s = 0.0
    for _ in range(3):
        rows = sensor_rows(logs, delay_s)
        if len(rows.stamp_s) < LEAST_ROWS:
            return {}
        delay_s += float(np.clip(np.nan_to_num(sensor_fit(rows)[4]), -0.1, 0.1))
    rows = sensor_rows(logs, delay_s)
    fitted = jackknife(lambda keep: sensor_fit(_kept(rows, keep(rows.stretch))), rows.stretch)
    fit = np.array([e.value for e in fitted])
    noise = jackknife(
        lambda keep: sensor_noise(_kept(rows, keep(rows.stretch)), fit), rows.stretch
    )
    sigmas = np.array([e.value for e in noise])
    pairs = lagged_products(rows, unit_errors(rows, fit, sigmas))
    correlation = jackknife(
        lambda keep: np.array([correlation_s(pairs, keep(pairs.stretch))]), rows.stretch
    )
    return {
        "range_scale": fitted[0],
        "range_bias_m": fitted[1],
        "robot_range_bias_m": fitted[2],
        "range_share": noise[0],
        "range_floor_m": noise[1],
        "bearing_bias_deg": _in_degrees(fitted[3]),
        "bearing_sigma_deg": _in_degrees(noise[2]),
        "delay_s": Estimate(delay_s + fitted[4].value, fitted[4].standard_error),
        "correlation_s": correlation[0],
    }


# Correlation ------------------------------------------------------------------------------------


class Pairs(NamedTuple):
    """Errors of the same object at two times. Shapes (n,)."""

    stretch: Integers
    lag_s: Floats
    product: Floats
    square: Floats  # mean of both


def lagged_products(rows: SensorRows, errors: Sequence[Floats]) -> Pairs:
    """All pairs of one object (and one kind of error) up to the longest lag apart."""
    parts = []
    for error in errors:
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


def autocorrelation(pairs: Pairs, keep: Mask) -> tuple[Floats, Floats, Floats]:
    """(mean lag in s, correlation, number of pairs) of each bin of lags that has enough."""
    kept = _kept(pairs, keep)
    result = []
    for low, high in pairwise((0.0, *LAGS_S)):
        mine = (kept.lag_s > low) & (kept.lag_s <= high)
        if (n := int(mine.sum())) >= LEAST_ROWS:
            ratio = kept.product[mine].sum() / max(kept.square[mine].sum(), 1e-12)
            result.append((kept.lag_s[mine].mean(), ratio, n))
    return tuple(np.array(result).reshape(-1, 3).T)  # type: ignore[return-value]


def correlation_s(pairs: Pairs, keep: Mask) -> float:
    """The time constant of exp(-lag / time) through the autocorrelation; 0: white; NaN: no pairs.

    Short lags count most: there a correlation is known best.
    """
    lag, ratio, n = autocorrelation(pairs, keep)
    if len(lag) == 0:
        return math.nan
    decay = np.exp(-lag / TIMES_S[:, None])
    weight = 1.0 / (1.0 - np.clip(ratio, 0.0, 0.98) ** 2 + 1.0 / np.sqrt(n))
    costs = (weight * (ratio - decay) ** 2).sum(axis=1)
    best = float(TIMES_S[int(np.argmin(costs))])
    return best if math.exp(-lag[0] / best) > 0.05 else 0.0


# Statistics -------------------------------------------------------------------------------------


def robust_fit(columns: Floats, values: Floats) -> Floats:
    """Coefficients (k,) with values ~ columns (n, k) @ coefficients; NaN for empty columns.

    Huber's weights, iterated; residuals beyond GROSS sigmas do not count.
    """
    used = np.abs(columns).max(axis=0, initial=0.0) > 1e-9
    X = columns[:, used]
    weight, coefficients = np.ones(len(values)), np.zeros(X.shape[1])
    for _ in range(12):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(X * root[:, None], values * root, rcond=None)[0]
        size = np.abs(values - X @ coefficients)
        size /= max(1.4826 * float(np.median(size)), 1e-9)
        weight = np.where(size > GROSS, 0.0, np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))
    result = np.full(columns.shape[1], np.nan)
    result[used] = coefficients
    return result


def variance_parts(errors: Floats, columns: Floats) -> Floats:
    """Not negative parts (k,) with E[error^2] = columns (n, k) @ parts.

    Maximum likelihood of independent normal errors (Fisher scoring); gross errors left out.
    """
    square = errors * errors
    level = max(float(np.median(square)) / 0.455, 1e-16)
    parts = np.zeros(columns.shape[1])
    expected, free = np.full(len(errors), level), np.ones(columns.shape[1], bool)
    for _ in range(40):
        good = square < GROSS**2 * expected
        weight = np.where(good, 1.0 / expected, 0.0)
        solved = np.linalg.lstsq(
            columns[:, free] * weight[:, None], np.where(good, square, 0.0) * weight, rcond=None
        )[0]
        if (solved < 0.0).any() and free.sum() > 1:
            free[np.flatnonzero(free)[int(np.argmin(solved))]] = False
            continue
        parts[:] = 0.0
        parts[free] = np.maximum(solved, 0.0)
        expected = np.maximum(columns @ parts, 1e-4 * level)
    return parts


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


def _stretches(times_s: Floats, stamps: Floats, number: int) -> Integers:
    share = (times_s - stamps[0]) / max(stamps[-1] - stamps[0], 1e-9)
    return np.asarray(
        STRETCHES * number + np.clip(STRETCHES * share, 0, STRETCHES - 1), dtype=np.int64
    )


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


def _in_degrees(estimate: Estimate) -> Estimate:
    return Estimate(math.degrees(estimate.value), math.degrees(estimate.standard_error))


def _kept(rows: Rows, keep: Mask) -> Rows:
    return type(rows)(*(column[keep] for column in rows))
