"""sensor_msgs/CameraInfo: the camera that detections come from."""

import math
from typing import Any

import cv2
import numpy as np
from msgspec.structs import replace

from cpcbl_agents.vision.camera import Camera, Floats
from cpcbl_launch.run.ros2.refused import BadMessage, Refused, is_finite
from cpcbl_team.config import CameraSettings

PINHOLE = ("plumb_bob", "rational_polynomial", "")
FISHEYE = ("equidistant", "fisheye")
LEAST_FOCAL, MOST_FOCAL = 0.1, 50.0  # of the width of an image
FARTHEST_CENTRE = 10.0  # of the width
MOST_LENS = 1e3  # of a coefficient of distortion
LEAST_PX = 16


class RosCamera:
    """A camera as its CameraInfo states it, mounted as the team file states it."""

    def __init__(self, settings: CameraSettings, matrix: Floats, lens: Floats, model: str) -> None:
        """`matrix` (3, 3) in pixels; `lens`: its distortion, empty for a rectified image."""
        self._matrix, self._lens, self._model = matrix, lens, model
        fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        self.camera = Camera(replace(settings, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy))

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.camera.size_px

    def on_plane(self, pixels: Floats) -> Floats:
        """The points (n, 2) of pixels (n, 2) on the plane z = 1 of the camera's frame."""
        if not self._lens.any():
            focal, centre = self._matrix[[0, 1], [0, 1]], self._matrix[:2, 2]
            return np.asarray((pixels - centre) / focal)
        undistort = cv2.fisheye.undistortPoints if self._model in FISHEYE else cv2.undistortPoints
        plane = undistort(pixels.reshape(-1, 1, 2), self._matrix, self._lens)
        return np.asarray(plane.reshape(-1, 2), np.float64)


def camera_of_info(info: Any, mounted: CameraSettings, rectified: bool) -> RosCamera | Refused:
    """The camera of a CameraInfo; `mounted` states its mounting and its accuracy."""
    matrix, lens = np.array(info.k, np.float64).reshape(3, 3), np.array(info.d, np.float64)
    model = str(info.distortion_model)
    projection = np.array(info.p, np.float64).reshape(3, 4)[:, :3]
    if rectified:
        lens = np.zeros(0)
        if projection.any():  # zeros: nobody has filled it in
            matrix = projection
    if not (is_finite(matrix.flat) and is_finite(lens.flat)):
        return _unusable("is not finite")
    if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
        return _unusable("has no focal length: calibrate the camera")
    if model not in (*PINHOLE, *FISHEYE) and lens.any():
        return _unusable(f"has the distortion model {model!r}, which is not known here")
    if model in FISHEYE and lens.any() and lens.size != 4:
        return _unusable(f"has {lens.size} coefficients of a fisheye lens; there must be 4")
    if model not in FISHEYE and lens.size not in (0, 4, 5, 8, 12, 14):
        return _unusable(f"has {lens.size} coefficients; there must be 4, 5, 8, 12 or 14")
    width, height = int(info.width), int(info.height)
    if not (LEAST_PX <= width <= 8192 and LEAST_PX <= height <= 8192):
        return _unusable(f"is of {width} x {height} pixels")
    for focal in (matrix[0, 0], matrix[1, 1]):
        if not LEAST_FOCAL < focal / width < MOST_FOCAL:
            return _unusable(f"has a focal length of {focal:g} pixels, {width} pixels wide")
    if np.abs(matrix[:2, 2]).max() > FARTHEST_CENTRE * width or (np.abs(lens) > MOST_LENS).any():
        return _unusable("has a centre or a distortion that no lens has")
    matrix, width, height = _of_region(info, matrix.copy(), width, height)
    if min(width, height) < LEAST_PX:
        return _unusable(f"is of {width} x {height} pixels, with its region and its binning")
    settings = replace(mounted, width_px=width, height_px=height)
    return RosCamera(settings, matrix, lens, model)


def _of_region(info: Any, matrix: Floats, width: int, height: int) -> tuple[Floats, int, int]:
    """The matrix and the size of images with the binning and the region of interest (which is in
    full pixels) that an info states."""
    across, along, roi = max(1, int(info.binning_x)), max(1, int(info.binning_y)), info.roi
    matrix[0, 2] -= int(roi.x_offset)
    matrix[1, 2] -= int(roi.y_offset)
    matrix[0] /= across
    matrix[1] /= along
    return matrix, (int(roi.width) or width) // across, (int(roi.height) or height) // along


def _unusable(text: str) -> Refused:
    return Refused(BadMessage.UNUSABLE_CAMERA_INFO, f"camera_info {text}")


def is_rotated(matrix: Any) -> bool:
    """Whether a rectification (9 numbers) turns the camera's axes by more than half a degree."""
    rectified_from_camera = np.array(matrix, np.float64).reshape(3, 3)
    if not rectified_from_camera.any():
        return False
    cosine = (float(np.trace(rectified_from_camera)) - 1.0) / 2.0
    return math.acos(min(1.0, max(-1.0, cosine))) > math.radians(0.5)
