"""A robot that knows so little that single readings determine no pose waits for more of them."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from support.core import (
    SECOND,
    diagonal,
    displaced,
    localizer,
    matrix3,
    point_sighting,
    sensor_noise,
    state_at,
)
from support.sweeps import over_seeds

from cpcbl_team.arcs import Arc
from cpcbl_team.config import Field, Gives, Landmark, OdometrySettings, SensorSettings, Start, Wall
from cpcbl_team.config.localizer import Variant
from cpcbl_team.delayed_prior import DelayedPrior, PropagatedPrior
from cpcbl_team.estimate import Estimate
from cpcbl_team.gate import AMBIGUOUS
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_team.motion import motion_noise, move
from cpcbl_team.state import State

ODOMETRY, SENSOR = OdometrySettings(), SensorSettings()
PIECE_NS = SECOND // 10
AHEAD, TURN = 0.05, 0.02  # m and rad a piece
BOUND = 30.0  # chi-square of two degrees of freedom: by chance once in three million times
Run = list[tuple[State, Pose2]]


class World(NamedTuple):
    """Landmarks, and what a robot at the origin knows of its start."""

    landmarks: dict[str, tuple[float, float, Gives]]
    sigma_m: float
    heading_sigma_deg: float
    variant: Variant = "joint"


ONE_RANGE = World({"a": (2.5, 1.5, "range")}, 0.05, 100.0)
RANGE_AND_BEARING = World({"a": (4.0, 3.0, "range"), "b": (-1.0, 3.0, "bearing")}, 1.0, 60.0)
BOTH_AND_RANGE = World({"a": (4.0, 3.0, "both"), "b": (-1.0, 3.0, "range")}, 1.0, 100.0)
BEARINGS = World(
    {n: (x, y, "bearing") for n, x, y in (("a", 4, 3), ("b", -1, 3), ("c", 1, 5))}, 1, 45
)
OVAL = World({"a": (3.0, 1.0, "both")}, 0.3, 30.0, "oval")


def run(world: World, seed: int, pieces: int = 200, start_off_m: float = 0.0) -> Run:
    """A circle of 2.5 m, with all landmarks in view."""
    rng = np.random.default_rng(seed)
    marks = {n: Landmark(x_m=x, y_m=y, gives=g) for n, (x, y, g) in world.landmarks.items()}
    start = Start(
        x_m=0.0, y_m=0.0, sigma_m=world.sigma_m, heading_sigma_deg=world.heading_sigma_deg
    )
    robot = localizer(world.variant, field=Field(landmarks=marks), start=start, odometry=ODOMETRY)
    noise, state, now = sensor_noise(rng, SENSOR), robot.start(0), 0
    truth = displaced(state.estimate.pose, state.estimate.covariance, rng)
    truth = truth._replace(x=truth.x + start_off_m)
    found = []
    for _ in range(pieces):
        drift = motion_noise(truth.heading, AHEAD, TURN, ODOMETRY)
        truth = displaced(step(truth, AHEAD, TURN), drift, rng)
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, AHEAD, TURN))
        now += PIECE_NS
        seen = [noise(point_sighting(truth, n, m.x_m, m.y_m)) for n, m in marks.items()]
        state = robot.cycle(state, Sightings(now, tuple(seen)))
        found.append((state, truth))
    return found


def chi_square(state: State, truth: Pose2) -> float:
    pose, (xx, xy, yy, *_), _ = state.reported
    x, y = truth.x - pose.x, truth.y - pose.y
    return (xx * y * y - 2.0 * xy * x * y + yy * x * x) / (xx * yy - xy * xy)


@over_seeds(12, 60)
@pytest.mark.parametrize(
    "world",
    [ONE_RANGE, RANGE_AND_BEARING, BOTH_AND_RANGE, BEARINGS, OVAL],
    ids=["range", "range and bearing", "both and range", "bearings", "oval"],
)
def test_it_is_not_certain_of_a_wrong_pose(world: World, seeds: range) -> None:
    """Linear at one pose of many, it was: up to a quarter of the runs."""
    wrong = [
        any(
            not state.lost and chi_square(state, truth) > BOUND for state, truth in run(world, seed)
        )
        for seed in seeds
    ]
    assert np.mean(wrong) <= 0.1


def test_the_evidence_determines_a_pose() -> None:
    """It waits while frames are ambiguous, and then knows its pose."""
    for world in (RANGE_AND_BEARING, BOTH_AND_RANGE, BEARINGS):
        states = [state for state, _ in run(world, 1)]
        assert states[0].counts.get(AMBIGUOUS)
        assert states[0].memory.recovery.delayed is not None
        last = states[-1]
        assert last.memory.recovery.delayed is None
        assert not last.lost
        assert last.estimate.heading_sigma_rad < math.radians(5.0)


def test_a_prior_that_the_evidence_contradicts_is_dropped() -> None:
    """The start is wrong by ten sigmas: the robot finds its pose by its evidence alone."""
    state, truth = run(BEARINGS._replace(sigma_m=0.5), 3, 300, start_off_m=5.0)[-1]
    assert not state.lost
    assert math.hypot(state.estimate.pose.x - truth.x, state.estimate.pose.y - truth.y) < 0.5


def test_walls_do_not_wait() -> None:
    """They are no evidence for a pose, so nothing would ever end it."""
    field = Field(walls={"south": Wall(from_m=(-9.0, -2.0), to_m=(9.0, -2.0))})
    robot = localizer(field=field)
    begin = state_at(Pose2(0.0, 0.0, 0.0), diagonal(0.5, math.radians(30.0)))
    state = robot.cycle(begin, Sightings(SECOND, (Sighting("south", 2.3, None),)))
    assert state.memory.recovery.delayed is None
    assert state.estimate.pose.y == pytest.approx(0.3, abs=0.1)


def test_a_delayed_prior_is_a_gaussian_on_the_tangent_at_any_pose() -> None:
    began = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.1, 0.5))
    estimate = move(began, 10.0, 0.0, ODOMETRY)
    prior = PropagatedPrior(DelayedPrior(0, estimate, Pose2(0.0, 0.0, 0.0)), Pose2(0.0, 0.0, 0.0))
    covariance, offset, cost = prior.about(estimate.pose)
    assert matrix3(covariance) == pytest.approx(matrix3(estimate.covariance), rel=1e-6, abs=1e-8)
    assert (*offset, cost) == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-9)
    arc, along = Arc.of(estimate), (0.2, -0.1, 0.7)
    covariance, offset, cost = prior.about(arc.at(along))
    squared = np.array(offset) @ np.linalg.solve(matrix3(covariance), np.array(offset))
    assert cost == pytest.approx(arc.cost(along))
    assert squared == pytest.approx(cost, rel=1e-4)
    assert prior.allows(arc.at((0.0, 0.0, 1.0)))
    assert not prior.allows(Pose2(0.0, 0.0, 0.0))
