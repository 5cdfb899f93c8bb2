"""The localizer as a whole: one prior for all constraints, runs without noise, the start."""

import math
from itertools import permutations

import numpy as np
import pytest
from support.core import (
    CORNERS,
    LOOP_START,
    MIXED,
    belief,
    diagonal,
    followed,
    frame,
    heading_error,
    localizer,
    loop,
    point_sighting,
    position_error,
    state_at,
)
from support.standing import ORIGIN, TENTH, standing, variants

from cpcbl_team.config import Field, Landmark, LocalizerSettings, SensorSettings, Start, Variant
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry, Sighting, Sightings

# One prior ----------------------------------------------------------------------------------------


@variants
def test_the_order_of_sightings_does_not_matter(variant: Variant) -> None:
    """All constraints come from the same prior (row 7)."""
    robot = standing(variant, MIXED)
    prior = robot.add_teammate_belief(state_at(ORIGIN, diagonal(0.3, 0.2)), belief(1.0, -1.0))
    true = Pose2(0.2, -0.1, 0.1)
    mate = point_sighting(true, "mate", 1.0, -1.0)
    ends = set()
    for names in permutations(["both", "ranged", "borne", "south"]):
        state = prior
        for i in (1, 2):
            visible = frame(true, i * TENTH, MIXED, names).sightings
            state = robot.cycle(state, Sightings(i * TENTH, (*visible[:2], mate, *visible[2:])))
        flat = (*state.estimate.pose, *state.estimate.covariance)
        ends.add(tuple(round(v, 9) + 0.0 for v in flat))
    assert len(ends) == 1


def test_constraints_are_combined_at_the_prior_not_one_after_the_other() -> None:
    """Two circles whose updates do not commute: worked at (0, 0) for both."""
    field = Field(
        landmarks={
            "a": Landmark(x_m=2.0, y_m=0.0, gives="range"),
            "b": Landmark(x_m=2.0, y_m=2.0, gives="range"),
        }
    )
    robot = standing("oval", field)
    state = state_at(ORIGIN, diagonal(0.04, 0.1))
    visible = (Sighting("a", 1.9, None, 0.1), Sighting("b", 2.6, None, 0.2))
    h = np.array([[-1.0, 0.0], [-(0.5**0.5), -(0.5**0.5)]])
    r, e = np.diag([0.1**2, 0.2**2]), np.array([1.9 - 2.0, 2.6 - 8.0**0.5])
    offset = 0.0016 * h.T @ np.linalg.solve(0.0016 * h @ h.T + r, e)
    pose = robot.cycle(state, Sightings(1, visible)).estimate.pose
    assert pose == pytest.approx((*offset, 0.0), abs=1e-9)


# A noise-free run ---------------------------------------------------------------------------------


@pytest.mark.parametrize("field", [CORNERS, MIXED], ids=["corners", "mixed"])
@variants
def test_without_noise_there_is_no_error(variant: Variant, field: Field) -> None:
    """Rows 1, 19, 24: a mixed map with walls too."""
    robot = localizer(variant, field, start=Start(x_m=LOOP_START.x, y_m=LOOP_START.y))
    run = list(followed(robot, robot.start(0), LOOP_START, loop()))
    worst = max(position_error(state.estimate, truth) for state, truth in run)
    state, truth = run[-1]
    assert worst < 1e-6
    assert heading_error(state.estimate, truth) < 1e-6
    assert set(state.counts) == {"accepted"}
    assert state.counts["accepted"] > 900


@pytest.mark.parametrize("field", [CORNERS, MIXED], ids=["corners", "mixed"])
@variants
def test_without_noise_a_wrong_start_is_mended(variant: Variant, field: Field) -> None:
    robot = localizer(variant, field)
    begin = Pose2(LOOP_START.x + 0.1, LOOP_START.y - 0.1, LOOP_START.heading + 0.05)
    *_, (state, truth) = followed(robot, state_at(begin, diagonal(0.1, 0.05)), LOOP_START, loop())
    assert position_error(state.estimate, truth) < 0.005
    assert heading_error(state.estimate, truth) < 0.001


# The heading's share (resolution a) ---------------------------------------------------------------


def sideways_sigma(paper: bool, heading_sigma: float) -> float:
    """After many bearings to a point 4 m ahead, with a heading that is this uncertain."""
    field = Field(landmarks={"ahead": Landmark(x_m=4.0, y_m=0.0, gives="bearing")})
    robot = standing("oval", field, paper_uncertainty=paper, sensor=SensorSettings())
    state = state_at(ORIGIN, diagonal(1.0, heading_sigma))
    state = state._replace(updates=state.updates._replace(heading_is_latest=True))
    for i in range(1, 40):
        visible = Sightings(i, (Sighting("ahead", None, 0.0, None, 0.01),))
        state = robot.cycle(state, visible)
        state = state._replace(updates=state.updates._replace(heading_is_latest=True))
    assert state.updates.heading_ns is None
    return math.sqrt(state.estimate.covariance.yy)


def test_a_bearing_cannot_place_better_than_the_heading_is_known() -> None:
    assert sideways_sigma(paper=False, heading_sigma=0.1) == pytest.approx(0.4, rel=0.1)


def test_the_papers_uncertainty_leaves_out_the_headings_share() -> None:
    once = 4.0 * math.sin(0.01) / math.sqrt(39.0)
    assert sideways_sigma(paper=True, heading_sigma=0.1) == pytest.approx(once, rel=0.01)


@pytest.mark.parametrize("variant", ["oval", "circular"])
def test_in_the_papers_uncertainty_heading_and_position_stay_apart(variant: Variant) -> None:
    robot = localizer(rules=LocalizerSettings(variant=variant, paper_uncertainty=True))
    state = robot.add_odometry(state_at(ORIGIN, diagonal(0.1, 0.1)), Odometry(0, TENTH, 0.1, 0.1))
    covariance = robot.predict(state, TENTH).estimate.covariance
    assert (covariance.xh, covariance.yh) == (0.0, 0.0)


# The start ----------------------------------------------------------------------------------------


def test_a_known_start_is_where_the_robot_is() -> None:
    place = Start(x_m=1.0, y_m=-1.0, heading_deg=90.0, sigma_m=0.2, heading_sigma_deg=10.0)
    state = localizer(start=place).start(7)
    assert state.stamp_ns == 7
    assert state.estimate.pose == pytest.approx((1.0, -1.0, 0.5 * math.pi))
    assert state.estimate.covariance == pytest.approx(diagonal(0.2, math.radians(10.0)))
    assert state.lost == ""


def test_an_unknown_start_is_anywhere_on_the_field() -> None:
    state = localizer(start=Start(known=False, x_m=1.0, y_m=-1.0)).start(7)
    assert state.lost == "start pose unknown"
    assert (state.estimate.pose.x, state.estimate.pose.y) == (0.0, 0.0)
    assert state.estimate.position_sigma_m >= 4.5
