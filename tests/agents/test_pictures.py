"""Frames that cannot be used: each is refused, by its reason, before it costs anything."""

import struct
import zlib
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import examples
from support.cameras import SIZE, jpeg, number_of, picture, png

from cpcbl_agents.vision.pictures import (
    Header,
    decode_frame,
    decode_image,
    encode_jpeg,
    pixel_fault,
    read_header,
)

GOOD = picture(7)
GREY = cv2.cvtColor(GOOD, cv2.COLOR_BGR2GRAY).astype(np.uint8)
CLEAR = cv2.cvtColor(GOOD, cv2.COLOR_BGR2BGRA).astype(np.uint8)
LEVELS_16 = GOOD.astype(np.uint16) * 257
JPEG, PNG = jpeg(GOOD), png(GOOD)


def jpeg_header(width: int, height: int, channels: int = 3, bits: int = 8) -> bytes:
    """The head of a JPEG, with its end, and nothing between."""
    sizes = struct.pack(">BHHB", bits, height, width, channels) + bytes(3 * channels)
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", 2 + len(sizes)) + sizes + b"\xff\xd9"


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_bomb(width: int, height: int) -> bytes:
    """A whole PNG of one colour: a few kilobytes for gigabytes of pixels."""
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    rows = zlib.compress(bytes(1_000_000), 9)
    return b"\x89PNG\r\n\x1a\n" + head + png_chunk(b"IDAT", rows) + png_chunk(b"IEND", b"")


def indexed() -> bytes:
    """A PNG with a palette, which OpenCV cannot write."""
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", *SIZE, 8, 3, 0, 0, 0))
    rows = zlib.compress(bytes((SIZE[0] + 1) * SIZE[1]))
    chunks = (b"PLTE", b"\xff\0\0"), (b"IDAT", rows), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(png_chunk(*chunk) for chunk in chunks)


