"""Detections, ranges, images, positions and stamps of ROS 2 as inputs; and what moves nothing."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from support.ros2 import MS, T0, lab, message, pose_stamped

from cpcbl_agents.vision.camera import Camera
from cpcbl_agents.vision.pictures import decode_frame
from cpcbl_launch.run.ros2.planar import covariance_36, header_fields, pose_fields
from cpcbl_launch.run.ros2.positions_in import (
    east_north,
    initial_pose_of,
    position_of_fix,
    position_of_pose,
)
from cpcbl_launch.run.ros2.refused import BadMessage, Refused
from cpcbl_launch.run.ros2.sensors_in import (
    frame_of_compressed,
    frame_of_image,
    sightings_of_detections,
    sightings_of_range,
)
from cpcbl_launch.run.ros2.stamps import SimulatedStamps, UnixStamps
from cpcbl_team.config import Datum, Ros2RobotSettings
from cpcbl_team.config.ros2 import DetectionFrame
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import InitialPose, Position, Sightings
from cpcbl_transport.messages import Frame
from cpcbl_transport.ros2 import messages as types

NAMES = ("door", "gate", "r2")


def reason_of(found: object) -> BadMessage | None:
    return found.reason if isinstance(found, Refused) else None


# Detection3DArray ---------------------------------------------------------------------------------


def detection_3d(name: str, point: Any, covariance: Any = None) -> dict[str, Any]:
    x, y, z = (float(n) for n in point)
    pose: dict[str, Any] = {"pose": {"position": {"x": x, "y": y, "z": z}}}
    pose["covariance"] = [0.0] * 36 if covariance is None else covariance
    weak = {"hypothesis": {"class_id": "gate", "score": 0.1}}
    return {"results": [weak, {"hypothesis": {"class_id": name, "score": 0.9}, "pose": pose}]}


def taken_3d(frame: str, *found: dict[str, Any], kind: DetectionFrame = "by_name") -> Any:
    settings = lab().robots["r1"]
    own = Ros2RobotSettings(detections_3d_frame=kind)
    said: list[Refused] = []
    array = message(types.DETECTIONS, header=header_fields(T0, frame), detections=list(found))
    seen = sightings_of_detections(array, T0, replace(settings, ros2=own), NAMES, said.append)
    return seen, said


def test_a_detection_in_the_optical_frame_is_where_the_camera_model_has_it() -> None:
    camera = Camera(lab().robots["r1"].camera)
    point = np.array([[2.0, 0.9, 0.3]])  # in the robot's frame
    optical = camera.to_camera_frame(point)[0]
    rows: tuple[tuple[str, Any, DetectionFrame], ...] = (
        ("r1/camera_optical_frame", optical, "by_name"),
        ("some_frame", optical, "camera"),
        ("base_link", point[0], "by_name"),
        ("r1/base_footprint", point[0], "by_name"),
        ("some_frame", point[0], "robot"),
    )
    for frame, given, kind in rows:
        seen, said = taken_3d(frame, detection_3d("door", given), kind=kind)
        assert not said
        (one,) = seen.sightings
        assert one.id == "door"
        assert one.range_m == pytest.approx(math.hypot(2.0, 0.9))
        assert one.bearing_rad == pytest.approx(math.atan2(0.9, 2.0))
        assert one.range_sigma_m is None


def test_a_detection_in_a_frame_of_tf_static_is_where_that_is() -> None:
    turn, settings = np.eye(4), lab().robots["r1"]
    turn[:2, :2], turn[:2, 3] = [[0.0, -1.0], [1.0, 0.0]], (0.2, 0.1)  # a lidar, turned to the left
    array = message(
        types.DETECTIONS,
        header=header_fields(T0, "lidar"),
        detections=[detection_3d("door", (2.0, 0.0, 0.0))],
    )
    seen = sightings_of_detections(array, T0, settings, NAMES, lambda refused: None, turn)
    assert isinstance(seen, Sightings)
    (one,) = seen.sightings
    assert one.range_m == pytest.approx(math.hypot(0.2, 2.1))
    assert one.bearing_rad == pytest.approx(math.atan2(2.1, 0.2))


def test_a_covariance_turns_with_its_frame() -> None:
    camera = Camera(lab().robots["r1"].camera)
    in_robot = np.diag([0.2**2, 0.05**2, 0.1**2])
    turn = camera.robot_from_camera
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = turn.T @ in_robot @ turn
    optical = camera.to_camera_frame(np.array([[2.0, 0.0, 0.3]]))[0]
    seen, _ = taken_3d("optical", detection_3d("door", optical, covariance.ravel().tolist()))
    (one,) = seen.sightings
    assert one.range_sigma_m == pytest.approx(0.2)
    assert one.bearing_sigma_rad == pytest.approx(0.05 / 2.0)


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (detection_3d("Door", [1, 0, 0]), BadMessage.UNKNOWN_NAME),
        (detection_3d("door", [math.nan, 0, 0]), BadMessage.NOT_FINITE),
        (detection_3d("door", [1, 0, 0], [math.nan] * 36), BadMessage.NOT_FINITE),
        (detection_3d("door", [0, 0, 0]), BadMessage.BAD_DETECTION),
        (detection_3d("door", [1, 0, 0], [-1.0] * 36), BadMessage.NOT_A_COVARIANCE),
        ({"results": []}, BadMessage.BAD_DETECTION),
    ],
)
def test_detections_that_give_no_sighting(found: dict[str, Any], reason: BadMessage) -> None:
    seen, said = taken_3d("base_link", found)
    assert not seen.sightings
    assert [one.reason for one in said] == [reason]


def test_a_frame_of_which_nothing_is_known_is_refused() -> None:
    seen, _ = taken_3d("lidar", detection_3d("door", [1, 0, 0]))
    assert reason_of(seen) is BadMessage.WRONG_FRAME


# Range --------------------------------------------------------------------------------------------


def a_range(name: str, range_m: float, variance: float = 0.0) -> Any:
    limits = {"min_range": 0.1, "max_range": 20.0, "variance": variance}
    return message(types.RANGE, header=header_fields(T0, name), range=range_m, **limits)


def test_a_range_names_its_object_in_its_frame() -> None:
    seen = sightings_of_range(a_range("door", 2.5, 0.04), T0, NAMES)
    assert isinstance(seen, Sightings)
    (one,) = seen.sightings
    assert (one.id, one.range_m, one.bearing_rad) == ("door", 2.5, None)
    assert one.range_sigma_m == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (a_range("dor", 2.0), BadMessage.UNKNOWN_NAME),
        (a_range("door", math.inf), BadMessage.OUT_OF_RANGE),
        (a_range("door", 2500.0), BadMessage.OUT_OF_RANGE),
        (a_range("door", 0.0), BadMessage.OUT_OF_RANGE),
        (a_range("door", math.nan), BadMessage.NOT_FINITE),
        (a_range("door", 2.0, math.nan), BadMessage.NOT_A_COVARIANCE),
    ],
)
def test_ranges_that_are_none(given: Any, reason: BadMessage) -> None:
    assert reason_of(sightings_of_range(given, T0, NAMES)) is reason


# Images -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "rgba8", "bgra8"])
def test_an_image_arrives_with_its_colours(encoding: str) -> None:
    bgr = np.zeros((48, 64, 3), np.uint8)
    bgr[:, :32], bgr[:, 32:] = (200, 40, 20), (20, 60, 220)
    codes = {
        "rgb8": cv2.COLOR_BGR2RGB,
        "mono8": cv2.COLOR_BGR2GRAY,
        "rgba8": cv2.COLOR_BGR2RGBA,
        "bgra8": cv2.COLOR_BGR2BGRA,
    }
    pixels = cv2.cvtColor(bgr, codes[encoding]) if encoding in codes else bgr
    rows = pixels.reshape(48, -1)
    padded = np.hstack([rows, np.full((48, 16), 99, np.uint8)])  # rows may be longer
    size = {"height": 48, "width": 64, "encoding": encoding, "step": padded.shape[1]}
    image = message(types.IMAGE, header=header_fields(T0, "c"), data=padded.ravel(), **size)
    frame = frame_of_image(image, T0)
    assert isinstance(frame, Frame)
    decoded = decode_frame(frame.image, (64, 48))
    assert not isinstance(decoded, str)
    gray = cv2.cvtColor(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    wanted = gray if encoding == "mono8" else bgr
    middle = np.abs(decoded.astype(int) - wanted)[8:40, [8, 16, 48, 56]]
    assert middle.max() < 8


def test_images_that_are_none() -> None:
    header = header_fields(T0, "c")
    size = {"height": 48, "width": 64, "step": 192}
    short = message(types.IMAGE, header=header, encoding="bgr8", data=[0] * 100, **size)
    assert reason_of(frame_of_image(short, T0)) is BadMessage.WRONG_SIZE
    bayer = message(types.IMAGE, header=header, encoding="bayer_rggb8", data=[0] * 9216, **size)
    assert reason_of(frame_of_image(bayer, T0)) is BadMessage.WRONG_ENCODING
    depth = message(types.COMPRESSED_IMAGE, header=header, format="x", data=list(b"\0" * 50))
    assert reason_of(frame_of_compressed(depth, T0)) is BadMessage.WRONG_ENCODING
    large = message(
        types.COMPRESSED_IMAGE, header=header, data=list(b"\xff\xd8" + b"\0" * 1_100_000)
    )
    assert reason_of(frame_of_compressed(large, T0)) is BadMessage.WRONG_SIZE


# Positions ----------------------------------------------------------------------------------------


def test_a_pose_is_a_position_in_the_fields_frame() -> None:
    found = position_of_pose(pose_stamped(T0, Pose2(1.0, 2.0, 0.3), 0.1), T0, "map", None)
    assert isinstance(found, Position)
    assert (found.x_m, found.y_m) == (1.0, 2.0)
    assert found.covariance == pytest.approx((0.01, 0.0, 0.01))
    elsewhere = pose_stamped(T0, Pose2(1.0, 2.0, 0.3), 0.1, frame="odom")
    assert reason_of(position_of_pose(elsewhere, T0, "map", None)) is BadMessage.WRONG_FRAME
    unknown = pose_stamped(T0, Pose2(1.0, 2.0, 0.3), 0.0)
    assert reason_of(position_of_pose(unknown, T0, "map", None)) is BadMessage.NOT_A_COVARIANCE
    stated = position_of_pose(unknown, T0, "map", 0.2)
    assert isinstance(stated, Position)
    assert stated.covariance == pytest.approx((0.04, 0.0, 0.04))
    broken = message(
        types.POSE,
        header=header_fields(T0, "map"),
        pose={"pose": pose_fields(Pose2(0, 0, 0)), "covariance": covariance_36(*[math.nan] * 6)},
    )
    assert reason_of(position_of_pose(broken, T0, "map", None)) is BadMessage.NOT_FINITE


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, None),
        ({"frame": "r1/map"}, None),
        ({"frame": "odom"}, BadMessage.WRONG_FRAME),
        ({"frame": ""}, BadMessage.WRONG_FRAME),
        ({"pose": Pose2(math.nan, 0.0, 0.0)}, BadMessage.NOT_FINITE),
        ({"pose": Pose2(0.0, 0.0, math.nan)}, BadMessage.NOT_FINITE),
        ({"sigma_m": math.nan}, BadMessage.NOT_FINITE),
        ({"sigma_m": 0.0, "sigma_rad": 0.0}, None),
    ],
)
def test_a_pose_of_rviz_is_an_initial_pose(change: Any, reason: BadMessage | None) -> None:
    usual = {"pose": Pose2(1.0, 2.0, 0.3), "sigma_m": 0.5, "sigma_rad": math.radians(15.0)}
    given = pose_stamped(T0, **(usual | change))
    found = initial_pose_of(given, T0, {"map", "r1/map"})
    assert reason_of(found) is reason
    if reason is None:
        assert isinstance(found, InitialPose)
        assert (found.x_m, found.y_m, found.heading_rad) == pytest.approx((1.0, 2.0, 0.3))
        rviz = 0.25, 0.0, 0.25, 0.0, 0.0, math.radians(15.0) ** 2
        assert found.covariance == pytest.approx(rviz)


def test_an_initial_pose_without_a_rotation_or_a_covariance_is_refused() -> None:
    given = pose_stamped(T0, Pose2(1.0, 2.0, 0.3), 0.5)
    given.pose.pose.orientation.w = given.pose.pose.orientation.z = 0.0
    assert reason_of(initial_pose_of(given, T0, {"map"})) is BadMessage.ZERO_QUATERNION
    numbers = covariance_36(0.25, 0.0, -0.25, 0.0, 0.0, 0.1)
    pose = {"pose": pose_fields(Pose2(0.0, 0.0, 0.0)), "covariance": numbers}
    given = message(types.POSE, header=header_fields(T0, "map"), pose=pose)
    assert reason_of(initial_pose_of(given, T0, {"map"})) is BadMessage.NOT_A_COVARIANCE


DATUM = Datum(latitude_deg=52.0, longitude_deg=13.0, x_axis_deg=90.0)  # x is north


def nav_sat_fix(latitude: float, longitude: float, status: int = 0, variance: float = 1.0) -> Any:
    return message(
        types.NAV_SAT_FIX,
        header=header_fields(T0, "gps"),
        status={"status": status},
        latitude=latitude,
        longitude=longitude,
        position_covariance=[variance, 0, 0, 0, 4.0 * variance, 0, 0, 0, 9.0],
        position_covariance_type=2,
    )


def test_a_fix_is_metres_along_the_fields_axes() -> None:
    east, north = east_north(52.0 + 1.0 / 3600.0, 13.0, DATUM)
    assert (east, north) == pytest.approx(
        (
            0.0,
            30.9,
        ),
        abs=0.02,
    )  # a second of arc
    east, _ = east_north(52.0, 13.0 + 1.0 / 3600.0, DATUM)
    assert east == pytest.approx(30.92 * math.cos(math.radians(52.0)) * 1.0021, abs=0.05)
    found = position_of_fix(nav_sat_fix(52.0 + 1.0 / 3600.0, 13.0), T0, DATUM, None)
    assert isinstance(found, Position)
    assert found.x_m == pytest.approx(30.9, abs=0.02)
    assert found.y_m == pytest.approx(0.0, abs=1e-6)
    assert found.covariance == pytest.approx((4.0, 0.0, 1.0))  # north, then west


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (nav_sat_fix(52.0, 13.0, status=-1), BadMessage.NO_FIX),
        (nav_sat_fix(math.nan, 13.0), BadMessage.NOT_FINITE),
        (nav_sat_fix(0.0, 0.0), BadMessage.OUT_OF_RANGE),
        (nav_sat_fix(520_000_000.0, 130_000_000.0), BadMessage.OUT_OF_RANGE),
        (nav_sat_fix(52.0, 13.0, variance=-1.0), BadMessage.NOT_A_COVARIANCE),
    ],
)
def test_fixes_that_are_none(given: Any, reason: BadMessage) -> None:
    assert reason_of(position_of_fix(given, T0, DATUM, None)) is reason


# Stamps -------------------------------------------------------------------------------------------


def test_stamps_of_another_clock_are_refused_with_the_fix() -> None:
    own = UnixStamps()
    assert own.team_ns(T0, T0 + 3 * MS) == T0
    assert own.lag_s() == pytest.approx(0.003)
    far = own.team_ns(T0 - 3_200 * 1000 * MS, T0)
    assert isinstance(far, Refused)
    assert far.text.startswith("stamps differ by 3,200 s: use_sim_time?")
    assert reason_of(own.team_ns(0, T0)) is BadMessage.WRONG_CLOCK


@pytest.mark.parametrize("speed", [1.0, 0.4, 2.5])
def test_simulated_time_follows_at_any_speed_without_a_jump(speed: float) -> None:
    own, random = SimulatedStamps(), np.random.default_rng(2)
    latest, offs, ratios = 0, [], []
    for i in range(1, 2001):  # 20 Hz of simulated time, which arrives late by some milliseconds
        due_ns = T0 + int(50 * MS * i / speed)
        arrived_ns = due_ns + int(random.exponential(3.0) * MS)
        team_ns = own.team_ns(50 * MS * i, arrived_ns)
        assert isinstance(team_ns, int)
        assert latest < team_ns <= arrived_ns
        if i > 400:
            offs.append(abs(arrived_ns - team_ns) * 1e-6)
            ratios.append((team_ns - latest) / (50 * MS / speed))
        latest = team_ns
    assert np.quantile(offs, 0.99) < 30.0  # ms
    assert 0.7 < min(ratios) <= max(ratios) < 1.3


def test_simulated_time_survives_a_pause_and_a_restart() -> None:
    own = SimulatedStamps()
    for i in range(100):
        own.team_ns(50 * MS * i, T0 + 50 * MS * i)
    later = own.team_ns(5000 * MS, T0 + 65_000 * MS)  # the simulation was paused for a minute
    assert isinstance(later, int)
    assert later <= T0 + 65_000 * MS
    for i in range(1, 400):
        later = own.team_ns(5000 * MS + 50 * MS * i, T0 + 65_000 * MS + 50 * MS * i)
    assert isinstance(later, int)
    assert abs(later - (T0 + 84_950 * MS)) < 100 * MS
    again = own.team_ns(50 * MS, T0 + 90_000 * MS)  # and is started again
    assert again == T0 + 90_000 * MS
