"""The pose of a robot from the corners of its markers, where the corners are exact or noisy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.cameras import calibrated
from support.markers import SIDES, seen_at
from support.sweeps import thorough

from cpcbl_agents.vision.camera import Camera, Floats
from cpcbl_agents.vision.markers import sighting
from cpcbl_agents.vision.poses import CORNER_SHARE, NARROW, SIDE_ANGLES, fit_pose
from cpcbl_team.camera_errors import CameraErrors, without_errors
from cpcbl_team.config import CameraSettings, Side, VisionSettings
from cpcbl_team.geometry import Pose2, wrap_angle

VISION = VisionSettings()
LENS = (-0.28, 0.09, 0.002, -0.001, 0.0)
CAMERAS = [
    calibrated(),
    calibrated(tilt_deg=12.0, roll_deg=9.0, yaw_deg=15.0, x_m=0.1, y_m=-0.05, mounted_m=0.6),
    calibrated(distortion=LENS, tilt_deg=4.0, roll_deg=90.0),
]


def plane(camera: Camera, robot: Pose2, side: Side) -> Floats:
    """Where a marker's corners are on the plane z = 1, by way of its pixels."""
    return camera.undistort(camera.project(seen_at(robot, side, VISION)))


def facing(camera: Camera, robot: Pose2, side: Side) -> float:
    """The angle between where a side looks and the way to the lens, in the plane."""
    way = math.atan2(camera.position[1] - robot.y, camera.position[0] - robot.x)
    return wrap_angle(robot.heading + SIDE_ANGLES[side] - way)


@given(
    st.sampled_from(CAMERAS),
    st.floats(0.6, 3.0),
    st.floats(-0.3, 0.3),
    st.floats(-math.pi, math.pi),
)
def test_exact_corners_tell_the_pose(
    settings: CameraSettings, range_m: float, aside: float, heading: float
) -> None:
    camera = Camera(settings)
    bearing = math.radians(settings.yaw_deg) + aside
    robot = Pose2(range_m * math.cos(bearing), range_m * math.sin(bearing), heading)
    seen = {
        side: plane(camera, robot, side)
        for side in SIDES
        if abs(facing(camera, robot, side)) < math.radians(65.0)
    }
    fit = fit_pose(seen, VISION, camera)
    assert fit.misfit < 1e-2
    x, y = fit.pose.x - robot.x, fit.pose.y - robot.y
    turn = wrap_angle(fit.pose.heading - robot.heading)
    sigmas = np.sqrt(np.diag(fit.covariance))
    if sigmas[2] < NARROW:  # what is told is one pose, not the middle of many
        assert math.hypot(x, y) < 2e-3
        assert abs(turn) < 5e-3
    assert len(seen) < 2 or sigmas[2] < 1.5 * NARROW
    assert (np.abs([x, y, turn]) < 3.0 * sigmas).all()


@pytest.mark.parametrize(
    ("range_m", "turn_deg"),
    [thorough(1.0, 35.0), (2.0, 10.0), thorough(2.0, 50.0), (3.5, 30.0)],
)
def test_three_sigma_hold_what_noise_does(range_m: float, turn_deg: float) -> None:
    settings = replace(
        CAMERAS[0], tilt_sigma_deg=0.01, yaw_sigma_deg=0.01, focal_share=1e-4, centre_share=1e-4
    )
    camera, random = Camera(settings), np.random.default_rng(8)
    robot = Pose2(range_m, 0.1, math.pi + math.radians(turn_deg))
    exact = camera.project(seen_at(robot, "front", VISION))
    noise_px = CORNER_SHARE * settings.edge_sigma_px * random.standard_normal((200, 4, 2))
    off = []
    for noise in noise_px:
        fit = fit_pose({"front": camera.undistort(exact + noise)}, VISION, camera)
        x, y, heading = fit.pose
        error = np.array([x - robot.x, y - robot.y, wrap_angle(heading - robot.heading)])
        off.append(error / np.sqrt(np.diag(fit.covariance)))
    assert (np.mean(np.abs(off) < 3.0, axis=0) >= 0.98).all()
    assert (np.sqrt(np.mean(np.square(off), axis=0)) < 1.5).all()


def test_corners_that_no_pose_shows_are_misfits() -> None:
    camera = Camera(CAMERAS[0])
    corners = plane(camera, Pose2(1.5, 0.0, math.pi), "front")
    bent = corners + np.array([[0.0, 0.0], [0.0, 0.0], [0.02, 0.02], [0.0, 0.0]])
    assert fit_pose({"front": corners}, VISION, camera).misfit < 1e-3
    assert fit_pose({"front": bent}, VISION, camera).misfit > 20.0


@pytest.mark.parametrize(
    "errors",
    [
        *(CameraErrors(0.0, math.log(share)) for share in (0.95, 1.05)),
        *(CameraErrors(0.0, 0.0, centre) for centre in (0.05, -0.05)),
    ],
    ids=str,
)
@pytest.mark.parametrize("roll_deg", [0.0, 180.0])
@pytest.mark.parametrize(("bearing_deg", "heading_deg"), [(45.0, 0.0), (30.0, 70.0), (-26.0, 40.0)])
def test_a_heading_that_a_wrong_lens_turned_is_corrected(
    errors: CameraErrors, roll_deg: float, bearing_deg: float, heading_deg: float
) -> None:
    stated = calibrated(yaw_sigma_deg=0.0, focal_share=0.0, centre_share=0.0, roll_deg=roll_deg)
    share, px = math.exp(errors.focal), stated.fx_px * errors.centre
    roll = math.radians(roll_deg)
    built = Camera(
        replace(
            stated,
            fx_px=share * stated.fx_px,
            fy_px=share * stated.fy_px,
            cx_px=stated.cx_px - px * math.cos(roll),
            cy_px=stated.cy_px + px * math.sin(roll),
        )
    )
    camera, bearing = Camera(stated), math.radians(bearing_deg)
    robot = Pose2(2.0 * math.cos(bearing), 2.0 * math.sin(bearing), math.radians(heading_deg))
    seen = {
        side: camera.undistort(built.project(seen_at(robot, side, VISION)))
        for side in SIDES
        if abs(facing(camera, robot, side)) < math.radians(65.0)
    }
    read = sighting("mate", fit_pose(seen, VISION, camera))
    corrected = without_errors(read, errors, 0.0)
    assert read.heading_rad is not None
    assert corrected.heading_rad is not None
    assert abs(wrap_angle(read.heading_rad - robot.heading)) > math.radians(0.3)
    assert abs(wrap_angle(corrected.heading_rad - robot.heading)) < math.radians(0.15)
