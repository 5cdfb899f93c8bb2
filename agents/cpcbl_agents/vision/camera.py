"""The camera model: from points in the robot's frame to pixels and back.

A pinhole with OpenCV's distortion. Camera frame: x right, y down, z along the optical axis. Robot
frame: x forward, y left, z up, from the floor below the robot's centre.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_team.config import CameraSettings

Floats = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# Columns: the camera's x, y, z axes in the frame of a robot that it looks forward from.
_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
NEAREST_M = 1e-3


class Camera:
    """One camera on its robot."""

    def __init__(self, settings: CameraSettings) -> None:
        self.settings = s = settings
        self.size_px = s.width_px, s.height_px
        self.matrix = np.array([[s.fx_px, 0.0, s.cx_px], [0.0, s.fy_px, s.cy_px], [0.0, 0.0, 1.0]])
        self.distortion = np.array(s.distortion)
        self.robot_from_camera = (
            _about_z(math.radians(s.yaw_deg))
            @ _about_y(math.radians(s.tilt_deg))
            @ _about_x(math.radians(s.roll_deg))
            @ _FORWARD
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


def _about_x(angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_y(angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _about_z(angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
