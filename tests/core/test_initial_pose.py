"""A pose that somebody sets: it replaces the estimate, in order with all other inputs."""

import math
from itertools import islice, permutations

import pytest
from support.core import (
    LOOP_START,
    MIXED,
    PROBABILISTIC,
    SECOND,
    VARIANTS,
    diagonal,
    driven,
    fix,
    followed,
    frame,
    least_eigenvalue,
    localizer,
    loop,
    matrix3,
    position_error,
    state_at,
)
from support.sweeps import thorough

from cpcbl_team.config import Start, Variant
from cpcbl_team.estimate import ZERO3, Covariance3
from cpcbl_team.geometry import Pose2
from cpcbl_team.initial_pose import LEAST_SIGMA_M, LEAST_SIGMA_RAD, is_covariance
from cpcbl_team.inputs import BeliefShared, InitialPose, Input
from cpcbl_team.sender_records import QuarantineReason, SenderRecord, quarantined
from cpcbl_team.state import with_teammates
from cpcbl_team.timeline import Timeline

MS = SECOND // 1000
SHARP = (0.01, 0.0, 0.01, 0.0, 0.0, math.radians(5.0) ** 2)
RVIZ = (0.25, 0.0, 0.25, 0.0, 0.0, math.radians(15.0) ** 2)
ELSEWHERE = Pose2(2.0, 1.0, 2.5)
variants = pytest.mark.parametrize("variant", VARIANTS)


def given_at(
    pose: Pose2, stamp_ns: int, covariance: tuple[float, float, float, float, float, float] = RVIZ
) -> InitialPose:
    return InitialPose(stamp_ns, *pose, covariance)


@variants
def test_the_pose_is_the_given_one_and_the_robot_is_not_lost(variant: Variant) -> None:
    robot = localizer(variant, MIXED, start=Start(x_m=0.0, y_m=0.0, known=False))
    state = robot.set_pose(robot.start(0), given_at(ELSEWHERE, SECOND))
    assert state.estimate.pose == pytest.approx(ELSEWHERE)
    assert state.estimate.covariance == pytest.approx(Covariance3(*RVIZ))
    assert (state.stamp_ns, state.lost) == (SECOND, "")


@variants
def test_a_robot_that_was_carried_goes_on_from_the_pose_that_it_is_told(variant: Variant) -> None:
    robot, state = localizer(variant, MIXED), state_at(LOOP_START, diagonal(0.05, 0.05))
    *_, (state, _) = followed(robot, state, LOOP_START, loop()[:30])
    nearly = ELSEWHERE._replace(x=ELSEWHERE.x + 0.3, heading=ELSEWHERE.heading - 0.1)
    state = robot.set_pose(state, given_at(nearly, state.stamp_ns))
    *_, (state, truth) = followed(robot, state, ELSEWHERE, loop()[:30])
    assert position_error(state.estimate, truth) < 0.2
    assert state.counts.keys() == {"accepted"}  # it never was lost, and rejected nothing


@pytest.mark.parametrize("variant", PROBABILISTIC)
def test_nothing_of_it_is_shared_until_it_is_told(variant: Variant) -> None:
    """A teammate's fix is then merged as at the start: nothing in the estimate came from it."""
    robot, state = localizer(variant, MIXED), state_at(LOOP_START, diagonal(0.2, 0.1))
    for i in range(5):
        state = robot.add_fix(state, fix(LOOP_START.x, LOOP_START.y, i * SECOND))
    assert robot.mark_shared(state, BeliefShared(5 * SECOND)).estimate.shared is not ZERO3
    state = robot.set_pose(state, given_at(ELSEWHERE, 6 * SECOND))
    assert state.estimate.shared == ZERO3
    help_ = fix(ELSEWHERE.x + 0.1, ELSEWHERE.y, 7 * SECOND)
    begun = state_at(ELSEWHERE, Covariance3(*RVIZ), 6 * SECOND)
    begun = begun._replace(odometry_until_ns=state.odometry_until_ns)
    assert robot.add_fix(state, help_).estimate == robot.add_fix(begun, help_).estimate
    told = robot.mark_shared(state, BeliefShared(6 * SECOND + 1))
    assert told.estimate.shared == told.estimate.covariance


