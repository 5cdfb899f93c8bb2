"""Encoding and decoding of pictures, and the reasons why a picture cannot be used.

The header of a frame is checked before it is decoded: a few bytes may claim gigabytes, and
OpenCV would convert grey, transparent or 16-bit pictures into others that look right. A truncated
picture is refused because its end is missing: some decoders fill it up.
"""

import struct
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.quads import noise_sigma

BLOCK_PX = 4  # high and wide: levels are compared between the means of such blocks
CLEAR_LEVELS = 40.0  # grey levels between blocks: a frame that surely shows something
LEAST_LEVELS, LEAST_SIGMAS = 6.0, 2.5  # less, also in sigmas of the noise, is a frame of one colour
DARK, BRIGHT = 32.0, 223.0  # level of a frame of one colour that is called black, white
QUALITY = 85  # of JPEGs, percent
WIDEST_SHOWN_PX = 1280

_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # grey, RGB, palette, grey and RGB with alpha
_JPEG, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers of segments that say it
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a segment


class Header(NamedTuple):
    """The header of a picture."""

    width_px: int
    height_px: int
    channels: int
    bits: int
    """Of each channel."""


def decode_image(image: bytes) -> Pixels | str:
    """The pixels, BGR, of any kind of picture that OpenCV reads; or why there are none. It is for
    files that a person names; `decode_frame` is for frames of cameras."""
    if not image:
        return "frame_empty"
    try:
        pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:  # as of a size beyond 2^30 pixels
        pixels = None
    return "frame_undecodable" if pixels is None else pixels.astype(np.uint8, copy=False)


def decode_frame(image: bytes, size_px: tuple[int, int]) -> Pixels | str:
    """The pixels of a frame, BGR: a JPEG or PNG in colour, of this size (width, height); or why
    there are none. No other is decoded, however large it claims to be."""
    if not image:
        return "frame_empty"
    header = read_header(image)
    if header is None:
        return "frame_undecodable"
    # Some cameras append zeros to a picture.
    end = _PNG_END if image.startswith(_PNG) else _JPEG_END
    is_complete = image.endswith(end) or image.rstrip(b"\0").endswith(end)
    reason = _header_fault(header, size_px) or ("" if is_complete else "frame_truncated")
    return reason or decode_image(image)


def read_header(image: bytes) -> Header | None:
    """The header of a JPEG or PNG; None for other data, or if it is truncated."""
    if image.startswith(_PNG):
        if len(image) < 26:
            return None
        width, height, bits, kind = struct.unpack_from(">IIBB", image, 16)
        return Header(width, height, _PNG_CHANNELS.get(kind, 0), bits)
    if not image.startswith(_JPEG):
        return None
    at = 2
    while at + 10 <= len(image) and image[at] == 0xFF:
        marker = image[at + 1]
        if marker in _JPEG_SIZES:
            bits, height, width, channels = struct.unpack_from(">BHHB", image, at + 4)
            return Header(width, height, channels, bits)
        if marker == 0xFF:  # fill bytes may stand before a marker
            at += 1
        elif marker in _JPEG_BARE:
            at += 2
        else:
            at += 2 + int.from_bytes(image[at + 2 : at + 4], "big")
    return None


def _header_fault(header: Header, size_px: tuple[int, int]) -> str:
    if not header.width_px or not header.height_px:
        return "frame_empty"
    if header.channels != 3:
        return "frame_wrong_channels"
    if header.bits != 8:
        return "frame_wrong_depth"
    return "" if (header.width_px, header.height_px) == size_px else "frame_wrong_size"


def pixel_fault(pixels: Pixels, size_px: tuple[int, int]) -> str:
    """Why a picture cannot be used by a camera of this size (width, height); empty if it can."""
    height, width, channels = (*pixels.shape, 1)[:3]
    if reason := _header_fault(Header(width, height, channels, 8 * pixels.itemsize), size_px):
        return reason
    if _contrast(pixels) >= CLEAR_LEVELS:
        return ""
    # A single bright pixel is a defect of the sensor
    noise = noise_sigma(cv2.extractChannel(pixels, 1).astype(np.uint8, copy=False))
    if _contrast(cv2.medianBlur(pixels, 3)) >= max(LEAST_LEVELS, LEAST_SIGMAS * noise):
        return ""
    level = float(pixels.mean())
    if level < DARK:
        return "frame_black"
    return "frame_white" if level > BRIGHT else "frame_blank"


def _contrast(pixels: cv2.typing.MatLike) -> float:
    """The difference between the darkest and the brightest block, in that channel in which it is
    the greatest."""
    height, width = (max(1, size // BLOCK_PX) for size in pixels.shape[:2])
    blocks = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    return float((blocks.max(axis=0).astype(int) - blocks.min(axis=0)).max())


def encode_jpeg(pixels: Pixels) -> bytes:
    """A JPEG for people, of at most 1280 pixels' width."""
    shrunk = WIDEST_SHOWN_PX / pixels.shape[1]
    if shrunk < 1.0:
        size = WIDEST_SHOWN_PX, max(1, round(pixels.shape[0] * shrunk))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    done, data = cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    assert done
    return bytes(data)
