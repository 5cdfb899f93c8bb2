"""Frames that make a detector fail or doubt its camera: floors of tiles, markers on their side, an
error within it, frames that repeat, jump in exposure, or stand on their head."""

import logging

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from support.cameras import calibrated
from support.hostile_frames import checkerboard, tiles, turned_marker
from support.markers import CARRIED, picture, standing, team
from support.rendered_pictures import picture as field_picture
from support.rendered_pictures import post
from support.rendered_pictures import team as field_team

from cpcbl_agents.sources import Picture
from cpcbl_agents.vision import detector as detector_module
from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.cylinders import CylinderDetector
from cpcbl_agents.vision.detections import Ambiguity, Detections
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_agents.vision.landmark_doubts import LandmarkDoubts
from cpcbl_launch.simulation.camera.render import Light
from cpcbl_team.config import CameraSettings
from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import UnclearObject

TEAM, CAMERA = team(CARRIED), calibrated()


@pytest.mark.parametrize("side_px", [6, 8, 10, 12, 16])
def test_a_floor_of_tiles_costs_no_robot(side_px: int) -> None:
    detector = CameraDetector("me", TEAM)
    assert detector.detections(checkerboard(side_px)) == Detections()
    assert detector.detections(tiles(side_px)) == Detections()
    assert detector.counts["outlines_dropped"] > 100


def test_a_teammate_that_fell_over_is_rejected() -> None:
    random, detector = np.random.default_rng(0), CameraDetector("me", TEAM)
    for _ in range(60):
        degrees, scale = float(random.normal(90.0, 3.0)), float(random.uniform(0.5, 1.5))
        at = float(random.uniform(60.0, 500.0)), float(random.uniform(60.0, 350.0))
        found = detector.detections(turned_marker(0, degrees, at, scale))
        if found == "camera_upside_down":  # which the picture of a single marker may be, too
            continue
        assert isinstance(found, Detections)
        assert found.found == ()
        assert {one.reason for one in found.ambiguities} <= {"bad_fit", "upside_down"}


ERRORS = [cv2.error("nobody has seen such a frame"), TypeError(), AssertionError(), MemoryError()]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_within_a_frame_costs_that_frame_and_is_said_once(
    error: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    detector = CameraDetector("me", TEAM)

    def fail(*_: object) -> Detections:
        raise error

    with caplog.at_level(logging.ERROR), monkeypatch.context() as broken:
        broken.setattr(detector._markers, "detections", fail)
        assert [detector.detections(tiles(40)) for _ in range(3)] == ["frame_failed"] * 3
    assert len(caplog.records) == 1
    assert isinstance(detector.detections(tiles(40)), Detections)


def test_an_error_in_drawing_costs_that_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    detector = CameraDetector("me", TEAM)

    def fail(*_: object) -> Pixels:
        raise AssertionError

    monkeypatch.setattr(detector_module, "annotate", fail)
    found, annotated = detector.detect_and_annotate(Picture(1, tiles(40)))
    assert found == "frame_failed"
    assert annotated.unclear == (UnclearObject("frame_failed"),)


def robots_in_view(seed: int, settings: CameraSettings = CAMERA) -> Pixels:
    robots = [standing("r1", 1.0, -15.0, 160.0), standing("r2", 1.4, 12.0, -150.0)]
    return picture(TEAM, robots, settings, seed=seed)


def test_a_frame_that_comes_again_is_not_used_again() -> None:
    detector, pixels = CameraDetector("me", TEAM), robots_in_view(1)
    first, again = (detector.detect(Picture(stamp_ns, pixels)) for stamp_ns in (1, 2))
    assert isinstance(first, Sightings)
    assert len(first.sightings) == 2
    assert again == "frame_repeated"
    assert isinstance(detector.detect(Picture(3, robots_in_view(2))), Sightings)
    assert isinstance(detector.detect(Picture(4, pixels)), Sightings)


@pytest.mark.thorough
def test_a_camera_that_is_upside_down_is_said_and_tells_nothing() -> None:
    detector = CameraDetector("me", TEAM)
    seen = [detector.detect(Picture(n, robots_in_view(n)[::-1, ::-1].copy())) for n in range(5)]
    assert all(isinstance(one, str) or one.sightings == () for one in seen)
    assert seen[-1] == "camera_upside_down"
    assert any(problem.startswith("the camera is upside down") for problem in detector.problems)
    for n in range(60):
        detector.detect(Picture(n, robots_in_view(n)))
    assert detector.problems == ()
    stated = replace(TEAM.robots["me"], camera=replace(CAMERA, roll_deg=180.0))
    right = CameraDetector("me", replace(TEAM, robots={**TEAM.robots, "me": stated}))
    found = right.detect(Picture(1, robots_in_view(1)[::-1, ::-1].copy()))
    assert isinstance(found, Sightings)
    assert len(found.sightings) == 2


def test_a_landmark_whose_bands_are_exchanged_is_upside_down() -> None:
    team, exchanged = (
        field_team({"a": post(1.3, 0.1, bands)}) for bands in (("red", "yellow"), ("yellow", "red"))
    )
    (one,) = (
        CylinderDetector("me", team, Camera(CAMERA))
        .detections(field_picture(exchanged))
        .ambiguities
    )
    assert (one.reason, one.names) == ("upside_down", ("a",))


def test_an_exposure_that_jumps_is_counted_and_said() -> None:
    detector = CameraDetector("me", TEAM)
    for n in range(4):
        pixels = robots_in_view(n)
        detector.detections(pixels // 8 if n % 2 else pixels)
    assert detector.counts["exposure_jump"] == 3
    assert any("exposure of the camera jumped 3 times" in one for one in detector.problems)


def test_what_is_doubted_is_counted_by_reason() -> None:
    detector = CameraDetector("me", TEAM)
    detector.detections(
        picture(team({"guest": {"front": 40}}), [standing("guest", 1.5, 0.0, 180.0)])
    )
    assert detector.counts["unknown_marker"] == 1


def test_landmarks_that_are_mostly_rejected_are_said_with_the_likely_cause() -> None:
    doubts, rejected = LandmarkDoubts(), Ambiguity("ranges_disagree", ("a",), np.zeros((4, 2)))
    doubts.add(2, [rejected] * 7)
    assert not doubts.problems
    doubts.add(0, [rejected] * 5)
    (said,) = doubts.problems
    assert said.startswith("12 of 14 landmarks are rejected (ranges_disagree); is the camera")


def test_a_marker_in_low_light_is_read() -> None:
    robots = [standing("r1", 1.0, 0.0, 180.0)]
    light = Light(brightness=0.12, noise=2.0)
    found = CameraDetector("me", TEAM).detections(picture(TEAM, robots, light=light))
    assert isinstance(found, Detections)
    assert [one.id for one in found.sightings] == ["r1"]
