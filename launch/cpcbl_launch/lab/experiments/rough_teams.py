"""Random teams that are known less well: what settings say may be wrong is wrong by so much.

The teams are those of `random_teams.py`, with scales of the odometry, directions of sensors and
places of landmarks of which a sigma is stated (the true ones are drawn with it), with sensor noise
that is correlated in time, with delays, budgets, and odometry that gets lost.
"""

from collections.abc import Sequence
from random import Random
from typing import TypeVar

from msgspec.structs import replace

from cpcbl_launch.lab.experiments.random_teams import random_team
from cpcbl_team.config import RobotSettings, Team

Drawn = TypeVar("Drawn")
USUAL = 0.5  # share of teams and robots in which one thing is as in other random teams
PLACE_SIGMAS_M = 0.02, 0.1
SCALE_SIGMAS = (0.02, 0.05), (0.1, 0.1)  # of distances, and of turns
BIAS_SIGMAS_DEG = 1.0, 5.0
CORRELATIONS_S = 0.3, 1.0
DELAYS_S = 0.1, 0.3
BUDGETS = 4.0, 20.0  # B/s
LOST_SHARES = 0.05, 0.3


def rough_team(seed: int) -> Team:
    """The team of a seed as its robots know it."""
    team, random = random_team(seed), Random(f"rough {seed}")
    sigma_m, bytes_per_s = _drawn(random, PLACE_SIGMAS_M, 0.0), _drawn(random, BUDGETS, 0.0)
    marks = {n: replace(mark, sigma_m=sigma_m) for n, mark in team.map.landmarks.items()}
    robots = {n: _rough(random, robot, bytes_per_s) for n, robot in team.robots.items()}
    return replace(
        team, name=f"rough-{seed}", map=replace(team.map, landmarks=marks), robots=robots
    )


def odometry_lost(seed: int) -> float:
    """The share of all pieces of odometry that do not arrive in the team of a seed."""
    return _drawn(Random(f"odometry {seed}"), LOST_SHARES, 0.0)


def _rough(random: Random, robot: RobotSettings, bytes_per_s: float) -> RobotSettings:
    of_distance, of_turn = _drawn(random, SCALE_SIGMAS, (0.0, 0.0))
    odometry = replace(robot.odometry, distance_scale_sigma=of_distance, turn_scale_sigma=of_turn)
    sensor = replace(
        robot.sensor,
        bearing_bias_sigma_deg=_drawn(random, BIAS_SIGMAS_DEG, 0.0),
        correlation_s=_drawn(random, CORRELATIONS_S, 0.0),
        delay_s=_drawn(random, DELAYS_S, 0.0),
    )
    budget = replace(robot.collaboration.budget, bytes_per_s=bytes_per_s)
    collaboration = replace(robot.collaboration, budget=budget)
    return replace(robot, odometry=odometry, sensor=sensor, collaboration=collaboration)


def _drawn(random: Random, values: Sequence[Drawn], usual: Drawn) -> Drawn:
    """One of these values, or the usual one."""
    return usual if random.random() < USUAL else random.choice(values)
