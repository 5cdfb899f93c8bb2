"""The noise of motions and readings, from the residuals of a solution.

Settings state noise with margins, or as a guess. A map that is to know how accurate it is needs
that of its own data: the variance of the residuals of each drive, divided by the share of it that
the fit leaves (Foerstner 1979), and the time for which errors to one object stay alike.
"""

from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import (
    MIN_ROWS,
    Integers,
    correlation_time_s,
    error_pairs,
)
from cpcbl_launch.mapping.problem import Problem, linearize, motion_blocks, reading_blocks
from cpcbl_launch.mapping.solve import Solution, solved_equations
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.sensors import repetition_variance_factor

PROBES = 12
LEAST_FACTOR = 0.2  # readings without any noise would have weights without bounds
LEAST_SHARE = 0.3  # of the variance that a fit leaves, below which residuals say too little
MOTION, RANGE, BEARING = range(3)


class Noise(NamedTuple):
    """Of each drive: what residuals say. NaN: too few of them."""

    factors: Floats  # (drives, 3), on the sigmas of motions, ranges, bearings
    correlation_s: Floats  # (drives, 2), of ranges and bearings
    left: Floats  # (drives, 3): the share of the variance that the fit leaves


def estimate_noise(problem: Problem, solution: Solution, seed: int = 0) -> Noise:
    """The noise of each drive."""
    left = _left_shares(problem, solution, seed)
    factors, correlation = (
        np.full((problem.drives, 3), np.nan),
        np.full((problem.drives, 2), np.nan),
    )
    motions = motion_blocks(problem, solution.x).residuals * solution.weights.motions[:, None]
    errors, readings = reading_blocks(problem, solution.x).residuals, problem.readings
    weight = solution.weights.readings**2
    measured = np.isfinite(np.stack([readings.range_m, readings.bearing], axis=1))
    objects = np.where(readings.mate >= 0, -1, readings.landmark)
    for drive in range(problem.drives):
        for kind in (0, 1):
            mine = (readings.drive == drive) & measured[:, kind]
            if mine.sum() < MIN_ROWS or left[drive, 1 + kind] < LEAST_SHARE:
                continue
            square = np.sum(weight[mine] * errors[mine, kind] ** 2) / np.sum(weight[mine])
            found = float(np.sqrt(square / left[drive, 1 + kind]))
            factors[drive, 1 + kind] = max(found, LEAST_FACTOR)
            stretch = np.zeros(mine.sum(), np.int64)
            unit = errors[mine, kind] / max(float(np.sqrt(square)), 1e-9)
            pairs = error_pairs(stretch, readings.stamp_s[mine], objects[mine], [unit])
            correlation[drive, kind] = correlation_time_s(pairs)
    return Noise(factors, correlation, left)


def _left_shares(problem: Problem, solution: Solution, seed: int) -> Floats:
    """The mean of 1 - leverage over the rows of each drive, shape (drives, 3), by random probes
    (Hutchinson 1990): E[z^T K z] over signs z is the trace of K, and of each part of it."""
    linear = linearize(problem, solution.x, solution.weights)
    equations = solved_equations(problem, solution)
    signs = np.random.default_rng(seed).choice((-1.0, 1.0), (len(linear.residuals), PROBES))
    smoothed = linear.jacobian @ equations.solve(linear.jacobian.T @ signs)
    leverage = np.mean(signs * smoothed, axis=1)
    motions, readings = problem.motions, problem.readings
    split = 3 * len(motions.pose)
    of_readings = leverage[split : split + 2 * len(readings.pose)].reshape(-1, 2)
    measured = np.isfinite(np.stack([readings.range_m, readings.bearing], axis=1))
    result = np.ones((problem.drives, 3))
    for drive in range(problem.drives):
        mine = motions.drive == drive
        if mine.any():
            result[drive, MOTION] -= leverage[:split].reshape(-1, 3)[mine].mean()
        for kind in (0, 1):
            rows = (readings.drive == drive) & measured[:, kind]
            if rows.any():
                result[drive, 1 + kind] -= of_readings[rows, kind].mean()
    return result


def with_noise(problem: Problem, noise: Noise) -> Problem:
    """The problem with this noise; what is NaN stays as it is."""
    factors = np.where(np.isfinite(noise.factors), noise.factors, 1.0)
    motions, readings = problem.motions, problem.readings
    whitening = motions.whitening / factors[motions.drive, MOTION][:, None, None]
    inflations = [
        _inflation(
            readings.drive, _objects(problem), readings.stamp_s, noise.correlation_s[:, k], old
        )
        for k, old in enumerate((readings.range_inflation, readings.bearing_inflation))
    ]
    return problem._replace(
        motions=motions._replace(whitening=whitening),
        readings=readings._replace(
            range_sigma=readings.range_sigma * factors[readings.drive, RANGE],
            bearing_sigma=readings.bearing_sigma * factors[readings.drive, BEARING],
            range_inflation=inflations[0],
            bearing_inflation=inflations[1],
        ),
    )


def _objects(problem: Problem) -> Integers:
    """A number of the object of each reading: the landmark, or the drive of the robot."""
    readings = problem.readings
    of_pose = np.zeros(problem.poses, np.int64)
    of_pose[problem.motions.pose] = of_pose[problem.motions.pose + 1] = problem.motions.drive
    mate = of_pose[np.maximum(readings.mate, 0)]
    return np.where(readings.mate >= 0, -1 - mate, readings.landmark)


def _inflation(
    drive: Integers, objects: Integers, stamp_s: Floats, correlation_s: Floats, old: Floats
) -> Floats:
    """The factors on variances by these correlation times (drives,); the old ones for NaN."""
    result = old.copy()
    last: dict[tuple[int, int], float] = {}
    for i in np.argsort(stamp_s, kind="stable").tolist():
        key, now = (int(drive[i]), int(objects[i])), float(stamp_s[i])
        time_s = float(correlation_s[key[0]])
        if np.isfinite(time_s):
            before = last.get(key)
            result[i] = repetition_variance_factor(None if before is None else now - before, time_s)
        last[key] = now
    return result
