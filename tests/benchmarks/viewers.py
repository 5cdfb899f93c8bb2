"""Who looks at the frames: a robot's eyes, their parts, and OpenCV's marker detection."""

from collections.abc import Callable, Iterable
from typing import Any

import cv2
from benchmarks.frames import TEAM, VIEWER

from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.cylinders import CylinderDetector
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_agents.vision.marker_families import opencv_dictionary
from cpcbl_agents.vision.markers import MarkerDetector

YARDSTICK = "OpenCV's marker detection"
EYES = "eyes"
Viewer = Callable[[Pixels], Any]


def _viewers() -> dict[str, Viewer]:
    camera = Camera(TEAM.robots[VIEWER].camera)
    dictionary = opencv_dictionary(TEAM.vision.family)
    return {
        EYES: CameraDetector(VIEWER, TEAM).detections,
        "of these, markers": MarkerDetector(VIEWER, TEAM, camera).detections,
        "of these, cylinders": CylinderDetector(VIEWER, TEAM, camera).detections,
        YARDSTICK: cv2.aruco.ArucoDetector(dictionary).detectMarkers,
    }


VIEWERS = _viewers()


def look(viewer: Viewer, frames: Iterable[Pixels]) -> None:
    """At all frames, one after the other."""
    for frame in frames:
        viewer(frame)
