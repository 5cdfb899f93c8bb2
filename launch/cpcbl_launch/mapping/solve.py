"""Levenberg-Marquardt with robust weights, and the covariance of what it finds.

Sources: Triggs et al. (1999), "Bundle adjustment, a modern synthesis"; Huber (1964); the weights of
readings are Cauchy's, iterated.
"""

from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import Integers
from cpcbl_launch.mapping.normal_equations import (
    NormalEquations,
    UndeterminedError,
    elimination_order,
)
from cpcbl_launch.mapping.problem import (
    CONSTANTS,
    Linearized,
    Problem,
    Weights,
    linearize,
    motion_blocks,
    reading_blocks,
)
from cpcbl_launch.reporting.metrics import Floats

CAUCHY_SIGMAS = 3.0  # of a reading; a Gaussian one keeps 90 % of its information
HUBER_SIGMAS = 4.0  # of a motion: a wheel that slips is rare
ITERATIONS = 60
CONVERGED_M = 1e-4  # the largest step of a landmark
LEAST_DAMPING, MOST_DAMPING = 1e-15, 1e9  # near pairs hardly hold the whole map's direction


class Solution(NamedTuple):
    """The best unknowns."""

    x: Floats
    weights: Weights
    cost: float  # half of the sum of robust losses
    iterations: int
    converged: bool


def robust_weights(problem: Problem, x: Floats) -> tuple[Weights, float]:
    """The weights at these unknowns, and the robust cost. A reading is compared with its own sigma:
    that it resembles the one before does not make it less likely to be wrong."""
    moved = np.sqrt(np.mean(motion_blocks(problem, x).residuals ** 2, axis=1))
    blocks, readings = reading_blocks(problem, x), problem.readings
    each = blocks.residuals**2
    square, c2 = each.sum(axis=1), CAUCHY_SIGMAS**2
    deflated = each[:, 0] / readings.range_inflation + each[:, 1] / readings.bearing_inflation
    share = np.divide(deflated, square, out=np.ones_like(square), where=square > 0.0)
    loss = float(np.sum(share * c2 * np.log1p(square / c2)))
    huber = np.minimum(1.0, HUBER_SIGMAS / np.maximum(moved, 1e-12))
    small = np.minimum(moved, HUBER_SIGMAS)
    loss += float(np.sum(3.0 * small * (2.0 * moved - small)))
    loss += float(np.sum(problem.priors.residuals(x) ** 2))
    return Weights(np.sqrt(huber), 1.0 / np.sqrt(1.0 + square / c2)), 0.5 * loss


def solve(problem: Problem, start: Floats, least_step_m: float = CONVERGED_M) -> Solution:
    """The unknowns with the least robust cost near `start`, shape (unknowns,). It ends when a step
    moves no landmark or wall by `least_step_m` (m; the direction of a wall in rad)."""
    x, damping, order = start.copy(), 1e-4, elimination_order(problem)
    weights, cost = robust_weights(problem, x)
    places = slice(problem.landmark_column(), problem.constant_column())
    for iteration in range(1, ITERATIONS + 1):
        linear = linearize(problem, x, weights)
        gradient = linear.jacobian.T @ linear.residuals
        while True:
            step = _step(linear, order, damping, gradient)
            trial_weights, trial_cost = robust_weights(problem, x + step)
            if trial_cost <= cost or damping > MOST_DAMPING:
                break
            damping *= 10.0
        gained = cost - trial_cost
        if gained >= 0.0:
            x, weights, cost = x + step, trial_weights, trial_cost
        damping = max(damping * 0.05, LEAST_DAMPING)
        small = np.abs(step[places]).max(initial=0.0) < least_step_m and damping < 1.0
        if small or gained < 1e-9 * (1e-6 + cost):
            return Solution(x, weights, cost, iteration, True)
    return Solution(x, weights, cost, ITERATIONS, False)


def solved_equations(problem: Problem, solution: Solution) -> NormalEquations:
    """The normal equations at the solution, whose inverse is the covariance of all unknowns."""
    linear = linearize(problem, solution.x, solution.weights)
    return NormalEquations(linear, elimination_order(problem), 0.0)


def _step(
    linear: Linearized, order: tuple[Integers, Integers], damping: float, gradient: Floats
) -> Floats:
    """The step with this damping; none where the equations need more of it. Raises
    UndeterminedError where none is enough."""
    try:
        return -NormalEquations(linear, order, damping).solve(gradient)
    except UndeterminedError:
        if damping > MOST_DAMPING:
            raise
        return np.full_like(gradient, np.nan)


class Covariances(NamedTuple):
    """What a solution says of its own accuracy."""

    places: Floats  # (2 (landmarks + walls), the same): x, y; then offset, direction of walls
    constants: Floats  # (drives, 4): sigmas of the constant errors
    information: Floats  # of the border: the inverse of its covariance; it ends with these two


def covariances(problem: Problem, solution: Solution) -> Covariances:
    """The covariance of all landmarks and walls, and the sigmas of the constant errors."""
    equations = solved_equations(problem, solution)
    border = equations.border_covariance()
    first = len(border) - (problem.size - problem.landmark_column())
    middle = first + 2 * (problem.landmarks + problem.walls)
    constants = np.sqrt(np.maximum(np.diag(border)[middle:], 0.0)).reshape(-1, CONSTANTS)
    return Covariances(border[first:middle, first:middle], constants, equations.information)
