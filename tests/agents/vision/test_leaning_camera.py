"""Cameras that are tilted or rolled by more than the team file states."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.cameras import calibrated
from support.markers import CARRIED, looked, off, picture, seen_at, standing, team
from support.rendered_pictures import CLEAN, post
from support.rendered_pictures import picture as field_picture
from support.rendered_pictures import team as field_team
from support.sweeps import sampled

from cpcbl_agents.vision.camera import Camera
from cpcbl_agents.vision.cylinders import CylinderDetector
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_agents.vision.marker_fits import LEAST, MarkerFits
from cpcbl_agents.vision.markers import CLEAR_RAD
from cpcbl_agents.vision.poses import Lean, PoseFit, fit_pose
from cpcbl_team.config import CameraSettings, VisionSettings
from cpcbl_team.geometry import Pose2, wrap_angle

STATED = calibrated()
TEAM = team(CARRIED)
PLACES = [(1.0, -18.0, 160.0), (1.8, 2.0, -150.0), (2.6, 20.0, 175.0)]
ROBOTS = [standing(f"r{k}", *place) for k, place in enumerate(PLACES, start=1)]
LEANS = [(1.0, 0.0), (-2.0, 0.0), (3.0, 0.0), (0.0, 1.0), (0.0, -2.0), (2.5, 2.5)]


def leaning(tilt_deg: float, roll_deg: float, stated: CameraSettings = STATED) -> CameraSettings:
    """The camera as it really is, where it was thought to be as stated."""
    return replace(stated, tilt_deg=stated.tilt_deg + tilt_deg, roll_deg=roll_deg)


@pytest.mark.parametrize(("tilt_deg", "roll_deg"), LEANS)
def test_markers_are_found_and_their_sigmas_hold(tilt_deg: float, roll_deg: float) -> None:
    true = leaning(tilt_deg, roll_deg)
    for seed in range(5):
        detections = looked(TEAM, picture(TEAM, ROBOTS, true, seed=seed), STATED)
        found = {one.sighting.id: one.sighting for one in detections.found}
        assert set(found) == {"r1", "r2", "r3"}
        for robot in ROBOTS:
            assert max(off(found[robot.name], robot).sigmas) < 3.0
            assert off(found[robot.name], robot).range_share < 0.02


@pytest.mark.parametrize("mounted_m", [0.2, 0.5])
@pytest.mark.parametrize(("tilt_deg", "roll_deg"), LEANS[:2] + LEANS[3:5])
def test_landmarks_are_ranged(tilt_deg: float, roll_deg: float, mounted_m: float) -> None:
    stated = replace(STATED, mounted_m=mounted_m, tilt_deg=10.0 * mounted_m)
    places = {"a": (1.3, -0.3), "b": (2.2, 0.5), "c": (3.5, -1.6)}
    colours = (("red", "yellow"), ("blue", "pink"), ("green", "orange"))
    posts = {
        name: post(*place, pair)
        for (name, place), pair in zip(places.items(), colours, strict=True)
    }
    pixels = field_picture(field_team(posts), leaning(tilt_deg, roll_deg, stated), light=CLEAN)
    detections = CylinderDetector("me", field_team(posts), Camera(stated)).detections(pixels)
    found = {one.sighting.id: one.sighting for one in detections.found}
    for name, (x, y) in places.items():
        seen = found[name]
        assert seen.range_m is not None
        assert seen.range_sigma_m is not None
        assert seen.bearing_rad is not None
        assert seen.bearing_sigma_rad is not None
        assert abs(seen.range_m - math.hypot(x, y)) < 3.0 * seen.range_sigma_m
        assert abs(seen.bearing_rad - math.atan2(y, x)) < 3.0 * seen.bearing_sigma_rad


@pytest.mark.parametrize(
    ("tilt_deg", "roll_deg", "says"),
    [
        (0.5, -0.5, None),
        (3.0, 0.0, "by its markers, the camera is tilted down by about"),
        (0.0, -3.0, "by its markers, the camera is rolled left by about"),
        (-9.0, 0.0, "markers are rejected (bad_fit); is the camera tilted up by about"),
    ],
)
def test_a_robot_says_how_its_camera_leans(tilt_deg: float, roll_deg: float, says: str) -> None:
    detector = CameraDetector("me", TEAM)
    for seed in range(LEAST // len(ROBOTS) + 1):
        pixels = picture(TEAM, ROBOTS, leaning(tilt_deg, roll_deg), seed=seed)
        detector.detections(pixels)
    if says is None:
        assert detector.problems == ()
        return
    (problem,) = detector.problems
    assert says in problem
    number = float(problem.split("about ")[1].split()[0])
    assert number == pytest.approx(max(abs(tilt_deg), abs(roll_deg)), rel=0.2)


def fit(lean: Lean, corner_variance: float = 1.0) -> PoseFit:
    return PoseFit(Pose2(1.0, 0.0, 0.0), np.eye(3), 1.0, lean, corner_variance)


def test_markers_that_are_rejected_for_another_reason_do_not_blame_the_camera() -> None:
    fits = MarkerFits(Lean(0.02, 0.02))
    for _ in range(LEAST):
        fits.add("contradiction", fit(Lean(0.0, 0.0)))
    assert fits.problems == (f"{LEAST} of {LEAST} markers are rejected (contradiction)",)


def test_few_markers_are_no_reason_for_a_problem() -> None:
    fits = MarkerFits(Lean(0.02, 0.02))
    for _ in range(LEAST - 1):
        fits.add("bad_fit", fit(Lean(0.1, 0.0)))
    assert fits.problems == ()


@pytest.mark.parametrize("noise_px", sampled([0.2, 0.4, 0.7], [0.4]))
def test_sigmas_hold_where_corners_err_by_more_than_stated(noise_px: float) -> None:
    """Corners of real images do: in low light, in motion, behind a lens that is not clean."""
    camera, random, vision = Camera(STATED), np.random.default_rng(4), VisionSettings()
    fits, places, headings = MarkerFits(Lean(0.02, 0.02)), [], []
    for _ in range(300):
        turn = random.uniform(-1.1, 1.1)
        robot = Pose2(float(random.uniform(0.8, 3.0)), 0.1, math.pi + float(turn))
        exact = camera.project(seen_at(robot, "front", vision))
        corners = camera.undistort(exact + noise_px * random.standard_normal((4, 2)))
        found = fit_pose({"front": corners}, vision, camera, fits.corner_variance)
        fits.add("", found)
        x, y, heading = found.pose
        error = np.array([x - robot.x, y - robot.y, wrap_angle(heading - robot.heading)])
        sigmas = np.abs(error) / np.sqrt(np.diag(found.covariance))
        places.append(sigmas[:2])
        if math.sqrt(found.covariance[2, 2]) < CLEAR_RAD:
            headings.append(sigmas[2])
    assert (np.mean(np.array(places) < 3.0, axis=0) >= 0.98).all()
    assert np.mean(np.array(headings) < 3.0) >= 0.97
    assert len(headings) > 50
    assert max(np.max(places), np.max(headings)) < 8.0
