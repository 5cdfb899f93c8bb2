"""Fixes, beliefs and the position sensor in the localizer."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    LOOP_START,
    belief,
    diagonal,
    driven,
    fix,
    frame,
    least_eigenvalue,
    localizer,
    loop,
    matrix3,
    placed_at,
    point_sighting,
    sensor_noise,
    state_at,
)
from support.standing import ORIGIN, moved_parts, probabilistic, separated, standing, variants

from cpcbl_team.config import Field, Landmark, LocalizerSettings, SensorSettings, Variant
from cpcbl_team.estimate import ZERO3, Covariance3
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import BeliefShared, Sighting, Sightings


@probabilistic
@pytest.mark.parametrize("paper", [False, True])
def test_a_teammates_uncertainty_is_compounded_before_the_constraint(
    variant: Variant, paper: bool
) -> None:
    """Row 39: of a teammate that hardly knows its place, neither part of the pose is learnt."""
    robot = standing(variant, paper_uncertainty=paper)
    state = robot.add_teammate_belief(
        state_at(ORIGIN, diagonal(0.3, 0.2)), belief(2.0, 0.5, sigma_m=30.0)
    )
    for i in (1, 2):
        visible = point_sighting(Pose2(0.1, 0.05, 0.05), "mate", 6.0, 0.5)
        state = robot.cycle(state, Sightings(i, (visible,)))
    assert state.counts == {"accepted": 2}
    assert state.estimate.pose == pytest.approx(ORIGIN, abs=1e-3)


@probabilistic
def test_a_teammate_with_a_known_place_is_one_more_landmark(variant: Variant) -> None:
    """Rows 25, 31: an exact one is worth as much as a post."""
    post = Field(landmarks={"mate": Landmark(x_m=6.0, y_m=0.5)})
    ends = []
    for robot in (standing(variant, post), standing(variant, Field())):
        state = robot.add_teammate_belief(
            state_at(ORIGIN, diagonal(0.13, 0.1)), belief(6.0, 0.5, sigma_m=1e-6)
        )
        for i in (1, 2):
            visible = point_sighting(Pose2(0.1, 0.05, 0.05), "mate", 6.0, 0.5)
            state = robot.cycle(state, Sightings(i, (visible,)))
        ends.append(state.estimate)
    assert ends[1].pose == pytest.approx(ends[0].pose, rel=0.03)
    assert math.hypot(ends[1].pose.x, ends[1].pose.y) > 0.03


@probabilistic
def test_a_teammates_range_is_as_wide_as_sensor_and_place_together(variant: Variant) -> None:
    robot = standing(variant)
    state = robot.add_teammate_belief(
        state_at(ORIGIN, diagonal(5.0, 0.1)), belief(500.0, 0.0, sigma_m=0.4)
    )
    visible = Sightings(1, (Sighting("mate", 500.0, None, 0.3),))
    covariance = robot.cycle(state, visible).estimate.covariance
    if variant == "circular":
        assert covariance.xx == pytest.approx(5.0**2)  # the major axis
    else:
        assert covariance.xx == pytest.approx(0.25, rel=0.03)


@variants
def test_a_fix_moves_the_position(variant: Variant) -> None:
    robot = standing(variant)
    state = robot.add_fix(state_at(ORIGIN, diagonal(0.3, 0.2)), fix(0.2, -0.1, 1))
    pose = state.estimate.pose
    assert 0.0 < pose.x <= 0.2
    assert pose.y == pytest.approx(-0.5 * pose.x)
    assert state.counts == {"accepted": 1}


LEANING = Covariance3(0.04, 0.0, 0.09, 0.0, 0.02, 0.01)


@separated
def test_a_fix_leaves_the_heading_alone(variant: Variant) -> None:
    before = state_at(ORIGIN, LEANING)
    after = standing(variant).add_fix(before, fix(0.1, 0.2, 1))  # row 27
    assert moved_parts(before, after) == "position"
    assert after.estimate.covariance.hh == LEANING.hh


def test_in_the_joint_variant_a_fix_moves_the_heading_through_the_cross_covariance() -> None:
    before = state_at(ORIGIN, LEANING)
    after = standing("joint").add_fix(before, fix(0.1, 0.2, 1)).estimate
    moved = after.pose.y / LEANING.yy * LEANING.yh
    assert after.pose.heading == pytest.approx(moved)
    assert after.covariance.hh < LEANING.hh


@variants
def test_a_position_sensor_moves_the_position_and_none_of_it_is_shared(variant: Variant) -> None:
    """Row 28: like a fix, but nobody else's error is in it."""
    robot, before = standing(variant), state_at(ORIGIN, diagonal(0.3, 0.2))
    after = robot.add_position(before, placed_at(0.2, -0.1, 1, sigma_m=0.1))
    exact = robot.add_fix(before, fix(0.2, -0.1, 1, sensor_m=0.1, observer_m=0.0))
    assert moved_parts(before, after) == "position"
    assert after.estimate.pose == pytest.approx(exact.estimate.pose)
    assert after.estimate.shared == ZERO3
    assert after.counts == {"accepted": 1}


