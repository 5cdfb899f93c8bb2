import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import (
    Matrix,
    covariance3,
    diagonal,
    least_eigenvalue,
    matrix3,
    poses,
    random_matrix,
)

from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import ZERO3, Estimate
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.motion import motion_jacobian, motion_noise, move

NOISE = OdometryNoise(
    distance_sigma_m_per_sqrt_m=0.1,
    turn_sigma_rad_per_sqrt_rad=0.2,
    turn_sigma_rad_per_sqrt_m=0.05,
)
SILENT = OdometryNoise(
    distance_sigma_m_per_sqrt_m=0.0,
    turn_sigma_rad_per_sqrt_rad=0.0,
    turn_sigma_rad_per_sqrt_m=0.0,
)
DRIVES = [(0.4, 0.0), (0.4, 0.6), (-0.3, -0.2), (0.0, 1.0), (0.0, 0.0)]
drives = pytest.mark.parametrize(("distance", "turn"), DRIVES)


def differences(pose: Pose2, distance: float, turn: float) -> Matrix:
    """d step / d (x, y, heading, distance, turn), by central differences."""
    columns = []
    for i in range(5):
        ends = []
        for h in (1e-6, -1e-6):
            v = [*pose, distance, turn]
            v[i] += h
            ends.append(step(Pose2(v[0], v[1], v[2]), v[3], v[4]))
        a, b = ends
        turned = wrap_angle(a.heading - b.heading)
        columns.append(np.array([a.x - b.x, a.y - b.y, turned]) / 2e-6)
    return np.stack(columns, axis=1)


@given(poses, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_jacobian_is_that_of_the_step(pose: Pose2, distance: float, turn: float) -> None:
    jacobian = np.array(motion_jacobian(pose.heading, distance, turn)).reshape(3, 3)
    np.testing.assert_allclose(jacobian, differences(pose, distance, turn)[:, :3], atol=1e-6)


@drives
def test_uncertainty_is_compounded_as_j_c_jt(distance: float, turn: float) -> None:
    """Row 38: C is block diagonal in the estimate and the differential motion."""
    rng = np.random.default_rng(3)
    pose, own, shared = Pose2(1.0, 2.0, 0.7), random_matrix(rng, 3), random_matrix(rng, 3)
    along = 0.1**2 * abs(distance)
    around = 0.2**2 * abs(turn) + 0.05**2 * abs(distance)
    C = np.zeros((5, 5))
    C[:3, :3], C[3:, 3:] = own + shared, np.diag([along, around])
    J = differences(pose, distance, turn)
    before = Estimate(pose, covariance3(own + shared), covariance3(shared))
    after = move(before, distance, turn, NOISE)
    np.testing.assert_allclose(matrix3(after.covariance), J @ C @ J.T, atol=1e-6)
    np.testing.assert_allclose(matrix3(after.shared), J[:, :3] @ shared @ J[:, :3].T, atol=1e-6)


@drives
def test_motion_noise_is_a_covariance(distance: float, turn: float) -> None:
    assert least_eigenvalue(matrix3(motion_noise(0.3, distance, turn, NOISE))) > -1e-12


def test_a_straight_line_without_noise_leads_along_the_heading() -> None:
    estimate = Estimate(Pose2(1.0, 1.0, math.pi / 6), ZERO3)
    for _ in range(40):
        estimate = move(estimate, 0.05, 0.0, SILENT)
    assert estimate.pose == pytest.approx((1.0 + math.sqrt(3.0), 2.0, math.pi / 6))
    assert estimate.covariance == ZERO3


def test_a_heading_error_leads_sideways_in_proportion_to_the_way() -> None:
    """Resolution b: (distance)^2 sigma_heading^2, not a white term."""
    estimate = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.0, 0.1))
    for _ in range(60):
        estimate = move(estimate, 0.05, 0.0, SILENT)
    assert estimate.covariance == pytest.approx((0.0, 0.0, 9.0 * 0.01, 0.0, 3.0 * 0.01, 0.01))


def test_a_turn_on_the_spot_widens_the_position_along_the_heading() -> None:
    slipping = msgspec.structs.replace(SILENT, distance_sigma_m_per_sqrt_rad=0.03)
    whole = cut = Estimate(Pose2(1.0, 2.0, 0.0), ZERO3)
    for turn in (2.0, -2.0):
        c = move(whole, 0.0, turn, slipping).covariance
        ahead, across = 0.5 * turn, 0.5 * turn + 0.5 * math.pi
        along = c.position().along
        assert along(math.cos(ahead), math.sin(ahead)) == pytest.approx(0.03**2 * 2.0)
        assert along(math.cos(across), math.sin(across)) == pytest.approx(0.0, abs=1e-15)
        assert (c.xh, c.yh, c.hh) == (0.0, 0.0, 0.0)
    for _ in range(20):
        cut = move(cut, 0.0, 0.1, slipping)
    assert 2.0 * cut.position_sigma_m**2 == pytest.approx(0.03**2 * 2.0)
    assert move(whole, 0.0, 2.0, SILENT).covariance == ZERO3


@pytest.mark.parametrize(("crawl_s", "along"), [(0.0, 0.1**2 * 0.02), (4.0, 0.03**2 * 4.0)])
def test_the_way_of_a_crawl_errs_with_the_time_it_takes(crawl_s: float, along: float) -> None:
    noise = msgspec.structs.replace(NOISE, crawl_sigma_m_per_sqrt_s=0.03)
    c = motion_noise(0.4, 0.02, 0.0, noise, crawl_s)
    assert c.position().along(math.cos(0.4), math.sin(0.4)) == pytest.approx(along)
    assert motion_noise(0.4, 2.0, 0.0, noise, 0.1) == motion_noise(0.4, 2.0, 0.0, noise)


def test_white_noise_grows_with_the_way_however_it_is_cut() -> None:
    whole = cut = Estimate(Pose2(0.0, 0.0, 0.4), ZERO3)
    whole = move(whole, 2.0, 0.0, NOISE)
    for _ in range(20):
        cut = move(cut, 0.1, 0.0, NOISE)
    along, around = 0.1**2 * 2.0, 0.05**2 * 2.0
    for estimate in (whole, cut):
        c = estimate.covariance
        assert c.position().along(math.cos(0.4), math.sin(0.4)) == pytest.approx(along)
        assert c.hh == pytest.approx(around)
