"""nav_msgs/Odometry as pieces of odometry: what is used, and what moves nothing."""

import math
from typing import Any

import pytest
from support.ros2 import MS, T0, arc, odometry

from cpcbl_launch.run.ros2.odometry_in import OdometryInput, motion
from cpcbl_launch.run.ros2.refused import BadMessage, Refused
from cpcbl_team.config import Ros2RobotSettings
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry

ORIGIN = Pose2(0.0, 0.0, 0.0)
FAR = Pose2(-3.0, 2.0, 2.9)


def taken(reader: OdometryInput, message: Any) -> Odometry | Refused | None:
    stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    return reader.take(message, stamp_ns, stamp_ns)


def reader(**settings: Any) -> OdometryInput:
    return OdometryInput(Ros2RobotSettings(**settings), "map")


def reason_of(found: object) -> BadMessage | None:
    return found.reason if isinstance(found, Refused) else None


@pytest.mark.parametrize("speed", [0.6, -0.4, 0.0])
@pytest.mark.parametrize("turn_rate", [0.0, 1.5, -3.0])
@pytest.mark.parametrize("start", [ORIGIN, FAR])
def test_pieces_lead_to_the_pose_of_odometry_wherever_it_begins(
    speed: float, turn_rate: float, start: Pose2
) -> None:
    own, reached = reader(), start
    for i in range(101):
        pose = arc(speed, turn_rate, 0.05 * i, start)
        piece = taken(own, odometry(T0 + 50 * MS * i, pose, (speed, turn_rate)))
        assert isinstance(piece, Odometry) or i == 0
        if isinstance(piece, Odometry):
            assert piece.stamp_ns - piece.from_ns == 50 * MS
            assert math.copysign(1.0, piece.distance_m) == math.copysign(1.0, speed) or not speed
            reached = step(reached, piece.distance_m, piece.turn_rad)
    end = arc(speed, turn_rate, 5.0, start)
    assert math.hypot(reached.x - end.x, reached.y - end.y) < 1e-6
    assert abs(wrap_angle(reached.heading - end.heading)) < 1e-9


def test_fast_odometry_is_joined_and_loses_nothing() -> None:
    own, total = reader(), 0.0
    for i in range(1001):  # 1 kHz
        piece = taken(own, odometry(T0 + MS * i, Pose2(0.0005 * i, 0.0, 0.0)))
        if isinstance(piece, Odometry):
            assert piece.stamp_ns - piece.from_ns == 8 * MS
            total += piece.distance_m
    assert total == pytest.approx(0.5)


def test_the_reset_and_the_jump_of_a_pose_move_nothing() -> None:
    own, total = reader(), 0.0
    refused = []
    poses = [Pose2(0.02 * i, 0.0, 0.0) for i in range(20)]
    after_reset = [Pose2(0.02 * i, 0.0, 0.0) for i in range(20)]  # begins with 0, 0, 0
    carried = [Pose2(4.0 + 0.02 * i, -3.0, 1.0) for i in range(20)]
    for i, pose in enumerate([*poses, *after_reset, *carried]):
        found = taken(own, odometry(T0 + 50 * MS * i, pose, (0.4, 0.0)))
        if isinstance(found, Odometry):
            total += abs(found.distance_m)
            assert abs(found.distance_m) < 0.03
        elif isinstance(found, Refused):
            refused.append(found.reason)
    assert refused == [BadMessage.RESET, BadMessage.JUMP]
    assert total == pytest.approx(0.02 * 19 * 2 + 19 * 0.02 * math.cos(1.0), abs=0.01)


def test_a_small_reset_is_seen_by_the_velocity_that_does_not_lead_there() -> None:
    own = reader()
    assert taken(own, odometry(T0, Pose2(0.2, 0.0, 0.0), (0.1, 0.0))) is None
    found = taken(own, odometry(T0 + 50 * MS, Pose2(0.002, 0.0, 0.0), (0.1, 0.0)))
    assert reason_of(found) is BadMessage.JUMP


def test_a_velocity_that_nobody_fills_in_refuses_nothing() -> None:
    own = reader()
    for i in range(10):  # 2 Hz at 1 m/s, curving: the turn rate is always 0
        pose = arc(1.0, 1.2, 0.5 * i, ORIGIN)
        found = taken(own, odometry(T0 + 500 * MS * i, pose, (1.0, 0.0)))
        assert isinstance(found, Odometry) or i == 0


