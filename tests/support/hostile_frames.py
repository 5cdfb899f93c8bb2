"""Frames that once ended a robot: a floor of tiles, a marker on its side."""

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.marker_families import opencv_dictionary


def checkerboard(side_px: int) -> Pixels:
    """A floor of black and white squares."""
    y, x = np.mgrid[0:480, 0:640]
    grey = ((x // side_px + y // side_px) % 2 * 200 + 20).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def tiles(side_px: int) -> Pixels:
    """A floor of black squares with white joints."""
    y, x = (at % (side_px + 4) < side_px for at in np.mgrid[0:480, 0:640])
    grey = np.where(x & y, 20, 220).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def turned_marker(number: int, degrees: float, at: tuple[float, float], scale: float) -> Pixels:
    """A marker of a robot that fell over."""
    pattern = cv2.aruco.generateImageMarker(opencv_dictionary("aruco_4x4_50"), number, 60)
    paper = cv2.copyMakeBorder(pattern, 12, 12, 12, 12, cv2.BORDER_CONSTANT, value=255)
    turn = cv2.getRotationMatrix2D((42.0, 42.0), degrees, scale)
    turn[:, 2] += np.array(at)
    grey = np.full((480, 640), 180, np.uint8)
    cv2.warpAffine(paper, turn, (640, 480), grey, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    return np.repeat(grey[..., None], 3, axis=2)
