"""Landmarks and teammates in camera frames. Raises DependencyError without OpenCV."""

from cpcbl_agents.extras import install_command
from cpcbl_team.errors import DependencyError

try:
    import cv2
except ImportError as error:
    raise DependencyError(f"a camera needs OpenCV: {install_command('camera')}") from error

cv2.setNumThreads(1)  # a robot is one process of many on its machine
