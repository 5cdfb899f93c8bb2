"""Calibration of logs with known errors, and the values that a log does not determine."""

import math

import numpy as np
import pytest
from support.exact_logs import circling

from cpcbl_launch.calibration.logs import RobotLog
from cpcbl_launch.calibration.odometry import calibrate_odometry
from cpcbl_launch.calibration.sensor import calibrate_sensor
from cpcbl_launch.calibration.statistics import (
    determined_coefficients,
    robust_fit,
    variance_components,
)


def test_an_exact_log_is_found_to_be_exact() -> None:
    log = circling()
    odometry, sensor = calibrate_odometry([log])[0], calibrate_sensor([log])[0]
    assert odometry["distance_scale"].value == pytest.approx(1.0, abs=1e-3)
    assert odometry["turn_scale"].value == pytest.approx(1.0, abs=1e-3)
    assert sensor["range_scale"].value == pytest.approx(1.0, abs=1e-3)
    assert sensor["bearing_bias_deg"].value == pytest.approx(0.0, abs=0.02)
    assert sensor["range_share"].value < 1e-3
    assert "robot_range_bias_m" not in sensor


def test_gross_outliers_do_not_matter() -> None:
    log = circling()
    random = np.random.default_rng(1)
    seen = log.sightings.copy()
    seen[:, 2] += random.normal(0.0, 0.05, len(seen))
    seen[:, 3] += random.normal(0.0, 0.02, len(seen))
    clean = calibrate_sensor([log._replace(sightings=seen)])[0]
    seen[::150, 2] += 3.0
    seen[::150, 3] += 0.5
    dirty = calibrate_sensor([log._replace(sightings=seen)])[0]
    for name, estimate in clean.items():
        if name != "correlation_s":
            slack = estimate.standard_error + 1e-3
            assert dirty[name].value == pytest.approx(estimate.value, abs=slack), name


def crawling(least_speed: float, slow: float = 0.008, sigma: float = 0.0) -> RobotLog:
    """Straight on, by turns at 0.3 m/s and slowly; the truth is known to 0.5 mm. `sigma`: of the
    way while it is slow, in m per root of a second."""
    random = np.random.default_rng(3)
    times = np.arange(0.0, 120.0, 0.02)
    commanded = np.where(times % 10.0 < 5.0, 0.3, slow)
    each = np.maximum(commanded, least_speed) * 0.02
    each += random.normal(0.0, sigma * math.sqrt(0.02), len(each)) * (commanded == slow)
    way = np.concatenate([[0.0], np.cumsum(each)[:-1]])
    way += random.normal(0.0, 0.0005, len(way))
    nothing = np.zeros_like(way)
    from_s = times[:-1:5]
    step = np.full_like(from_s, 0.1)
    odometry = np.stack([from_s, from_s + 0.1, commanded[:-1:5] * step, 0.0 * step], axis=1)
    return RobotLog(
        np.stack([times, way, nothing, nothing], axis=1), odometry, np.empty((0, 4)), ()
    )


def test_motors_with_a_dead_zone_are_found_to_have_one() -> None:
    found = calibrate_odometry([crawling(least_speed=0.02)])[0]
    assert found["least_speed_m_s"].value == pytest.approx(0.02, abs=0.001)
    assert found["distance_scale"].value == pytest.approx(1.0, abs=3e-3)
    without = calibrate_odometry([crawling(least_speed=0.0)])[0]
    assert "least_speed_m_s" not in without
    assert "crawl_sigma_m_per_sqrt_s" not in without


def test_how_crawling_errs_is_found() -> None:
    found = calibrate_odometry([crawling(least_speed=0.02, sigma=0.006)])[0]
    crawl = found["crawl_sigma_m_per_sqrt_s"]
    assert crawl.standard_error < 0.0015
    assert abs(crawl.value - 0.006) < 3.0 * crawl.standard_error


def test_a_robot_that_only_turns_tells_no_distance_scale() -> None:
    found = calibrate_odometry([circling(turn_rate=0.5, speed=0.0)])[0]
    assert "distance_scale" not in found
    assert found["turn_scale"].value == pytest.approx(1.0, abs=1e-3)


def test_truth_with_gaps_is_used_only_where_it_is_known() -> None:
    log = circling()
    random = np.random.default_rng(2)
    seen = log.sightings.copy()
    seen[:, 2] += random.normal(0.0, 0.05, len(seen))
    gaps = (log.truth[:, 0] % 10.0) < 7.0  # three of ten seconds are missing
    whole = calibrate_sensor([log._replace(sightings=seen)])[0]
    holed = calibrate_sensor([log._replace(sightings=seen, truth=log.truth[gaps])])[0]
    assert holed["range_floor_m"].value == pytest.approx(whole["range_floor_m"].value, rel=0.1)
    odometry = calibrate_odometry([log._replace(truth=log.truth[gaps])])[0]
    assert odometry["turn_scale"].value == pytest.approx(1.0, abs=2e-3)


def test_a_range_at_one_distance_tells_the_bias_and_not_the_scale() -> None:
    random = np.random.default_rng(3)
    columns = np.stack([np.full(400, 3.0), np.ones(400)], axis=1) / 0.05
    assert determined_coefficients(columns, (0.2, 0.3)).sum() == 1
    varied = np.stack([random.uniform(1.0, 6.0, 400), np.ones(400)], axis=1) / 0.05
    assert determined_coefficients(varied, (0.2, 0.3)).all()


def test_statistics_find_what_was_drawn() -> None:
    random = np.random.default_rng(4)
    x = random.uniform(0.5, 5.0, 4000)
    errors = random.normal(0.0, np.hypot(0.05 * x, 0.1))
    parts = variance_components(errors, np.stack([x * x, np.ones_like(x)], axis=1))[0]
    assert np.sqrt(parts) == pytest.approx([0.05, 0.1], rel=0.1)
    values = 2.0 * x - 1.0 + errors
    values[::100] += 50.0
    fitted = robust_fit(np.stack([x, np.ones_like(x)], axis=1), values)
    assert fitted == pytest.approx([2.0, -1.0], abs=0.03)
