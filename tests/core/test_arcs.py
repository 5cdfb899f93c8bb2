"""An estimate with an uncertain heading as a Gaussian along an arc."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.core import covariance3, diagonal, matrix3, point_sighting, poses, random_matrix

from cpcbl_team.arc_fit import Scalar, best_fit, least_cost
from cpcbl_team.arcs import Arc, square_root, with_arc_width
from cpcbl_team.config import OdometryNoise
from cpcbl_team.constraints import bearing_heading, range_circle
from cpcbl_team.estimate import Estimate, Row
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.motion import move

EXACT = OdometryNoise(
    distance_sigma_m_per_sqrt_m=0.0,
    distance_sigma_m_per_sqrt_rad=0.0,
    turn_sigma_rad_per_sqrt_m=0.0,
    turn_sigma_rad_per_sqrt_rad=0.0,
)
offsets = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.5, 1.5))
seeds = st.integers(0, 2**32 - 1)


def some_arc(pose: Pose2, seed: int) -> tuple[Arc, Estimate]:
    estimate = Estimate(pose, covariance3(random_matrix(np.random.default_rng(seed), 3)))
    return Arc.of(estimate), estimate


def after_ten_metres(heading_sigma: float, position_sigma: float = 0.05) -> Estimate:
    """Straight ahead from the origin, with exact odometry."""
    begin = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(position_sigma, heading_sigma))
    return move(begin, 10.0, 0.0, EXACT)


def offset_between(a: Pose2, b: Pose2) -> Row:
    return b.x - a.x, b.y - a.y, wrap_angle(b.heading - a.heading)


@given(poses, seeds, offsets)
def test_the_jacobian_is_that_of_finite_differences(pose: Pose2, seed: int, offset: Row) -> None:
    arc, _ = some_arc(pose, seed)
    found = np.array(arc.jacobian(offset)).reshape(3, 3)
    for i in range(3):
        by = [1e-6 * (i == k) for k in range(3)]
        low = arc.at((offset[0] - by[0], offset[1] - by[1], offset[2] - by[2]))
        high = arc.at((offset[0] + by[0], offset[1] + by[1], offset[2] + by[2]))
        assert np.array(offset_between(low, high)) / 2e-6 == pytest.approx(found[:, i], abs=1e-5)


@given(poses, seeds)
def test_at_the_mean_the_arc_is_its_tangent(pose: Pose2, seed: int) -> None:
    arc, estimate = some_arc(pose, seed)
    nowhere = 0.0, 0.0, 0.0
    assert arc.at(nowhere) == pytest.approx(pose)
    there = arc.covariance.transformed(arc.jacobian(nowhere))
    assert there == pytest.approx(estimate.covariance, rel=1e-6, abs=1e-8)
    assert arc.tangent_map(nowhere) == pytest.approx((1, 0, 0, 0, 1, 0, 0, 0, 1), abs=1e-9)


@given(poses, seeds, offsets)
def test_the_prior_on_another_tangent_is_the_same_gaussian(
    pose: Pose2, seed: int, offset: Row
) -> None:
    """Its covariance is that of offset and turn, and the squared distance of the pose there from
    its mean is the cost."""
    arc, estimate = some_arc(pose, seed)
    mapped = estimate.covariance.transformed(arc.tangent_map(offset))
    by_offset = arc.covariance.transformed(arc.jacobian(offset))
    assert mapped == pytest.approx(by_offset, rel=1e-6, abs=1e-7)
    from_mean = np.array(arc.tangent_offset(offset))
    squared = from_mean @ np.linalg.solve(matrix3(by_offset), from_mean)
    assert squared == pytest.approx(arc.cost(offset), rel=1e-4, abs=1e-6)


def test_a_robot_that_drove_lies_on_the_arc_about_its_start() -> None:
    """Worked by hand: ten metres ahead with a heading that is 30 degrees to the left."""
    arc = Arc.of(after_ten_metres(0.5))
    turn = math.radians(30.0)
    there = arc.at((0.0, 0.0, turn))
    assert there == pytest.approx((10.0 * math.cos(turn), 10.0 * math.sin(turn), turn), abs=1e-9)


@pytest.mark.parametrize("heading_sigma_deg", [5.0, 20.0, 45.0])
def test_what_is_reported_holds_the_arc(heading_sigma_deg: float) -> None:
    """The mean square error along the way equals that of true poses; across it, it is not less."""
    rng = np.random.default_rng(1)
    sigma = math.radians(heading_sigma_deg)
    ends = np.array([step(Pose2(0.0, 0.0, h), 10.0, 0.0)[:2] for h in rng.normal(0, sigma, 40_000)])
    squares = np.mean((ends - [10.0, 0.0]) ** 2, axis=0)
    reported = with_arc_width(after_ten_metres(sigma, 0.0)).covariance
    assert reported.xx == pytest.approx(squares[0], rel=0.05)
    assert reported.yy > 0.97 * squares[1]


def test_a_certain_heading_or_no_way_leaves_the_estimate_as_it_is() -> None:
    for estimate in (
        Estimate(Pose2(1.0, 2.0, 3.0), diagonal(0.3, 0.5)),
        after_ten_metres(math.radians(0.9)),
    ):
        assert with_arc_width(estimate) is estimate


@given(seeds)
def test_a_square_root_of_a_covariance(seed: int) -> None:
    covariance = covariance3(random_matrix(np.random.default_rng(seed), 3))
    columns = np.array(square_root(covariance)).T
    assert columns @ columns.T == pytest.approx(matrix3(covariance), rel=1e-5, abs=1e-6)


# Fits ---------------------------------------------------------------------------------------------


def sighted(truth: Pose2, x: float, y: float, pose: Pose2) -> list[Scalar]:
    """An exact sighting of a point, as it is linear about a pose."""
    seen = point_sighting(truth, "post", x, y)
    assert seen.range_m is not None
    assert seen.bearing_rad is not None
    constraints = (
        range_circle(pose, x, y, seen.range_m, 0.01),
        bearing_heading(pose, x, y, seen.bearing_rad, 0.01),
    )
    return [(c.row, c.residual, c.sigma**2) for c in constraints if c is not None]


@settings(max_examples=50)
@given(st.floats(-0.8, 0.8))
def test_a_landmark_leads_along_the_arc(turn: float) -> None:
    """Where the truth is on the arc, it is found, and costs nothing but its turn."""
    arc = Arc.of(after_ten_metres(0.5))
    truth = arc.at((0.0, 0.0, turn))
    fit = best_fit(arc, lambda pose: sighted(truth, 12.0, 2.0, pose))
    assert fit is not None
    assert arc.at(fit.offset) == pytest.approx(truth, abs=0.02)
    assert fit.cost <= arc.cost((0.0, 0.0, turn)) + 1e-3


def test_two_poses_that_fit_as_well_are_no_answer() -> None:
    """The range to a post straight ahead does not tell left from right."""
    arc = Arc.of(after_ten_metres(0.5))
    truth = arc.at((0.0, 0.0, 0.5))
    both = best_fit(arc, lambda pose: sighted(truth, 12.0, 0.0, pose)[:1])
    assert both is None
    one = best_fit(arc, lambda pose: sighted(truth, 12.0, 0.0, pose))
    assert one is not None
    assert one.offset[2] == pytest.approx(0.5, abs=0.01)


def test_an_object_is_judged_at_the_pose_that_fits_it_best() -> None:
    """Twice the sigma of the heading aside: four, and not what a tangent would make of it."""
    arc = Arc.of(after_ten_metres(0.4))
    truth = arc.at((0.0, 0.0, 0.8))
    cost = least_cost(arc, lambda pose: sighted(truth, 12.0, 2.0, pose), 0.0)
    assert cost == pytest.approx(4.0, abs=0.05)


def test_a_pose_is_not_its_own_rival() -> None:
    """A turn to the left and one to the right by the rest of a circle."""
    arc = Arc.of(Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.05, math.radians(70.0))))
    truth = Pose2(0.0, 0.0, math.radians(170.0))
    fit = best_fit(arc, lambda pose: sighted(truth, 3.0, 1.0, pose))
    assert fit is not None
    assert arc.at(fit.offset) == pytest.approx(truth, abs=0.05)
