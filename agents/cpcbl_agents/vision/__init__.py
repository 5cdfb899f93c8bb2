"""Landmarks and teammates in camera frames. Raises ValueError where OpenCV is not installed."""

from cpcbl_agents.detector import NEEDS_OPENCV

try:
    import cv2
except ImportError as error:
    raise ValueError(f"a camera {NEEDS_OPENCV}") from error

cv2.setNumThreads(1)  # a robot is one process of many on its machine
