"""Robots in a picture: a box whose sides carry markers, warped by the plane's true homography."""

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_launch.simulation.camera.scene import RobotAppearance, SceneRobot
from cpcbl_launch.simulation.camera.view import Box, Grey, View, cross_products
from cpcbl_team.config import MarkerFamily, Side, VisionSettings

BODY = (70.0, 66.0, 64.0)
LID = (84.0, 80.0, 78.0)
PAPER = 236.0
INK = 22.0
SIDES: dict[Side, float] = {
    "front": 0.0,
    "left": math.pi / 2.0,
    "back": math.pi,
    "right": -math.pi / 2.0,
}
"""In which direction each side looks, in the robot's frame."""
_UP = np.array([0.0, 0.0, 1.0])


class Face(NamedTuple):
    """A flat convex piece: its corners (n, 3) in the field's frame, counter-clockwise from outside
    and from its lower left, and its colour; the picture that fills it, if any."""

    corners: Floats
    bgr: tuple[float, float, float]
    picture: tuple[MarkerFamily, int] | None = None

    def is_facing(self, lens: Floats) -> bool:
        a, b, c = self.corners[:3]
        (normal,) = cross_products((b - a)[None], (c - a)[None])
        return float(normal @ (lens - a)) > 0.0


def body_top_m(vision: VisionSettings) -> float:
    """Bodies end where masts begin, but above their markers."""
    return max(vision.mast.foot_m, vision.marker_mounted_m + 0.7 * vision.marker_m)


def robot_faces(
    robot: SceneRobot, appearance: RobotAppearance, vision: VisionSettings
) -> Iterator[Face]:
    """A robot's outside, its markers after the sides that they are on."""
    half, top_m = vision.marker_distance_m, body_top_m(vision)
    numbers = {marker.side: marker.number for marker in appearance.markers}
    centre = np.array([robot.x_m, robot.y_m, 0.0])
    lid = []
    for side, direction in SIDES.items():
        angle = robot.heading_rad + direction
        out = np.array([math.cos(angle), math.sin(angle), 0.0])
        along = np.array([-out[1], out[0], 0.0])  # to the right, for who looks at it
        wall = centre + half * out
        yield Face(_upright(wall, along, half, 0.0, top_m), BODY)
        lid.append(wall + half * along + top_m * _UP)
        if side in numbers:
            size = vision.marker_m / 2.0 * quiet_zone_ratio(vision.family)
            low, high = vision.marker_mounted_m - size, vision.marker_mounted_m + size
            picture = vision.family, numbers[side]
            yield Face(_upright(wall, along, size, low, high), (PAPER,) * 3, picture)
    yield Face(np.array(lid), LID)


def draw_face(view: View, face: Face, box: Box) -> tuple[Grey, Grey]:
    """The colours (h, w, 3) or (3,), and the covered shares (h, w), of a box's pixels."""
    shares = view.polygon_shares(face.corners, box)
    if face.picture is None:
        return np.array(face.bgr, np.float32), shares
    return _render_picture(view, face, box)[..., None], shares


def _upright(wall: Floats, along: Floats, half: float, low_m: float, high_m: float) -> Floats:
    """Corners of a rectangle whose middle stands on a place of the floor."""
    left, right = wall - half * along, wall + half * along
    return np.array([left + low_m * _UP, right + low_m * _UP, right + high_m * _UP,
                     left + high_m * _UP])  # fmt: skip


def _render_picture(view: View, face: Face, box: Box) -> Grey:
    """A face's picture in the pixels of a box, each the mean over its area."""
    assert face.picture is not None
    low_left, low_right, _, high_left = face.corners
    plane = view.homography(high_left, low_right - low_left, low_left - high_left)
    width, height = box.size
    finer = 4 if width * height <= 160 * 160 else 2
    paper = _marker_image(*face.picture, _pixels_per_module(plane, finer))
    n = len(paper)
    unit_from_paper = np.array([[1.0 / n, 0.0, 0.5 / n], [0.0, 1.0 / n, 0.5 / n], [0.0, 0.0, 1.0]])
    shift_x, shift_y = ((0.5 - start) * finer - 0.5 for start in (box.left, box.top))
    fine_from_pixel = np.array([[finer, 0.0, shift_x], [0.0, finer, shift_y], [0.0, 0.0, 1.0]])
    fine = cv2.warpPerspective(
        paper,
        fine_from_pixel @ plane @ unit_from_paper,
        (width * finer, height * finer),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    shades = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    return shades.astype(np.float32)


def _pixels_per_module(plane: Floats, finer: int) -> int:
    """Pixels per module for the size of the picture in the frame: edges are then as sharp as the
    finer grid, and none is missed."""
    corners = plane @ np.array([[0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0], [1.0] * 4])
    if (corners[2] <= 0.0).any():
        return 32
    pixels = corners[:2] / corners[2]
    sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=0)
    wanted = finer * sides.min() / 8.0
    return min((4, 8, 16, 32), key=lambda detail: abs(math.log(detail / max(wanted, 1e-3))))


@lru_cache(maxsize=256)
def _marker_image(family: MarkerFamily, number: int, detail: int) -> Pixels:
    """A marker with a quiet zone of one module around, grey, `detail` pixels a module."""
    modules = _dictionary(family).markerSize + 2
    ink = cv2.aruco.generateImageMarker(_dictionary(family), number, modules * detail)
    paper = cv2.copyMakeBorder(ink, *(detail,) * 4, cv2.BORDER_CONSTANT, value=(255,))
    shades: Pixels = np.where(paper > 127, PAPER, INK).astype(np.uint8)
    return shades


def quiet_zone_ratio(family: MarkerFamily) -> float:
    """The side of a marker with its quiet zone, over that of the marker."""
    modules = _dictionary(family).markerSize + 2
    return (modules + 2) / modules


@lru_cache(maxsize=8)
def _dictionary(family: MarkerFamily) -> cv2.aruco.Dictionary:
    number: int = getattr(cv2.aruco, f"DICT_{family.removeprefix('aruco_').upper()}")
    return cv2.aruco.getPredefinedDictionary(number)
