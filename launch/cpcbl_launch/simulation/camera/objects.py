"""Cylinders and robots in a picture: the colours and the covered shares of the pixels around them.

A cylinder is rendered by the ray of every pixel. A robot is a box whose sides carry markers, each
warped by the homography of its plane.
"""

import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Box, Floats, Pixels
from cpcbl_agents.vision.marker_families import marker_image, marker_layout
from cpcbl_agents.vision.poses import SIDE_ANGLES
from cpcbl_launch.simulation.camera.scene import Bgr, Scene, SceneCylinder, SceneRobot, with_stand
from cpcbl_launch.simulation.camera.view import Grey, View, cross_products
from cpcbl_team.config import MarkerFamily, VisionSettings

CAP: Bgr = (52.0, 52.0, 52.0)
SHADE = 0.28  # of the light comes from one side
LIGHT = 0.5, math.sqrt(0.75)  # where from, in the field's frame
BODY: Bgr = (70.0, 66.0, 64.0)
LID: Bgr = (84.0, 80.0, 78.0)
PAPER, INK = 236.0, 22.0
_ROUND = np.linspace(0.0, math.tau, 8, endpoint=False)
_CIRCLE = np.column_stack([np.cos(_ROUND), np.sin(_ROUND)]) / math.cos(math.pi / 8)
_UP = np.array([0.0, 0.0, 1.0])


class Piece(NamedTuple):
    """A part of an object: a box of pixels, their colours (h, w, 3) or (3,), and their covered
    shares (h, w)."""

    box: Box
    colours: Grey
    shares: Grey


class Face(NamedTuple):
    """A flat convex piece: its corners (n, 3) in the field's frame, counter-clockwise from outside
    and from its lower left, and its colour; the marker on it, if any."""

    corners: Floats
    bgr: Bgr
    marker: tuple[MarkerFamily, int] | None = None

    def is_facing(self, lens: Floats) -> bool:
        a, b, c = self.corners[:3]
        (normal,) = cross_products((b - a)[None], (c - a)[None])
        return float(normal @ (lens - a)) > 0.0


def cylinder_pieces(view: View, cylinder: SceneCylinder) -> list[Piece]:
    """A cylinder; empty if it is not in the frame or the lens is inside it."""
    lens, (low, *_), (*_, high) = view.lens, cylinder.bands, cylinder.bands
    ex, ey = cylinder.x_m - lens[0], cylinder.y_m - lens[1]
    if math.hypot(ex, ey) <= 1.05 * cylinder.radius_m:
        return []
    circle = _CIRCLE * cylinder.radius_m + (cylinder.x_m, cylinder.y_m)
    ends = low.from_m, high.to_m
    box = view.box(np.vstack([np.column_stack([circle, np.full(8, z)]) for z in ends]))
    if box is None:
        return []
    dx, dy, dz = view.ray_directions(box)
    level = np.maximum(np.sqrt(dx * dx + dy * dy), np.float32(1e-6))
    ux, uy, slope = dx / level, dy / level, dz / level
    middle, across = ex * ux + ey * uy, ex * uy - ey * ux
    half = np.sqrt(np.maximum(cylinder.radius_m**2 - across * across, 0.0))
    front = middle - half
    heights, backs = lens[2] + front * slope, lens[2] + (middle + half) * slope
    per_pixel = _change_per_pixel(heights)

    shares = view.shares_inside(_tangent_planes(ex, ey, cylinder.radius_m), box)
    if low.from_m <= lens[2] <= high.to_m:
        shares *= _share_above(heights - low.from_m, per_pixel)
        shares *= _share_above(high.to_m - heights, per_pixel)
    elif lens[2] > high.to_m:  # its top face is seen
        shares *= _share_above(high.to_m - backs, _change_per_pixel(backs))
        shares *= _share_above(heights - low.from_m, per_pixel)
    else:
        shares *= _share_above(backs - low.from_m, _change_per_pixel(backs))
        shares *= _share_above(high.to_m - heights, per_pixel)

    lit = ((front * ux - ex) * LIGHT[0] + (front * uy - ey) * LIGHT[1]) / cylinder.radius_m
    lit = (1.0 - SHADE) + SHADE * lit
    edges = [(low.from_m, CAP, low.bgr), (high.to_m, high.bgr, CAP)]
    edges[1:1] = [(b.from_m, a.bgr, b.bgr) for a, b in pairwise(cylinder.bands)]
    colours = np.empty((*heights.shape, 3), np.float32)
    colours[:] = CAP
    for height, below, above in edges:
        step = np.asarray(above, np.float32) - np.asarray(below, np.float32)
        if step.any():
            colours += _share_above(heights - height, per_pixel)[..., None] * step
    colours *= lit[..., None]
    return [Piece(box, colours, shares)]


def _share_above(heights: Grey, per_pixel: Grey) -> Grey:
    """The share of each pixel that is above zero, by the height at its centre."""
    share: Grey = np.clip(0.5 + heights / per_pixel, 0.0, 1.0)
    return share


def _change_per_pixel(heights: Grey) -> Grey:
    """The difference of heights from one pixel to the next."""
    if min(heights.shape) < 2:
        return np.full_like(heights, 1e-3)
    down, right = np.gradient(heights)
    steepness: Grey = np.maximum(np.hypot(down, right), np.float32(1e-9))
    return steepness


