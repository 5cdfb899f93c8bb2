"""Teams of equals, in which what a robot told could come back to it as news; and their NEES.

All robots have the same sensors and odometry, and see all round. Two stand side by side; in a ring
each sees its two neighbours; in a clique everyone sees everyone. All of them see landmarks, or one
does, or none: then what the team knows of its place can only go round. They drive round squares
side by side, or stand.
"""

import math
from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np

from cpcbl_launch.lab.experiments.runs import Run
from cpcbl_launch.reporting.metrics import Floats, position_nees
from cpcbl_team.config import (
    Field,
    Landmark,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)

Sighted = Literal["all", "one", "none"]
START_SIGMA_M = 0.05
ROUND_M = 0.5  # half the diagonal of the square that a robot drives round
TURN_SIGMA = (
    0.02  # rad per √rad and √m: a heading drifts by 7° in a minute, little enough to be linear
)


class Shape(NamedTuple):
    """So many robots evenly on a circle, and how far they see."""

    robots: int
    radius_m: float
    range_m: float


SHAPES = {
    "alone": Shape(1, 0.0, 4.0),
    "pair": Shape(2, 0.5, 4.0),
    "ring": Shape(6, 2.0, 2.8),
    "clique": Shape(5, 1.5, 4.0),
}


def equal_team(shape: str, sighted: Sighted, drives: bool = True) -> Team:
    """A landmark stands in the middle, and one behind each robot."""
    count, radius, range_m = SHAPES[shape]
    directions = [math.tau * i / count for i in range(count)]
    marks = {"middle": Landmark(x_m=0.0, y_m=0.8 if count < 3 else 0.0)}
    sees = {"all": count, "one": 1, "none": 0}[sighted]
    robots = {}
    for i, a in enumerate(directions):
        x, y, away = radius * math.cos(a), radius * math.sin(a), radius + 1.5
        marks[f"m{i}"] = Landmark(x_m=away * math.cos(a), y_m=away * math.sin(a))
        robots[f"r{i}"] = _robot(x, y, range_m, i < sees, drives)
    return Team(name="equals", robots=robots, map=Field(landmarks=marks))


def _robot(x: float, y: float, range_m: float, sighted: bool, drives: bool) -> RobotSettings:
    r = ROUND_M
    way: tuple[tuple[float, float], ...] = ()
    if drives:
        way = (x + r, y), (x, y + r), (x - r, y), (x, y - r)
        x, y = way[-1]
    return RobotSettings(
        sensor=SensorSettings(
            field_of_view_deg=360.0, max_range_m=range_m, rate_hz=5.0, sees_landmarks=sighted
        ),
        odometry=OdometrySettings(
            moves=drives,
            turn_sigma_rad_per_sqrt_rad=TURN_SIGMA,
            turn_sigma_rad_per_sqrt_m=TURN_SIGMA,
        ),
        waypoints_m=way,
        speed_m_s=0.3,
        start=Start(x_m=x, y_m=y, heading_deg=45.0, sigma_m=START_SIGMA_M),
    )


def team_nees(runs: Iterable[Run]) -> Floats:
    """Position NEES, mean over the robots of a team; shape (runs, times)."""
    teams = []
    for run in runs:
        every = [position_nees(samples) for samples in run.robots.values()]
        robots = [nees for nees in every if nees is not None]
        assert len(robots) == len(run.robots)
        teams.append(np.mean(robots, axis=0))
    return np.array(teams)


def nees_bounds(runs: int) -> tuple[float, float]:
    """Within which 95 % of the means of so many independent NEES of two states lie (two-sided).

    Chi-square with twice as many degrees of freedom (Wilson & Hilferty 1931). A team's mean over
    robots and time scatters less than one robot at one time, however these are correlated.
    """
    part = 1.0 / (9.0 * runs)
    low, high = (2.0 * (1.0 - part + z * math.sqrt(part)) ** 3 for z in (-1.959964, 1.959964))
    return low, high
