"""Messages of ROS 2 as robots send them, for tests of the bridge."""

import math
from functools import cache
from typing import Any

from cpcbl_launch.run.ros2.building import build_message
from cpcbl_launch.run.ros2.planar import (
    covariance_36,
    header_fields,
    pose_fields,
)
from cpcbl_launch.team.file import parse_team
from cpcbl_team.config import Team
from cpcbl_team.geometry import Pose2
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.messages import MessageTypes
from cpcbl_transport.ros2.names import Distribution

MS = 1_000_000
OPTICAL = (-0.5, 0.5, -0.5, 0.5)  # x right, y down, z ahead, in the axes of a body (REP 103)
T0 = 1_700_000_000_000_000_000
TEAM = """
name = "lab"
[map.landmarks]
door = { x_m = 3.0, y_m = 0.0 }
gate = { x_m = 0.0, y_m = 3.0 }
[vision]
family = "apriltag_36h11"
marker_m = 0.16
[ros2]
tags = { door = { id = 7, mounted_m = 0.4, side_m = 0.2 } }
[defaults]
source = "external"
[robots.r1]
start = { x_m = 0.0, y_m = 0.0 }
camera = { mounted_m = 0.25, x_m = 0.1, yaw_deg = 20.0, tilt_deg = 5.0 }
[robots.r2]
start = { x_m = 1.0, y_m = 0.0 }
markers = { front = 0, left = 1, back = 2, right = 3 }
"""


def lab(*changes: tuple[str, str]) -> Team:
    """The team of these tests, with pieces of its file replaced."""
    text = TEAM
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return parse_team(text)


@cache
def message_types() -> MessageTypes:
    return MessageTypes(Distribution.JAZZY)


def message(name: str, **fields: Any) -> Any:
    """A message after a way over the wire: as a subscriber gets it."""
    own = message_types()
    return own.decode(name, own.encode(build_message(own, name, fields)))


def odometry(
    stamp_ns: int,
    pose: Pose2,
    velocity: tuple[float, float] = (0.0, 0.0),
    frame: str = "odom",
    child: str = "base_link",
    covariance: float = 0.01,
) -> Any:
    return message(
        types.ODOMETRY,
        header=header_fields(stamp_ns, frame),
        child_frame_id=child,
        pose={"pose": pose_fields(pose), "covariance": [covariance] * 36},
        twist={"twist": {"linear": {"x": velocity[0]}, "angular": {"z": velocity[1]}}},
    )


def camera_info(frame: str = "camera", **fields: Any) -> Any:
    matrix = [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0]
    projection = [600.0, 0.0, 320.0, 0.0, 0.0, 600.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    usual: dict[str, Any] = {
        "header": header_fields(T0, frame),
        "height": 480,
        "width": 640,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": matrix,
        "p": projection,
    }
    return message(types.CAMERA_INFO, **(usual | fields))


def detection(tag: int, corners: Any, family: str = "tag36h11") -> dict[str, Any]:
    """A detection; corners (4, 2) in pixels."""
    points = [{"x": float(x), "y": float(y)} for x, y in corners]
    return {"family": family, "id": tag, "corners": points, "decision_margin": 60.0}


def detections(stamp_ns: int, *found: dict[str, Any], frame: str = "camera") -> Any:
    header = header_fields(stamp_ns, frame)
    return message(types.APRIL_TAGS, header=header, detections=list(found))


def pose_stamped(
    stamp_ns: int, pose: Pose2, sigma_m: float, sigma_rad: float = 0.1, frame: str = "map"
) -> Any:
    covariance = covariance_36(sigma_m**2, 0.0, sigma_m**2, 0.0, 0.0, sigma_rad**2)
    return message(
        types.POSE,
        header=header_fields(stamp_ns, frame),
        pose={"pose": pose_fields(pose), "covariance": covariance},
    )


def static(
    parent: str, child: str, point: Any = (0.0, 0.0, 0.0), turn: Any = (0.0, 0.0, 0.0, 1.0)
) -> dict[str, Any]:
    return {
        "header": header_fields(T0, parent),
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", map(float, point), strict=True)),
            "rotation": dict(zip("xyzw", map(float, turn), strict=True)),
        },
    }


def arc(speed_m_s: float, turn_rate_rad_s: float, seconds: float, start: Pose2) -> Pose2:
    """Where a robot is that drives an arc from a start."""
    turn = turn_rate_rad_s * seconds
    if abs(turn) < 1e-12:
        return start @ Pose2(speed_m_s * seconds, 0.0, 0.0)
    radius = speed_m_s / turn_rate_rad_s
    return start @ Pose2(radius * math.sin(turn), radius * (1.0 - math.cos(turn)), turn)
