"""Pictures of the simulated field from the true pose of a robot's camera.

Objects are drawn from far to near with a pinhole model, each pixel by its covered share. Then the
picture gets the lens's distortion, and the light, blur and noise of an exposure. Equal generators
give equal pictures.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from msgspec.structs import replace

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_launch.simulation.camera.backdrop import backdrop, wall_corners
from cpcbl_launch.simulation.camera.objects import cylinder_pieces, robot_pieces
from cpcbl_launch.simulation.camera.scene import Scene, SceneCylinder, SceneRobot, with_stand
from cpcbl_launch.simulation.camera.view import Grey, View
from cpcbl_team.config import CameraSettings, Light, Wall
from cpcbl_team.geometry import Pose2

__all__ = ["Light", "Scene", "SceneRobot", "render"]

WIDEST = 4.0  # a picture before distortion, over one after it
WALL_MARGIN_M = 0.12  # an object so near to a wall is not behind it
NOISE_MARGIN_PX = 256  # the noise of a frame is a window of a larger piece, here or there


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
    pinhole, maps = _pinhole(camera.settings) or (camera, None)
    picture = _draw_scene(scene, View(pinhole, pose), robots)
    if maps is not None:
        picture = cv2.remap(picture, *maps, cv2.INTER_LINEAR).astype(np.uint8, copy=False)
    return _expose(picture, light, random)


def _draw_scene(scene: Scene, view: View, robots: Sequence[SceneRobot]) -> Pixels:
    picture = backdrop(view, scene)
    objects: list[SceneCylinder | SceneRobot] = [*scene.landmarks.values(), *scene.clutter, *robots]
    objects.sort(key=lambda it: -math.hypot(it.x_m - view.lens[0], it.y_m - view.lens[1]))
    for scene_object in objects:
        place = np.array([scene_object.x_m, scene_object.y_m])
        walls = [wall_corners(w) for w in scene.walls if _is_behind(place, w, view.lens[:2])]
        if isinstance(scene_object, SceneCylinder):
            pieces = cylinder_pieces(view, with_stand(scene_object, 0.0))
        else:
            pieces = robot_pieces(view, scene_object, scene)
        for box, colours, shares in pieces:
            for wall in walls:
                shares = shares * (1.0 - view.polygon_shares(wall, box))
            under = picture[box.slices]
            mixed = under + (colours - under) * shares[..., None]
            under[:] = np.clip(mixed + 0.5, 0.0, 255.0)
    return picture


def _is_behind(place: Floats, wall: Wall, lens: Floats) -> bool:
    """Whether the line from the lens (2,) to a place (2,) crosses a wall."""
    a, along = np.array(wall.from_m), np.subtract(wall.to_m, wall.from_m)
    length = float(np.hypot(*along))
    if length == 0.0:
        return False
    normal = np.array([-along[1], along[0]]) / length
    before, after = float(normal @ (lens - a)), float(normal @ (place - a))
    if before * after >= 0.0 or abs(after) < WALL_MARGIN_M:
        return False
    crossing = lens + (place - lens) * (before / (before - after))
    return bool(0.0 <= float(along @ (crossing - a)) <= length**2)


@lru_cache(maxsize=32)
def _pinhole(settings: CameraSettings) -> tuple[Camera, tuple[Floats, Floats]] | None:
    """A camera without distortion that covers the whole picture, and the maps to that picture;
    None for a camera without distortion."""
    if not any(settings.distortion):
        return None
    camera, (width, height) = Camera(settings), (settings.width_px, settings.height_px)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    plane = camera.undistort(np.column_stack([u.ravel(), v.ravel()]))
    x, y = settings.fx_px * plane[:, 0], settings.fy_px * plane[:, 1]
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
    map_x, map_y = (k.reshape(height, width).astype(np.float32) for k in (x - left, y - top))
    return Camera(straight), cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)


def _expose(picture: Pixels, light: Light, random: np.random.Generator) -> Pixels:
    """The picture (h, w, 3) in this light; only the noise depends on the generator."""
    height, width = picture.shape[:2]
    if light.brightness != 1.0 or light.gradient or light.tint != (1.0, 1.0, 1.0):
        gain = _gain(width, height, light)
        picture = cv2.multiply(picture, gain, dtype=cv2.CV_8U).astype(np.uint8, copy=False)
    if light.blur_px:  # a Gaussian that is cut off beyond three sigma
        side = 2 * max(1, round(3.0 * light.blur_px)) + 1
        blurred = cv2.GaussianBlur(picture, (side, side), light.blur_px)
        picture = blurred.astype(np.uint8, copy=False)
    if light.noise:
        left, top = (int(start) for start in random.integers(0, NOISE_MARGIN_PX, 2))
        window = slice(top, top + height), slice(left, left + width)
        above, below = _grain(width, height, light.noise)
        noisy = cv2.subtract(cv2.add(picture, above[window]), below[window])
        picture = noisy.astype(np.uint8, copy=False)
    return picture


@lru_cache(maxsize=4)
def _gain(width: int, height: int, light: Light) -> Grey:
    """What each pixel's colours are multiplied by, (h, w, 3)."""
    across = 1.0 + light.gradient * (0.5 - (np.arange(width) + 0.5) / width)
    gain = light.brightness * np.maximum(across, 0.0)[None, :, None] * np.array(light.tint)
    return np.ascontiguousarray(np.broadcast_to(gain, (height, width, 3)), np.float32)


@lru_cache(maxsize=4)
def _grain(width: int, height: int, sigma: float) -> tuple[Pixels, Pixels]:
    """Noise around zero: what is added to pixels, and what is taken from them."""
    size = height + NOISE_MARGIN_PX, width + NOISE_MARGIN_PX, 3
    noise = np.round(np.random.default_rng(7).standard_normal(size, np.float32) * sigma)
    above, below = (np.clip(part, 0.0, 255.0).astype(np.uint8) for part in (noise, -noise))
    return above, below
