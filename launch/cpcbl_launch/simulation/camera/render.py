"""Pictures of the simulated field from the true pose of a robot's camera.

Objects are drawn from far to near with a pinhole model, each pixel by its covered share. Then the
picture gets the lens's distortion, light, blur and noise. Equal generators give equal pictures.
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
from cpcbl_launch.simulation.camera.cylinders import cylinder_box, draw_cylinder
from cpcbl_launch.simulation.camera.exposure import expose
from cpcbl_launch.simulation.camera.robots import body_top_m, draw_face, robot_faces
from cpcbl_launch.simulation.camera.scene import (
    RobotAppearance,
    Scene,
    SceneCylinder,
    SceneRobot,
    WallSegment,
    with_stand,
)
from cpcbl_launch.simulation.camera.view import Box, Grey, View
from cpcbl_team.config import CameraSettings, Light
from cpcbl_team.geometry import Pose2

__all__ = ["Light", "Scene", "SceneRobot", "render"]

WIDEST = 4.0  # a picture before distortion, over one after it


def render(
    scene: Scene,
    camera: Camera,
    pose: Pose2,
    robots: Sequence[SceneRobot],
    light: Light,
    random: np.random.Generator,
) -> Pixels:
    """The picture of a camera on a robot at `pose` (`field_from_robot`): (h, w, 3), BGR.

    `robots` are the other robots; a robot does not see itself.
    """
    pinhole = _pinhole(camera.settings)
    picture = _draw_scene(scene, View(camera if pinhole is None else pinhole.camera, pose), robots)
    if pinhole is not None:
        picture = cv2.remap(picture, *pinhole.maps, cv2.INTER_LINEAR).astype(np.uint8, copy=False)
    return expose(picture, light, random)


def _draw_scene(scene: Scene, view: View, robots: Sequence[SceneRobot]) -> Pixels:
    picture = backdrop(view, scene)
    cylinders = [*scene.landmarks.values(), *scene.clutter]
    objects: list[SceneCylinder | SceneRobot] = [*cylinders, *robots]
    objects.sort(
        key=lambda scene_object: (
            -math.hypot(scene_object.x_m - view.lens[0], scene_object.y_m - view.lens[1])
        )
    )
    for scene_object in objects:
        walls = [
            wall_corners(w, scene.wall_m)
            for w in scene.walls
            if _is_hidden_by(w, view, scene_object)
        ]
        pieces = (
            _cylinder_pieces(view, with_stand(scene_object, 0.0))
            if isinstance(scene_object, SceneCylinder)
            else _robot_pieces(view, scene_object, scene)
        )
        for box, colours, shares in pieces:
            for wall in walls:
                shares = shares * (1.0 - view.polygon_shares(wall, box))
            _blend(picture, box, colours, shares)
    return picture


Piece = tuple[Box, Grey, Grey]  # where, colours, covered shares


def _cylinder_pieces(view: View, cylinder: SceneCylinder) -> Iterator[Piece]:
    box = cylinder_box(view, cylinder)
    if box is not None:
        yield box, *draw_cylinder(view, cylinder, box)


def _robot_pieces(view: View, robot: SceneRobot, scene: Scene) -> Iterator[Piece]:
    """Its body and its mast, the nearer to the lens last."""
    appearance, top_m = (
        scene.appearances.get(robot.name, RobotAppearance()),
        body_top_m(scene.vision),
    )
    above = view.lens[2] > top_m
    if appearance.mast is not None and not above:
        yield from _cylinder_pieces(
            view, with_stand(appearance.mast.at(robot.x_m, robot.y_m), top_m)
        )
    for face in robot_faces(robot, appearance, scene.vision):
        box = view.box(face.corners) if face.is_facing(view.lens) else None
        if box is not None:
            yield box, *draw_face(view, face, box)
    if appearance.mast is not None and above:
        yield from _cylinder_pieces(
            view, with_stand(appearance.mast.at(robot.x_m, robot.y_m), top_m)
        )


def _blend(picture: Pixels, box: Box, colours: Grey, shares: Grey) -> None:
    """Blends colours into the picture by the covered share of each pixel."""
    under = picture[box.slices]
    mixed = under + (colours - under) * shares[..., None]
    under[:] = np.clip(mixed + 0.5, 0.0, 255.0)


def _is_hidden_by(wall: WallSegment, view: View, scene_object: SceneCylinder | SceneRobot) -> bool:
    """Whether the line from the lens to the middle of an object crosses a wall."""
    a, b, lens = np.array(wall.a), np.array(wall.b), view.lens[:2]
    there, margin_m = np.array([scene_object.x_m, scene_object.y_m]), 0.12
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
    """A camera without distortion that covers the whole picture, and the maps to that picture."""

    camera: Camera
    maps: tuple[Floats, Floats]


@lru_cache(maxsize=32)
def _pinhole(settings: CameraSettings) -> _Pinhole | None:
    """None for a camera without distortion."""
    if not any(settings.distortion):
        return None
    camera, (width, height) = Camera(settings), (settings.width_px, settings.height_px)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    plane = camera.undistort(np.column_stack([u.ravel(), v.ravel()]))
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
