"""Upright cylinders in a picture, by the ray of every pixel: silhouette, bands and shade."""

import math

import numpy as np

from cpcbl_agents.vision.camera import Floats
from cpcbl_launch.simulation.camera.scene import SceneCylinder
from cpcbl_launch.simulation.camera.view import Box, Grey, View

CAP = (52.0, 52.0, 52.0)
SHADE = 0.28  # of the light comes from one side
LIGHT = 0.5, math.sqrt(0.75)  # where from, in the field's frame
_ROUND = np.linspace(0.0, math.tau, 8, endpoint=False)
_CIRCLE = np.column_stack([np.cos(_ROUND), np.sin(_ROUND)]) / math.cos(math.pi / 8)


def cylinder_box(view: View, cylinder: SceneCylinder) -> Box | None:
    """The pixels that a cylinder may cover; None if there are none, or the lens is inside it."""
    if (
        math.hypot(cylinder.x_m - view.lens[0], cylinder.y_m - view.lens[1])
        <= 1.05 * cylinder.radius_m
    ):
        return None
    return view.box(_bounding_prism(cylinder))


def draw_cylinder(view: View, cylinder: SceneCylinder, box: Box) -> tuple[Grey, Grey]:
    """The colours (h, w, 3) and the covered shares (h, w) of a box's pixels."""
    lens, (low, *_), (*_, high) = view.lens, cylinder.bands, cylinder.bands
    ex, ey = cylinder.x_m - lens[0], cylinder.y_m - lens[1]
    dx, dy, dz = view.ray_directions(box)
    level = np.maximum(np.sqrt(dx * dx + dy * dy), np.float32(1e-6))
    ux, uy, slope = dx / level, dy / level, dz / level
    middle, across = ex * ux + ey * uy, ex * uy - ey * ux
    half = np.sqrt(np.maximum(cylinder.radius_m**2 - across * across, 0.0))
    front = middle - half
    heights = lens[2] + front * slope
    backs = lens[2] + (middle + half) * slope
    per_pixel = _change_per_pixel(heights)

    shares = view.shares_inside(_tangent_planes(ex, ey, cylinder.radius_m), box)
    if lens[2] > high.to_m:  # its top is seen, or its bottom below
        shares *= np.clip(0.5 + (high.to_m - backs) / _change_per_pixel(backs), 0.0, 1.0)
        shares *= np.clip(0.5 + (heights - low.from_m) / per_pixel, 0.0, 1.0)
    elif lens[2] < low.from_m:
        shares *= np.clip(0.5 + (backs - low.from_m) / _change_per_pixel(backs), 0.0, 1.0)
        shares *= np.clip(0.5 + (high.to_m - heights) / per_pixel, 0.0, 1.0)
    else:
        shares *= np.clip(0.5 + (heights - low.from_m) / per_pixel, 0.0, 1.0)
        shares *= np.clip(0.5 + (high.to_m - heights) / per_pixel, 0.0, 1.0)

    lit = ((front * ux - ex) * LIGHT[0] + (front * uy - ey) * LIGHT[1]) / cylinder.radius_m
    lit = (1.0 - SHADE) + SHADE * lit
    edges = [(low.from_m, CAP, low.bgr)]
    edges += [
        (b.from_m, a.bgr, b.bgr) for a, b in zip(cylinder.bands, cylinder.bands[1:], strict=False)
    ]
    edges += [(high.to_m, high.bgr, CAP)]
    colours = np.empty((*heights.shape, 3), np.float32)
    colours[:] = CAP
    for height, below, above in edges:
        step = np.asarray(above, np.float32) - np.asarray(below, np.float32)
        if step.any():
            colours += np.clip(0.5 + (heights - height) / per_pixel, 0.0, 1.0)[..., None] * step
    colours *= lit[..., None]
    return colours, shares


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


def _bounding_prism(cylinder: SceneCylinder) -> Floats:
    """Corners of a prism around a cylinder (16, 3)."""
    circle = _CIRCLE * cylinder.radius_m + (cylinder.x_m, cylinder.y_m)
    ends = cylinder.bands[0].from_m, cylinder.bands[-1].to_m
    return np.vstack([np.column_stack([circle, np.full(8, z)]) for z in ends])
