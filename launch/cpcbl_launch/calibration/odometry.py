"""How a robot's odometry errs: windows of a drive against true poses.

Windows of a few seconds tell the corrections, longer ones how the noise grows.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.dead_zone import CRAWL_NOISE, crawl_noise, least_speed, no_slower
from cpcbl_launch.calibration.robot_log import RobotLog
from cpcbl_launch.calibration.statistics import (
    GROSS,
    LEAST_ROWS,
    Estimate,
    Fit,
    Mask,
    jackknife,
    kept,
    robust_fit,
    sigmas,
    solved,
    told,
    variance_parts,
)
from cpcbl_launch.calibration.windows import (
    NOISE_WINDOWS_S,
    WINDOW_S,
    Corrections,
    OdometryRows,
    odometry_rows,
)
from cpcbl_launch.reporting.metrics import Floats

LEAST_MOTION = 0.02  # m or rad in a window; less tells nothing of scales
DELAYS_S = np.arange(0.0, 1.001, 0.02)
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
    what is constant (m^2, rad^2): the truth's own errors. Long windows, of which there are few,
    weigh more: what is alike for seconds tells in them.
    """

    def joined(name: str) -> Floats:
        return np.concatenate([getattr(w, name) for w in windows])

    along, path = now.distance_scale * joined("along"), now.distance_scale * joined("path")
    turned_along, turned = (now.turn_scale * joined(n) for n in ("turned_along", "turned"))
    ways = np.concatenate([w.true_way - now.ways(w) for w in windows])
    turns = np.concatenate([w.true_turn - now.turns(w) for w in windows])
    one = np.ones_like(path)
    sizes = [len(w.path) for w in windows]
    weights = np.concatenate([np.full(n, sizes[0] / max(n, 1)) for n in sizes])
    moving = (path > LEAST_MOTION) | (turned > LEAST_MOTION)
    of_ways, of_turns = (
        _covering(errors[moving], np.stack(columns, axis=1)[moving], weights[moving])
        for errors, columns in ((ways, (along, turned_along, one)), (turns, (turned, path, one)))
    )
    return np.concatenate([of_ways, of_turns], axis=1)[:, [0, 1, 3, 4, 2, 5]]


def _covering(errors: Floats, columns: Floats, weights: Floats) -> Floats:
    """Variance parts, grown where windows of one length (they share a weight) err by more: drift
    that is alike for seconds grows faster than the root of the way, and tails are heavy."""
    parts = variance_parts(errors, columns, weights)
    if np.isnan(parts).any():
        return parts
    unit = errors**2 / np.maximum(columns @ parts[0], 1e-12)
    worst = max(float(np.minimum(unit[weights == w], GROSS**2).mean()) for w in np.unique(weights))
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
    crawl = None
    if found is not None and least is not None:
        speed = least.value / found.now.distance_scale
        crawl = crawl_noise(logs, found.now, speed)
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
    if crawl is not None:
        result[CRAWL_NOISE] = crawl
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