BAD: dict[str, tuple[str, bytes]] = {
    "nothing": ("frame_empty", b""),
    "no width": ("frame_empty", jpeg_header(0, 48)),
    "no height": ("frame_empty", jpeg_header(64, 0)),
    "PNG without height": ("frame_empty", png_bomb(64, 0)),
    "garbage": ("frame_undecodable", bytes(range(256)) * 10),
    "zeros": ("frame_undecodable", bytes(1000)),
    "text": ("frame_undecodable", b"GIF89a, or so it says"),
    "another format": ("frame_undecodable", cv2.imencode(".bmp", GOOD)[1].tobytes()),
    "only a signature": ("frame_undecodable", JPEG[:3]),
    "only half a header": ("frame_undecodable", PNG[:20]),
    "a header and no picture": ("frame_undecodable", jpeg_header(*SIZE)),
    "a damaged PNG": ("frame_undecodable", PNG[:60] + bytes(10) + PNG[70:]),
    "half a JPEG": ("frame_truncated", JPEG[: len(JPEG) // 2]),
    "a JPEG without its last byte": ("frame_truncated", JPEG[:-1]),
    "a JPEG that ends in zeros": ("frame_truncated", JPEG[:-200] + bytes(200)),
    "half a PNG": ("frame_truncated", PNG[: len(PNG) // 2]),
    "grey JPEG": ("frame_wrong_channels", jpeg(GREY)),
    "grey PNG": ("frame_wrong_channels", png(GREY)),
    "transparent PNG": ("frame_wrong_channels", png(CLEAR)),
    "PNG with a palette": ("frame_wrong_channels", indexed()),
    "CMYK": ("frame_wrong_channels", jpeg_header(*SIZE, channels=4)),
    "16 bit": ("frame_wrong_depth", png(LEVELS_16)),
    "12 bit": ("frame_wrong_depth", jpeg_header(*SIZE, bits=12)),
    "wrong size": ("frame_wrong_size", jpeg(picture(7, (48, 64)))),
    "huge JPEG": ("frame_wrong_size", jpeg_header(65_535, 65_535)),
    "huge PNG": ("frame_wrong_size", png_bomb(30_000, 30_000)),
}


@pytest.mark.parametrize("data", [JPEG, PNG, JPEG + bytes(50)], ids=["JPEG", "PNG", "padded"])
def test_a_good_picture_is_decoded(data: bytes) -> None:
    pixels = decode_frame(data, SIZE)
    assert not isinstance(pixels, str)
    assert pixels.shape == GOOD.shape
    assert number_of(pixels) == 7
    assert pixel_fault(pixels, SIZE) == ""


@pytest.mark.parametrize("pixels", [GREY, CLEAR, LEVELS_16], ids=["grey", "clear", "16 bit"])
def test_a_file_that_a_person_names_may_be_of_any_kind(pixels: Any) -> None:
    made = decode_image(png(pixels))
    assert not isinstance(made, str)
    assert made.shape == GOOD.shape
    assert made.dtype == np.uint8
    assert decode_image(b"") == "frame_empty"
    assert decode_image(b"no picture") == "frame_undecodable"


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_used_is_refused_by_its_reason(what: str) -> None:
    reason, data = BAD[what]
    assert decode_frame(data, SIZE) == reason


@pytest.mark.parametrize("data", [JPEG, PNG], ids=["JPEG", "PNG"])
def test_a_picture_that_ends_anywhere_too_soon_is_refused(data: bytes) -> None:
    for length in range(len(data)):
        assert isinstance(decode_frame(data[:length], SIZE), str), length


@pytest.mark.parametrize("progressive", [0, 1])
def test_headers_of_whole_pictures(progressive: int) -> None:
    options = (cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
    data = cv2.imencode(".jpg", GOOD, options)[1].tobytes()
    comment = b"\xff\xfe" + struct.pack(">H", 5) + b"\xff\xc0\xff"  # looks like a header inside
    for image in (data, data[:2] + comment + data[2:], data[:2] + b"\xff\xff" + data[2:]):
        assert read_header(image) == Header(*SIZE, 3, 8)
    assert read_header(png(LEVELS_16)) == Header(*SIZE, 3, 16)


@examples(150)
@given(st.binary(max_size=200), st.sampled_from([b"", JPEG[:20], PNG[:20], b"\xff\xd8\xff"]))
def test_nothing_raises(noise: bytes, head: bytes) -> None:
    assert isinstance(decode_frame(head + noise, SIZE), str)


def plain(*levels: float) -> "np.typing.NDArray[np.uint8]":
    noise = np.random.default_rng(1).normal(0.0, 2.0, GOOD.shape)
    return np.clip(np.array(levels) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("reason", "pixels"),
    [
        ("frame_black", plain(2, 2, 2)),
        ("frame_white", plain(253, 253, 253)),
        ("frame_blank", plain(128, 128, 128)),
        ("frame_blank", plain(0, 0, 255)),
        ("frame_empty", np.empty((0, 64, 3), np.uint8)),
        ("frame_wrong_channels", GREY),
        ("frame_wrong_channels", CLEAR),
        ("frame_wrong_depth", LEVELS_16),
        ("frame_wrong_depth", np.full(GOOD.shape, np.nan)),
        ("frame_wrong_size", picture(7, (48, 64))),
        ("", GOOD),
    ],
)
def test_pixels_that_show_nothing_are_refused(reason: str, pixels: Any) -> None:
    assert pixel_fault(pixels, SIZE) == reason


def test_a_small_landmark_on_a_plain_wall_is_something_to_see() -> None:
    wall = np.full((480, 640, 3), 150, np.uint8)
    wall[201:213, 301:305] = (0, 0, 200)
    wall[213:225, 301:305] = (0, 200, 220)
    assert pixel_fault(wall, (640, 480)) == ""
    noisy = wall + np.random.default_rng(1).normal(0.0, 4.0, wall.shape)
    assert pixel_fault(noisy.clip(0, 255).astype(np.uint8), (640, 480)) == ""


def test_a_dark_picture_is_black_only_if_it_shows_nothing() -> None:
    noise = np.random.default_rng(1).normal(8.0, 3.0, (480, 640, 3))
    dark = noise.clip(0, 255).astype(np.uint8)
    dark[50, 70] = 255  # a pixel of the sensor that is broken
    assert pixel_fault(dark, (640, 480)) == "frame_black"
    noise[100:200, 300:400] += 20.0
    assert pixel_fault(noise.clip(0, 255).astype(np.uint8), (640, 480)) == ""


def test_a_picture_for_people_is_a_jpeg_of_moderate_size() -> None:
    small = decode_frame(encode_jpeg(GOOD), SIZE)
    assert not isinstance(small, str)
    assert number_of(small) == 7
    assert read_header(encode_jpeg(picture(7, (2560, 1000)))) == Header(1280, 500, 3, 8)
