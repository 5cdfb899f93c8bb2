"""The camera model, and the panorama of a frame.

The camera is a pinhole with OpenCV's distortion. Camera frame: x right, y down, z along the optical
axis. Robot frame: x forward, y left, z up, from the floor below the robot's centre.

In the panorama, columns are azimuths and rows are slopes, for any tilt, roll and lens. Vertical
lines are columns: the sides of a cylinder are columns, and a height z at the distance d from the
lens is the row (lens - z) / d. So edges can be averaged along columns and rows.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_team.config import CameraSettings

Floats = NDArray[np.float64]
Pixels = NDArray[np.uint8]
Map = NDArray[np.float32]

# Columns: the camera's x, y, z axes in the frame of a robot that it looks forward from.
_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
NEAREST_M = 1e-3
STEEPEST = 4.0  # slopes: what is farther below or above than this is not unrolled
WIDEST_RAD = math.radians(85.0)  # to each side of the camera's yaw
MARGIN_PX = 2.0
LEAST_SCALE = 0.1
FOLD_PX = 0.5  # a lens model that folds back does not come back to its pixel
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
        turns = ((0.0, 0.0, yaw), (0.0, tilt, 0.0), (roll, 0.0, 0.0))
        about_z, about_y, about_x = (cv2.Rodrigues(np.array(turn))[0] for turn in turns)
        self.robot_from_camera: Floats = about_z @ about_y @ about_x @ _FORWARD
        """Rotation (3, 3)."""
        self.position = np.array([s.x_m, s.y_m, s.mounted_m])
        """Of the lens in the robot's frame (m)."""

    def to_camera_frame(self, points: Floats) -> Floats:
        """Points (n, 3) of the robot's frame in the camera's (m)."""
        return np.asarray((points - self.position) @ self.robot_from_camera)

    def to_robot_frame(self, points: Floats) -> Floats:
        """Points (n, 3) of the camera's frame in the robot's (m)."""
        return np.asarray(points @ self.robot_from_camera.T + self.position)

    def project(self, points: Floats) -> Floats:
        """The pixels (n, 2) of points (n, 3) of the robot's frame; NaN for those behind the lens.
        Pixels may lie outside of the picture."""
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
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


class Scale(NamedTuple):
    """Pixels of the frame per column and per row of the panorama."""

    across_px: float
    along_px: float


