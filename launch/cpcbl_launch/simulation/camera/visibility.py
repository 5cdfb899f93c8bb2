"""The visible share of an object: the part inside the frame with nothing in front of it.

It follows from geometry alone, independent of the renderer: rays to the lens from points on the
side of an object that faces the lens. Every object hides others like an upright cylinder.
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


def visible_shares(
    points: Floats, camera: Camera, before: Sequence[Sequence[Solid]]
) -> tuple[float, ...]:
    """The share of points (n, 3) of the robot's frame that lie in the frame, with none of the
    solids before them: for each of some sets of solids."""
    inside = is_in_frame(points, camera)
    if not inside.any():
        return (0.0,) * len(before)
    return tuple(
        float(np.mean(inside & ~is_hidden(points, camera.position, solids))) for solids in before
    )


def is_in_frame(points: Floats, camera: Camera) -> Mask:
    """Which of the points (n, 3) of the robot's frame fall on a pixel."""
    width, height = camera.size_px
    u, v = camera.project(points).T
    with np.errstate(invalid="ignore"):
        inside: Mask = (u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)
    return inside


def is_hidden(points: Floats, lens: Floats, before: Sequence[Solid]) -> Mask:
    """Which of the points (n, 3) have one of the solids between themselves and the lens (3,)."""
    covered = np.zeros(len(points), dtype=np.bool_)
    x, y, _ = (float(v) for v in points.mean(axis=0) - lens)
    far, spread = math.hypot(x, y), float(np.abs(points - points.mean(axis=0)).max()) * 1.5
    for solid in before:
        if _may_hide(
            solid.x - float(lens[0]), solid.y - float(lens[1]), solid.radius, x, y, far, spread
        ):
            covered |= _is_crossed(points, lens, solid)
    return covered


def _may_hide(
    a: float, b: float, radius: float, x: float, y: float, far: float, spread: float
) -> bool:
    """Whether a circle around (a, b) may touch the line to a point within `spread` of (x, y)."""
    along, across = (a * x + b * y) / far, abs(a * y - b * x) / far
    return -radius <= along <= far + spread + radius and across <= spread + radius


def _is_crossed(points: Floats, lens: Floats, solid: Solid) -> Mask:
    """Whether the line from the lens to each point crosses the solid."""
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
