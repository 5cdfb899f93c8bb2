"""The noise of readings, from the residuals of a solution.

Settings state noise with margins, or as a guess. A map that is to know how accurate it is needs
that of its own data: the variance of the residuals of each drive, divided by the share of it that
the fit leaves (Foerstner 1979), and the time for which errors to one object stay alike. The noise
of odometry stays as it is stated: a fit follows the odometry so closely that its residuals say
little of it.
"""

from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import (
    MIN_ROWS,
    Integers,
    Mask,
    correlation_time_s,
    error_pairs,
)
from cpcbl_launch.mapping.problem import Problem, Readings, linearize, reading_blocks
from cpcbl_launch.mapping.solve import Solution, solved_equations
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.sensors import repetition_variance_factor

PROBES = 12
LEAST_FACTOR = 0.2  # readings without any noise would have weights without bounds
LEAST_SHARE = 0.3  # of the variance that a fit leaves, below which residuals say too little
RANGE, BEARING = range(2)


class Noise(NamedTuple):
    """Of the ranges and the bearings of each drive, shapes (drives, 2). NaN: too few of them."""

    factors: Floats  # on their sigmas
    correlation_s: Floats
    left: Floats  # the share of their variance that the fit leaves


def estimate_noise(problem: Problem, solution: Solution, seed: int = 0) -> Noise:
    """The noise of each drive."""
    left = _left_shares(problem, solution, seed)
    factors, correlation = np.full_like(left, np.nan), np.full_like(left, np.nan)
    errors, readings = reading_blocks(problem, solution.x).residuals, problem.readings
    weight, measured, objects = (
        solution.weights.readings**2,
        _has_reading(problem),
        _objects(problem),
    )
    for drive in range(problem.drives):
        for kind in (RANGE, BEARING):
            mine = (readings.drive == drive) & measured[:, kind]
            if mine.sum() < MIN_ROWS or left[drive, kind] < LEAST_SHARE:
                continue
            square = np.sum(weight[mine] * errors[mine, kind] ** 2) / np.sum(weight[mine])
            found = float(np.sqrt(square / left[drive, kind]))
            factors[drive, kind] = max(found, LEAST_FACTOR)
            unit = errors[mine, kind] / max(float(np.sqrt(square)), 1e-9)
            stretch = np.zeros(int(mine.sum()), np.int64)
            pairs = error_pairs(stretch, readings.stamp_s[mine], objects[mine], [unit])
            correlation[drive, kind] = correlation_time_s(pairs)
    return Noise(factors, correlation, left)


def _has_reading(problem: Problem) -> Mask:
    """Which ranges and bearings were measured, shape (s, 2)."""
    readings = problem.readings
    return np.isfinite(np.stack([readings.range_m, readings.bearing], axis=1))


def _left_shares(problem: Problem, solution: Solution, seed: int) -> Floats:
    """The mean of 1 - leverage over the readings of each drive, shape (drives, 2), by random probes
    (Hutchinson 1990): E[z^T K z] over signs z is the trace of K, and of each part of it."""
    linear = linearize(problem, solution.x, solution.weights)
    equations = solved_equations(problem, solution)
    signs = np.random.default_rng(seed).choice((-1.0, 1.0), (len(linear.residuals), PROBES))
    smoothed = linear.jacobian @ equations.solve(linear.jacobian.T @ signs)
    leverage = np.mean(signs * smoothed, axis=1)
    readings, measured = problem.readings, _has_reading(problem)
    first = 3 * len(problem.motions.pose)
    of_readings = leverage[first : first + 2 * len(readings.pose)].reshape(-1, 2)
    result = np.ones((problem.drives, 2))
    for drive in range(problem.drives):
        for kind in (RANGE, BEARING):
            rows = (readings.drive == drive) & measured[:, kind]
            if rows.any():
                result[drive, kind] -= of_readings[rows, kind].mean()
    return result


def with_noise(problem: Problem, noise: Noise) -> Problem:
    """The problem with this noise; what is NaN stays as it is."""
    factors = np.where(np.isfinite(noise.factors), noise.factors, 1.0)
    readings, objects = problem.readings, _objects(problem)
    inflations = [
        _inflation(readings, objects, noise.correlation_s[:, kind], old)
        for kind, old in enumerate((readings.range_inflation, readings.bearing_inflation))
    ]
    return problem._replace(
        readings=readings._replace(
            range_sigma=readings.range_sigma * factors[readings.drive, RANGE],
            bearing_sigma=readings.bearing_sigma * factors[readings.drive, BEARING],
            range_inflation=inflations[RANGE],
            bearing_inflation=inflations[BEARING],
        )
    )


def _objects(problem: Problem) -> Integers:
    """A number of the object of each reading: the landmark, the wall, or the drive of the robot."""
    readings = problem.readings
    of_pose = np.zeros(problem.poses, np.int64)
    of_pose[problem.motions.pose] = of_pose[problem.motions.pose + 1] = problem.motions.drive
    mate = of_pose[np.maximum(readings.mate, 0)]
    places = np.where(readings.wall >= 0, problem.landmarks + readings.wall, readings.landmark)
    return np.where(readings.mate >= 0, -1 - mate, places)


def _inflation(readings: Readings, objects: Integers, correlation_s: Floats, old: Floats) -> Floats:
    """The factors on variances by these correlation times (drives,); the old ones for NaN."""
    result, last = old.copy(), dict[tuple[int, int], float]()
    for i in np.argsort(readings.stamp_s, kind="stable").tolist():
        key, now_s = (int(readings.drive[i]), int(objects[i])), float(readings.stamp_s[i])
        time_s, before_s = float(correlation_s[key[0]]), last.get(key)
        if np.isfinite(time_s):
            since_s = None if before_s is None else now_s - before_s
            result[i] = repetition_variance_factor(since_s, time_s)
        last[key] = now_s
    return result
