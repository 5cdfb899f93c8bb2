"""Markers of rendered robots are read, and are where the camera model says."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from support.rendered_pictures import (
    CAMERAS,
    LENS,
    MARKED,
    POSE,
    detected,
    mate,
    off_by,
    picture,
    team,
)

from cpcbl_agents.vision.camera import Camera, Floats
from cpcbl_launch.simulation.camera.objects import paper_ratio
from cpcbl_launch.simulation.camera.render import Light, SceneRobot
from cpcbl_team.config import (
    CameraSettings,
    MarkerFamily,
    RobotSettings,
    Side,
    VisionSettings,
)

SIDES: dict[Side, float] = {"front": 180.0, "left": 90.0, "back": 0.0, "right": -90.0}


def marker_corners(camera: Camera, robot: SceneRobot, side: Side, vision: VisionSettings) -> Floats:
    """Upper left, upper right, lower right, lower left of a marker (4, 2), px."""
    return marker_points(camera, robot, side, vision, ((-1, 1), (1, 1), (1, -1), (-1, -1)))


def marker_points(
    camera: Camera,
    robot: SceneRobot,
    side: Side,
    vision: VisionSettings,
    places: Sequence[tuple[float, float]],
) -> Floats:
    """Places on a marker, to the right and up in halves of its side (n, 2), px."""
    angle = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}[side]
    out = robot.heading_rad + math.radians(angle)
    half = vision.marker_m / 2.0
    points = []
    for right, up in (half * np.array(places)).tolist():
        x = robot.x_m + vision.marker_distance_m * math.cos(out) - right * math.sin(out)
        y = robot.y_m + vision.marker_distance_m * math.sin(out) + right * math.cos(out)
        points.append([*POSE.inverse().transform(x, y), vision.marker_mounted_m + up])
    return camera.project(np.array(points))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("ahead_m", [0.6, 1.5, 3.0])
def test_opencv_reads_the_marker_of_the_side_that_is_turned_to_it(
    side: Side, ahead_m: float
) -> None:
    robot = mate("r2", ahead_m, 0.1, SIDES[side])
    found = detected(picture(team(robots={"r2": MARKED}), robots=[robot], light=Light()))
    assert set(found) == {MARKED.markers[side]}


@pytest.mark.parametrize(
    "family", ["aruco_4x4_50", "aruco_5x5_50", "aruco_6x6_50", "apriltag_16h5", "apriltag_36h11"]
)
@pytest.mark.parametrize("turned_deg", [180.0, 140.0, 225.0])
def test_a_marker_of_any_family_is_read_and_is_where_the_camera_model_says(
    family: MarkerFamily, turned_deg: float
) -> None:
    vision = VisionSettings(family=family)
    robot = mate("r2", 1.0, -0.1, turned_deg)
    settings = CameraSettings(tilt_deg=5.0, distortion=LENS)
    subject = team(robots={"r2": RobotSettings(markers={"front": 11})}, vision=vision)
    found = detected(picture(subject, settings, [robot]), family)
    expected = marker_corners(Camera(settings), robot, "front", vision)
    assert found[11] == pytest.approx(expected, abs=0.6)  # the detector's own; edges: below


@pytest.mark.parametrize("settings", CAMERAS, ids=["plain", "tilted", "bent", "upright"])
@pytest.mark.parametrize("ahead_m", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("turned_deg", [180.0, 150.0, 215.0])
def test_the_edges_of_a_marker_are_where_the_camera_model_says(
    settings: CameraSettings, ahead_m: float, turned_deg: float
) -> None:
    vision = VisionSettings()
    robot = mate("r2", ahead_m, 0.05, turned_deg)
    pixels = picture(team(robots={"r2": MARKED}), settings, [robot])
    camera = Camera(settings)
    corners = marker_corners(camera, robot, "front", vision)
    middle = corners.mean(axis=0)
    module = float(np.hypot(*(corners[0] - corners[3]))) / 6.0
    edges = marker_points(camera, robot, "front", vision, ((0, 1), (1, 0), (0, -1), (-1, 0)))
    for edge, a, b in zip(edges, corners, np.roll(corners, -1, axis=0), strict=True):
        if not (10.0 < edge[0] < 629.0 and 10.0 < edge[1] < 469.0):
            continue
        across = np.array([a[1] - b[1], b[0] - a[0]])
        across *= np.sign(across @ (middle - edge))
        assert abs(off_by(pixels, edge, across, reach_px=min(2.0, 0.6 * module))) < 0.1


def test_the_white_around_a_marker_is_one_module_wide() -> None:
    assert paper_ratio("aruco_4x4_50") == pytest.approx(8 / 6)
    assert paper_ratio("apriltag_36h11") == pytest.approx(10 / 8)
    assert paper_ratio("apriltag_standard41h12") == pytest.approx(11 / 5)  # of the white square
