"""The camera model: from points in the robot's frame to pixels and back.

A pinhole with OpenCV's distortion. Camera frame: x right, y down, z along the optical axis. Robot
frame: x forward, y left, z up, from the floor below the robot's centre.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_team.config import CameraSettings

Floats = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# Columns: the camera's x, y, z axes in the frame of a robot that it looks forward from.
_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
NEAREST_M = 1e-3
NO_PIXELS: Pixels = np.empty((0, 0, 3), np.uint8)


class Box(NamedTuple):
    """Pixels from (left, top) up to, not with, (right, bottom)."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def size(self) -> tuple[int, int]:
        """Width, height."""
        return self.right - self.left, self.bottom - self.top

    def overlaps(self, other: "Box") -> bool:
        apart_x = self.right <= other.left or other.right <= self.left
        return not (apart_x or self.bottom <= other.top or other.bottom <= self.top)


class Camera:
    """One camera on its robot."""

    def __init__(self, settings: CameraSettings) -> None:
        self.settings = s = settings
        self.size_px = s.width_px, s.height_px
        self.matrix = np.array([[s.fx_px, 0.0, s.cx_px], [0.0, s.fy_px, s.cy_px], [0.0, 0.0, 1.0]])
        self.distortion = np.array(s.distortion)
        yaw, tilt, roll = (math.radians(a) for a in (s.yaw_deg, s.tilt_deg, s.roll_deg))
        self.robot_from_camera = (
            _rotation(2, yaw) @ _rotation(1, tilt) @ _rotation(0, roll) @ _FORWARD
        )
        """Rotation (3, 3)."""
        self.position = np.array([s.x_m, s.y_m, s.mounted_m])
        """Of the lens in the robot's frame (m)."""

    def to_camera_frame(self, points: Floats) -> Floats:
        """Points (n, 3) of the robot's frame in the camera's (m)."""
        moved: Floats = (points - self.position) @ self.robot_from_camera
        return moved

    def to_robot_frame(self, points: Floats) -> Floats:
        """Points (n, 3) of the camera's frame in the robot's (m)."""
        moved: Floats = points @ self.robot_from_camera.T + self.position
        return moved

    def project(self, points: Floats) -> Floats:
        """The pixels (n, 2) of points (n, 3) of the robot's frame; NaN for those behind the lens.

        Pixels may lie outside of the picture.
        """
        seen = self.to_camera_frame(np.asarray(points, dtype=np.float64))
        pixels = np.full((len(seen), 2), np.nan)
        ahead = seen[:, 2] > NEAREST_M
        if ahead.any():
            still = np.zeros(3)
            found, _ = cv2.projectPoints(seen[ahead], still, still, self.matrix, self.distortion)
            pixels[ahead] = found.reshape(-1, 2)
        return pixels

    def undistort(self, pixels: Floats) -> Floats:
        """The points (n, 2) of pixels (n, 2) on the plane z = 1 of the camera's frame."""
        points = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        plane = cv2.undistortPoints(points, self.matrix, self.distortion)
        return plane.reshape(-1, 2).astype(np.float64)

    def rays(self, pixels: Floats) -> Floats:
        """Unit vectors (n, 3) of the rays of pixels (n, 2), in the robot's frame."""
        plane = self.undistort(pixels)
        directions = np.column_stack([plane, np.ones(len(plane))]) @ self.robot_from_camera.T
        unit: Floats = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return unit

    def intersect_plane(self, pixels: Floats, height_m: float = 0.0) -> Floats:
        """The intersections (n, 2) of the rays of pixels (n, 2) with the plane at this height (m),
        in the robot's frame; NaN if there is none."""
        rays = self.rays(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            way = (height_m - self.position[2]) / rays[:, 2]
            met: Floats = self.position[:2] + way[:, None] * rays[:, :2]
        met[~(way > 0.0)] = np.nan
        return met


def _rotation(axis: int, angle: float) -> Floats:
    """The rotation (3, 3) about one of the axes x, y, z."""
    rotation, i, j = np.eye(3), (axis + 1) % 3, (axis + 2) % 3
    rotation[i, i] = rotation[j, j] = math.cos(angle)
    rotation[j, i] = math.sin(angle)
    rotation[i, j] = -rotation[j, i]
    return rotation
