"""The background of a rendered picture: a speckled floor, the walls of the hall around the field,
and the walls of the field.

Floor and hall are rendered at half resolution, because they have no sharp edges. The floor is a
texture that repeats, warped by the homography between the image plane and the floor. The shade of
the hall depends on the elevation of a pixel's ray. Each wall of the field is a rectangle, clipped
at the near plane, projected, and filled as a polygon with anti-aliased edges.
"""

from functools import lru_cache

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_launch.simulation.camera.scene import Scene
from cpcbl_launch.simulation.camera.view import NEAREST_M, View
from cpcbl_team.config import Wall

SPECKLE = 7.0  # standard deviation of the floor's grey levels
TILE_PX, TILE_M = 256, 3.0  # side of the texture of the floor
COARSER = 2  # pixels of the picture per pixel of floor and hall, in each direction
FLOOR = np.array([112.0, 108.0, 104.0])  # colours are BGR
HALL = np.array([176.0, 172.0, 168.0])
WALL = np.array([138.0, 140.0, 142.0])
WALL_HEIGHT_M = 0.3
_SHIFT = 4  # fractional bits of the coordinates of polygons


def backdrop(view: View, scene: Scene) -> Pixels:
    """A new picture (height, width, 3), BGR, of a scene without its cylinders and robots."""
    picture = _floor_and_hall(view)
    for wall in sorted(scene.walls, key=lambda wall: -_distance_m(view, wall)):
        _draw_wall(view, wall, picture)
    return picture


def wall_corners(wall: Wall) -> Floats:
    """The corners (4, 3) of a wall in the field frame (m)."""
    (ax, ay), (bx, by), top = wall.from_m, wall.to_m, WALL_HEIGHT_M
    return np.array([[ax, ay, 0.0], [bx, by, 0.0], [bx, by, top], [ax, ay, top]])


def _floor_and_hall(view: View) -> Pixels:
    width, height = (-(-side // COARSER) for side in view.size_px)
    coarse = np.array([[COARSER, 0, (COARSER - 1) / 2], [0, COARSER, (COARSER - 1) / 2], [0, 0, 1]])
    x, y, z = (view.rays @ coarse).astype(np.float32)  # of coarse pixels (u, v, 1)
    u, v = np.arange(width, dtype=np.float32)[None, :], np.arange(height, dtype=np.float32)[:, None]
    up = (z[0] * u + z[2]) + z[1] * v
    # A ray intersects the floor at lens - ray * (height of the lens / up).
    lens, scale = view.lens, TILE_PX / TILE_M
    met = np.vstack([lens[0] * z - lens[2] * x, lens[1] * z - lens[2] * y, z / scale]) * scale
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    speckles = cv2.warpPerspective(
        _floor_texture(), met, (width, height), flags=flags, borderMode=cv2.BORDER_WRAP
    )
    picture = cv2.LUT(cv2.merge([speckles] * 3), _FLOOR_TABLE)
    steps = np.clip(up * np.float32(60.0), 0.0, 60.0).astype(np.uint8)
    hall = cv2.LUT(cv2.merge([steps] * 3), _HALL_TABLE)
    cv2.copyTo(hall, (up > 0.0).astype(np.uint8), picture)
    full = cv2.resize(picture, (width * COARSER, height * COARSER))
    return np.ascontiguousarray(full[: view.size_px[1], : view.size_px[0]], np.uint8)


def _draw_wall(view: View, wall: Wall, picture: Pixels) -> None:
    """Draws a wall into the picture; its shade depends on its direction on the field."""
    corners = _clip_polygon((wall_corners(wall) - view.lens) @ view.field_from_camera)
    if len(corners) < 3:
        return
    pixels = corners @ view.matrix.T
    pixels = np.clip(pixels[:, :2] / pixels[:, 2:], -1e4, 1e4)
    direction = np.subtract(wall.to_m, wall.from_m)
    facing = abs(direction[0]) / max(float(np.hypot(*direction)), 1e-9)
    shade = (WALL * (0.85 + 0.15 * facing)).tolist()
    fixed = np.round(pixels * 2**_SHIFT).astype(np.int32)
    cv2.fillConvexPoly(picture, fixed, shade, cv2.LINE_AA, _SHIFT)


def _clip_polygon(corners: Floats) -> Floats:
    """The part of a polygon (n, 3) of the camera frame that is in front of the near plane."""
    kept = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if a[2] > NEAREST_M:
            kept.append(a)
        if (a[2] > NEAREST_M) != (b[2] > NEAREST_M):
            kept.append(a + (b - a) * ((NEAREST_M - a[2]) / (b[2] - a[2])))
    return np.array(kept).reshape(-1, 3)


def _distance_m(view: View, wall: Wall) -> float:
    """The distance along the floor from the lens to the nearest point of a wall."""
    a, b, lens = np.array(wall.from_m), np.array(wall.to_m), view.lens[:2]
    along = float((lens - a) @ (b - a)) / max(float((b - a) @ (b - a)), 1e-9)
    return float(np.hypot(*(a + min(max(along, 0.0), 1.0) * (b - a) - lens)))


@lru_cache(maxsize=1)
def _floor_texture() -> Pixels:
    """Noise (TILE_PX, TILE_PX) around a grey level of 128; it repeats without seams."""
    noise = np.random.default_rng(5).normal(0.0, 1.0, (TILE_PX, TILE_PX)).astype(np.float32)
    coarse = cv2.GaussianBlur(np.tile(noise, (2, 2)), (0, 0), 6.0)
    half = TILE_PX // 2
    coarse = coarse[half : half + TILE_PX, half : half + TILE_PX]
    coarse = np.roll(coarse, (half, half), (0, 1))
    return _grey_levels(128.0 + 32.0 * (0.6 * noise + 0.8 * coarse / coarse.std()))


def _grey_levels(values: Floats) -> Pixels:
    levels: Pixels = np.clip(values, 0.0, 255.0).astype(np.uint8)
    return levels


_LEVELS = np.arange(256.0)[:, None, None]
_FLOOR_TABLE = _grey_levels(FLOOR + (_LEVELS - 128.0) * (SPECKLE / 32.0))
"""The colour of the floor for each grey level of its texture, (256, 1, 3)."""
_HALL_TABLE = _grey_levels(HALL + 50.0 * (np.minimum(_LEVELS, 60.0) / 60.0))
"""The colour of the hall for each sixtieth of the upward component of a ray, (256, 1, 3)."""
