"""The panorama of a frame: columns are azimuths, rows are slopes, for any tilt, roll and lens.

Vertical lines are columns: the sides of a cylinder are columns, and a height z at the distance d
from the lens is the row (lens - z) / d. So edges can be averaged along columns and rows.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Box, Camera, Floats, Pixels
from cpcbl_team.config import CameraSettings

STEEPEST = 4.0  # slopes: what is farther below or above than this is not unrolled
WIDEST_RAD = math.radians(85.0)  # to each side of the camera's yaw
MARGIN_PX = 2.0
LEAST_SCALE = 0.1
FOLD_PX = 0.5  # a lens model that folds back does not come back to its pixel

Map = NDArray[np.float32]


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
        columns, rows = self.size
        return Box(
            max(0, math.floor(left)),
            max(0, math.floor(top)),
            min(columns, math.ceil(right) + 1),
            min(rows, math.ceil(bottom) + 1),
        )

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
        azimuths = self._yaw - np.arctan2(rays[:, 1], rays[:, 0])
        azimuths = np.remainder(azimuths + math.pi, math.tau) - math.pi
        return azimuths, -rays[:, 2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)

    def _columns_and_rows(self, azimuths: Floats, slopes: Floats) -> tuple[Floats, Floats]:
        columns: Floats = (azimuths - self.first_azimuth) / self.step
        rows: Floats = (slopes - self.first_slope) / self.step
        return columns, rows

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