def test_times_that_do_not_go_on() -> None:
    own = reader()
    assert taken(own, odometry(T0, ORIGIN)) is None
    first = taken(own, odometry(T0 + 100 * MS, Pose2(0.01, 0.0, 0.0)))
    assert isinstance(first, Odometry)
    again = taken(own, odometry(T0 + 100 * MS, Pose2(0.02, 0.0, 0.0)))
    assert reason_of(again) is BadMessage.REPEATED
    late = taken(own, odometry(T0 + 50 * MS, Pose2(0.005, 0.0, 0.0)))
    assert reason_of(late) is BadMessage.OUT_OF_ORDER
    back = taken(own, odometry(T0 - 5000 * MS, ORIGIN))  # the bag begins again
    assert reason_of(back) is BadMessage.CLOCK_BACK
    goes_on = taken(own, odometry(T0 - 4950 * MS, Pose2(0.01, 0.0, 0.0)))
    assert isinstance(goes_on, Odometry)
    assert goes_on.from_ns == T0 - 5000 * MS
    gap = taken(own, odometry(T0 + 4000 * MS, Pose2(0.5, 0.0, 0.0)))
    assert reason_of(gap) is BadMessage.GAP


@pytest.mark.parametrize(
    ("frame", "child", "reason"),
    [
        ("odom", "base_footprint", None),
        ("r1/odom", "r1/base_link", None),
        ("/odom", "base_link", None),
        ("base_link", "odom", BadMessage.WRONG_FRAME),
        ("base_link", "base_link", BadMessage.FRAME_LOOP),
        ("map", "base_link", BadMessage.FRAME_LOOP),
        ("odom", "map", BadMessage.FRAME_LOOP),
        ("odometry", "base_link", BadMessage.WRONG_FRAME),
        ("", "base_link", BadMessage.WRONG_FRAME),
    ],
)
def test_frames(frame: str, child: str, reason: BadMessage | None) -> None:
    found = taken(reader(), odometry(T0, ORIGIN, frame=frame, child=child))
    assert reason_of(found) is reason


def test_a_second_publisher_with_another_base_frame_is_refused() -> None:
    own = reader()
    assert taken(own, odometry(T0, ORIGIN)) is None
    found = taken(own, odometry(T0 + 50 * MS, Pose2(2.0, 0.0, 0.0), child="imu_link"))
    assert isinstance(found, Refused)
    assert found.text.startswith("child frame 'base_link' expected, 'imu_link' came")


@pytest.mark.parametrize(
    ("pose", "covariance", "reason"),
    [
        (Pose2(math.nan, 0.0, 0.0), 0.0, BadMessage.NOT_FINITE),
        (Pose2(0.0, math.inf, 0.0), 0.0, BadMessage.NOT_FINITE),
        (Pose2(0.0, 0.0, math.nan), 0.0, BadMessage.NOT_FINITE),
        (ORIGIN, math.nan, BadMessage.NOT_FINITE),
    ],
)
def test_numbers_that_are_none(pose: Pose2, covariance: float, reason: BadMessage) -> None:
    found = taken(reader(), odometry(T0, pose, covariance=covariance))
    assert reason_of(found) is reason


def test_a_quaternion_of_zeros_is_no_rotation() -> None:
    message = odometry(T0, ORIGIN)
    message.pose.pose.orientation.w = 0.0
    found = taken(reader(), message)
    assert reason_of(found) is BadMessage.ZERO_QUATERNION


def test_motion_to_the_side_is_said() -> None:
    said: list[Refused] = []
    own = OdometryInput(Ros2RobotSettings(), "map", said.append)
    assert taken(own, odometry(T0, ORIGIN)) is None
    assert isinstance(taken(own, odometry(T0 + 100 * MS, Pose2(0.0, 0.08, 0.0))), Odometry)
    assert [one.reason for one in said] == [BadMessage.SIDEWAYS]


def test_the_track_has_the_pose_and_the_stamp_of_a_time() -> None:
    own = reader()
    for i in range(11):
        message = odometry(T0 + 100 * MS * i, Pose2(0.1 * i, 0.0, math.pi + 0.1 * i))
        own.take(message, T0 + 100 * MS * i, 5000 * i)  # another clock
    at = own.track.at(T0 + 250 * MS)
    assert at is not None
    assert at.ros_ns == 12_500
    assert at.odometry_from_base.x == pytest.approx(0.25)
    assert wrap_angle(at.odometry_from_base.heading - math.pi - 0.25) == pytest.approx(0.0)
    assert own.track.at(T0 + 1001 * MS) is None
    assert own.track.at(T0 - 1) is None
    distance, aside, turn = motion(Pose2(0.0, 0.0, 3.1), Pose2(-0.1, 0.0, -3.1))
    assert turn == pytest.approx(2.0 * (math.pi - 3.1))
    assert distance == pytest.approx(0.1, abs=1e-3)
    assert abs(aside) < 0.01
