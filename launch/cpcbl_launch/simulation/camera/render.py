"""Pictures of the simulated field, as a robot's camera sees it from its true pose.

Drawn far to near through a pinhole, each pixel by the share of it that a thing covers; then bent
by the lens's distortion, lit, blurred and made noisy. The same generator gives the same picture.
"""

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from msgspec.structs import replace

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_launch.simulation.camera.backdrop import backdrop, wall_corners
from cpcbl_launch.simulation.camera.cylinders import draw_post, post_box
from cpcbl_launch.simulation.camera.exposure import exposed
from cpcbl_launch.simulation.camera.robots import body_top_m, draw_face, faces
from cpcbl_launch.simulation.camera.scene import Looks, Plane, Post, Scene, Standing, stand
from cpcbl_launch.simulation.camera.view import Box, Grey, View
from cpcbl_team.config import CameraSettings, Light
from cpcbl_team.geometry import Pose2

__all__ = ["Light", "Scene", "Standing", "render"]

WIDEST = 4.0  # a picture before distortion, over one after it


def render(
    scene: Scene,
    camera: Camera,
    pose: Pose2,
    robots: Sequence[Standing],
    light: Light,
    random: np.random.Generator,
) -> Pixels:
    """What a camera on a robot at `pose` (`field_from_robot`) sees: (h, w, 3), BGR.

    `robots` are the others; the viewer does not see itself.
    """
    pinhole = _pinhole(camera.settings)
    picture = _drawn(scene, View(camera if pinhole is None else pinhole.camera, pose), robots)
    if pinhole is not None:
        picture = cv2.remap(picture, *pinhole.maps, cv2.INTER_LINEAR).astype(np.uint8, copy=False)
    return exposed(picture, light, random)


def _drawn(scene: Scene, view: View, robots: Sequence[Standing]) -> Pixels:
    picture = backdrop(view, scene)
    posts = [*scene.landmarks.values(), *scene.clutter]
    things: list[Post | Standing] = [*posts, *robots]
    things.sort(key=lambda thing: -math.hypot(thing.x_m - view.lens[0], thing.y_m - view.lens[1]))
    for thing in things:
        walls = [wall_corners(w, scene.wall_m) for w in scene.walls if _hides(w, view, thing)]
        pieces = (
            _post(view, stand(thing, 0.0))
            if isinstance(thing, Post)
            else _robot(view, thing, scene)
        )
        for box, colours, shares in pieces:
            for wall in walls:
                shares = shares * (1.0 - view.covered(wall, box))
            _paint(picture, box, colours, shares)
    return picture


Piece = tuple[Box, Grey, Grey]  # where, colours, covered shares


def _post(view: View, post: Post) -> Iterator[Piece]:
    box = post_box(view, post)
    if box is not None:
        yield box, *draw_post(view, post, box)


def _robot(view: View, robot: Standing, scene: Scene) -> Iterator[Piece]:
    """Its body and its mast, the nearer to the lens last."""
    looks, top_m = scene.looks.get(robot.name, Looks()), body_top_m(scene.vision)
    above = view.lens[2] > top_m
    if looks.mast is not None and not above:
        yield from _post(view, stand(looks.mast.at(robot.x_m, robot.y_m), top_m))
    for face in faces(robot, looks, scene.vision):
        box = view.box(face.corners) if face.seen_from(view.lens) else None
        if box is not None:
            yield box, *draw_face(view, face, box)
    if looks.mast is not None and above:
        yield from _post(view, stand(looks.mast.at(robot.x_m, robot.y_m), top_m))


def _paint(picture: Pixels, box: Box, colours: Grey, shares: Grey) -> None:
    """Lays colours over what is there, by the share of each pixel that they cover."""
    under = picture[box.slices]
    mixed = under + (colours - under) * shares[..., None]
    under[:] = np.clip(mixed + 0.5, 0.0, 255.0)


def _hides(wall: Plane, view: View, thing: Post | Standing) -> bool:
    """Whether the way from the lens to a thing's middle passes through a wall."""
    a, b, lens = np.array(wall.a), np.array(wall.b), view.lens[:2]
    there, margin_m = np.array([thing.x_m, thing.y_m]), 0.12
    along, way = b - a, there - lens
    length = float(np.hypot(*along))
    if length == 0.0:
        return False
    normal = np.array([-along[1], along[0]]) / length
    before, after = float(normal @ (lens - a)), float(normal @ (there - a))
    if before * after >= 0.0 or abs(after) < margin_m:
        return False
    crossing = lens + way * (before / (before - after))
    return bool(0.0 <= float(along @ (crossing - a)) <= length**2)


class _Pinhole(NamedTuple):
    """A camera without distortion that sees all that one with it does, and the way back."""

    camera: Camera
    maps: tuple[Floats, Floats]


@lru_cache(maxsize=32)
def _pinhole(settings: CameraSettings) -> _Pinhole | None:
    """None for a camera without distortion."""
    if not any(settings.distortion):
        return None
    camera, (width, height) = Camera(settings), (settings.width_px, settings.height_px)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    plane = camera.undistorted(np.column_stack([u.ravel(), v.ravel()]))
    x = settings.fx_px * plane[:, 0]
    y = settings.fy_px * plane[:, 1]
    left, top = (max(math.floor(k.min()) - 2, -WIDEST * s) for k, s in ((x, width), (y, height)))
    right, bottom = (min(math.ceil(k.max()) + 2, WIDEST * s) for k, s in ((x, width), (y, height)))
    straight = replace(
        settings,
        width_px=int(right - left),
        height_px=int(bottom - top),
        cx_px=-float(left),
        cy_px=-float(top),
        distortion=(0.0,) * 5,
    )
    maps = tuple(
        (k - start).reshape(height, width).astype(np.float32) for k, start in ((x, left), (y, top))
    )
    return _Pinhole(Camera(straight), cv2.convertMaps(maps[0], maps[1], cv2.CV_16SC2))
