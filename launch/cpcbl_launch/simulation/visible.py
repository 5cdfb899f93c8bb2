"""How much of a thing a camera can see: what lies in the frame with nothing before it.

By geometry alone, apart from the renderer: points on the side of a thing that faces the lens, and
rays from them to the lens. What stands on the field hides like an upright cylinder.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Camera, Floats

Mask = NDArray[np.bool_]

_SPREAD = np.radians(np.linspace(-75.0, 75.0, 7))  # of the side that faces the lens


class Solid(NamedTuple):
    """An upright cylinder, in the viewer's frame (m)."""

    x: float
    y: float
    radius: float
    low: float
    high: float


def share_shown(points: Floats, camera: Camera, before: Sequence[Solid]) -> float:
    """The share of points (n, 3) of the robot's frame that lie in the frame, with none of these
    solids before them."""
    return float(np.mean(in_frame(points, camera) & ~hidden(points, camera.position, before)))


def in_frame(points: Floats, camera: Camera) -> Mask:
    """Which of the points (n, 3) of the robot's frame fall on a pixel."""
    width, height = camera.size_px
    u, v = camera.project(points).T
    with np.errstate(invalid="ignore"):
        inside: Mask = (u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)
    return inside


def hidden(points: Floats, lens: Floats, before: Sequence[Solid]) -> Mask:
    """Which of the points (n, 3) have one of the solids between them and the lens (3,)."""
    covered = np.zeros(len(points), dtype=np.bool_)
    for solid in before:
        covered |= _crossed(points, lens, solid)
    return covered


def _crossed(points: Floats, lens: Floats, solid: Solid) -> Mask:
    """Whether the way from the lens to each point goes through the solid."""
    way = points - lens
    start = lens[:2] - (solid.x, solid.y)
    a = np.sum(way[:, :2] ** 2, axis=1)
    b = way[:, :2] @ start
    c = float(start @ start) - solid.radius**2
    root = b * b - a * c
    if not (root > 0.0).any():
        return np.zeros(len(points), dtype=np.bool_)
    with np.errstate(invalid="ignore", divide="ignore"):
        half = np.sqrt(root)
        enters, leaves = np.maximum((-b - half) / a, 0.0), np.minimum((-b + half) / a, 1.0)
        heights = lens[2] + np.stack([enters, leaves]) * way[:, 2]
        met: Mask = (
            (root > 0.0)
            & (enters < leaves)
            & (heights.max(axis=0) >= solid.low)
            & (heights.min(axis=0) <= solid.high)
        )
    return met


def cylinder_points(solid: Solid, lens: Floats) -> Floats:
    """Points (63, 3) on the side of a cylinder that faces the lens, from edge to edge."""
    facing = math.atan2(lens[1] - solid.y, lens[0] - solid.x)
    angles, heights = np.meshgrid(facing + _SPREAD, np.linspace(solid.low, solid.high, 9))
    x = solid.x + solid.radius * np.cos(angles)
    y = solid.y + solid.radius * np.sin(angles)
    return np.column_stack([x.ravel(), y.ravel(), heights.ravel()])


def plate_points(x: float, y: float, height: float, facing: float, side: float) -> Floats:
    """Points (25, 3) of an upright square plate that looks into direction `facing` (rad)."""
    across, up = np.meshgrid(np.linspace(-0.5, 0.5, 5) * side, np.linspace(-0.5, 0.5, 5) * side)
    points = [x - across * math.sin(facing), y + across * math.cos(facing), height + up]
    return np.column_stack([p.ravel() for p in points])
