"""Landmarks and teammates in camera frames. Raises ValueError where OpenCV is not installed."""

try:
    import cv2
except ImportError as error:
    raise ValueError("a camera needs OpenCV: pip install 'cpcbl-team[camera]'") from error

cv2.setNumThreads(1)  # a robot is one process of many on its machine
