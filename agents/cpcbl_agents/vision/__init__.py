"""Landmarks and teammates in camera frames. Raises DependencyError without OpenCV."""

from cpcbl_agents.sources import NEEDS_OPENCV
from cpcbl_team.errors import DependencyError

try:
    import cv2
except ImportError as error:
    raise DependencyError(f"a camera {NEEDS_OPENCV}") from error

cv2.setNumThreads(1)  # a robot is one process of many on its machine
