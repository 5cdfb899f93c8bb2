"""AprilTag detections as sightings: corners of our camera model, in any order, with noise."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from support.ros2 import T0, camera_info, detection, detections, lab

from cpcbl_agents.vision.camera import Camera, Floats
from cpcbl_agents.vision.poses import side_corners
from cpcbl_launch.run.ros2.refused import BadMessage, Refused
from cpcbl_launch.run.ros2.tags_in import TagInput
from cpcbl_team.config import CameraSettings, Side, Team
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Sightings

LENS = [-0.3, 0.1, 0.001, -0.002, 0.0]
DOOR, MATE = Pose2(2.5, 1.2, -2.3), Pose2(1.8, 0.3, 2.6)


def true_camera(team: Team, distortion: Any = (0.0,) * 5) -> Camera:
    settings = replace(team.robots["r1"].camera, fx_px=600.0, fy_px=600.0, cx_px=320.0, cy_px=240.0)
    return Camera(replace(settings, distortion=tuple(distortion)))


def corners_of(team: Team, camera: Camera, name: str, side: Side, pose: Pose2) -> Floats:
    """The pixels (4, 2) of a tag, from its upper left corner on, of an object at a pose in the
    robot's frame."""
    vision = team.vision
    if name == "door":
        vision = replace(vision, marker_m=0.2, marker_mounted_m=0.4, marker_distance_m=0.0)
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    points = side_corners(side, vision) @ turn.T + np.array([pose.x, pose.y, 0.0])
    return camera.project(points)


def ready(team: Team, info: Any = None) -> tuple[TagInput, list[Refused]]:
    said: list[Refused] = []
    own = TagInput("r1", team, said.append)
    assert own.take_camera_info(camera_info() if info is None else info) is None
    return own, said


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("is_clockwise", [True, False])
def test_a_landmark_and_a_teammate_are_where_they_are(first: int, is_clockwise: bool) -> None:
    team = lab()
    camera, (own, said) = true_camera(team), ready(team)
    found = []
    for tag, name, pose in ((7, "door", DOOR), (0, "r2", MATE)):
        corners = np.roll(corners_of(team, camera, name, "front", pose), first, axis=0)
        found.append(detection(tag, corners if is_clockwise else corners[::-1]))
    seen = own.take(detections(T0, *found), T0)
    assert isinstance(seen, Sightings)
    by_name = {one.id: one for one in seen.sightings}
    assert not said
    for name, pose in (("door", DOOR), ("r2", MATE)):
        one = by_name[name]
        assert one.range_m == pytest.approx(math.hypot(pose.x, pose.y), abs=4e-3)
        assert one.bearing_rad == pytest.approx(math.atan2(pose.y, pose.x), abs=4e-3)
        assert one.range_sigma_m is not None
        assert 0.0 < one.range_sigma_m < 0.3
    assert by_name["door"].heading_rad is None
    heading = by_name["r2"].heading_rad
    assert heading is not None
    assert abs(wrap_angle(heading - MATE.heading)) < 0.01


@pytest.mark.parametrize("is_rectified", [True, False])
def test_a_lens_counts_for_raw_images_alone(is_rectified: bool) -> None:
    defaults = ("[defaults]", f"[defaults]\nros2 = {{ rectified = {str(is_rectified).lower()} }}")
    team = lab(defaults)
    own, said = ready(team, camera_info(d=LENS))
    camera = true_camera(team, (0.0,) * 5 if is_rectified else LENS)
    corners = corners_of(team, camera, "door", "front", DOOR)
    seen = own.take(detections(T0, detection(7, corners)), T0)
    assert isinstance(seen, Sightings), said
    (one,) = seen.sightings
    assert one.range_m == pytest.approx(math.hypot(DOOR.x, DOOR.y), abs=4e-3)


def test_binning_and_region_of_the_camera_count() -> None:
    team = lab()
    roi = {"x_offset": 100, "y_offset": 40, "width": 500, "height": 400}
    own, said = ready(team, camera_info(binning_x=2, binning_y=2, roi=roi))
    corners = corners_of(team, true_camera(team), "door", "front", DOOR)
    seen = own.take(detections(T0, detection(7, (corners - np.array([100.0, 40.0])) / 2.0)), T0)
    assert isinstance(seen, Sightings), said
    assert seen.sightings[0].range_m == pytest.approx(math.hypot(DOOR.x, DOOR.y), abs=4e-3)


def test_the_stated_sigmas_hold_for_noise_in_the_corners_and_a_camera_that_leans() -> None:
    team = lab()
    own, _ = ready(team)
    random, ranges, bearings = np.random.default_rng(1), [], []
    stated = team.robots["r1"].camera
    for _ in range(300):
        errors = {
            key: getattr(stated, key) + sigma * random.standard_normal()
            for key, sigma in (("tilt_deg", 1.0), ("roll_deg", 1.0), ("yaw_deg", 2.0))
        }
        focal = 600.0 * (1.0 + 0.025 * random.standard_normal())
        leaning: CameraSettings = replace(
            true_camera(team).settings, fx_px=focal, fy_px=focal, **errors
        )
        angle, far = math.radians(20.0) + random.uniform(-0.3, 0.3), random.uniform(1.0, 3.0)
        back = angle + math.pi + random.uniform(-0.9, 0.9)
        pose = Pose2(0.1 + far * math.cos(angle), far * math.sin(angle), back)
        corners = corners_of(team, Camera(leaning), "door", "front", pose)
        noisy = corners + 0.2 * random.standard_normal((4, 2))
        seen = own.take(detections(T0, detection(7, noisy)), T0)
        if not isinstance(seen, Sightings) or not seen.sightings:
            continue
        (one,) = seen.sightings
        assert one.range_m
        assert one.bearing_rad is not None
        assert one.range_sigma_m
        assert one.bearing_sigma_rad
        ranges.append((one.range_m - math.hypot(pose.x, pose.y)) / one.range_sigma_m)
        off = wrap_angle(one.bearing_rad - math.atan2(pose.y, pose.x))
        bearings.append(off / one.bearing_sigma_rad)
    assert len(ranges) > 250
    for errors_in_sigmas in (np.array(ranges), np.array(bearings)):
        assert 0.6 < errors_in_sigmas.std() < 1.3
        assert (np.abs(errors_in_sigmas) < 3.0).mean() > 0.97


