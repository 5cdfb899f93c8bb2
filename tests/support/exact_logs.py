"""Logs without any error, which tests change."""

import math

import numpy as np

from cpcbl_launch.calibration.logs import RobotLog


def circling(turn_rate: float = 0.3, speed: float = 0.3, seconds: float = 100.0) -> RobotLog:
    """An exact drive, one landmark in its midst, sightings at 5 Hz."""
    times = np.arange(0.0, seconds, 0.02)
    heading = turn_rate * times
    radius = speed / turn_rate if turn_rate else 0.0
    x, y = radius * np.sin(heading), radius * (1.0 - np.cos(heading))
    truth = np.stack([times, x, y, (heading + math.pi) % math.tau - math.pi], axis=1)
    from_s = times[:-1:5]
    step = np.full_like(from_s, 0.1)
    odometry = np.stack([from_s, from_s + 0.1, speed * step, turn_rate * step], axis=1)
    rows = slice(0, None, 10)
    dx, dy = 3.0 - x[rows], 1.0 - y[rows]
    bearing = np.arctan2(dy, dx) - heading[rows]
    bearing = (bearing + math.pi) % math.tau - math.pi
    seen = np.stack([times[rows], np.zeros_like(dx), np.hypot(dx, dy), bearing], axis=1)
    return RobotLog(truth, odometry, seen, (np.array([[0.0, 3.0, 1.0]]),))
