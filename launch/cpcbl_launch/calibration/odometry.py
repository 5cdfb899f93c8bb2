"""Errors of a robot's odometry: windows of a drive compared with true poses.

The conventions are those of `OdometrySettings`. A displacement is compared along its own direction.
Windows of a few seconds determine the corrections, longer ones the growth of the noise. A dead zone
of the motors shows as a least speed below which the robot does not drive.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.logs import LONGEST_GAP_S, RobotLog
from cpcbl_launch.calibration.statistics import (
    MIN_ROWS,
    OUTLIER_SIGMAS,
    Estimate,
    Integers,
    LinearFit,
    Mask,
    RowFilter,
    determined_coefficients,
    jackknife,
    join_rows,
    robust_fit,
    select_rows,
    sigma_estimates,
    solve,
    stretch_numbers,
    variance_components,
)
from cpcbl_launch.reporting.metrics import Floats

NOISE_WINDOWS_S = (1.0, 2.0, 4.0, 8.0, 16.0)
WINDOW_S, NUDGE_S = 2.0, 0.01
MIN_MOTION = 0.02  # m or rad in a window; a smaller motion does not determine scales
DELAYS_S = np.arange(0.0, 1.001, 0.02)
REFINEMENTS, MOST_STEP_S = 4, 0.05  # of the best of these
CORRECTIONS = {  # with their limits; of two that a log cannot separate the larger stays
    "distance_scale": 0.2,
    "turn_scale": 0.2,
    "delay_s": 0.2,
    "distance_loss_m_per_rad": 0.1,
    "turn_bias_rad_per_m": 0.1,
}
NOISE = (
    "distance_sigma_m_per_sqrt_m",
    "distance_sigma_m_per_sqrt_rad",
    "turn_sigma_rad_per_sqrt_rad",
    "turn_sigma_rad_per_sqrt_m",
)


class OdometryWindows(NamedTuple):
    """Commanded and true motion in windows of a drive. Shapes (n,); m, rad."""

    stretch: Integers
    turn: Floats  # commanded
    turn_rate: Floats  # decrease of `turn` for a second of delay
    true_turn: Floats
    displacement: Floats  # commanded, along the true headings
    displacement_rate: Floats
    true_displacement: Floats  # its part along `displacement`
    loss: Floats  # |turn| while driving, its part along `displacement`
    distance: Floats  # sum of distances
    turn_while_driving: Floats  # sum of |turn| while driving
    distance_along: Floats  # sum of |distance| x cos^2 of the angle to `displacement`
    turn_along: Floats  # sum of |turn| x the same
    path_length: Floats  # sum of |distance|
    turn_total: Floats  # sum of |turn|


class OdometryCorrections(NamedTuple):
    """Present values, named as in `OdometrySettings`."""

    distance_scale: float
    turn_scale: float
    delay_s: float
    loss: float
    bias: float

    def displacement(self, rows: OdometryWindows) -> Floats:
        return np.asarray(self.distance_scale * rows.displacement - self.loss * rows.loss)

    def turn(self, rows: OdometryWindows) -> Floats:
        return np.asarray(self.turn_scale * rows.turn + self.bias * self.distance(rows))

    def distance(self, rows: OdometryWindows) -> Floats:
        return np.asarray(self.distance_scale * rows.distance - self.loss * rows.turn_while_driving)


def odometry_windows(logs: Sequence[RobotLog], delay_s: float, length_s: float) -> OdometryWindows:
    """Windows of about `length_s` that lie between rows of truth without long gaps."""
    return join_rows([_windows_of_log(log, i, delay_s, length_s) for i, log in enumerate(logs)])


def _windows_of_log(log: RobotLog, number: int, delay_s: float, length_s: float) -> OdometryWindows:
    stamps = log.truth[:, 0]
    x, y, heading = log.truth[:, 1], log.truth[:, 2], np.unwrap(log.truth[:, 3])
    first, last = _window_rows(stamps, log.odometry, delay_s, length_s)
    a, b = stamps[first], stamps[last]
    before, now, after = (
        _commanded_motion(log.odometry, stamps, heading, delay_s + nudge, a, b)
        for nudge in (-NUDGE_S, 0.0, NUDGE_S)
    )
    turn, px, py, lx, ly, distance, turn_while_driving, path_length, turn_total, *doubled = now.T
    displacement = np.hypot(px, py)
    still = displacement < 1e-3
    ux = np.where(still, np.cos(heading[first]), px / np.maximum(displacement, 1e-9))
    uy = np.where(still, np.sin(heading[first]), py / np.maximum(displacement, 1e-9))
    rate = (after - before) / (2.0 * NUDGE_S)
    cos2, sin2 = ux * ux - uy * uy, 2.0 * ux * uy
    return OdometryWindows(
        stretch_numbers(a, stamps, number),
        turn,
        rate[:, 0],
        heading[last] - heading[first],
        ux * px + uy * py,
        ux * rate[:, 1] + uy * rate[:, 2],
        ux * (x[last] - x[first]) + uy * (y[last] - y[first]),
        ux * lx + uy * ly,
        distance,
        turn_while_driving,
        0.5 * (path_length + cos2 * doubled[0] + sin2 * doubled[1]),
        0.5 * (turn_total + cos2 * doubled[2] + sin2 * doubled[3]),
        path_length,
        turn_total,
    )


def _window_rows(
    stamps: Floats, odometry: Floats, delay_s: float, length_s: float
) -> tuple[Integers, Integers]:
    """The first and last row of truth of each window; windows do not overlap."""
    begin, end = max(stamps[0], odometry[0, 0]) + 1.0, min(stamps[-1], odometry[-1, 1]) - 1.0
    grid = np.arange(begin, end - length_s, length_s)
    ends = odometry[:, 1] + delay_s
    first = _row_near_odometry_end(stamps, ends, grid)
    last = _row_near_odometry_end(stamps, ends, stamps[first] + length_s)
    gaps = np.concatenate(([0], np.cumsum(np.diff(stamps) > LONGEST_GAP_S)))
    seconds = stamps[last] - stamps[first]
    good = (gaps[first] == gaps[last]) & (stamps[first] - grid < 0.5 * length_s)
    good &= (seconds > 0.75 * length_s) & (seconds < 1.5 * length_s)
    return first[good], last[good]


def _row_near_odometry_end(stamps: Floats, ends: Floats, times_s: Floats) -> Integers:
    """Of the next rows of truth, the one nearest to the end of a piece of odometry: inside a piece
    only the mean speed is known."""
    rows = np.searchsorted(stamps, times_s)[:, None] + np.arange(6)
    rows = np.minimum(rows, len(stamps) - 1)
    after = np.clip(np.searchsorted(ends, stamps[rows]), 1, len(ends) - 1)
    aside = np.minimum(np.abs(ends[after] - stamps[rows]), np.abs(stamps[rows] - ends[after - 1]))
    late = stamps[rows] - stamps[rows[:, :1]] > 0.12
    return np.asarray(rows[np.arange(len(rows)), np.argmin(np.where(late, 9.0, aside), axis=1)])


def _commanded_motion(
    odometry: Floats, stamps: Floats, heading: Floats, delay_s: float, a: Floats, b: Floats
) -> Floats:
    """The commanded motion from a to b, shape (n, 13): turn; distance, and |turn| while driving, in
    x and y along the true headings; distance; |turn| while driving; |distance|; |turn|; the last
    two times cos and sin of twice the heading.
    """
    from_s, until_s, distance, turn = odometry.T
    direction = np.interp(0.5 * (from_s + until_s) + delay_s, stamps, heading)
    c, s = np.cos(direction), np.sin(direction)
    displacement, turn_total = np.abs(distance), np.abs(turn)
    cos2, sin2 = np.cos(2.0 * direction), np.sin(2.0 * direction)
    lost = np.sign(distance) * turn_total
    distance_along = [distance * c, distance * s, lost * c, lost * s]
    doubled = [displacement * cos2, displacement * sin2, turn_total * cos2, turn_total * sin2]
    pieces = np.stack([turn, *distance_along, distance, lost, displacement, turn_total, *doubled])
    knots = np.stack([from_s, until_s], axis=1).ravel() + delay_s
    totals = np.cumsum(pieces, axis=1)
    levels = np.stack([totals - pieces, totals], axis=2).reshape(len(pieces), -1)
    sums = [np.interp(b, knots, level) - np.interp(a, knots, level) for level in levels]
    return np.stack(sums, axis=1)


def odometry_delay_s(logs: Sequence[RobotLog]) -> float:
    """The delay (s) on a grid with the best fit of turns and displacements, each with its scale."""
    costs = []
    for delay_s in DELAYS_S:
        rows = odometry_windows(logs, float(delay_s), WINDOW_S)
        ways, cost = (rows.displacement, rows.true_displacement), 0.0
        for reading, true in ((rows.turn, rows.true_turn), ways):
            moving = np.abs(reading) > MIN_MOTION
            if moving.sum() >= MIN_ROWS // 2:
                scale = robust_fit(reading[moving, None], true[moving])[0]
                error = float(np.abs(true[moving] - scale * reading[moving]).mean())
                cost += moving.sum() * math.log(max(error, 1e-9))
        costs.append(cost)
    return float(DELAYS_S[int(np.argmin(costs))])


def odometry_fit(rows: OdometryWindows, now: OdometryCorrections, noise: Floats) -> LinearFit:
    """Moving windows as rows of a fit of `CORRECTIONS`, in units of their sigma.

    The scales are fitted as differences from 1, the delay as a difference from the present one.
    `noise`: see `odometry_noise`.
    """
    way = noise[0] * now.distance_scale * rows.distance_along
    way += noise[1] * now.turn_scale * rows.turn_along
    turn = noise[2] * now.turn_scale * rows.turn_total
    turn += noise[3] * now.distance_scale * rows.path_length
    way_sigma = np.sqrt(np.maximum(way + noise[4], 1e-12))
    turn_sigma = np.sqrt(np.maximum(turn + noise[5], 1e-12))
    ways, turns = np.abs(rows.displacement) > MIN_MOTION, np.abs(rows.turn) > MIN_MOTION
    turns |= np.abs(rows.distance) > MIN_MOTION
    of_ways, of_turns = np.zeros((ways.sum(), 5)), np.zeros((turns.sum(), 5))
    of_ways[:, 0] = rows.displacement[ways]
    of_ways[:, 2] = now.distance_scale * rows.displacement_rate[ways]
    of_ways[:, 3] = -rows.loss[ways]
    of_turns[:, 1], of_turns[:, 2] = rows.turn[turns], now.turn_scale * rows.turn_rate[turns]
    of_turns[:, 4] = now.distance(rows)[turns]
    way_errors = ((rows.true_displacement - rows.displacement) / way_sigma)[ways]
    turn_errors = ((rows.true_turn - rows.turn) / turn_sigma)[turns]
    way_fit = LinearFit(rows.stretch[ways], of_ways / way_sigma[ways, None], way_errors)
    turn_fit = LinearFit(rows.stretch[turns], of_turns / turn_sigma[turns, None], turn_errors)
    return join_rows([way_fit, turn_fit])


def odometry_noise(windows: Sequence[OdometryWindows], now: OdometryCorrections) -> Floats:
    """Variances from the growth of the residuals, shape (2, 6) as of `variance_components`.

    They are those of `NOISE`, and the constants (m^2, rad^2), which are errors of the truth. Long
    windows are few and get a larger weight, because they show errors that are correlated for
    seconds.
    """
    rows = join_rows(windows)
    along, path = now.distance_scale * rows.distance_along, now.distance_scale * rows.path_length
    turned_along, turned = now.turn_scale * rows.turn_along, now.turn_scale * rows.turn_total
    ways, turns = rows.true_displacement - now.displacement(rows), rows.true_turn - now.turn(rows)
    sizes, one = [len(w.path_length) for w in windows], np.ones_like(path)
    weights = np.repeat([sizes[0] / max(n, 1) for n in sizes], sizes)
    moving = (path > MIN_MOTION) | (turned > MIN_MOTION)
    of_ways, of_turns = (
        _covering_variances(errors[moving], np.stack(columns, axis=1)[moving], weights[moving])
        for errors, columns in ((ways, (along, turned_along, one)), (turns, (turned, path, one)))
    )
    return np.hstack([of_ways, of_turns])[:, [0, 1, 3, 4, 2, 5]]


def _covering_variances(errors: Floats, columns: Floats, weights: Floats) -> Floats:
    """Variance components, increased if windows of one length (they share a weight) have larger
    errors: correlated drift grows faster than the root of the distance, and tails are heavy."""
    parts = variance_components(errors, columns, weights)
    if np.isnan(parts).any():
        return parts
    unit = np.minimum(errors**2 / np.maximum(columns @ parts[0], 1e-12), OUTLIER_SIGMAS**2)
    return parts * max(1.0, *(float(unit[weights == w].mean()) for w in np.unique(weights)))


class OdometryFit(NamedTuple):
    """The best corrections, and the data of their fit."""

    now: OdometryCorrections
    known: Mask  # of `CORRECTIONS`
    fit: LinearFit
    windows: Sequence[OdometryWindows]  # of `NOISE_WINDOWS_S`


def calibrate_odometry(
    logs: Sequence[RobotLog],
) -> tuple[dict[str, Estimate], OdometryFit | None]:
    """Values named as in `OdometrySettings`, if the logs determine them, and their fit."""
    if not (logs := [log for log in logs if len(log.odometry)]):
        return {}, None
    found = _fit_corrections(logs, OdometryCorrections(1.0, 1.0, odometry_delay_s(logs), 0.0, 0.0))
    crawling: dict[str, Estimate | None] = {}
    if found and (least_speed := estimate_least_speed(logs, found.now)):
        speed = least_speed.value / found.now.distance_scale
        crawl_noise = estimate_crawl_noise(logs, found.now, speed)
        crawling = {"least_speed_m_s": least_speed, CRAWL_NOISE: crawl_noise}
        found = _fit_corrections([with_least_speed(log, speed) for log in logs], found.now)
    if found is None:
        return {}, None
    now, known, fit, windows = found
    changes = jackknife(lambda keep: solve(select_rows(fit, keep(fit.stretch)), known), fit.stretch)
    values = [Estimate(v, c.standard_error) for v, c in zip(now, changes, strict=True)]
    grown = sigma_estimates(
        lambda keep: odometry_noise([select_rows(w, keep(w.stretch)) for w in windows], now),
        windows[0].stretch,
    )
    result = {name: v for name, v, k in zip(CORRECTIONS, values, known, strict=True) if k}
    result |= {name: estimate for name, estimate in crawling.items() if estimate is not None}
    return result | dict(zip(NOISE, grown, strict=False)), found


def _fit_corrections(logs: Sequence[RobotLog], now: OdometryCorrections) -> OdometryFit | None:
    """The corrections that fit best; None if the robot moved too little."""
    for _ in range(REFINEMENTS):
        windows = [odometry_windows(logs, now.delay_s, length_s) for length_s in NOISE_WINDOWS_S]
        noise = odometry_noise(windows, now)
        if np.isnan(noise).all():
            return None
        rows = odometry_windows(logs, now.delay_s, WINDOW_S)
        fit = odometry_fit(rows, now, np.nan_to_num(noise[0]))
        known = determined_coefficients(fit.columns, CORRECTIONS.values())
        scale, turn_scale, later_s, loss, bias = solve(fit, known).tolist()
        delay_s = now.delay_s + min(max(later_s, -MOST_STEP_S), MOST_STEP_S) if known[2] else 0.0
        now = OdometryCorrections(1.0 + scale, 1.0 + turn_scale, delay_s, max(loss, 0.0), bias)
    return OdometryFit(now, known, fit, windows)


def turn_residuals(logs: Sequence[RobotLog], turn_scale: float) -> Floats:
    """Mean absolute error of the turn in a window, rad, for each of `DELAYS_S`."""
    windows = [odometry_windows(logs, float(delay_s), WINDOW_S) for delay_s in DELAYS_S]
    return np.array([np.abs(w.true_turn - turn_scale * w.turn).mean() for w in windows])


LEAST_SPEEDS_M_S = np.arange(0.0, 0.0501, 0.001)
MAX_ERROR_M = 0.1  # a larger error of a displacement has other causes than a dead zone
SIGNIFICANT_SIGMAS = 3.0  # standard errors
MIN_CRAWL_SHARE = 0.7  # of the time of a window that counts as slow
MIN_CRAWL_WINDOWS = 8  # windows of one length
CRAWL_NOISE = "crawl_sigma_m_per_sqrt_s"


def estimate_least_speed(logs: Sequence[RobotLog], now: OdometryCorrections) -> Estimate | None:
    """The speed (m/s) of a robot that is commanded to drive slower, if the logs determine it. It is
    the speed on a grid with the best fit of the displacements."""
    each = []
    for speed in LEAST_SPEEDS_M_S / now.distance_scale:
        driven = [with_least_speed(log, speed) for log in logs]
        rows = odometry_windows(driven, now.delay_s, WINDOW_S)
        each.append(_displacement_errors_m(rows, now))
    stretch, errors = rows.stretch, np.array(each)
    slow = np.ptp(errors, axis=0) > 0.0
    if slow.sum() < MIN_ROWS // 2:
        return None

    def best(keep: RowFilter) -> Floats:
        cost = errors[:, keep(stretch) & slow].sum(axis=1)
        return LEAST_SPEEDS_M_S[[int(np.argmin(cost))]]

    (found,) = jackknife(best, stretch)
    step = float(LEAST_SPEEDS_M_S[1])
    found = Estimate(found.value, max(found.standard_error, step / math.sqrt(12.0)))
    return found if found.value > SIGNIFICANT_SIGMAS * found.standard_error else None


def with_least_speed(log: RobotLog, speed_m_s: float) -> RobotLog:
    """The log with this speed in place of each lower commanded speed other than 0."""
    odometry = log.odometry.copy()
    slow, seconds = _slow_pieces(log, speed_m_s)
    odometry[slow, 2] = np.copysign(speed_m_s * seconds, log.odometry[:, 2])[slow]
    return log._replace(odometry=odometry)


def _slow_pieces(log: RobotLog, speed_m_s: float) -> tuple[Mask, Floats]:
    """Which pieces of odometry are slower than this but not 0, and their lengths (s)."""
    from_s, until_s, distance, _ = log.odometry.T
    seconds = until_s - from_s
    return (distance != 0.0) & (np.abs(distance) < speed_m_s * seconds), seconds


def _displacement_errors_m(rows: OdometryWindows, now: OdometryCorrections) -> Floats:
    return np.minimum(np.abs(rows.true_displacement - now.displacement(rows)), MAX_ERROR_M)


def estimate_crawl_noise(
    logs: Sequence[RobotLog], now: OdometryCorrections, speed_m_s: float
) -> Estimate | None:
    """The error of the displacement (m per root of a second) while the robot drives at its least
    speed, because the commanded (reported) speed is below this; None if that is rare.

    The windows of the length with the largest error determine it.
    """
    crawl_windows = []  # of each length: stretches, squares of errors, seconds at the least speed
    for length_s in NOISE_WINDOWS_S:
        driven, only = (
            odometry_windows([change(log, speed_m_s) for log in logs], now.delay_s, length_s)
            for change in (with_least_speed, _with_slow_seconds)
        )
        slow = only.path_length > MIN_CRAWL_SHARE * length_s
        if slow.sum() >= MIN_CRAWL_WINDOWS:
            square_m2 = _displacement_errors_m(driven, now) ** 2
            crawl_windows.append((driven.stretch[slow], square_m2[slow], only.path_length[slow]))
    if not crawl_windows:
        return None

    def variance(keep: RowFilter) -> Floats:
        each = []
        for stretch, square_m2, seconds in crawl_windows:
            kept = keep(stretch)
            each.append(square_m2[kept].sum() / max(seconds[kept].sum(), 1e-9))
        return np.full((2, 1), max(each))

    return sigma_estimates(variance, crawl_windows[0][0])[0]


def _with_slow_seconds(log: RobotLog, speed_m_s: float) -> RobotLog:
    """The log with the seconds of slow pieces in place of distances."""
    slow, seconds = _slow_pieces(log, speed_m_s)
    odometry = log.odometry.copy()
    odometry[:, 2] = np.where(slow, seconds, 0.0)
    return log._replace(odometry=odometry)
