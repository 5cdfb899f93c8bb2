"""The extended Kalman filters of two libraries, driven as their manuals say.

Models and Jacobians are ours; prediction and update are theirs.
"""

import math
from typing import Any

import gtsam
import numpy as np
from benchmarks.drive import MAP, SENSOR, Plain
from benchmarks.numpy_peers import (
    difference,
    expected,
    jacobian_of,
    noise_of,
    read,
    start_covariance,
    stepped,
)
from filterpy.kalman import ExtendedKalmanFilter
from support.core import LOOP_START


class _Robot(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter with the motion of an odometry step."""

    x: Any

    def predict_x(self, u: Any = 0) -> None:
        self.x = stepped(self.x, *u)


def begin_filterpy() -> Any:
    robot = _Robot(dim_x=3, dim_z=2 * len(MAP))
    robot.x, robot.P = np.array(LOOP_START), start_covariance()
    return robot


def filterpy_ekf(robot: Any, reading: Plain) -> Any:
    """One cycle with one update for the whole frame: what costs filterpy least."""
    distance, turn, _ = reading
    heading = float(robot.x[2])
    robot.F = jacobian_of(heading, distance, turn)
    robot.Q = noise_of(heading, distance, turn)
    robot.predict((distance, turn))
    z, h, r = expected(robot.x)
    robot.update(read(reading), lambda _: h, lambda _: z, R=np.diag(r), residual=difference)
    return robot


def begin_gtsam() -> Any:
    return gtsam.LieGroupEKFPose2(gtsam.Pose2(*LOOP_START), start_covariance())


_NO_FEEDBACK = np.zeros((3, 3))


def gtsam_ekf(robot: Any, reading: Plain) -> Any:
    """One cycle on the Lie group SE(2): errors are in the robot's frame, forward and left."""
    distance, turn, seen = reading
    half = 0.5 * turn
    way = gtsam.Pose2(distance * math.cos(half), distance * math.sin(half), turn)
    robot.predictWithCompose(way, _NO_FEEDBACK, noise_of(-turn, distance, turn))
    pose = robot.state()
    x, y, c, s = pose.x(), pose.y(), math.cos(pose.theta()), math.sin(pose.theta())
    foreseen: list[float] = []
    readings: list[float] = []
    rows: list[tuple[float, float, float]] = []
    variances: list[float] = []
    for name, range_m, bearing in seen:
        px, py = MAP[name]
        dx, dy = px - x, py - y
        ahead, left = c * dx + s * dy, c * dy - s * dx
        q = ahead * ahead + left * left
        d, direction = math.sqrt(q), math.atan2(left, ahead)
        foreseen += (d, direction)
        readings += (range_m, direction + math.remainder(bearing - direction, math.tau))
        rows += ((-ahead / d, -left / d, 0.0), (left / q, -ahead / q, -1.0))
        variances += (
            SENSOR.range_share**2 * q + SENSOR.range_floor_m**2,
            SENSOR.bearing_sigma_rad**2,
        )
    robot.updateWithVector(
        np.array(foreseen), np.array(rows), np.array(readings), np.diag(variances)
    )
    return robot


def gtsam_pose(robot: Any) -> tuple[float, float, float]:
    pose = robot.state()
    return pose.x(), pose.y(), pose.theta()
