"""What teammates say of landmarks whose places are not on the map."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    CORNERS,
    LOOP_START,
    SECOND,
    driven,
    frame,
    localizer,
    loop,
    matrix2,
    position_error,
)

from cpcbl_team.config import Field, SensorSettings, Start, Unsurveyed, Variant
from cpcbl_team.inputs import BeliefShared, Input, LandmarkBelief
from cpcbl_team.localizer import Localizer
from cpcbl_team.sender_records import QuarantineReason, SenderRecord
from cpcbl_team.state import State, with_landmark, with_teammates
from cpcbl_team.timeline import Timeline

EXACT_START = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.0, heading_sigma_deg=0.0)
VAGUE_START = replace(EXACT_START, x_m=LOOP_START.x + 0.3, sigma_m=0.3)
UNKNOWN_START = replace(EXACT_START, known=False)


def robot(start: Start, variant: Variant = "joint") -> Localizer:
    """A robot that knows the place of no corner."""
    field = Field(unsurveyed={name: Unsurveyed() for name in CORNERS.landmarks})
    sensor = SensorSettings(range_share=0.01, bearing_sigma_deg=0.5, max_range_m=20.0)
    return localizer(variant, field, start=start, sensor=sensor)


def belief_about(
    name: str, stamp_ns: int, sigma_m: float = 0.02, sender: str = "mate"
) -> LandmarkBelief:
    """The true place of a corner."""
    mark, variance = CORNERS.landmarks[name], sigma_m**2
    return LandmarkBelief(sender, name, stamp_ns, mark.x_m, mark.y_m, (variance, 0.0, variance))


def round_trip(robot: Localizer, state: State) -> State:
    """After one round with exact sensors and wheels."""
    for piece, truth in driven(LOOP_START, loop(), start_ns=state.stamp_ns):
        state = robot.add_odometry(state, piece)
        state = robot.cycle(state, frame(truth, piece.stamp_ns, CORNERS))
    return state


def after_beliefs(robot: Localizer, state: State, sigma_m: float = 0.02) -> State:
    for name in CORNERS.landmarks:
        state = robot.landmark_beliefs.add(state, belief_about(name, state.stamp_ns, sigma_m))
    return state


@pytest.mark.parametrize("variant", ["joint", "oval", "circular"])
def test_a_robot_without_a_map_takes_landmarks_where_a_teammate_says(variant: Variant) -> None:
    one = robot(VAGUE_START, variant)
    state = round_trip(one, after_beliefs(one, one.start(0)))
    assert position_error(state.estimate, LOOP_START) < 0.05
    assert state.estimate.position_sigma_m < 0.05
    assert state.estimate.shared == state.estimate.covariance


def without_trust(state: State, name: str) -> State:
    """With this teammate in quarantine."""
    expelled = SenderRecord(reason=QuarantineReason.BIASED)
    memory = state.memory.teammates._replace(senders={name: expelled})
    return with_teammates(state, memory)


def test_one_in_quarantine_takes_nobody_elses_place() -> None:
    """With a better one it replaced that of a correct teammate, and was not believed itself."""
    one = robot(VAGUE_START)
    state = one.landmark_beliefs.add(one.start(0), belief_about("ne", 0))
    state = without_trust(state, "liar")
    state = one.landmark_beliefs.add(state, belief_about("ne", 0, 0.001, "liar"))
    assert state.memory.teammates.trusted_landmarks["ne"].robot == "mate"


def test_a_lost_robot_finds_itself_by_what_a_teammate_says() -> None:
    one = robot(UNKNOWN_START)
    state = one.start(0)
    assert state.lost
    state = round_trip(one, after_beliefs(one, state))
    assert not state.lost
    assert position_error(state.estimate, LOOP_START) < 0.05


def test_a_robot_that_knows_its_pose_better_than_the_belief_finds_the_place_itself() -> None:
    one = robot(EXACT_START)
    state = round_trip(one, after_beliefs(one, one.start(0), sigma_m=0.5))
    assert state.common_errors is not None
    assert set(state.common_errors.objects) == set(CORNERS.landmarks)


def found(start: Start = EXACT_START) -> tuple[Localizer, State]:
    """A robot that has found all corners itself."""
    one = robot(replace(start, sigma_m=0.1, heading_sigma_deg=3.0))
    state = round_trip(one, one.start(0))
    assert state.common_errors is not None
    assert set(state.common_errors.objects) == set(CORNERS.landmarks)
    return one, state


def test_a_better_belief_improves_the_place_and_the_pose() -> None:
    one, before = found()
    after = after_beliefs(one, before)
    assert before.common_errors is not None
    assert after.common_errors is not None
    for name in CORNERS.landmarks:
        old, new = (s.place_covariance(name) for s in (before.common_errors, after.common_errors))
        assert new.xx + new.yy < 0.5 * (old.xx + old.yy)
    old_pose, new_pose = before.estimate.covariance, after.estimate.covariance
    assert new_pose.determinant() < 0.1 * old_pose.determinant()
    assert after.estimate.shared == after.estimate.covariance


def test_what_one_in_quarantine_says_changes_no_place_and_no_pose() -> None:
    """Of places that the robot has found, and of those that it has not."""
    vague = robot(VAGUE_START)
    for one, before in (found(), (vague, vague.start(0))):
        expelled = without_trust(before, "mate")
        seen = frame(LOOP_START, before.stamp_ns + SECOND, CORNERS)
        believed, told, without = (
            one.cycle(state, seen)
            for state in (after_beliefs(one, before), after_beliefs(one, expelled), expelled)
        )
        assert believed.estimate != without.estimate
        assert told.estimate == without.estimate
        assert told.common_errors == without.common_errors


def test_a_belief_that_came_while_it_was_of_no_use_is_merged_when_the_landmark_is_seen() -> None:
    one, before = found()
    state = before
    for name in CORNERS.landmarks:
        state = with_landmark(state, belief_about(name, state.stamp_ns))  # as while it was lost
    with_beliefs, without = (round_trip(one, s).common_errors for s in (state, before))
    assert with_beliefs is not None
    assert without is not None
    for name in CORNERS.landmarks:
        new, old = with_beliefs.place_covariance(name), without.place_covariance(name)
        assert new.xx + new.yy < 0.5 * (old.xx + old.yy)


def test_a_belief_that_comes_again_and_again_makes_nothing_certain() -> None:
    """Once it has come, its repetition tells nothing: below the belief's own sigma nothing gets."""
    one, state = found()
    state = one.mark_shared(state, BeliefShared(state.stamp_ns))
    for _ in range(100):
        state = one.landmark_beliefs.add(state, belief_about("ne", state.stamp_ns, 0.05))
    assert state.common_errors is not None
    place = state.common_errors.place_covariance("ne")
    assert np.linalg.eigvalsh(matrix2(place))[0] > 0.05**2


