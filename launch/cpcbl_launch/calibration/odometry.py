"""How a robot's odometry errs: windows of a drive against true poses.

Conventions are those of `OdometrySettings`. A way is compared along its own direction, a turn
whole; windows of a few seconds tell the corrections, longer ones how the noise grows.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.robot_log import LONGEST_GAP_S, RobotLog
from cpcbl_launch.calibration.statistics import (
    GROSS,
    LEAST_ROWS,
    Estimate,
    Fit,
    Integers,
    Keep,
    Mask,
    jackknife,
    kept,
    robust_fit,
    sigmas,
    solved,
    stretches,
    told,
    variance_parts,
)
from cpcbl_team.metrics import Floats

WINDOW_S = 2.0
NOISE_WINDOWS_S = (1.0, 2.0, 4.0, 8.0, 16.0)
LEAST_MOTION = 0.02  # m or rad in a window; less tells nothing of scales
DELAYS_S = np.arange(0.0, 1.001, 0.02)
LEAST_SPEEDS_M_S = np.arange(0.0, 0.0501, 0.001)
SLIPPED_M = 0.1  # a way that errs more than this in a window is no matter of a dead zone
SURE = 3.0  # standard errors
NUDGE_S = 0.01
CORRECTIONS = (
    "distance_scale",
    "turn_scale",
    "delay_s",
    "distance_loss_m_per_rad",
    "turn_bias_rad_per_m",
)
LIMITS = (0.2, 0.2, 0.2, 0.1, 0.1)  # of two that a log cannot tell apart the larger stays
NOISE = (
    "distance_sigma_m_per_sqrt_m",
    "distance_sigma_m_per_sqrt_rad",
    "turn_sigma_rad_per_sqrt_rad",
    "turn_sigma_rad_per_sqrt_m",
)


class OdometryRows(NamedTuple):
    """Windows of a drive, each beside what the truth says. Shapes (n,)."""

    stretch: Integers
    turn: Floats  # commanded
    turn_rate: Floats  # by how much `turn` falls for a second of delay
    true_turn: Floats
    way: Floats  # commanded way along the true headings
    way_rate: Floats
    true_way: Floats  # the part of the true displacement along it
    loss: Floats  # the part along it of |turn| while driving
    drove: Floats  # sum of distance
    turned_driving: Floats  # sum of |turn| while driving
    along: Floats  # sum of |distance| that errs along it: times cos^2 of the direction between
    turned_along: Floats  # the same of |turn|
    path: Floats  # sum of |distance|
    turned: Floats  # sum of |turn|


class Corrections(NamedTuple):
    """Present values by the names of `OdometrySettings`."""

    distance_scale: float
    turn_scale: float
    delay_s: float
    loss: float
    bias: float

    def ways(self, rows: OdometryRows) -> Floats:
        return np.asarray(self.distance_scale * rows.way - self.loss * rows.loss)

    def turns(self, rows: OdometryRows) -> Floats:
        return np.asarray(self.turn_scale * rows.turn + self.bias * self.drove(rows))

    def drove(self, rows: OdometryRows) -> Floats:
        return np.asarray(self.distance_scale * rows.drove - self.loss * rows.turned_driving)


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
    turn, px, py, lx, ly, drove, turned_driving, path, turned, *doubled = now.T
    way = np.hypot(px, py)
    still = way < 1e-3
    ux = np.where(still, np.cos(heading[first]), px / np.maximum(way, 1e-9))
    uy = np.where(still, np.sin(heading[first]), py / np.maximum(way, 1e-9))
    rate = (after - before) / (2.0 * NUDGE_S)
    cos2, sin2 = ux * ux - uy * uy, 2.0 * ux * uy
    return OdometryRows(
        stretches(a, stamps, number),
        turn,
        rate[:, 0],
        heading[last] - heading[first],
        ux * px + uy * py,
        ux * rate[:, 1] + uy * rate[:, 2],
        ux * (x[last] - x[first]) + uy * (y[last] - y[first]),
        ux * lx + uy * ly,
        drove,
        turned_driving,
        0.5 * (path + cos2 * doubled[0] + sin2 * doubled[1]),
        0.5 * (turned + cos2 * doubled[2] + sin2 * doubled[3]),
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
    """What was commanded from a to b, shape (n, 13): turn; way, and |turn| while driving, in x and
    y along the true headings; way; |turn| while driving; |way|; |turn|; both times cos and sin of
    twice the heading.
    """
    from_s, until_s, distance, turn = odometry.T
    direction = np.interp(0.5 * (from_s + until_s) + delay_s, stamps, heading)
    c, s, way, turned = np.cos(direction), np.sin(direction), np.abs(distance), np.abs(turn)
    cos2, sin2 = np.cos(2.0 * direction), np.sin(2.0 * direction)
    lost = np.sign(distance) * turned
    along = [distance * c, distance * s, lost * c, lost * s]
    doubled = [way * cos2, way * sin2, turned * cos2, turned * sin2]
    pieces = np.stack([turn, *along, distance, lost, way, turned, *doubled])
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


def least_speed(logs: Sequence[RobotLog], now: Corrections) -> Estimate | None:
    """The speed (m/s) at which it drives when told to drive slower, if the logs tell it: that on
    a grid with which ways fit best.
    """
    each, stretch = [], np.empty(0, np.int64)
    for speed in LEAST_SPEEDS_M_S:
        rows = odometry_rows(
            [no_slower(log, speed / now.distance_scale) for log in logs], now.delay_s, WINDOW_S
        )
        each.append(np.abs(rows.true_way - now.ways(rows)))
        stretch = rows.stretch
    errors = np.minimum(each, SLIPPED_M)
    slow = np.ptp(errors, axis=0) > 0.0
    if slow.sum() < LEAST_ROWS // 2:
        return None

    def best(keep: Keep) -> Floats:
        cost = errors[:, keep(stretch) & slow].sum(axis=1)
        return LEAST_SPEEDS_M_S[[int(np.argmin(cost))]]

    (found,) = jackknife(best, stretch)
    step = float(LEAST_SPEEDS_M_S[1])
    found = Estimate(found.value, max(found.standard_error, step / math.sqrt(12.0)))
    return found if found.value > SURE * found.standard_error else None


def no_slower(log: RobotLog, speed_m_s: float) -> RobotLog:
    """The log as of a robot that is never told to drive slower, but for standing."""
    odometry = log.odometry.copy()
    from_s, until_s, distance, _ = odometry.T
    slow = (distance != 0.0) & (np.abs(distance) < speed_m_s * (until_s - from_s))
    odometry[slow, 2] = np.copysign(speed_m_s * (until_s - from_s), distance)[slow]
    return log._replace(odometry=odometry)


def odometry_fit(rows: OdometryRows, now: Corrections, noise: Floats) -> Fit:
    """Moving windows as rows of a fit of `CORRECTIONS`, in units of their sigma.

    The scales are fitted as differences from 1, the delay as one from the present. `noise`: see
    `odometry_noise`.
    """
    way_sigma, turn_sigma = odometry_sigmas(rows, now, noise)
    ways, turns = np.abs(rows.way) > LEAST_MOTION, np.abs(rows.turn) > LEAST_MOTION
    turns |= np.abs(rows.drove) > LEAST_MOTION
    of_ways, of_turns = np.zeros((ways.sum(), 5)), np.zeros((turns.sum(), 5))
    of_ways[:, 0], of_ways[:, 2] = rows.way[ways], now.distance_scale * rows.way_rate[ways]
    of_ways[:, 3] = -rows.loss[ways]
    of_turns[:, 1], of_turns[:, 2] = rows.turn[turns], now.turn_scale * rows.turn_rate[turns]
    of_turns[:, 4] = now.drove(rows)[turns]
    sigma = np.concatenate([way_sigma[ways], turn_sigma[turns]])
    values = np.concatenate([(rows.true_way - rows.way)[ways], (rows.true_turn - rows.turn)[turns]])
    return Fit(
        np.concatenate([rows.stretch[ways], rows.stretch[turns]]),
        np.concatenate([of_ways, of_turns]) / sigma[:, None],
        values / sigma,
    )


def odometry_sigmas(rows: OdometryRows, now: Corrections, noise: Floats) -> tuple[Floats, Floats]:
    """Sigmas (m, rad) of the ways and turns of windows."""
    way = noise[0] * now.distance_scale * rows.along + noise[1] * now.turn_scale * rows.turned_along
    turn = noise[2] * now.turn_scale * rows.turned + noise[3] * now.distance_scale * rows.path
    return np.sqrt(np.maximum(way + noise[4], 1e-12)), np.sqrt(np.maximum(turn + noise[5], 1e-12))


def odometry_noise(windows: Sequence[OdometryRows], now: Corrections) -> Floats:
    """Variances by how residuals grow, shape (2, 6) as of `variance_parts`: those of `NOISE`, and
    what is constant (m^2, rad^2): the truth's own errors. Short and long windows weigh the same.
    """

    def joined(name: str) -> Floats:
        return np.concatenate([getattr(w, name) for w in windows])

    along, path = now.distance_scale * joined("along"), now.distance_scale * joined("path")
    turned_along, turned = (now.turn_scale * joined(n) for n in ("turned_along", "turned"))
    ways = np.concatenate([w.true_way - now.ways(w) for w in windows])
    turns = np.concatenate([w.true_turn - now.turns(w) for w in windows])
    one = np.ones_like(path)
    sizes = [len(w.path) for w in windows]
    counts = np.concatenate([np.full(n, sizes[0] / max(n, 1)) for n in sizes])
    moving = (path > LEAST_MOTION) | (turned > LEAST_MOTION)
    of_ways, of_turns = (
        _covering(errors[moving], np.stack(columns, axis=1)[moving], counts[moving])
        for errors, columns in ((ways, (along, turned_along, one)), (turns, (turned, path, one)))
    )
    return np.concatenate([of_ways, of_turns], axis=1)[:, [0, 1, 3, 4, 2, 5]]


def _covering(errors: Floats, columns: Floats, counts: Floats) -> Floats:
    """Variance parts, grown where windows of one length (they share a count) err by more: drift
    that is alike for seconds grows faster than the root of the way, and tails are heavy."""
    parts = variance_parts(errors, columns, counts)
    if np.isnan(parts).any():
        return parts
    unit = errors**2 / np.maximum(columns @ parts[0], 1e-12)
    worst = max(float(np.minimum(unit[counts == c], GROSS**2).mean()) for c in np.unique(counts))
    return parts * max(1.0, worst)


class _Fitted(NamedTuple):
    """Corrections that fit best, and what they were fitted to."""

    now: Corrections
    known: Mask  # of `CORRECTIONS`
    fit: Fit
    windows: Sequence[OdometryRows]  # of `NOISE_WINDOWS_S`


def calibrate_odometry(logs: Sequence[RobotLog]) -> dict[str, Estimate]:
    """Values by the names of `OdometrySettings`; those that the logs do not tell are missing."""
    logs = [log for log in logs if len(log.odometry)]
    if not logs:
        return {}
    found = _fitted(logs, Corrections(1.0, 1.0, odometry_delay_s(logs), 0.0, 0.0))
    least = None if found is None else least_speed(logs, found.now)
    if found is not None and least is not None:
        speed = least.value / found.now.distance_scale
        found = _fitted([no_slower(log, speed) for log in logs], found.now)
    if found is None:
        return {}
    now, known, fit, windows = found
    changes = jackknife(lambda keep: solved(kept(fit, keep(fit.stretch)), known), fit.stretch)
    values = [Estimate(v, c.standard_error) for v, c in zip(now, changes, strict=True)]
    grown = sigmas(
        lambda keep: odometry_noise([kept(w, keep(w.stretch)) for w in windows], now),
        windows[0].stretch,
    )
    result = {name: v for name, v, k in zip(CORRECTIONS, values, known, strict=True) if k}
    if least is not None:
        result["least_speed_m_s"] = least
    return result | dict(zip(NOISE, grown, strict=False))


def _fitted(logs: Sequence[RobotLog], now: Corrections) -> _Fitted | None:
    """None where too little moved."""
    for _ in range(4):
        windows = [odometry_rows(logs, now.delay_s, length_s) for length_s in NOISE_WINDOWS_S]
        noise = odometry_noise(windows, now)
        if np.isnan(noise).all():
            return None
        rows = odometry_rows(logs, now.delay_s, WINDOW_S)
        fit = odometry_fit(rows, now, np.nan_to_num(noise[0]))
        known = told(fit.columns, LIMITS)
        now = _changed(now, solved(fit, known), bool(known[2]))
    return _Fitted(now, known, fit, windows)


def _changed(now: Corrections, change: Floats, tells_delay: bool) -> Corrections:
    later_s = float(np.clip(change[2], -0.05, 0.05)) if tells_delay else -now.delay_s
    scale, turn_scale, _, loss, bias = change.tolist()
    return Corrections(1.0 + scale, 1.0 + turn_scale, now.delay_s + later_s, max(loss, 0.0), bias)


def turn_residuals(logs: Sequence[RobotLog], turn_scale: float) -> Floats:
    """Mean absolute error of the turn in a window, rad, for each of `DELAYS_S`."""
    windows = [odometry_rows(logs, float(delay_s), WINDOW_S) for delay_s in DELAYS_S]
    return np.array([np.abs(w.true_turn - turn_scale * w.turn).mean() for w in windows])