@variants
def test_a_position_far_off_is_rejected_and_counted(variant: Variant) -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    after = standing(variant).add_position(before, placed_at(3.0, 0.0, 1))
    assert after.estimate == before.estimate
    assert after.counts == {"gated": 1}


@separated
def test_a_position_sensor_leaves_the_heading_alone(variant: Variant) -> None:
    before = state_at(ORIGIN, LEANING)
    assert moved_parts(before, standing(variant).add_position(before, placed_at(0.1, 0.2, 1))) == (
        "position"
    )


def test_a_fix_is_no_update_of_a_type() -> None:
    robot = standing("oval", minimum_interval_s=1.0)
    state = robot.add_fix(state_at(ORIGIN, diagonal(0.3, 0.2)), fix(0.1, 0.1, 1))
    updates = state.updates
    assert (updates.position_ns, updates.heading_ns) == (None, None)
    assert updates.objects_ns == {"fix:mate": 1}


def test_shared_information_that_comes_back_is_not_new() -> None:
    """Its own belief, returned by a teammate, must not make it more certain (resolution c)."""
    robot = standing("joint")
    state = robot.mark_shared(state_at(ORIGIN, diagonal(0.2, 0.1)), BeliefShared(0))
    for i in range(1, 50):
        state = robot.add_fix(state, fix(0.0, 0.0, i, sensor_m=0.01, observer_m=0.2))
    assert state.estimate.position_sigma_m > 0.99 * 0.2


@probabilistic
def test_a_fix_without_new_information_changes_nothing(variant: Variant) -> None:
    """Its merge would inflate the rest of the pose: here the heading, by 2 % of its variance each
    time."""
    robot = standing(variant)
    before = robot.mark_shared(state_at(ORIGIN, diagonal(0.2, 0.1)), BeliefShared(0))
    state = before
    for i in range(1, 50):
        state = robot.add_fix(state, fix(0.0, 0.0, i, observer_m=0.5))
    assert state.estimate == before.estimate


@probabilistic
def test_a_fix_does_not_cost_the_heading(variant: Variant) -> None:
    """The weight that is best for the position alone gives up what is known of the heading."""
    robot = localizer(variant)
    state = robot.mark_shared(state_at(ORIGIN, diagonal(0.5, 0.05)), BeliefShared(0))
    state = robot.add_fix(state, fix(0.1, 0.1, 1))
    assert state.estimate.position_sigma_m < 0.1
    assert state.estimate.heading_sigma_rad < 2.0 * 0.05


