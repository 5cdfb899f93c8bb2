"""What differs between days, as variances, and what it adds to the noise of a team file."""

import math

import numpy as np
import pytest
from support.exact_logs import circling

from cpcbl_launch.calibration.between_days import (
    DayVariance,
    coverage_factor,
    missing_variance,
    odometry_day_variances,
    pooled_variances,
    sensor_day_variances,
    with_day_variances,
)
from cpcbl_launch.calibration.logs import RobotLog
from cpcbl_launch.calibration.odometry import NOISE as ODOMETRY_NOISE
from cpcbl_launch.calibration.odometry import calibrate_odometry
from cpcbl_launch.calibration.sensor import fit_sensor
from cpcbl_launch.calibration.statistics import LAGS_S, Estimate

SIGMA_M, SIGMA_RAD = 0.03, 0.01


def day(seed: int, bearing_bias: float = 0.0, turn_scale: float = 1.0) -> RobotLog:
    """A drive with white noise; true turn = turn_scale x reported."""
    random, log = np.random.default_rng(seed), circling(seconds=150.0)
    seen, odometry = log.sightings.copy(), log.odometry.copy()
    seen[:, 2] += random.normal(0.0, SIGMA_M, len(seen))
    seen[:, 3] += bearing_bias + random.normal(0.0, SIGMA_RAD, len(seen))
    odometry[:, 3] = odometry[:, 3] / turn_scale + random.normal(0.0, 0.002, len(odometry))
    return log._replace(sightings=seen, odometry=odometry)


def sensor_variances(days: list[RobotLog]) -> dict[str, DayVariance]:
    fit = fit_sensor(days)
    assert fit is not None
    return sensor_day_variances(fit)


def test_a_bias_that_differs_is_found_with_its_variance() -> None:
    found = sensor_variances([day(1), day(2, bearing_bias=0.04)])
    assert found["bearing"].days == 2
    assert found["bearing"].between == pytest.approx(0.04**2 / 2.0, rel=0.1)
    assert abs(found["range"].between) < 0.02 * SIGMA_M**2
    assert found["range"].noise == pytest.approx(SIGMA_M**2, rel=0.15)


@pytest.mark.thorough
def test_days_that_are_the_same_have_on_average_no_variance() -> None:
    """What chance makes of equal days is subtracted."""
    robots = [sensor_variances([day(2 * i), day(2 * i + 1)]) for i in range(8)]
    for kind, sigma in (("range", SIGMA_M), ("bearing", SIGMA_RAD)):
        mean = np.mean([robot[kind].between for robot in robots])
        assert abs(mean) < 0.02 * sigma**2


def test_one_day_says_nothing_of_others() -> None:
    found = sensor_variances([day(1)])
    assert {own.days for own in found.values()} == {1}
    assert pooled_variances([found]) == {}
    values = {"range_share": Estimate(0.01, 0.001)}
    assert with_day_variances(values, found, {}) == values


def test_a_scale_of_turns_that_differs_is_found() -> None:
    odometry = calibrate_odometry([day(1), day(2, turn_scale=0.95)])[1]
    assert odometry is not None
    found = odometry_day_variances(odometry)
    turned = 0.3 * 16.0  # in the longest windows
    assert found["turn"].between == pytest.approx((0.05 * turned) ** 2 / 2.0, rel=0.15)


def test_robots_are_pooled_by_their_degrees_of_freedom() -> None:
    robots = [
        {"range": DayVariance(2, 5.0, 1.0), "bearing": DayVariance(2, -1.0, 1.0)},
        {"range": DayVariance(4, 1.0, 1.0)},
        {"range": DayVariance(1, 0.0, 1.0)},
    ]
    factor = coverage_factor(1 + 3) ** 2
    assert pooled_variances(robots) == {"range": pytest.approx(factor * 2.0), "bearing": 0.0}


@pytest.mark.parametrize(("freedom", "quantile"), [(5, 5.507), (10, 3.957), (30, 3.270)])
def test_three_sigma_of_few_days_are_wider(freedom: int, quantile: float) -> None:
    """The quantiles are from tables of Student's t, two-sided 99.73 %."""
    assert 3.0 * coverage_factor(freedom) == pytest.approx(quantile, rel=0.02)
    assert coverage_factor(1) == coverage_factor(2) == coverage_factor(3)


@pytest.mark.parametrize("days", [2, 3, 5])
def test_noise_with_the_missing_variance_is_the_error_of_a_new_day(days: int) -> None:
    random = np.random.default_rng(days)
    effects = random.normal(0.0, 0.3, (200_000, days + 1))
    seen, new = effects[:, :-1], effects[:, -1]
    residual = seen - seen.mean(axis=1, keepdims=True)
    own = DayVariance(days, 0.0, float((residual**2).mean()))
    due = float(((new - seen.mean(axis=1)) ** 2).mean())
    assert own.noise + missing_variance(own, 0.3**2) == pytest.approx(due, rel=0.02)


def test_noise_and_its_correlation_time_grow() -> None:
    values = {
        "range_share": Estimate(0.01, 0.001),
        "range_floor_m": Estimate(0.02, 0.001),
        "bearing_sigma_deg": Estimate(1.0, 0.1),
        "bearing_bias_deg": Estimate(0.5, 0.1),
        "correlation_s": Estimate(4.0, 0.5),
    }
    own = {"range": DayVariance(2, 0.0, 1e-4), "bearing": DayVariance(2, 0.0, 1e-4)}
    found = with_day_variances(values, own, {"range": 3e-4, "bearing": 0.0})
    assert found["range_share"] == values["range_share"]
    assert found["range_floor_m"].value == pytest.approx(math.hypot(0.02, math.sqrt(3e-4)))
    assert found["bearing_sigma_deg"] == values["bearing_sigma_deg"]
    assert found["bearing_bias_deg"] == values["bearing_bias_deg"]
    ranges_s = 0.25 * 4.0 + 0.75 * LAGS_S[-1]
    assert found["correlation_s"].value == pytest.approx(0.5 * (ranges_s + 4.0))
    assert found["correlation_s"].standard_error == 0.5


def test_noise_of_odometry_grows_in_proportion() -> None:
    values = {key: Estimate(0.03, 0.001) for key in (*ODOMETRY_NOISE, "distance_scale")}
    own = {kind: DayVariance(4, 0.0, 1e-3) for kind in ("distance", "turn")}
    found = with_day_variances(values, own, {"distance": 6e-3, "turn": 2e-3})
    assert found["distance_scale"] == values["distance_scale"]
    factors = [found[key].value / 0.03 for key in ODOMETRY_NOISE]
    distance, turn = 2.0, math.sqrt(2.0)
    assert factors == pytest.approx([distance, distance, turn, turn])
