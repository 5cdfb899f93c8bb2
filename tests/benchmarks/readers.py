"""Who reads markers in a grey picture: a robot's detector, OpenCV's and pupil-apriltags."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from support.cameras import calibrated

from cpcbl_agents.vision.camera import Camera
from cpcbl_agents.vision.marker_families import NOT_IN_OPENCV, opencv_dictionary
from cpcbl_agents.vision.markers import MarkerDetector
from cpcbl_team.config import MarkerFamily, RobotSettings, Team, VisionSettings

PUPIL: dict[MarkerFamily, str] = {
    "apriltag_16h5": "tag16h5",
    "apriltag_25h9": "tag25h9",
    "apriltag_36h11": "tag36h11",
    "apriltag_standard41h12": "tagStandard41h12",
}
# Numbers and middles (x, y; px) of the markers in a grey picture
Reader = Callable[[NDArray[np.uint8]], list[tuple[int, float, float]]]


def peers(family: MarkerFamily) -> dict[str, Reader]:
    """Those of the two that have a family."""
    found: dict[str, Reader] = {}
    if family not in NOT_IN_OPENCV:
        found["OpenCV"] = opencv_reader(family)
    if family in PUPIL:
        found["pupil"] = pupil_reader(family)
    return found


def own_reader(family: MarkerFamily) -> Reader:
    """A robot's detector of markers, without poses."""
    team = Team(name="one", robots={"me": RobotSettings()}, vision=VisionSettings(family=family))
    detector = MarkerDetector("me", team, Camera(calibrated()))

    def read(grey: Any) -> list[tuple[int, float, float]]:
        markers = detector.detect_markers(grey)
        return [(m.id, *map(float, m.outline.mean(axis=0))) for m in markers]  # type: ignore[misc]

    return read


def opencv_reader(family: MarkerFamily) -> Reader:
    """OpenCV's detector with its parameters as they come."""
    detector = cv2.aruco.ArucoDetector(opencv_dictionary(family))

    def read(grey: Any) -> list[tuple[int, float, float]]:
        corners, numbers, _ = detector.detectMarkers(grey)
        middles = [c.reshape(4, 2).mean(axis=0) for c in corners]
        found = [] if numbers is None else numbers.ravel().tolist()
        return [(int(n), float(m[0]), float(m[1])) for n, m in zip(found, middles, strict=True)]

    return read


def pupil_reader(family: MarkerFamily) -> Reader:
    """pupil-apriltags as it comes, but at full resolution."""
    module = import_module("pupil_apriltags")
    detector = module.Detector(families=PUPIL[family], nthreads=1, quad_decimate=1.0)

    def read(grey: Any) -> list[tuple[int, float, float]]:
        return [
            (int(t.tag_id), float(t.center[0]), float(t.center[1])) for t in detector.detect(grey)
        ]

    return read
