"""/tf_static: where sensors are mounted, and the transforms that move nothing."""

import math
from typing import Any

import numpy as np
import pytest
from support.ros2 import OPTICAL, lab, message, static

from cpcbl_agents.vision.camera import Camera
from cpcbl_launch.run.ros2.refused import BadMessage, Refused
from cpcbl_launch.run.ros2.transforms_in import (
    CameraMounting,
    MovingFrames,
    StaticTransforms,
    mounted_at,
    mounting_text,
)
from cpcbl_team.config import CameraSettings
from cpcbl_transport.ros2 import messages as types

MOVING = MovingFrames("map", "odom", "base_link")


def about(axis: str, angle_deg: float) -> tuple[float, float, float, float]:
    half = math.radians(0.5 * angle_deg)
    x, y, z = (math.sin(half) * (axis == name) for name in "xyz")
    return x, y, z, math.cos(half)


def taken(*transforms: dict[str, Any]) -> tuple[StaticTransforms, list[Refused]]:
    said: list[Refused] = []
    own = StaticTransforms(said.append)
    for one in transforms:
        own.take(message(types.TRANSFORMS, transforms=[one]), MOVING)
    return own, said


def test_a_camera_is_where_the_chain_of_its_frames_leads() -> None:
    own, said = taken(
        static("base_footprint", "base_link", (0.0, 0.0, 0.01)),
        static("camera_link", "camera_optical_frame", (0.0, 0.0, 0.0), OPTICAL),
        static("base_link", "mast", (0.1, 0.02, 0.2), about("z", 20.0)),
        static("mast", "camera_link", (0.05, 0.0, 0.1), about("y", 5.0)),
    )
    assert not said
    matrix = own.base_from("camera_optical_frame", "base_link")
    assert matrix is not None
    found = mounted_at(CameraSettings(), matrix, "camera_optical_frame")
    ahead = 0.05 * np.array([math.cos(math.radians(20.0)), math.sin(math.radians(20.0))])
    assert (found.x_m, found.y_m) == pytest.approx((0.1 + ahead[0], 0.02 + ahead[1]))
    assert found.mounted_m == pytest.approx(0.31)  # above base_footprint
    assert (found.yaw_deg, found.tilt_deg, found.roll_deg) == pytest.approx((20.0, 5.0, 0.0))
    by_camera = Camera(found).robot_from_camera @ np.array([1.0, 2.0, 3.0])
    assert by_camera == pytest.approx(matrix[:3, :3] @ np.array([1.0, 2.0, 3.0]))
    assert own.base_from("camera_optical_frame", "") is not None  # before odometry names it
    assert own.base_from("lidar", "base_link") is None


@pytest.mark.parametrize(
    ("frame", "turn"),
    [("camera_optical", OPTICAL), ("camera", OPTICAL), ("camera_link", (0.0, 0.0, 0.0, 1.0))],
)
def test_a_frame_without_optical_in_its_name_is_upright(frame: str, turn: Any) -> None:
    own, _ = taken(static("base_link", frame, (0.1, 0.0, 0.3), turn))
    matrix = own.base_from(frame, "base_link")
    assert matrix is not None
    found = mounted_at(CameraSettings(), matrix, frame)
    assert (found.yaw_deg, found.tilt_deg, found.roll_deg) == pytest.approx((0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("transform", "reason"),
    [
        (static("camera", "camera"), BadMessage.FRAME_LOOP),
        (static("camera", "mast"), BadMessage.FRAME_LOOP),
        (static("mast", "base_link"), BadMessage.FRAME_LOOP),
        (static("camera", "odom"), BadMessage.FRAME_LOOP),  # by odometry
        (static("base_link", "map"), BadMessage.FRAME_LOOP),  # by this bridge
        (static("map", "odom"), BadMessage.TWO_PARENTS),
        (static("mast", "camera", (0.5, 0.0, 0.0)), BadMessage.TWO_PARENTS),
        (static("base_link", "camera"), BadMessage.TWO_PARENTS),
        (static("", "camera"), BadMessage.WRONG_FRAME),
        (static("mast", ""), BadMessage.WRONG_FRAME),
        (static("mast", "lidar", (math.nan, 0.0, 0.0)), BadMessage.NOT_FINITE),
        (static("mast", "lidar", turn=(math.inf, 0.0, 0.0, 1.0)), BadMessage.NOT_FINITE),
        (static("mast", "lidar", turn=(0.0, 0.0, 0.0, 0.0)), BadMessage.ZERO_QUATERNION),
    ],
)
def test_transforms_that_are_refused_or_doubted(
    transform: dict[str, Any], reason: BadMessage
) -> None:
    chain = static("base_link", "mast"), static("mast", "camera"), static("world", "map")
    own, said = taken(*chain, transform, static("mast", "camera"))
    assert said[0].reason is reason
    camera = own.base_from("camera", "base_link")
    assert camera is not None
    assert np.allclose(camera, np.eye(4))
    assert own.between("base_link", "lidar") is None


def test_a_loop_is_named() -> None:
    _, (refused,) = taken(
        static("base_link", "mast"), static("mast", "camera"), static("camera", "mast")
    )
    assert refused.text == "camera -> mast closes a loop of transforms: mast -> camera -> mast"


def test_the_static_transforms_count_where_the_team_file_says_nothing() -> None:
    own = CameraMounting("r1", CameraSettings())
    assert own.camera("camera_optical", "base_link") == CameraSettings()
    assert not own.findings
    own.take(message(types.TRANSFORMS, transforms=[static("base_link", "lidar")]), MOVING)
    assert own.camera("camera_optical", "base_link") == CameraSettings()
    (line,) = own.findings
    assert "/tf_static does not connect frame 'camera_optical' with the robot's" in line
    place = static("base_link", "camera_optical", (0.1, 0.0, 0.3), OPTICAL)
    own.take(message(types.TRANSFORMS, transforms=[place]), MOVING)
    found = own.camera("/camera_optical", "base_link")
    assert (found.x_m, found.mounted_m) == pytest.approx((0.1, 0.3))
    assert not own.findings
    low = static("base_link", "camera_optical", (0.1, 0.0, 0.0), OPTICAL)
    own.take(message(types.TRANSFORMS, transforms=[low]), MOVING)
    assert own.camera("camera_optical", "base_link") == CameraSettings()
    assert "is 0.00 m above the floor by /tf_static; publish base_footprint" in own.findings[0]


@pytest.mark.parametrize(("x_m", "said"), [(0.11, ""), (0.15, "x_m = 0.150")])
def test_a_team_file_that_says_something_else_counts_and_the_difference_is_said(
    x_m: float, said: str
) -> None:
    stated = lab().robots["r1"].camera  # x_m = 0.1
    own = CameraMounting("r1", stated)
    chain = [
        static("base_link", "mast", (x_m, 0.0, 0.25), about("z", 20.0)),
        static("mast", "camera_link", turn=about("y", 5.0)),
        static("camera_link", "camera_optical", turn=OPTICAL),
    ]
    own.take(message(types.TRANSFORMS, transforms=chain), MOVING)
    assert own.camera("camera_optical", "base_link") is stated
    assert own.base_from("camera_optical", "base_link") is None
    expected = (
        f"r1: frame 'camera_optical' is mounted at {said}, y_m = 0.000, mounted_m = 0.250,"
        " yaw_deg = 20.0, tilt_deg = 5.0, roll_deg = 0.0 by /tf_static, the team file says"
        f" {mounting_text(stated)}, which counts"
    )
    assert own.findings == ([expected] if said else [])