@pytest.mark.parametrize(
    ("covariance", "every"),
    [(SHARP, 1), (RVIZ, 24), thorough(RVIZ, 1)],
    ids=["a Gaussian", "a mixture", "a mixture, all orders"],
)
def test_in_any_order_of_arrival_it_comes_before_what_is_measured_at_its_time(
    covariance: tuple[float, float, float, float, float, float], every: int
) -> None:
    """Of all orders, one in `every`. A mixture of many components costs a tenth of a second each
    time that it is updated again after a late input."""
    robot, at_ns = localizer("joint", MIXED), 150 * MS
    moved = Pose2(ELSEWHERE.x + 0.2, ELSEWHERE.y, ELSEWHERE.heading)
    inputs: list[Input] = [
        *(odometry for odometry, _ in driven(LOOP_START, [(0.05, 0.0)] * 2)),
        frame(LOOP_START, 50 * MS, MIXED),
        given_at(moved, at_ns, covariance),
        frame(ELSEWHERE, at_ns, MIXED),
    ]
    states = []
    for order in islice(permutations(inputs), 0, None, every):
        timeline = Timeline(robot, state_at(LOOP_START, diagonal(0.05, 0.05)))
        for item in order:
            assert timeline.add(item) is None
            assert timeline.latest(at_ns).stamp_ns <= 200 * MS
        states.append(timeline.state)
    assert all(state == states[0] for state in states)
    assert (states[0].memory.mixture is None) is (covariance == SHARP)
    assert position_error(states[0].estimate, ELSEWHERE) < 0.1  # corrected by the frame


def test_what_was_measured_elsewhere_is_forgotten() -> None:
    robot, state = localizer("joint", MIXED), state_at(LOOP_START, diagonal(0.05, 0.05))
    *_, (state, _) = followed(robot, state, LOOP_START, loop()[:20])
    assert robot.recovery.evidence(state.memory.recovery)
    state = robot.set_pose(state, given_at(ELSEWHERE, state.stamp_ns))
    assert not robot.recovery.evidence(state.memory.recovery)


@pytest.mark.parametrize(("to", "reason"), [(ELSEWHERE, None), (LOOP_START, "biased")])
def test_a_robot_that_was_elsewhere_forgives_those_that_said_so(to: Pose2, reason: str) -> None:
    robot, state = localizer("joint", MIXED), state_at(LOOP_START, diagonal(0.02, 0.02))
    record = quarantined(SenderRecord(), QuarantineReason.BIASED, 0)
    memory = state.memory.teammates._replace(senders={"mate": record})
    state = robot.set_pose(with_teammates(state, memory), given_at(to, SECOND))
    after = state.memory.teammates.senders["mate"]
    assert (after.reason, after.quarantines) == (reason, 1)


def test_sigmas_have_a_floor_and_large_ones_make_the_robot_search() -> None:
    robot, state = localizer("joint", MIXED), state_at(LOOP_START, diagonal(0.05, 0.05))
    exact = robot.set_pose(state, given_at(ELSEWHERE, SECOND, (0.0,) * 6))
    floor = Covariance3(LEAST_SIGMA_M**2, 0.0, LEAST_SIGMA_M**2, 0.0, 0.0, LEAST_SIGMA_RAD**2)
    assert exact.estimate.covariance == floor
    wide = (400.0, 0.0, 400.0, 30.0, -9.0, 1e6)
    state = robot.set_pose(state, given_at(ELSEWHERE, SECOND, wide))
    assert state.lost == "position sigma 20.00 m"
    assert state.estimate.covariance.hh == pytest.approx(math.pi**2)
    assert least_eigenvalue(matrix3(state.estimate.covariance)) > 0.0
    state = robot.cycle(state, frame(LOOP_START, 2 * SECOND, MIXED))
    assert not state.lost
    assert position_error(state.estimate, LOOP_START) < 0.2


@pytest.mark.parametrize(
    ("covariance", "is_one"),
    [
        (RVIZ, True),
        ((0.0,) * 6, True),
        ((0.25, 0.1, 0.25, 0.02, 0.0, 0.07), True),
        ((1.0, 1.0, 1.0, 1.0, 1.0, 1.0), True),
        ((1.0, 1.1, 1.0, 0.0, 0.0, 1.0), False),
        ((0.0, 0.1, 1.0, 0.0, 0.0, 1.0), False),
        ((1.0, 0.0, 1.0, 0.0, 0.0, -1e-9), False),
        ((1.0, 0.9, 1.0, 0.9, -0.9, 1.0), False),
    ],
)
def test_six_numbers_are_a_covariance_or_not(
    covariance: tuple[float, float, float, float, float, float], is_one: bool
) -> None:
    assert is_covariance(covariance) is is_one
