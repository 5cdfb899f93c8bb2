"""The least squares problem: derivatives, elimination and noise-free worlds."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.mapped_worlds import exact_walls
from support.mapping_worlds import ROOM, make_world

from cpcbl_launch.mapping.align import Rigid, fit_rigid
from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import build_map
from cpcbl_launch.mapping.normal_equations import NormalEquations, elimination_order
from cpcbl_launch.mapping.problem import (
    CONSTANTS,
    Problem,
    Weights,
    linearize,
    motion_blocks,
    reading_blocks,
)
from cpcbl_launch.mapping.solve import robust_weights
from cpcbl_launch.reporting.metrics import Floats

KNOWN = ("door", "lamp")


def small_problem(seed: int = 3) -> tuple[Problem, Floats]:
    """A problem with landmarks, walls and teammates, and unknowns that are off its solution."""
    world = make_world(seed, robots=2, seconds=8.0, walls=ROOM)
    known = {name: world.team.map.landmarks[name] for name in KNOWN}
    walls = {"south": replace(exact_walls(ROOM)["south"], sigma_m=0.1, direction_sigma_deg=1.0)}
    mapped = build_map(world.team, world.runs, Request(known, place_sigma_m=0.01, walls=walls))
    assert mapped.problem.walls >= 3
    rng = np.random.default_rng(seed)
    return mapped.problem, mapped.solution.x + 0.02 * rng.standard_normal(mapped.problem.size)


@pytest.mark.parametrize("blocks", [motion_blocks, reading_blocks])
def test_derivatives_are_those_of_finite_differences(blocks) -> None:  # type: ignore[no-untyped-def]
    problem, x = small_problem()
    exact, h = blocks(problem, x), 1e-6
    for column in range(problem.size):
        nudge = np.zeros(problem.size)
        nudge[column] = h
        numeric = (blocks(problem, x + nudge).residuals - blocks(problem, x - nudge).residuals) / (
            2.0 * h
        )
        mine = np.where((exact.columns == column)[:, None, :], exact.derivatives, 0.0).sum(axis=2)
        scale = 1.0 + np.abs(exact.derivatives).max()
        assert np.abs(numeric - mine).max() < 1e-5 * scale, column


def test_elimination_solves_the_normal_equations() -> None:
    problem, x = small_problem()
    weights = Weights(np.ones(len(problem.motions.pose)), np.ones(len(problem.readings.pose)))
    linear = linearize(problem, x, weights)
    dense = (linear.jacobian.T @ linear.jacobian).toarray()
    equations = NormalEquations(linear, elimination_order(problem), 0.0)
    right = np.random.default_rng(1).standard_normal((problem.size, 3))
    found = equations.solve(right)
    assert np.allclose(dense @ found, right, atol=1e-6 * np.abs(dense).max())
    border = elimination_order(problem)[1]
    expected = np.linalg.inv(dense)[np.ix_(border, border)]
    assert np.allclose(equations.border_covariance(), expected, rtol=1e-4, atol=1e-10)


def test_the_cost_is_that_of_the_weighted_residuals_where_these_are_small() -> None:
    problem, _ = small_problem()
    world = make_world(3, robots=2, seconds=6.0, noise=0.0)
    known = {name: world.team.map.landmarks[name] for name in KNOWN}
    exact = build_map(world.team, world.runs, Request(known, place_sigma_m=0.01))
    _, cost = robust_weights(exact.problem, exact.solution.x)
    assert cost < 1e-9 * problem.size


def test_a_shrunken_world_fits_worse() -> None:
    """Scales stand on the expected side: a map that is 2 % smaller, with the constant errors that
    explain this best, has the larger cost."""
    world = make_world(4, robots=2, noise=1.0)
    mapped = build_map(world.team, world.runs, Request({}))
    problem, x = mapped.problem, mapped.solution.x.copy()
    poses, landmarks, constants = problem.parts(x)
    poses[:, :2] *= 0.98
    landmarks *= 0.98
    constants[:, 0] += 0.02
    constants[:, 3] += 0.02
    assert robust_weights(problem, x)[1] > mapped.solution.cost
    assert x.size == 3 * problem.poses + 2 * problem.landmarks + CONSTANTS * problem.drives


def test_a_rigid_fit_finds_turn_and_shift_beside_an_outlier_and_never_mirrors() -> None:
    rng = np.random.default_rng(2)
    points, rigid = rng.uniform(-5.0, 5.0, (12, 2)), Rigid(2.3, np.array([4.0, -1.0]))
    places = rigid.points(points)
    places[4] += 3.0
    found = fit_rigid(points, places)
    assert math.isclose(found.angle, rigid.angle, abs_tol=1e-2)
    mirrored = fit_rigid(points * (1.0, -1.0), places)
    turned = mirrored.points(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    (ax, ay), (bx, by) = turned[1] - turned[0], turned[2] - turned[0]
    assert math.isclose(ax * by - ay * bx, 1.0)
