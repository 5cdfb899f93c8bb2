"""The errors of a camera's exposure: uneven light, blur, and the sensor's noise."""

from functools import lru_cache

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Pixels
from cpcbl_launch.simulation.camera.view import Grey
from cpcbl_team.config import Light

MARGIN_PX = 256  # the noise of a frame is a window of a larger piece, here or there


def expose(picture: Pixels, light: Light, random: np.random.Generator) -> Pixels:
    """The picture (h, w, 3) in this light; only the noise depends on the generator."""
    height, width = picture.shape[:2]
    if light.brightness != 1.0 or light.gradient or light.tint != (1.0, 1.0, 1.0):
        gain = _gain(width, height, light.brightness, light.gradient, light.tint)
        picture = cv2.multiply(picture, gain, dtype=cv2.CV_8U).astype(np.uint8, copy=False)
    if light.blur_px:
        picture = _blur(picture, light.blur_px)
    if light.noise:
        left, top = (int(start) for start in random.integers(0, MARGIN_PX, 2))
        window = slice(top, top + height), slice(left, left + width)
        above, below = _grain(width, height, light.noise)
        picture = cv2.subtract(cv2.add(picture, above[window]), below[window]).astype(
            np.uint8, copy=False
        )
    return picture


def _blur(picture: Pixels, sigma_px: float) -> Pixels:
    """With a Gaussian that is cut off beyond three sigma."""
    side = 2 * max(1, round(3.0 * sigma_px)) + 1
    return cv2.GaussianBlur(picture, (side, side), sigma_px).astype(np.uint8, copy=False)


@lru_cache(maxsize=4)
def _gain(
    width: int, height: int, brightness: float, gradient: float, tint: tuple[float, float, float]
) -> Grey:
    """What each pixel's colours are multiplied by, (h, w, 3)."""
    across = 1.0 + gradient * (0.5 - (np.arange(width) + 0.5) / width)
    gain = brightness * np.maximum(across, 0.0)[None, :, None] * np.array(tint)
    return np.ascontiguousarray(np.broadcast_to(gain, (height, width, 3)), np.float32)


@lru_cache(maxsize=4)
def _grain(width: int, height: int, sigma: float) -> tuple[Pixels, Pixels]:
    """Noise around zero: what is added to pixels, and what is taken from them."""
    size = height + MARGIN_PX, width + MARGIN_PX, 3
    noise = np.random.default_rng(7).standard_normal(size, np.float32) * sigma
    noise = np.round(noise)
    return (
        np.clip(noise, 0.0, 255.0).astype(np.uint8),
        np.clip(-noise, 0.0, 255.0).astype(np.uint8),
    )
