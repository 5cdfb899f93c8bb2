"""Cylinders that are on no map, for rendered frames."""

import msgspec
import numpy as np

from cpcbl_launch.simulation.camera.scene import Band, Scene, SceneCylinder, colour_bgr


def with_clutter(scene: Scene, count: int, random: np.random.Generator) -> Scene:
    """The scene with so many cylinders at random places that are on no map.

    They have the landmarks' shape with one band, the bands of a landmark exchanged, or other shapes
    in the team's colours.
    """
    cylinders = [_random_cylinder(scene, random) for _ in range(count)]
    return msgspec.structs.replace(scene, clutter=(*scene.clutter, *cylinders))


def _random_cylinder(scene: Scene, random: np.random.Generator) -> SceneCylinder:
    paints = [colour_bgr(scene.vision, name) for name in scene.vision.colours]
    shape, kind = scene.vision.landmark, random.integers(3)
    places = [(cylinder.x_m, cylinder.y_m) for cylinder in scene.landmarks.values()] or [(0.0, 0.0)]
    low, high = np.min(places, axis=0) - 1.0, np.max(places, axis=0) + 1.0
    x_m, y_m = (float(v) for v in random.uniform(low, high))
    colour = paints[int(random.integers(len(paints)))]
    foot, height = shape.foot_m, shape.height_m
    if kind == 0:
        bands: tuple[Band, ...] = (Band(foot, foot + height, colour),)
        return SceneCylinder(x_m, y_m, shape.radius_m, bands)
    if kind == 1 and scene.landmarks:
        cylinders = list(scene.landmarks.values())
        lower, upper = cylinders[int(random.integers(len(cylinders)))].bands
        swapped = lower._replace(bgr=upper.bgr), upper._replace(bgr=lower.bgr)
        if not any(swapped == cylinder.bands for cylinder in cylinders):
            return SceneCylinder(x_m, y_m, shape.radius_m, swapped)
    radius_m = shape.radius_m * float(random.uniform(0.3, 4.0))
    top_m = height * float(random.uniform(0.1, 0.6))
    return SceneCylinder(x_m, y_m, radius_m, (Band(0.0, top_m, colour),))
