"""Poses, transforms, diagnostics and markers as ROS 2 has them."""

import math

import pytest
from support.ros2 import T0, lab, message, message_types

from cpcbl_launch.reporting.metrics import ellipse_of
from cpcbl_launch.run.ros2.building import build_message
from cpcbl_launch.run.ros2.diagnostics_out import (
    ERROR,
    OK,
    STALE,
    WARN,
    bridge_diagnostic,
    diagnostics_message,
    robot_diagnostic,
)
from cpcbl_launch.run.ros2.markers_out import helpers, markers_message
from cpcbl_launch.run.ros2.odometry_in import TrackPoint
from cpcbl_launch.run.ros2.planar import planar_pose, stamp_of
from cpcbl_launch.run.ros2.poses_out import (
    field_from_odometry,
    odometry_message,
    pose_message,
    transform_message,
)
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_transport.messages import Flow, Pose, Status, Trust
from cpcbl_transport.ros2 import messages as types

ROWS = ((0.04, 0.01, 0.001), (0.01, 0.09, 0.002), (0.001, 0.002, 0.03))
POSE = Pose("r1", T0, 3.0, -2.0, 2.5, ROWS)
AT = TrackPoint(T0, 5_000_000_000, Pose2(-7.0, 4.0, -2.8))


def status(**changes: object) -> Status:
    usual: dict[str, object] = {
        "robot": "r1",
        "incarnation": "1",
        "stamp_ns": T0,
        "position_sigma_m": 0.1,
        "heading_sigma_rad": 0.05,
        "tier": 3,
        "lost": "",
        "counts": {},
        "messages_sent": 0,
        "bytes_sent": 0,
        "messages_received": 0,
        "bytes_received": 0,
    }
    return Status(**(usual | changes))  # type: ignore[arg-type]


def test_a_pose_is_that_of_amcl() -> None:
    found = message(types.POSE, **pose_message(POSE, 5_000_000_007, "map"))
    assert found.header.frame_id == "map"
    assert stamp_of(found.header) == 5_000_000_007
    assert planar_pose(found.pose.pose) == pytest.approx(Pose2(3.0, -2.0, 2.5))
    covariance = found.pose.covariance.reshape(6, 6)
    assert covariance[:2, :2].tolist() == [[0.04, 0.01], [0.01, 0.09]]
    assert covariance[5].tolist() == [0.001, 0.002, 0.0, 0.0, 0.0, 0.03]
    assert (covariance == covariance.T).all()


def test_the_transforms_chain_to_the_pose() -> None:
    found = message(types.TRANSFORMS, **transform_message(POSE, AT, ("map", "odom"), 0.5))
    (transform,) = found.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    assert stamp_of(transform.header) == AT.ros_ns + 500_000_000
    rotation = transform.transform.rotation
    angle = 2.0 * math.atan2(rotation.z, rotation.w)
    shift = transform.transform.translation
    chained = Pose2(shift.x, shift.y, angle) @ AT.odometry_from_base
    assert chained[:2] == pytest.approx((3.0, -2.0))
    assert wrap_angle(chained.heading - 2.5) == pytest.approx(0.0)
    assert field_from_odometry(POSE, AT)[:2] == pytest.approx((shift.x, shift.y))


def test_the_pose_as_odometry() -> None:
    fields = odometry_message(POSE, T0, ("map", "base_link"), (0.4, -0.1))
    found = message(types.ODOMETRY, **fields)
    assert (found.header.frame_id, found.child_frame_id) == ("map", "base_link")
    assert found.twist.twist.linear.x == 0.4
    assert found.twist.twist.angular.z == -0.1


@pytest.mark.parametrize(
    ("changes", "level", "words"),
    [
        ({}, OK, "localized"),
        ({"lost": "position sigma 3 m"}, ERROR, "lost: position sigma 3 m"),
        ({"problems": ("no odometry",)}, WARN, "no odometry"),
        ({"unconfirmed": "found without a start"}, WARN, "found without a start"),
        ({"trust": (Trust("r2", "bias"),)}, WARN, "distrusts r2 (bias)"),
    ],
)
def test_a_diagnostic_says_what_is_wrong(
    changes: dict[str, object], level: int, words: str
) -> None:
    found = robot_diagnostic("r1", status(**changes), 0.5)
    assert (found["level"], found["message"]) == (level, words)
    array = message(types.DIAGNOSTICS, **diagnostics_message([found], T0))
    assert array.status[0].name == "cpcbl: r1"
    assert {value.key for value in array.status[0].values} >= {"tier", "lost", "quarantine"}


def test_a_robot_that_says_nothing_is_stale_and_findings_are_a_warning() -> None:
    assert robot_diagnostic("r1", status(), 7.0)["level"] == STALE
    assert robot_diagnostic("r1", None, 0.0)["level"] == STALE
    assert bridge_diagnostic("", [])["level"] == OK
    found = bridge_diagnostic("r1", ["r1/odom: nobody publishes it"])
    assert (found["level"], found["name"]) == (WARN, "cpcbl: r1 bridge")


def test_markers_show_robots_landmarks_and_help() -> None:
    poses = {"r1": POSE, "r2": Pose("r2", T0, 1.0, 1.0, 0.0, None, lost="kidnapped")}
    fields = markers_message(poses, [("r1", "r2"), ("r1", "r9")], lab().map, "map", 1.5)
    found = message(types.MARKERS, **fields).markers
    names = [marker.ns for marker in found]
    assert len(set(names)) == len(names)  # each replaces the one before it alone
    assert {"cpcbl robots/r1", "cpcbl ellipses/r1", "cpcbl landmarks/door"} <= set(names)
    by_name = {marker.ns: marker for marker in found}
    assert len(by_name["cpcbl help/help"].points) == 2
    assert by_name["cpcbl names/r2"].text == "r2 (lost)"
    assert all(marker.lifetime.sec == 1 for marker in found)
    assert all(marker.header.frame_id == "map" for marker in found)
    assert all(marker.color.a > 0.0 for marker in found)
    assert all(marker.pose.orientation.w or marker.pose.orientation.z for marker in found)


def test_an_ellipse_lies_along_the_larger_axis() -> None:
    assert ellipse_of(0.04, 0.0, 0.01) == pytest.approx((0.2, 0.1, 0.0))
    assert ellipse_of(0.01, 0.0, 0.04) == pytest.approx((0.2, 0.1, 0.5 * math.pi))
    major, minor, direction = ellipse_of(0.025, 0.015, 0.025)
    assert (major, minor, direction) == pytest.approx((0.2, 0.1, 0.25 * math.pi))


def test_a_teammate_helps_when_its_messages_have_become_more() -> None:
    counts, latest = helpers({}, status(heard=(Flow("fix", "r2", 7), Flow("alive", "r2", 9))))
    assert (counts, latest) == ({"r2": 7}, [])
    counts, latest = helpers(counts, status(heard=(Flow("fix", "r2", 7), Flow("belief", "r2", 1))))
    assert (counts, latest) == ({"r2": 8}, ["r2"])


def test_a_field_that_a_type_does_not_have_is_a_mistake_of_the_programmer() -> None:
    with pytest.raises(TypeError, match="no field 'colour'"):
        build_message(message_types(), types.MARKERS, {"markers": [{"colour": {}}]})
