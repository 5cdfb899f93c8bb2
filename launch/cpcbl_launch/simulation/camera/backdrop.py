"""The background of a picture: a speckled floor, a hall, the field's walls."""

from functools import lru_cache

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_launch.simulation.camera.scene import Bgr, Scene, WallSegment
from cpcbl_launch.simulation.camera.view import NEAREST_M, View

SPECKLE = 7.0  # grey levels
TILE_PX, TILE_M = 256, 3.0  # the floor's pattern repeats
COARSER = 2  # nothing here has sharp edges but the walls
HALL = np.array([176.0, 172.0, 168.0])
WALL = np.array([138.0, 140.0, 142.0])
_SHIFT = 4


def backdrop(view: View, scene: Scene) -> Pixels:
    """A new picture (h, w, 3)."""
    picture = _floor_and_hall(view, scene.floor)
    far_first = sorted(scene.walls, key=lambda wall: -_distance_m(view, wall))
    for wall in far_first:
        _draw_wall(view, wall, scene.wall_m, picture)
    return picture


def wall_corners(wall: WallSegment, height_m: float) -> Floats:
    """(4, 3), in the field's frame."""
    (ax, ay), (bx, by) = wall
    return np.array([[ax, ay, 0.0], [bx, by, 0.0], [bx, by, height_m], [ax, ay, height_m]])


def _floor_and_hall(view: View, floor: Bgr) -> Pixels:
    width, height = (-(-side // COARSER) for side in view.size_px)
    coarse = np.array([[COARSER, 0, (COARSER - 1) / 2], [0, COARSER, (COARSER - 1) / 2], [0, 0, 1]])
    x, y, z = (view.rays @ coarse).astype(np.float32)  # of coarse pixels (u, v, 1)
    u, v = np.arange(width, dtype=np.float32)[None, :], np.arange(height, dtype=np.float32)[:, None]
    up = (z[0] * u + z[2]) + z[1] * v
    # where a ray meets the floor: lens - ray * (height of the lens / up)
    lens, scale = view.lens, TILE_PX / TILE_M
    met = np.vstack([lens[0] * z - lens[2] * x, lens[1] * z - lens[2] * y, z / scale]) * scale
    speckles = cv2.warpPerspective(
        _tile(),
        met,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_WRAP,
    )
    picture = cv2.LUT(cv2.merge([speckles] * 3), _shades(floor))
    steps = np.clip(up * np.float32(60.0), 0.0, 60.0).astype(np.uint8)
    hall = cv2.LUT(cv2.merge([steps] * 3), _hall())
    cv2.copyTo(hall, (up > 0.0).astype(np.uint8), picture)
    full = cv2.resize(picture, (width * COARSER, height * COARSER))
    return np.ascontiguousarray(full[: view.size_px[1], : view.size_px[0]], np.uint8)


def _draw_wall(view: View, wall: WallSegment, height_m: float, picture: Pixels) -> None:
    corners = (wall_corners(wall, height_m) - view.lens) @ view.field_from_camera
    seen = _ahead(corners)
    if len(seen) < 3:
        return
    pixels = seen @ view.matrix.T
    pixels = np.clip(pixels[:, :2] / pixels[:, 2:], -1e4, 1e4)
    direction = np.subtract(wall.b, wall.a)
    facing = abs(direction[0]) / max(float(np.hypot(*direction)), 1e-9)
    shade = (WALL * (0.85 + 0.15 * facing)).tolist()
    fixed = np.round(pixels * 2**_SHIFT).astype(np.int32)
    cv2.fillConvexPoly(picture, fixed, shade, cv2.LINE_AA, _SHIFT)


def _ahead(corners: Floats) -> Floats:
    """The part of a polygon (n, 3) in front of the lens, camera frame."""
    kept = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if a[2] > NEAREST_M:
            kept.append(a)
        if (a[2] > NEAREST_M) != (b[2] > NEAREST_M):
            kept.append(a + (b - a) * ((NEAREST_M - a[2]) / (b[2] - a[2])))
    return np.array(kept).reshape(-1, 3)


def _distance_m(view: View, wall: WallSegment) -> float:
    """From the lens to the wall's nearest point."""
    a, b, lens = np.array(wall.a), np.array(wall.b), view.lens[:2]
    along = float((lens - a) @ (b - a)) / max(float((b - a) @ (b - a)), 1e-9)
    return float(np.hypot(*(a + min(max(along, 0.0), 1.0) * (b - a) - lens)))


@lru_cache(maxsize=1)
def _tile() -> Pixels:
    """Speckles of the floor around a grey of 128; the tile repeats without seams."""
    noise = np.random.default_rng(5).normal(0.0, 1.0, (TILE_PX, TILE_PX)).astype(np.float32)
    coarse = cv2.GaussianBlur(np.tile(noise, (2, 2)), (0, 0), 6.0)
    half = TILE_PX // 2
    coarse = coarse[half : half + TILE_PX, half : half + TILE_PX]
    coarse = np.roll(coarse, (half, half), (0, 1))
    mixed = 0.6 * noise + 0.8 * coarse / coarse.std()
    tile: Pixels = np.clip(128.0 + 32.0 * mixed, 0.0, 255.0).astype(np.uint8)
    return tile


@lru_cache(maxsize=8)
def _shades(floor: Bgr) -> Pixels:
    """The floor's colour for each grey of the pattern, (256, 1, 3)."""
    levels = (np.arange(256.0)[:, None, None] - 128.0) * (SPECKLE / 32.0)
    shades: Pixels = np.clip(np.array(floor) + levels, 0.0, 255.0).astype(np.uint8)
    return shades


@lru_cache(maxsize=1)
def _hall() -> Pixels:
    """The hall's colour by the elevation of the ray, (256, 1, 3)."""
    rise = np.minimum(np.arange(256.0), 60.0)[:, None, None] / 60.0
    shades: Pixels = np.clip(HALL + 50.0 * rise, 0.0, 255.0).astype(np.uint8)
    return shades
