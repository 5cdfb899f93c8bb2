import math

import numpy as np
import pytest
from support.core import Matrix

from cpcbl_launch.reporting.metrics import (
    Samples,
    Score,
    Trajectory,
    interpolated_truth,
    position_nees,
    samples_with_truth,
    score,
)
from cpcbl_launch.reporting.recorder import mean_score

TRUTH = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.1], [2.0, 2.0, -1.0]])
OFFSETS = np.array([[0.3, 0.4, 0.1], [0.0, 0.0, 0.1], [0.0, -0.6, -0.2]])
SIGMA_01 = np.tile([0.01, 0.0, 0.01, 0.0, 0.0, 0.01], (3, 1))


def rows_of(covariance: Matrix, n: int) -> Matrix:
    return np.tile([covariance[0, 0], covariance[0, 1], covariance[1, 1], 0.0, 0.0, 0.1], (n, 1))


def test_a_score_is_what_its_fields_say() -> None:
    found = score(Samples(TRUTH + OFFSETS, TRUTH, SIGMA_01 * [9, 1, 9, 1, 1, 1]))
    assert found.samples == 3
    assert found.position_rmse_m == pytest.approx(math.sqrt((0.25 + 0.36) / 3))
    assert found.position_mean_m == pytest.approx((0.5 + 0.6) / 3)
    assert found.position_max_m == pytest.approx(0.6)
    assert found.heading_rmse_deg == pytest.approx(math.degrees(math.sqrt(0.06 / 3)))
    assert found.nees == pytest.approx((0.25 + 0.36) / 0.09 / 3)
    assert found.heading_nees == pytest.approx(0.06 / 3 / 0.01)
    assert found.inside_3_sigma == 1.0


@pytest.mark.parametrize(("off", "inside"), [(2.999, 1.0), (3.001, 0.0)])
def test_three_sigma_are_three(off: float, inside: float) -> None:
    """Not the 3.44 that hold 99.7 % of a Gaussian in the plane."""
    beside = np.array([[0.1 * off, 0.0, 0.0]])
    assert score(Samples(beside, 0.0 * beside, SIGMA_01[:1])).inside_3_sigma == inside


def test_a_team_has_the_largest_error_of_all_and_the_rmse_of_all_samples() -> None:
    one = Score(samples=1, position_rmse_m=0.5, position_max_m=0.5, nees=1.0)
    many = Score(samples=3, position_rmse_m=0.1, position_max_m=0.3, nees=2.0)
    team = mean_score([one, many, Score(samples=0)])
    assert (team.position_max_m, team.nees) == (0.5, 1.5)
    assert team.position_rmse_m == pytest.approx(0.3)
    assert team.pooled_rmse_m == pytest.approx(math.sqrt((0.25 + 3 * 0.01) / 4))
    assert mean_score([Score(samples=0)]).pooled_rmse_m is None


def test_the_share_inside_3_sigma_is_by_mahalanobis_distance() -> None:
    found = score(Samples(TRUTH + OFFSETS, TRUTH, SIGMA_01))  # resolution h
    assert found.inside_3_sigma == pytest.approx(1 / 3)


def test_a_perfect_estimate_has_no_error() -> None:
    """A noise-free run has no covariance to divide by."""
    found = score(Samples(TRUTH, TRUTH, np.zeros((3, 6))))
    assert (found.position_rmse_m, found.position_max_m, found.heading_rmse_deg) == (0.0, 0.0, 0.0)
    assert (found.nees, found.inside_3_sigma) == (0.0, 1.0)


def test_a_variant_without_a_covariance_has_no_nees() -> None:
    found = score(Samples(TRUTH + OFFSETS, TRUTH, None))  # row 44: B gives no uncertainty
    assert (found.nees, found.inside_3_sigma) == (None, None)
    assert found.position_rmse_m is not None


def test_nothing_to_compare_scores_nothing() -> None:
    found = score(Samples(TRUTH[:0], TRUTH[:0], SIGMA_01[:0]))
    assert (found.samples, found.position_rmse_m, found.nees) == (0, None, None)


def test_heading_errors_are_taken_the_short_way_round() -> None:
    a, b = np.array([[0.0, 0.0, 3.1]]), np.array([[0.0, 0.0, -3.1]])
    assert score(Samples(a, b, None)).heading_rmse_deg == pytest.approx(
        math.degrees(math.tau - 6.2)
    )


@pytest.mark.parametrize("xy", [0.0, 0.02, -0.02, 3.0, -3.0])
def test_the_nees_is_the_quadratic_form(xy: float) -> None:
    covariance = np.array([[1.5 * abs(xy) + 0.01, xy], [xy, abs(xy) + 0.04]])
    offsets = OFFSETS[:, :2]
    expected = np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(covariance), offsets)
    found = position_nees(Samples(TRUTH + OFFSETS, TRUTH, rows_of(covariance, 3)))
    assert found is not None
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


def test_truth_is_interpolated_the_short_way_round() -> None:
    truth = np.array([[0.0, 0.0, 0.0, 3.0], [2.0, 4.0, -2.0, -3.0]])
    at, _ = interpolated_truth(np.array([1.0]), truth)
    np.testing.assert_allclose(at[0, :2], [2.0, -1.0])
    assert math.remainder(at[0, 2] - math.pi, math.tau) == pytest.approx(0.0)


def test_truth_counts_near_a_row() -> None:
    """Between rows that are far apart a robot may have been anywhere."""
    truth = np.array([[10.0, 1.0, 2.0, 0.0], [30.0, 1.0, 2.0, 0.0]])
    times = np.array([9.8, 9.9, 10.0, 10.1, 10.2, 20.0, 29.9, 30.1, 30.2])
    _, counts = interpolated_truth(times, truth)
    assert counts.tolist() == [False, True, True, True, False, False, True, True, False]


def test_a_score_says_how_much_of_it_has_truth() -> None:
    truth = np.array([[10.0, 0.0, 0.0, 0.0]])
    stamps_ns = np.array([10.0, 10.1, 11.0, 12.0]) * 1e9
    path = Trajectory(stamps_ns.astype(np.int64), np.zeros((4, 3)), None)
    found = score(samples_with_truth(path, truth)[1])
    assert (found.samples, found.scored_share) == (2, 0.5)


def test_one_row_of_truth_is_enough_near_it() -> None:
    at, counts = interpolated_truth(np.array([0.9, 4.0]), np.array([[1.0, 5.0, 6.0, 0.1]]))
    np.testing.assert_allclose(at[0], [5.0, 6.0, 0.1])
    assert counts.tolist() == [True, False]