class Panorama:
    """The maps between one camera's pixels and its panorama.

    Column 0 and row 0 are at (`first_azimuth`, `first_slope`), one step is about a pixel at the
    optical axis. Azimuths are to the right of the camera's yaw, slopes are downwards.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._yaw = math.radians(camera.settings.yaw_deg)
        self.step = 1.0 / camera.settings.fx_px
        width, height = camera.size_px
        azimuths, slopes = self._panorama_angles(_grid(width, height))
        seen = (np.abs(slopes) < STEEPEST) & (np.abs(azimuths) < WIDEST_RAD)
        self.first_azimuth = float(azimuths[seen].min())
        self.first_slope = float(slopes[seen].min())
        columns, rows = self._columns_and_rows(azimuths, slopes)
        self.columns: Map = columns.reshape(height, width).astype(np.float32)
        """Of each pixel (height, width)."""
        self.rows: Map = rows.reshape(height, width).astype(np.float32)
        self.size = math.ceil(columns[seen].max()) + 1, math.ceil(rows[seen].max()) + 1
        """(columns, rows)."""
        self.x, self.y = self._pixel_maps()

    def azimuth(self, column: float) -> float:
        """Rad, to the right of the camera's yaw."""
        return self.first_azimuth + column * self.step

    def slope(self, row: float) -> float:
        """Distance down per distance ahead."""
        return self.first_slope + row * self.step

    def bearing(self, azimuth: float) -> float:
        """Rad, to the left of the robot's front, not wrapped."""
        return self._yaw - azimuth

    def crop(self, pixels: Pixels, box: Box) -> Pixels:
        """A part of the panorama, (rows, columns, 3); black outside of the frame."""
        cut = cv2.remap(pixels, self.x[box.slices], self.y[box.slices], cv2.INTER_LINEAR)
        return cut.astype(np.uint8, copy=False)

    def clip_box(self, left: float, top: float, right: float, bottom: float) -> Box:
        """The box around these columns and rows, as far as there is a panorama."""
        first_column, first_row = max(0, math.floor(left)), max(0, math.floor(top))
        end_column = min(self.size[0], math.ceil(right) + 1)
        return Box(first_column, first_row, end_column, min(self.size[1], math.ceil(bottom) + 1))

    def corners(self, left: float, top: float, right: float, bottom: float) -> Floats:
        """The pixels (4, 2) of a box of the panorama, as far as they are in the frame."""
        columns, rows = self.size
        i = [min(max(round(row), 0), rows - 1) for row in (top, top, bottom, bottom)]
        j = [min(max(round(column), 0), columns - 1) for column in (left, right, right, left)]
        width, height = self._camera.size_px
        pixels = np.column_stack([self.x[i, j], self.y[i, j]]).astype(np.float64)
        return pixels.clip(0.0, (width - 1.0, height - 1.0))

    def is_at_border(self, column: float, row: float, margin_px: float) -> bool:
        """Whether a place of the panorama is at the border of the frame or beyond it."""
        columns, rows = self.size
        if not (0.0 <= row <= rows - 1 and 0.0 <= column <= columns - 1):
            return True  # NaN too
        x, y = self.x[round(row), round(column)], self.y[round(row), round(column)]
        width, height = self._camera.size_px
        inside_x = margin_px <= x + 0.5 <= width - margin_px
        return not (inside_x and margin_px <= y + 0.5 <= height - margin_px)

    def scale(self, column: float, row: float) -> Scale:
        """The scale of the frame around a place of the panorama."""
        columns, rows = self.size
        i = min(max(round(row), 1), rows - 2)
        j = min(max(round(column), 1), columns - 2)
        x, y = self.x, self.y
        across = math.hypot(x[i, j + 1] - x[i, j - 1], y[i, j + 1] - y[i, j - 1])
        along = math.hypot(x[i + 1, j] - x[i - 1, j], y[i + 1, j] - y[i - 1, j])
        return Scale(max(0.5 * across, LEAST_SCALE), max(0.5 * along, LEAST_SCALE))

    def _panorama_angles(self, pixels: Floats) -> tuple[Floats, Floats]:
        """Azimuths and slopes (n,) of pixels (n, 2)."""
        rays = self._camera.rays(pixels)
        azimuths = wrap_angles(self._yaw - np.arctan2(rays[:, 1], rays[:, 0]))
        return azimuths, -rays[:, 2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)

    def _columns_and_rows(self, azimuths: Floats, slopes: Floats) -> tuple[Floats, Floats]:
        return (azimuths - self.first_azimuth) / self.step, (slopes - self.first_slope) / self.step

    def _pixel_maps(self) -> tuple[Map, Map]:
        """The pixel (x, y) of each place of the panorama, each (rows, columns)."""
        columns, rows = self.size
        places = _grid(columns, rows)
        bearings = self._yaw - (self.first_azimuth + places[:, 0] * self.step)
        down = self.first_slope + places[:, 1] * self.step
        points = np.column_stack([np.cos(bearings), np.sin(bearings), -down])
        pixels = self._camera.project(points + self._camera.position)
        last = np.add(self._camera.size_px, MARGIN_PX)
        pixels[~((pixels > -MARGIN_PX) & (pixels < last)).all(axis=1)] = -9.0  # NaN too
        back = np.column_stack(self._columns_and_rows(*self._panorama_angles(pixels)))
        pixels[np.hypot(*(back - places).T) > FOLD_PX] = -9.0
        x, y = pixels.astype(np.float32).T.reshape(2, rows, columns)
        return np.ascontiguousarray(x), np.ascontiguousarray(y)


@lru_cache(maxsize=4)
def panorama_for(settings: CameraSettings) -> Panorama:
    """The panorama of a camera, cached because it is slow to make and depends only on settings."""
    return Panorama(Camera(settings))


def _grid(width: int, height: int) -> Floats:
    """All (x, y) of a picture, row by row: (width * height, 2)."""
    y, x = np.mgrid[:height, :width]
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)


def wrap_angles(angles: Floats) -> Floats:
    """The same angles (rad), from -pi to pi."""
    return np.remainder(angles + math.pi, math.tau) - math.pi
