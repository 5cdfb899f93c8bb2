"""Who looks at the frames: a robot's eyes, their parts, and OpenCV's marker detection."""

from collections.abc import Callable, Iterable
from typing import Any

import cv2
from benchmarks.frames import TEAM, VIEWER

from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.codes import DICTIONARIES
from cpcbl_agents.vision.cylinders import Cylinders
from cpcbl_agents.vision.detector import CameraEyes
from cpcbl_agents.vision.markers import Markers

YARDSTICK = "OpenCV's marker detection"
EYES = "eyes"
Viewer = Callable[[Pixels], Any]


def _viewers() -> dict[str, Viewer]:
    camera = Camera(TEAM.robots[VIEWER].camera)
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[TEAM.vision.family])
    return {
        EYES: CameraEyes(VIEWER, TEAM).glimpses,
        "of these, markers": Markers(VIEWER, TEAM, camera).glimpses,
        "of these, cylinders": Cylinders(VIEWER, TEAM, camera).glimpses,
        YARDSTICK: cv2.aruco.ArucoDetector(dictionary).detectMarkers,
    }


VIEWERS = _viewers()


def look(viewer: Viewer, frames: Iterable[Pixels]) -> None:
    """At all frames, one after the other."""
    for frame in frames:
        viewer(frame)
