"""Frames that made a detector fail: floors of tiles, markers on their side, an error within it."""

import logging

import cv2
import numpy as np
import pytest
from support.markers import CARRIED, team

from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.detections import Detections
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_agents.vision.marker_codes import marker_dictionary

TEAM = team(CARRIED)


def tiles(side_px: int) -> Pixels:
    """A floor of black and white squares."""
    y, x = np.mgrid[0:480, 0:640]
    grey = ((x // side_px + y // side_px) % 2 * 200 + 20).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def turned_marker(number: int, degrees: float, at: tuple[float, float], scale: float) -> Pixels:
    """A marker of a robot that fell over."""
    pattern = cv2.aruco.generateImageMarker(marker_dictionary(TEAM.vision.family), number, 60)
    paper = cv2.copyMakeBorder(pattern, 12, 12, 12, 12, cv2.BORDER_CONSTANT, value=255)
    turn = cv2.getRotationMatrix2D((42.0, 42.0), degrees, scale)
    turn[:, 2] += np.array(at)
    grey = np.full((480, 640), 180, np.uint8)
    cv2.warpAffine(paper, turn, (640, 480), grey, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    return np.repeat(grey[..., None], 3, axis=2)


@pytest.mark.parametrize("side_px", [6, 8, 10, 12, 16])
def test_a_floor_of_tiles_costs_no_robot(side_px: int) -> None:
    detector = CameraDetector("me", TEAM)
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


def test_an_error_within_a_frame_costs_that_frame_and_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    detector = CameraDetector("me", TEAM)

    def fail(pixels: Pixels) -> Detections:
        raise cv2.error("nobody has seen such a frame")

    with caplog.at_level(logging.ERROR), monkeypatch.context() as broken:
        broken.setattr(detector._markers, "detections", fail)
        assert [detector.detections(tiles(40)) for _ in range(3)] == ["frame_failed"] * 3
    assert len(caplog.records) == 1
    assert isinstance(detector.detections(tiles(40)), Detections)
