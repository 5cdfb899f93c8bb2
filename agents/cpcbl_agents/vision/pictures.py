"""Pictures as bytes and as pixels, and what is wrong with those that cannot be used."""

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Pixels

LEAST_CONTRAST = 4.0  # standard deviation of grey levels: a frame of one colour shows nothing


def decoded(image: bytes) -> Pixels | str:
    """The pixels of a JPEG or PNG, BGR; or why there are none."""
    if not image:
        return "frame_empty"
    pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    return "frame_undecodable" if pixels is None else pixels.astype(np.uint8, copy=False)


def fault(pixels: Pixels, size_px: tuple[int, int]) -> str:
    """Why a picture cannot be used by a camera of this size (width, height); empty if it can."""
    if pixels.size == 0:
        return "frame_empty"
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        return "frame_wrong_channels"
    if (pixels.shape[1], pixels.shape[0]) != size_px:
        return "frame_wrong_size"
    if float(pixels[::8, ::8].std()) < LEAST_CONTRAST:
        return "frame_blank"
    return ""
