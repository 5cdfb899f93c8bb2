"""A pinhole camera at a pose of the field: points of the field to pixels, and pixels to rays.

Pixel centres have integer coordinates, as in OpenCV. Values of a pixel are those at its centre; its
covered share follows from the distance of the centre to the edge.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Box, Camera, Floats
from cpcbl_team.geometry import Pose2

Grey = NDArray[np.float32]
NEAREST_M = 0.02  # what is nearer to the lens has no pixels of its own


def _clip_to_near_plane(ahead: Floats, behind: Floats) -> Floats:
    """Points (n, 3) of the camera's frame that bound the part of an object in front of the near
    plane, from corners on both sides of that plane."""
    way = behind[None] - ahead[:, None]
    share = (NEAREST_M - ahead[:, None, 2]) / way[..., 2]
    return np.concatenate([ahead, (ahead[:, None] + share[..., None] * way).reshape(-1, 3)])


def _pixel_centres(box: Box) -> tuple[Grey, Grey]:
    """The columns (1, width) and the rows (height, 1) of the pixels of a box."""
    columns = np.arange(box.left, box.right, dtype=np.float32)[None, :]
    return columns, np.arange(box.top, box.bottom, dtype=np.float32)[:, None]


def cross_products(a: Floats, b: Floats) -> Floats:
    """Cross products of rows (n, 3); numpy's own takes ten times as long for a few."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.column_stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


class View:
    """A pinhole camera at a pose of the field."""

    def __init__(self, camera: Camera, pose: Pose2) -> None:
        self.size_px, self.matrix = camera.size_px, camera.matrix
        c, s = math.cos(pose.heading), math.sin(pose.heading)
        field_from_robot = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self.field_from_camera: Floats = field_from_robot @ camera.robot_from_camera
        """Rotation (3, 3)."""
        self.lens: Floats = np.array([pose.x, pose.y, 0.0]) + field_from_robot @ camera.position
        """Field frame (m)."""
        self.rays: Floats = self.field_from_camera @ np.linalg.inv(self.matrix)
        """The direction in which pixel (u, v, 1) looks, field frame: (3, 3)."""

    def box(self, points: Floats) -> Box | None:
        """The pixels around all these points (n, 3) of the field, within the picture; None if
        there are none."""
        seen = (points - self.lens) @ self.field_from_camera
        width, height = self.size_px
        ahead = seen[:, 2] > NEAREST_M
        if not ahead.any():
            return None
        if not ahead.all():
            seen = _clip_to_near_plane(seen[ahead], seen[~ahead])
        pixels = seen @ self.matrix.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        left, top = np.floor(np.clip(pixels.min(axis=0), -2.0, 1e5)).astype(int) - 1
        right, bottom = np.ceil(np.clip(pixels.max(axis=0), -2.0, 1e5)).astype(int) + 2
        found = Box(max(left, 0), max(top, 0), min(right, width), min(bottom, height))
        return found if min(found.size) > 0 else None

    def ray_directions(self, box: Box) -> tuple[Grey, Grey, Grey]:
        """The directions of the rays of all pixels in a box: x, y, z of the field frame."""
        u, v = _pixel_centres(box)
        x, y, z = ((np.float32(a) * u + np.float32(c)) + np.float32(b) * v for a, b, c in self.rays)
        return x, y, z

    def shares_inside(self, normals: Sequence[Floats], box: Box) -> Grey:
        """The share of each pixel that is inside all the planes through the lens with these
        normals (3,), which point inwards."""
        u, v = _pixel_centres(box)
        shares = np.ones((box.bottom - box.top, box.right - box.left), np.float32)
        for normal in normals:
            across, down, offset = normal @ self.rays
            slope = math.hypot(across, down)
            if slope == 0.0:
                continue
            a, b, c = (np.float32(k / slope) for k in (across, down, offset))
            shares *= np.clip((a * u + (c + np.float32(0.5))) + b * v, 0.0, 1.0)
        return shares

    def polygon_shares(self, corners: Floats, box: Box) -> Grey:
        """The share of each pixel that a convex polygon (n, 3) of the field covers."""
        sides = corners - self.lens
        middle = sides.mean(axis=0)
        normals = cross_products(sides, np.concatenate([sides[1:], sides[:1]]))
        normals *= np.where(normals @ middle < 0.0, -1.0, 1.0)[:, None]
        return self.shares_inside(list(normals), box)

    def homography(self, origin: Floats, across: Floats, down: Floats) -> Floats:
        """From the coordinates on a plane, origin + s across + t down, to pixels: (3, 3)."""
        columns = np.column_stack([across, down, origin - self.lens])
        found: Floats = self.matrix @ self.field_from_camera.T @ columns
        return found
