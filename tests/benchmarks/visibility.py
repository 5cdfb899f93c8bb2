"""The visible share of an object: the part that lies in the frame and that nothing occludes.

It follows from geometry alone, independently of the renderer. Line segments from points on the
side of the object that faces the lens to the lens are tested for intersection with the solids of
other objects, and each solid is an upright cylinder. Coordinates are metres in the viewer's robot
frame.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Camera, Floats

Mask = NDArray[np.bool_]

_SPREAD = np.radians(np.linspace(-75.0, 75.0, 7))  # azimuths of points, seen from the axis


class Solid(NamedTuple):
    """An upright cylinder between two heights above the floor."""

    x: float
    y: float
    radius: float
    low: float
    high: float


def visible_shares(
    points: Floats, camera: Camera, solid_sets: Sequence[Sequence[Solid]]
) -> tuple[float, ...]:
    """For each set of solids, the share of the points (n, 3) that are in the frame and that none
    of these solids occludes."""
    inside = is_in_frame(points, camera)
    if not inside.any():
        return (0.0,) * len(solid_sets)
    lens = camera.position
    return tuple(float(np.mean(inside & ~is_occluded(points, lens, s))) for s in solid_sets)


def is_in_frame(points: Floats, camera: Camera) -> Mask:
    """Whether each of the points (n, 3) is projected to a pixel of the frame."""
    width, height = camera.size_px
    u, v = camera.project(points).T
    with np.errstate(invalid="ignore"):
        inside: Mask = (u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)
    return inside


def is_occluded(points: Floats, lens: Floats, solids: Sequence[Solid]) -> Mask:
    """Whether a solid intersects the line segment from the lens (3,) to each point (n, 3).

    The segment is lens + t * ray with 0 <= t <= 1. Within a solid's radius, t lies between the
    roots of a quadratic equation; there, the segment must pass between its base and its top.
    """
    x, y, radius, low, high = np.array(solids).reshape(-1, 5).T[:, :, None]
    ray_x, ray_y, ray_z = (points - lens).T
    from_axis_x, from_axis_y = lens[0] - x, lens[1] - y
    a = ray_x**2 + ray_y**2
    b = ray_x * from_axis_x + ray_y * from_axis_y
    c = from_axis_x**2 + from_axis_y**2 - radius**2
    with np.errstate(invalid="ignore", divide="ignore"):  # NaN if there is no root
        root = np.sqrt(b * b - a * c)
        enters, leaves = np.maximum((-b - root) / a, 0.0), np.minimum((-b + root) / a, 1.0)
        heights = lens[2] + np.stack([enters, leaves]) * ray_z
        between = (heights.max(axis=0) >= low) & (heights.min(axis=0) <= high)
        occluded: Mask = ((enters < leaves) & between).any(axis=0)
    return occluded


def cylinder_points(solid: Solid, lens: Floats) -> Floats:
    """Points (63, 3) of a grid on the side of a cylinder that faces the lens."""
    facing = math.atan2(lens[1] - solid.y, lens[0] - solid.x)
    angles, heights = np.meshgrid(facing + _SPREAD, np.linspace(solid.low, solid.high, 9))
    x = solid.x + solid.radius * np.cos(angles)
    y = solid.y + solid.radius * np.sin(angles)
    return np.column_stack([x.ravel(), y.ravel(), heights.ravel()])


def plate_points(x: float, y: float, height: float, facing: float, side: float) -> Floats:
    """Points (25, 3) of a grid on an upright square plate with this side length, whose centre is
    at (x, y, height) and whose normal has the azimuth `facing` (rad)."""
    across, up = np.meshgrid(np.linspace(-0.5, 0.5, 5) * side, np.linspace(-0.5, 0.5, 5) * side)
    points = [x - across * math.sin(facing), y + across * math.cos(facing), height + up]
    return np.column_stack([p.ravel() for p in points])
