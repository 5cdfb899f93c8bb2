"""Pictures of a calibration board as a known camera with distortion takes them."""

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_launch.calibration.lens import PRINTED_PX_PER_M, Board, draw_board
from cpcbl_team.config import CameraSettings

FINER = 2  # samples a pixel, across and down


class Shot(NamedTuple):
    """A picture, and where the board was: `camera_from_board`, a rotation (3, 3) and m (3)."""

    pixels: Pixels
    turn: Floats
    move: Floats


def board_pictures(
    settings: CameraSettings, board: Board, count: int, random: np.random.Generator
) -> Iterator[Shot]:
    """The board near and far, in all parts of the picture, tilted by up to 40 degrees."""
    rays = undistorted_grid(settings)
    sheet = cv2.GaussianBlur(draw_board(board), (0, 0), 2.0).astype(np.uint8)
    width, height = (n * board.square_m for n in board.squares)
    for _ in range(count):
        size = random.uniform(0.45, 0.8)  # of the picture's width
        away = width * settings.fx_px / (size * settings.width_px)
        spot = random.uniform(0.25, 0.75, 2) * (settings.width_px, settings.height_px)
        middle = Camera(settings).undistort(spot[None])[0]
        tilt = np.radians(random.uniform(-40, 40, 2))
        turn = cv2.Rodrigues(np.array([*tilt, random.uniform(-0.5, 0.5)]))[0].astype(float)
        centre = np.array([*middle, 1.0]) * away - turn @ np.array([width / 2, height / 2, 0.0])
        yield Shot(_picture(rays, sheet, turn, centre, board, random), turn, centre)


@cache
def undistorted_grid(settings: CameraSettings) -> Floats:
    """Where the samples of all pixels look, on the plane z = 1: (height x FINER, width x FINER, 2).

    The fixed point of the distortion, iterated until it stands.
    """
    steps = (np.arange(FINER) + 0.5) / FINER - 0.5
    u = (np.arange(settings.width_px)[:, None] + steps).ravel()
    v = (np.arange(settings.height_px)[:, None] + steps).ravel()
    x0 = np.broadcast_to((u - settings.cx_px) / settings.fx_px, (len(v), len(u)))
    y0 = np.broadcast_to(((v - settings.cy_px) / settings.fy_px)[:, None], (len(v), len(u)))
    k1, k2, p1, p2, k3 = settings.distortion
    x, y = x0, y0
    for _ in range(40):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx, dy = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (x0 - dx) / radial, (y0 - dy) / radial
    return np.stack([x, y], axis=-1)


def _picture(
    rays: Floats,
    sheet: Pixels,
    turn: Floats,
    move: Floats,
    board: Board,
    random: np.random.Generator,
) -> Pixels:
    """Each sample's ray meets the board's plane; a floor around, light from one side, noise."""
    plane = np.column_stack([turn[:, 0], turn[:, 1], move])  # camera from (x, y, 1) on the board
    met = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1) @ np.linalg.inv(plane).T
    place = met[..., :2] / met[..., 2:]
    half = round(board.square_m * PRINTED_PX_PER_M) // 2  # the sheet's margin
    spot = (place * (2 * half / board.square_m) + half - 0.5).astype(np.float32)
    seen = cv2.remap(
        sheet, spot[..., 0], spot[..., 1], cv2.INTER_LINEAR, borderValue=(110.0, 110.0, 110.0)
    )
    height, width = rays.shape[0] // FINER, rays.shape[1] // FINER
    grey = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA).astype(float)
    light = np.linspace(0.7, 1.0, width)[None, :]
    noisy = 20.0 + 0.8 * grey * light + random.normal(0.0, 2.0, grey.shape)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