def _tangent_planes(ex: float, ey: float, radius_m: float) -> list[Floats]:
    """The planes through the lens on either side of a cylinder: normals that point to it."""
    towards, half = math.atan2(ey, ex), math.asin(radius_m / math.hypot(ex, ey))
    left, right = towards + half, towards - half
    return [
        np.array([math.sin(left), -math.cos(left), 0.0]),
        np.array([-math.sin(right), math.cos(right), 0.0]),
    ]


def body_top_m(vision: VisionSettings) -> float:
    """Bodies end where masts begin, but above their markers."""
    half_m = max(0.7, 0.5 * paper_ratio(vision.family)) * vision.marker_m
    return max(vision.mast.foot_m, vision.marker_mounted_m + half_m)


def robot_pieces(view: View, robot: SceneRobot, scene: Scene) -> list[Piece]:
    """A robot's body and its mast, the nearer to the lens last."""
    body = []
    for face in _robot_faces(robot, scene):
        if face.is_facing(view.lens) and (box := view.box(face.corners)) is not None:
            colours = np.array(face.bgr, np.float32)
            if face.marker is not None:
                colours = _render_marker(view, face.corners, *face.marker, box)[..., None]
            body.append(Piece(box, colours, view.polygon_shares(face.corners, box)))
    if robot.name not in scene.masts:
        return body
    top_m = body_top_m(scene.vision)
    mast = with_stand(scene.masts[robot.name].at(robot.x_m, robot.y_m), top_m)
    pieces = cylinder_pieces(view, mast)
    return body + pieces if view.lens[2] > top_m else pieces + body


def _robot_faces(robot: SceneRobot, scene: Scene) -> Iterator[Face]:
    """A robot's outside, its markers after the sides that they are on."""
    vision, numbers = scene.vision, scene.markers.get(robot.name, {})
    half, top_m = vision.marker_distance_m, body_top_m(vision)
    centre = np.array([robot.x_m, robot.y_m, 0.0])
    lid = []
    for side, direction in SIDE_ANGLES.items():
        angle = robot.heading_rad + direction
        out = np.array([math.cos(angle), math.sin(angle), 0.0])
        along = np.array([-out[1], out[0], 0.0])  # to the right, for who looks at it
        wall = centre + half * out
        yield Face(_upright(wall, along, half, 0.0, top_m), BODY)
        lid.append(wall + half * along + top_m * _UP)
        if side in numbers:
            size = vision.marker_m / 2.0 * paper_ratio(vision.family)
            low, high = vision.marker_mounted_m - size, vision.marker_mounted_m + size
            marker = vision.family, numbers[side]
            yield Face(_upright(wall, along, size, low, high), (PAPER,) * 3, marker)
    yield Face(np.array(lid), LID)


def _upright(wall: Floats, along: Floats, half: float, low_m: float, high_m: float) -> Floats:
    """Corners of a rectangle whose middle stands on a place of the floor."""
    left, right, low, high = wall - half * along, wall + half * along, low_m * _UP, high_m * _UP
    return np.array([left + low, right + low, right + high, left + high])


def _render_marker(
    view: View, corners: Floats, family: MarkerFamily, number: int, box: Box
) -> Grey:
    """The grey levels of a marker between corners, in the pixels of a box: means over each."""
    low_left, low_right, _, high_left = corners
    plane = view.homography(high_left, low_right - low_left, low_left - high_left)
    width, height = box.size
    finer = 4 if width * height <= 160 * 160 else 2
    paper = _marker_paper(family, number, _pixels_per_module(plane, finer))
    n = len(paper)
    unit_from_paper = np.array([[1.0 / n, 0.0, 0.5 / n], [0.0, 1.0 / n, 0.5 / n], [0.0, 0.0, 1.0]])
    shift_x, shift_y = ((0.5 - start) * finer - 0.5 for start in (box.left, box.top))
    fine_from_pixel = np.array([[finer, 0.0, shift_x], [0.0, finer, shift_y], [0.0, 0.0, 1.0]])
    homography, size = fine_from_pixel @ plane @ unit_from_paper, (width * finer, height * finer)
    fine = cv2.warpPerspective(
        paper, homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    shades = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    return shades.astype(np.float32)


def _pixels_per_module(plane: Floats, finer: int) -> int:
    """Pixels per module for the size of the marker in the frame: edges are then as sharp as the
    finer grid, and none is missed."""
    corners = plane @ np.array([[0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0], [1.0] * 4])
    if (corners[2] <= 0.0).any():
        return 32
    pixels = corners[:2] / corners[2]
    sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=0)
    wanted = finer * sides.min() / 8.0
    return min((4, 8, 16, 32), key=lambda detail: abs(math.log(detail / max(wanted, 1e-3))))


@lru_cache(maxsize=256)
def _marker_paper(family: MarkerFamily, number: int, detail: int) -> Pixels:
    """A marker with a quiet zone of one module around, grey, `detail` pixels a module."""
    image = marker_image(family, number, detail)
    shades: Pixels = np.where(image > 127, PAPER, INK).astype(np.uint8)
    return shades


def paper_ratio(family: MarkerFamily) -> float:
    """The side of a marker with its quiet zone, over that of the square that is looked for."""
    layout = marker_layout(family)
    return (layout.side + 2) / layout.quad
