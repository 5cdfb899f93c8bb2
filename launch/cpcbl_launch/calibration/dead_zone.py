"""Motors' dead zone: the speed below which a robot does not drive, and how it errs there."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.robot_log import RobotLog
from cpcbl_launch.calibration.statistics import (
    LEAST_ROWS,
    Estimate,
    Integers,
    Keep,
    Mask,
    jackknife,
    kept,
    sigmas,
)
from cpcbl_launch.calibration.windows import (
    NOISE_WINDOWS_S,
    WINDOW_S,
    Corrections,
    odometry_rows,
)
from cpcbl_launch.reporting.metrics import Floats

LEAST_SPEEDS_M_S = np.arange(0.0, 0.0501, 0.001)
SLIPPED_M = 0.1  # a way that errs more than this in a window is no matter of a dead zone
SURE = 3.0  # standard errors
CRAWLED = 0.7  # of a window, to tell how crawling errs
CRAWLS = 8  # windows of one length
CRAWL_NOISE = "crawl_sigma_m_per_sqrt_s"


def least_speed(logs: Sequence[RobotLog], now: Corrections) -> Estimate | None:
    """The speed (m/s) at which it drives when told to drive slower, if the logs tell it: that on
    a grid with which ways fit best.
    """
    told = [speed / now.distance_scale for speed in LEAST_SPEEDS_M_S]
    rows = [
        odometry_rows([no_slower(log, speed) for log in logs], now.delay_s, WINDOW_S)
        for speed in told
    ]
    stretch = rows[0].stretch
    errors = np.minimum([np.abs(r.true_way - now.ways(r)) for r in rows], SLIPPED_M)
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
    slow, seconds = _slow(log, speed_m_s)
    odometry[slow, 2] = np.copysign(speed_m_s * seconds, log.odometry[:, 2])[slow]
    return log._replace(odometry=odometry)


def _slow(log: RobotLog, speed_m_s: float) -> tuple[Mask, Floats]:
    """Which pieces of odometry are slower than this, but do not stand; how long each is."""
    from_s, until_s, distance, _ = log.odometry.T
    seconds = until_s - from_s
    return (distance != 0.0) & (np.abs(distance) < speed_m_s * seconds), seconds


class _Crawls(NamedTuple):
    """Windows in which a robot mostly crawled. Shapes (n,)."""

    stretch: Integers
    square_m2: Floats  # of the error of its way
    seconds: Floats  # crawled


def crawl_noise(logs: Sequence[RobotLog], now: Corrections, speed_m_s: float) -> Estimate | None:
    """How far the way errs for a root of a second while the robot, told to drive slower than this
    (as reported), drives at its least speed; None where it seldom does. As in windows of the length
    that errs most.
    """
    crawls = []
    for length_s in NOISE_WINDOWS_S:
        driven, only = (
            odometry_rows([change(log, speed_m_s) for log in logs], now.delay_s, length_s)
            for change in (no_slower, _seconds_slow)
        )
        errors_m = np.minimum(np.abs(driven.true_way - now.ways(driven)), SLIPPED_M)
        rows = _Crawls(driven.stretch, errors_m**2, only.path)
        rows = kept(rows, only.path > CRAWLED * length_s)
        if len(rows.seconds) >= CRAWLS:
            crawls.append(rows)
    if not crawls:
        return None

    def variance(keep: Keep) -> Floats:
        left = [kept(rows, keep(rows.stretch)) for rows in crawls]
        each = [rows.square_m2.sum() / max(rows.seconds.sum(), 1e-9) for rows in left]
        return np.full((2, 1), max(each))

    return sigmas(variance, crawls[0].stretch)[0]


def _seconds_slow(log: RobotLog, speed_m_s: float) -> RobotLog:
    """The log with the seconds of slow pieces for distances."""
    slow, seconds = _slow(log, speed_m_s)
    odometry = log.odometry.copy()
    odometry[:, 2] = np.where(slow, seconds, 0.0)
    return log._replace(odometry=odometry)