def seen_with(message: Any, team: Team | None = None) -> tuple[Any, list[Refused]]:
    own, said = ready(team or lab())
    return own.take(message, T0), said


@pytest.mark.parametrize(
    ("family", "said"),
    [("apriltag_36h11", "tag36h11"), ("apriltag_standard41h12", "tagStandard41h12")],
)
def test_tags_of_the_family_of_the_team_file_are_taken(family: str, said: str) -> None:
    team = lab(('family = "apriltag_36h11"', f'family = "{family}"'))
    corners = corners_of(team, true_camera(team), "door", "front", DOOR)
    seen, refused = seen_with(detections(T0, detection(7, corners, said)), team)
    assert isinstance(seen, Sightings)
    assert [one.id for one in seen.sightings] == ["door"]
    assert not refused


def test_tags_that_give_no_sighting_are_said() -> None:
    team = lab()
    corners = corners_of(team, true_camera(team), "door", "front", DOOR)
    for message, reason, words in (
        (detection(99, corners), BadMessage.UNKNOWN_TAG, "tags 99 are on no robot"),
        (detection(7, corners, "tag16h5"), BadMessage.WRONG_FAMILY, "tag16h5"),
        (detection(7, corners * np.nan), BadMessage.NOT_FINITE, "corner"),
        (detection(7, 320.0 + 0.01 * corners), BadMessage.BAD_DETECTION, "a side of"),
        (detection(7, corners * 3.0), BadMessage.WRONG_SIZE, "640 x 480"),
        (detection(7, corners * 1e300), BadMessage.WRONG_SIZE, "640 x 480"),
        (detection(7, corners[[0, 2, 1, 3]]), BadMessage.BAD_DETECTION, "those of no square"),
        # A tag that hangs far lower than the team file states
        (
            detection(7, corners + np.array([0.0, 160.0])),
            BadMessage.BAD_DETECTION,
            "0.4 m above the floor",
        ),
    ):
        seen, said = seen_with(detections(T0, message))
        assert isinstance(seen, Sightings)
        assert not seen.sightings
        assert [one.reason for one in said] == [reason]
        assert words in said[0].text


def test_one_tag_at_two_places_and_the_robots_own_tag_give_none() -> None:
    team = lab(("[robots.r1]", "[robots.r1]\nmarkers = { front = 5 }"))
    camera = true_camera(team)
    corners = corners_of(team, camera, "door", "front", DOOR)
    twice = detections(T0, detection(7, corners), detection(7, corners - 150.0))
    for message, words in (
        (twice, "seen twice: door"),
        (detections(T0, detection(5, corners)), "own marker: r1"),
    ):
        seen, said = seen_with(message, team)
        assert not seen.sightings
        assert words in " ".join(one.text for one in said)


def test_detections_without_the_info_of_their_camera_are_refused() -> None:
    team = lab()
    corners = corners_of(team, true_camera(team), "door", "front", DOOR)
    message = detections(T0, detection(7, corners))
    found = TagInput("r1", team).take(message, T0)
    assert isinstance(found, Refused)
    assert found.reason is BadMessage.NO_CAMERA_INFO
    own, _ = ready(team, camera_info(frame="other_camera"))
    found = own.take(message, T0)
    assert isinstance(found, Refused)
    assert found.reason is BadMessage.WRONG_FRAME


@pytest.mark.parametrize(
    "fields",
    [
        {"k": [0.0] * 9, "p": [0.0] * 12},  # not calibrated
        {"p": [math.nan] * 12},
        {"width": 0},
        {"p": [6000000.0, 0, 0, 0, 0, 6000000.0, 0, 0, 0, 0, 1.0, 0]},
        {"p": [600.0, 0, 320.0, 0, 0, 6000000.0, 240.0, 0, 0, 0, 1.0, 0]},
        {"p": [600.0, 0, 1e300, 0, 0, 600.0, 240.0, 0, 0, 0, 1.0, 0]},
        {"binning_y": 4000},  # of 480 rows
    ],
)
def test_a_camera_info_that_cannot_be_used(fields: dict[str, Any]) -> None:
    found = TagInput("r1", lab()).take_camera_info(camera_info(**fields))
    assert isinstance(found, Refused)
    assert found.reason is BadMessage.UNUSABLE_CAMERA_INFO


def test_a_fisheye_lens() -> None:
    team = lab(("[defaults]", "[defaults]\nros2 = { rectified = false }"))
    lens = [0.05, -0.01, 0.002, 0.0]
    own, said = ready(team, camera_info(d=lens, distortion_model="equidistant"))
    plain = corners_of(team, true_camera(team), "door", "front", DOOR)
    plane = ((plain - [320.0, 240.0]) / 600.0).reshape(-1, 1, 2)
    matrix = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
    bent = cv2.fisheye.distortPoints(plane, matrix, np.array(lens)).reshape(-1, 2)
    seen = own.take(detections(T0, detection(7, bent)), T0)
    assert isinstance(seen, Sightings), said
    assert seen.sightings[0].range_m == pytest.approx(math.hypot(DOOR.x, DOOR.y), abs=4e-3)
