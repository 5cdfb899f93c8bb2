"""Robots whose heading is hardly known, and one landmark: they may turn about it, unnoticed."""

import math

import numpy as np
import pytest
from support.core import (
    SECOND,
    covariance3,
    displaced,
    frame,
    localizer,
    matrix3,
    sensor_noise,
)

from cpcbl_team.config import Field, Landmark, OdometrySettings, SensorSettings, Start
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry
from cpcbl_team.motion import motion_noise
from cpcbl_team.wide_headings import along_arc, with_arc

POST = (3.0, 1.0)
POSE = Pose2(0.5, -0.3, 0.4)


def turn_about_post(pose: Pose2) -> tuple[float, float, float]:
    """How a pose moves, a radian of turn about the post."""
    return -(pose.y - POST[1]), pose.x - POST[0], 1.0


@pytest.mark.parametrize("turn", [-1.2, 0.0, 0.3, 1.5])
def test_a_turn_about_a_landmark_leaves_the_robot_on_its_circle(turn: float) -> None:
    x, y, _ = turn_about_post(POSE)
    linear = Pose2(POSE.x + turn * x, POSE.y + turn * y, wrap_angle(POSE.heading + turn))
    direction = np.array(turn_about_post(POSE))
    prior = Estimate(POSE, covariance3(0.2 * np.outer(direction, direction)))
    after = along_arc(prior, prior._replace(pose=linear))
    assert after.pose.inverse().transform(*POST) == pytest.approx(POSE.inverse().transform(*POST))
    # and the error that is left is still a turn about it, which changes no reading of it
    due = 0.2 * np.outer(turn_about_post(after.pose), turn_about_post(after.pose))
    assert matrix3(after.covariance) == pytest.approx(due)


@pytest.mark.parametrize("sigma_rad", [0.15, 0.4, 0.7])
def test_others_get_the_second_moments_of_the_arc(sigma_rad: float) -> None:
    lever = np.array(turn_about_post(POSE))
    rest = np.diag([0.01, 0.02, 0.0])
    linear = covariance3(sigma_rad**2 * np.outer(lever, lever) + rest)
    turns = sigma_rad * np.random.default_rng(2).normal(size=400_000)
    c, s, x, y = np.cos(turns), np.sin(turns), POSE.x - POST[0], POSE.y - POST[1]
    moved = np.array([(c - 1.0) * x - s * y, s * x + (c - 1.0) * y, turns])
    due = moved @ moved.T / turns.size + rest
    found = with_arc(Estimate(POSE, linear)).covariance
    assert matrix3(found) == pytest.approx(due, rel=0.02, abs=0.02 * sigma_rad**2)


def test_an_ordinary_estimate_is_reported_as_it_is() -> None:
    estimate = Estimate(POSE, Covariance3(0.1, 0.0, 0.1, 0.02, 0.0, 0.009))
    assert with_arc(estimate) is estimate


def nees_about_one_landmark(seed: int) -> float:
    """The mean over a way around the only landmark; the start is known to 1 m and 45 deg."""
    field = Field(landmarks={"post": Landmark(x_m=POST[0], y_m=POST[1])})
    sensor, odometry = SensorSettings(range_share=0.03, bearing_sigma_deg=2.0), OdometrySettings()
    start = Start(x_m=1.0, y_m=0.0, sigma_m=1.0, heading_sigma_deg=45.0)
    robot = localizer(field=field, start=start, sensor=sensor, odometry=odometry)
    rng, state = np.random.default_rng(seed), robot.start(0)
    truth, found = displaced(state.estimate.pose, state.estimate.covariance, rng), []
    noise, drift = sensor_noise(rng, sensor), motion_noise(0.0, 0.08, 0.04, odometry)
    along, around = rng.normal(size=(2, 150)) * [[math.sqrt(drift.xx)], [math.sqrt(drift.hh)]]
    for i in range(150):
        now = (i + 1) * SECOND // 5
        truth = step(truth, 0.08 + along[i], 0.04 + around[i])
        state = robot.add_odometry(state, Odometry(i * SECOND // 5, now, 0.08, 0.04))
        state = robot.cycle(state, frame(truth, now, field, noise=noise))
        (x, y, _), covariance, _ = state.reported
        e = np.array([x - truth.x, y - truth.y])
        found.append(float(e @ np.linalg.solve(matrix3(covariance)[:2, :2], e)))
    return float(np.mean(found[25:]))


def test_one_landmark_makes_no_certainty_of_where_about_it_the_robot_is() -> None:
    """The mean of 40 runs: 74 with corrections along the tangent, 207 with reports of it."""
    assert np.mean([nees_about_one_landmark(seed) for seed in range(40)]) < 5.0
