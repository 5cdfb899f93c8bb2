"""What tests of the baselines share: robots whose noise is known exactly."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cpcbl_agents.sources.mrclam import read_table
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.recorder import BaselineReport
from cpcbl_launch.run.logged_team import LoggedTeam, load_logged_team
from cpcbl_team.config import OdometrySettings, SensorSettings, Team
from support.logs import STEP_MS, log_team, write_log

ROBOTS = ("1", "2", "3")
KINDS = ("dead_reckoning", "solo_ekf", "centralized_ekf")
SENSOR = SensorSettings(range_share=0.05, range_floor_m=0.02, bearing_sigma_deg=2.0)
# Noise of turns by the way only: noise by the turn would itself be a turn, and so count twice.
ODOMETRY = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.08,
    turn_sigma_rad_per_sqrt_rad=0.0,
    turn_sigma_rad_per_sqrt_m=0.08,
)


def rewrite_table(path: Path, change: Callable[[Floats], Floats], columns: int) -> None:
    np.savetxt(path, change(read_table(path, columns)), fmt="%.9f")


def add_noise(folder: Path, seed: int) -> None:
    """White noise exactly as SENSOR and ODOMETRY say."""
    rng, step_s = np.random.default_rng(seed), STEP_MS * 1e-3
    shares = ODOMETRY.distance_sigma_m_per_sqrt_m, ODOMETRY.turn_sigma_rad_per_sqrt_m

    def wheels(rows: Floats) -> Floats:
        root = np.sqrt(np.abs(rows[:, 1:2]) * step_s)
        rows[:, 1:] += root * np.array(shares) * rng.normal(size=(len(rows), 2)) / step_s
        return rows

    def camera(rows: Floats) -> Floats:
        sigma = np.hypot(SENSOR.range_share * rows[:, 2], SENSOR.range_floor_m)
        rows[:, 2] += sigma * rng.normal(size=len(rows))
        rows[:, 3] += SENSOR.bearing_sigma_rad * rng.normal(size=len(rows))
        rows[:, 3] = (rows[:, 3] + math.pi) % math.tau - math.pi
        return rows

    for path in sorted(folder.glob("Robot*_Odometry.dat")):
        rewrite_table(path, wheels, 3)
    for path in sorted(folder.glob("Robot*_Measurement.dat")):
        rewrite_table(path, camera, 4)


def with_robot_settings(team: Team, **settings: Any) -> Team:
    """All robots with other settings."""
    robots = {n: msgspec.structs.replace(r, **settings) for n, r in team.robots.items()}
    return msgspec.structs.replace(team, robots=robots)


def noisy_log(folder: Path, seed: int, seconds: float = 40.0) -> LoggedTeam:
    write_log(folder, ROBOTS, seconds)
    add_noise(folder, seed)
    return with_start_poses(
        load_logged_team(
            with_robot_settings(log_team(*ROBOTS), sensor=SENSOR, odometry=ODOMETRY), folder
        )
    )


def with_start_poses(logged: LoggedTeam, dx_m: float = 0.0, dy_m: float = 0.0) -> LoggedTeam:
    """Robots that are sure of starts which are so far off."""
    robots = {}
    for name, robot in logged.team.robots.items():
        assert robot.start is not None
        start = msgspec.structs.replace(
            robot.start,
            x_m=robot.start.x_m + dx_m,
            y_m=robot.start.y_m + dy_m,
            sigma_m=1e-4,
            heading_sigma_deg=0.01,
        )
        robots[name] = msgspec.structs.replace(robot, start=start)
    return logged._replace(team=msgspec.structs.replace(logged.team, robots=robots))


def figure(report: BaselineReport, name: str = "position_rmse_m", robot: str = "") -> float:
    value = getattr(report.robots[robot] if robot else report.team, name)
    assert isinstance(value, float)
    return value