@pytest.mark.thorough
def test_beliefs_that_came_from_this_robot_make_no_pose_overconfident() -> None:
    """A teammate has improved what this robot once said: seven tenths of its error are still in it.
    Three times it says so; taken as new each time, it would give a NEES of 4.4."""
    errors = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        one, state = found(replace(EXACT_START, x_m=LOOP_START.x + 0.1 * rng.normal()))
        state = one.mark_shared(state, BeliefShared(state.stamp_ns))
        for name, mark in CORNERS.landmarks.items():
            assert state.common_errors is not None
            x, y = state.common_errors.place_error(name)
            xx, xy, yy = state.common_errors.place_covariance(name).scaled(0.5)
            belief = LandmarkBelief("mate", name, state.stamp_ns, 0.0, 0.0, (xx, xy, yy))
            x, y = mark.x_m + 0.7 * (x - mark.x_m), mark.y_m + 0.7 * (y - mark.y_m)
            for _ in range(3):
                state = one.landmark_beliefs.add(state, replace(belief, x_m=x, y_m=y))
        pose, c = state.estimate.pose, state.estimate.covariance
        off = np.array([pose.x - LOOP_START.x, pose.y - LOOP_START.y])
        errors.append(off @ np.linalg.inv(matrix2(c.position())) @ off)
    assert np.mean(errors) < 2.0 + 3.0 * math.sqrt(4.0 / len(errors))


def test_a_wrong_belief_moves_nothing_and_its_sender_is_no_longer_believed() -> None:
    one, state = found()
    wrong = replace(belief_about("ne", state.stamp_ns), x_m=CORNERS.landmarks["ne"].x_m + 5.0)
    for piece, truth in driven(LOOP_START, loop()[:60], start_ns=state.stamp_ns):
        state = one.landmark_beliefs.add(
            one.add_odometry(state, piece), replace(wrong, stamp_ns=state.stamp_ns)
        )
        state = one.cycle(state, frame(truth, piece.stamp_ns, CORNERS))
        assert position_error(state.estimate, truth) < 0.2
    assert state.counts["landmark_gated"] > 0
    assert state.memory.teammates.senders["mate"].reason
    assert not one.landmark_beliefs.usable(state)


def test_the_best_belief_is_kept_and_the_last_one_of_each_sender() -> None:
    state = robot(EXACT_START).start(0)
    first, worse = belief_about("ne", 0, 0.1), belief_about("ne", 1, 0.2, "other")
    state = with_landmark(with_landmark(state, first), worse)
    assert state.memory.teammates.landmarks["ne"] == first
    again = belief_about("ne", 2, 0.3)
    state = with_landmark(state, again)
    assert state.memory.teammates.landmarks["ne"] == again
    state = with_landmark(state, worse)
    assert state.memory.teammates.landmarks["ne"] == worse


def test_beliefs_in_any_order_give_the_same_state() -> None:
    inputs: list[Input] = [belief_about(name, k) for k, name in enumerate(CORNERS.landmarks, 1)]
    for piece, truth in driven(LOOP_START, loop()[:30]):
        inputs += [piece, frame(truth, piece.stamp_ns, CORNERS)]
    inputs.append(belief_about("ne", SECOND, 0.01, "other"))
    states = []
    for order in (inputs, inputs[::-1]):
        one = robot(VAGUE_START)
        timeline = Timeline(one, one.start(0), horizon_ns=60 * SECOND)
        for item in order:
            timeline.add(item)
        states.append(timeline.state)
    assert states[0] == states[1]