@pytest.mark.parametrize("paper", [False, True])
@probabilistic
def test_the_shared_part_stays_a_part_of_the_covariance(variant: Variant, paper: bool) -> None:
    rng = np.random.default_rng(5)
    robot = localizer(rules=LocalizerSettings(variant=variant, paper_uncertainty=paper))
    noise, state = sensor_noise(rng, SensorSettings()), state_at(LOOP_START, diagonal(0.05, 0.05))
    for odometry, truth in driven(LOOP_START, loop()):
        now = odometry.stamp_ns
        state = robot.predict(robot.add_odometry(state, odometry), now)
        match rng.integers(4):
            case 0:
                state = robot.mark_shared(state, BeliefShared(now))
            case 1:
                x, y = (truth.x, truth.y) + 0.05 * rng.normal(size=2)
                state = robot.add_fix(state, fix(x, y, now))
            case 2:
                state = robot.cycle(state, frame(truth, now, noise=noise))
            case _:
                state = robot.add_teammate_belief(state, belief(1.0, 0.0, now))
                mate = noise(point_sighting(truth, "mate", 1.0, 0.0))
                state = robot.cycle(state, Sightings(now, (mate,)))
        covariance, shared = matrix3(state.estimate.covariance), matrix3(state.estimate.shared)
        for part in (covariance, shared, covariance - shared):
            assert least_eigenvalue(part) > -1e-9 * np.trace(covariance)


def test_two_teammates_in_one_frame_are_two_landmarks() -> None:
    """The second one is merged about the estimate that the first one moved."""
    places = {"mate": (3.0, 0.5), "other": (3.2, -0.4)}
    posts = Field(landmarks={n: Landmark(x_m=x, y_m=y) for n, (x, y) in places.items()})
    seen = [point_sighting(Pose2(0.1, 0.05, 0.05), n, *place) for n, place in places.items()]
    ends = []
    for robot in (standing("joint", posts), standing("joint", Field())):
        state = state_at(ORIGIN, diagonal(0.13, 0.1))
        for name, place in places.items() if robot.field.landmarks == {} else ():
            known = replace(belief(*place, sigma_m=1e-6), robot=name)
            state = robot.add_teammate_belief(state, known)
        ends.append(robot.cycle(state, Sightings(1, tuple(seen))).estimate)
    assert ends[1].pose == pytest.approx(ends[0].pose, rel=0.03)
    assert math.hypot(ends[1].pose.x, ends[1].pose.y) > 0.08


@pytest.mark.parametrize(("nis", "counts"), [(13.0, "accepted"), (14.5, "gated")])
def test_a_fix_is_rejected_by_the_bound_of_two_degrees_of_freedom(nis: float, counts: str) -> None:
    """99.9 %: 13.8; 10.8 of one degree of freedom."""
    before = state_at(ORIGIN, diagonal(0.3, 0.2))
    sigma_m = math.sqrt(0.3**2 + 2.0 * 0.05**2)
    after = standing("joint").add_fix(before, fix(math.sqrt(nis) * sigma_m, 0.0, 1))
    assert after.counts == {counts: 1}


@pytest.mark.parametrize(("nis", "counts"), [(10.0, "accepted"), (11.5, "gated")])
def test_the_heading_of_a_fix_is_rejected_by_the_bound_of_one(nis: float, counts: str) -> None:
    before = state_at(ORIGIN, diagonal(0.3, 0.2))
    sigma = math.sqrt(0.2**2 + 0.05**2 + 0.02**2)
    after = standing("joint").add_fix(before, fix(0.0, 0.0, 1, heading=math.sqrt(nis) * sigma))
    assert after.counts[counts] == 1


@pytest.mark.parametrize(("nis", "agrees"), [(8.5, True), (9.5, False)])
def test_a_fix_with_a_heading_is_judged_by_three_degrees_of_freedom(
    nis: float, agrees: bool
) -> None:
    """Half of it from the position, half from the heading; 6 of two are 9 of three."""
    before = state_at(ORIGIN, diagonal(0.3, 0.2))
    off_m = math.sqrt(0.5 * nis * (0.3**2 + 2.0 * 0.05**2))
    turned = math.sqrt(0.5 * nis * (0.2**2 + 0.05**2 + 0.02**2))
    after = standing("joint").add_fix(before, fix(off_m, 0.0, 1, heading=turned))
    assert (after.memory.teammates.senders["mate"].score == 0.0) is agrees
