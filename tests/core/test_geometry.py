import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import angles, coordinates, poses

from cpcbl_team.geometry import Pose2, phase, step, wrap_angle


def same_pose(a: Pose2, b: Pose2) -> bool:
    return math.hypot(a.x - b.x, a.y - b.y) < 1e-9 and abs(wrap_angle(a.heading - b.heading)) < 1e-9


@given(st.floats(-1e3, 1e3))
def test_a_wrapped_angle_is_the_same_direction_within_half_a_turn(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert abs(wrapped) <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_the_phase_of_a_number_beside_the_axis_is_zero() -> None:
    """`cmath.phase` raises an OverflowError there: a driver's bearing may be so small."""
    assert phase(complex(3.0, 5e-324)) == 0.0
    assert phase(complex(0.0, -2.0)) == -0.5 * math.pi


@given(poses)
def test_a_pose_and_its_inverse_cancel_from_both_sides(pose: Pose2) -> None:
    nothing = Pose2(0.0, 0.0, 0.0)
    assert same_pose(pose @ pose.inverse(), nothing)
    assert same_pose(pose.inverse() @ pose, nothing)


@given(poses, poses, poses)
def test_composition_is_associative(a: Pose2, b: Pose2, c: Pose2) -> None:
    assert same_pose((a @ b) @ c, a @ (b @ c))


@given(poses, poses, coordinates, coordinates)
def test_a_composition_transforms_points_as_its_parts_do(
    a: Pose2, b: Pose2, x: float, y: float
) -> None:
    assert (a @ b).transform(x, y) == pytest.approx(a.transform(*b.transform(x, y)), abs=1e-9)


def test_a_pose_maps_points_of_its_robot_into_the_field() -> None:
    field_from_robot = Pose2(1.0, 2.0, 0.5 * math.pi)
    assert field_from_robot.transform(3.0, 0.0) == pytest.approx((1.0, 5.0))  # forward is north
    assert field_from_robot.transform(0.0, 1.0) == pytest.approx((0.0, 2.0))  # left is west


@given(poses, st.floats(-2.0, 2.0))
def test_a_straight_step_leads_along_the_heading(pose: Pose2, distance: float) -> None:
    assert same_pose(step(pose, distance, 0.0), pose @ Pose2(distance, 0.0, 0.0))


@given(poses, st.floats(-1.0, 1.0), angles)
def test_a_step_back_undoes_a_step(pose: Pose2, distance: float, turn: float) -> None:
    assert same_pose(step(step(pose, distance, turn), -distance, -turn), pose)


def test_small_steps_follow_an_arc() -> None:
    pose = Pose2(0.0, 0.0, 0.0)
    for _ in range(1000):
        pose = step(pose, 0.5 * math.pi / 1000, 0.5 * math.pi / 1000)
    assert pose == pytest.approx((1.0, 1.0, 0.5 * math.pi), abs=1e-6)
