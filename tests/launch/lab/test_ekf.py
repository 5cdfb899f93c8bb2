"""The extended Kalman filter of the baselines, step by step."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from support.core import LOOP_START, diagonal, driven, loop
from support.noisy_logs import ODOMETRY, SENSOR

from cpcbl_launch.lab.baselines import BaselineInputs, Ekf, expected_sighting, linearize
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Field, OdometrySettings, RobotSettings
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Sighting, Sightings


def inputs_at(pose: Pose2, *pieces: Odometry, sigma: float = 0.1) -> BaselineInputs:
    settings = RobotSettings(sensor=SENSOR, odometry=ODOMETRY, source="mrclam")
    return BaselineInputs(settings, 0, Estimate(pose, diagonal(sigma, sigma)), pieces, ())


def differences(function: Callable[[Floats], Floats], at: Floats) -> Floats:
    """The Jacobian of a function by central differences."""
    h = 1e-6
    columns = [(function(at + h * e) - function(at - h * e)) / (2.0 * h) for e in np.eye(len(at))]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("seed", range(10))
def test_the_jacobian_of_a_sighting_is_that_of_finite_differences(seed: int) -> None:
    x = np.random.default_rng(seed).uniform(-3.0, 3.0, size=5)
    expected = differences(lambda at: expected_sighting(at[:3], at[3:])[0], x)
    np.testing.assert_allclose(expected_sighting(x[:3], x[3:])[1], expected, atol=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_motion_transforms_the_whole_covariance_by_its_jacobian(seed: int) -> None:
    """Of two robots with cross-covariance, of which one drives; without noise of its wheels."""
    rng = np.random.default_rng(seed)
    distance, turn = rng.uniform(0.1, 1.0), rng.uniform(-1.0, 1.0)
    pose = Pose2(*rng.uniform(-2.0, 2.0, size=3).tolist())
    exact = OdometrySettings(
        distance_sigma_m_per_sqrt_m=0.0,
        turn_sigma_rad_per_sqrt_rad=0.0,
        turn_sigma_rad_per_sqrt_m=0.0,
    )
    driver = inputs_at(pose, Odometry(0, 1_000_000_000, distance, turn))
    driver = driver._replace(settings=RobotSettings(odometry=exact))
    ekf = Ekf({"other": inputs_at(Pose2(1.0, 1.0, 0.0)), "driver": driver}, Field())
    root = rng.normal(size=(6, 6))
    ekf.covariance = root @ root.T
    jacobian = np.eye(6)
    jacobian[3:, 3:] = differences(
        lambda at: np.array(step(Pose2(*at.tolist()), distance, turn)), np.array(pose)
    )
    expected = jacobian @ ekf.covariance @ jacobian.T
    ekf.predict("driver", 1_000_000_000)
    np.testing.assert_allclose(ekf.covariance, expected, atol=1e-6)
    np.testing.assert_allclose(ekf.mean, [1.0, 1.0, 0.0, *step(pose, distance, turn)])


def test_odometry_in_parts_gives_the_same_as_in_one_piece() -> None:
    pieces = [piece for piece, _ in driven(LOOP_START, loop()[:40])]
    whole, parts = (Ekf({"r": inputs_at(LOOP_START, *pieces)}, Field()) for _ in range(2))
    whole.predict("r", pieces[-1].stamp_ns)
    for stamp_ns in range(0, pieces[-1].stamp_ns + 1, 50_000_000):
        parts.predict("r", stamp_ns)
    np.testing.assert_allclose(parts.marginal("r")[0], whole.marginal("r")[0], atol=1e-9)
    np.testing.assert_allclose(parts.marginal("r")[1], whole.marginal("r")[1], atol=1e-4)


def test_the_covariance_grows_with_the_distance_as_the_settings_state() -> None:
    ekf = Ekf(
        {"r": inputs_at(Pose2(0.0, 0.0, 0.0), Odometry(0, 100, 0.25, 0.0), sigma=0.0)}, Field()
    )
    ekf.predict("r", 100)
    gained = np.diag(ekf.covariance)
    assert gained[0] == pytest.approx(ODOMETRY.distance_sigma_m_per_sqrt_m**2 * 0.25)
    assert gained[2] == pytest.approx(ODOMETRY.turn_sigma_rad_per_sqrt_m**2 * 0.25)


def test_a_bearing_straight_behind_is_wrapped() -> None:
    ekf = Ekf(
        {"a": inputs_at(Pose2(0.0, 0.0, 0.0)), "b": inputs_at(Pose2(-2.0, 0.001, 0.0))}, Field()
    )
    ekf.correct("a", Sightings(0, (Sighting("b", 2.0, 0.01 - math.pi),)))
    assert ekf.mean[2] == pytest.approx(-0.01, abs=0.009)
    assert ekf.covariance[2, 2] < 0.9 * 0.1**2


def test_one_sighting_informs_and_correlates_both_robots() -> None:
    ekf = Ekf({"a": inputs_at(Pose2(0.0, 0.0, 0.0)), "b": inputs_at(Pose2(2.0, 0.0, 0.0))}, Field())
    ekf.correct("a", Sightings(0, (Sighting("b", 2.1, 0.0),)))
    assert ekf.mean[0] == pytest.approx(-(ekf.mean[3] - 2.0))
    assert ekf.mean[3] > 2.02
    assert ekf.covariance[0, 3] > 0.003
    assert ekf.covariance[0, 0] < 0.008


class IteratedEkf(Ekf):
    iterations = 30


def test_an_iterated_update_ends_at_the_most_probable_poses() -> None:
    """There the pull of the prior equals that of the sighting; one linear step ends beside it."""
    sighting, sigma, columns = Sighting("b", 1.6, 0.9), 0.5, [0, 1, 2, 3, 4]
    start = {"a": Pose2(0.0, 0.0, 0.0), "b": Pose2(2.0, 0.5, 0.0)}
    imbalance = []
    for kind in (Ekf, IteratedEkf):
        ekf = kind({name: inputs_at(pose, sigma=sigma) for name, pose in start.items()}, Field())
        before = ekf.mean.copy()
        ekf.correct("a", Sightings(0, (sighting,)))
        m = linearize(sighting, SENSOR, Field(), ekf.mean[:3], ekf.mean[3:])
        assert m is not None
        pull = m.jacobian.T @ (m.innovation / m.noise)
        imbalance.append(np.abs((ekf.mean - before)[columns] / sigma**2 - pull).max())
    assert imbalance[0] > 0.1
    assert imbalance[1] < 1e-6


def test_an_outlier_is_gated_and_a_faulty_sighting_ignored() -> None:
    ekf = Ekf({"a": inputs_at(Pose2(0.0, 0.0, 0.0)), "b": inputs_at(Pose2(2.0, 0.0, 0.0))}, Field())
    mean, covariance = ekf.mean.copy(), ekf.covariance.copy()
    wrong = (Sighting("b", 4.0, 0.0), Sighting("b", math.nan, 0.0), Sighting("nobody", 1.0, 0.0))
    ekf.correct("a", Sightings(0, wrong))
    np.testing.assert_array_equal(ekf.mean, mean)
    np.testing.assert_array_equal(ekf.covariance, covariance)


def test_the_covariance_grows_after_the_end_of_odometry() -> None:
    """By 0.3 m and as far as the last speed leads, both for a second, after `timeout_s`; the
    heading by as many radians, for a robot that drove may turn."""
    ekf = Ekf({"r": inputs_at(Pose2(0.0, 0.0, 0.0), Odometry(0, 100_000_000, 0.05, 0.0))}, Field())
    ekf.predict("r", 600_000_000)
    before = ekf.marginal("r")[1]
    ekf.predict("r", 2_600_000_000)
    gained = ekf.marginal("r")[1] - before
    np.testing.assert_allclose(gained, 2.0 * (0.3**2 + 0.5**2) * np.eye(3), atol=1e-9)
