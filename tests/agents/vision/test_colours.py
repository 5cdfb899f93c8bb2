"""Blobs of one colour."""

import cv2
import numpy as np
import pytest

from cpcbl_agents.vision.camera import Camera, Panorama, Pixels
from cpcbl_agents.vision.colours import MAX_BLOBS, ColourSegmenter
from cpcbl_team.config import COLOURS, CameraSettings, Colour

SETTINGS = CameraSettings(
    width_px=200, height_px=150, fx_px=150.0, fy_px=150.0, cx_px=99.5, cy_px=74.5
)
PANORAMA = Panorama(Camera(SETTINGS))


def bgr(hue: int, saturation: int = 200, value: int = 200) -> Pixels:
    hsv = np.array([[[hue, saturation, value]]], np.uint8)
    pixel: Pixels = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0].astype(np.uint8)
    return pixel


def frame(*boxes: tuple[int, int, int, int, int]) -> Pixels:
    """Grey, with boxes: left, top, right, bottom, hue."""
    pixels = np.full((150, 200, 3), 120, np.uint8)
    for left, top, right, bottom, hue in boxes:
        pixels[top:bottom, left:right] = bgr(hue)
    return pixels


def test_hue_through_red() -> None:
    pixels = frame((20, 20, 30, 40, 177), (60, 20, 70, 40, 3), (100, 20, 110, 40, 60))
    blobs = ColourSegmenter(dict(COLOURS), ["red"]).blobs(pixels, PANORAMA)
    assert [blob.colour for blob in blobs] == ["red", "red"]
    assert sorted(blob.outline[0, 0] for blob in blobs) == [20.0, 60.0]


@pytest.mark.parametrize("count", [1, 8, 9, 17])
def test_any_number_of_colours(count: int) -> None:
    colours = {f"c{i}": Colour(hue=(10 * i, 10 * i + 5)) for i in range(count)}
    boxes = [(10 * i + 2, 20, 10 * i + 8, 40, 10 * i + 2) for i in range(count)]
    blobs = ColourSegmenter(colours, colours).blobs(frame(*boxes), PANORAMA)
    assert sorted((blob.outline[0, 0], blob.colour) for blob in blobs) == [
        (10.0 * i + 2.0, f"c{i}") for i in range(count)
    ]


def test_only_colours_in_use_and_no_specks() -> None:
    pixels = frame((95, 65, 105, 85, 60), (60, 20, 70, 40, 110), (150, 20, 151, 21, 60))
    (blob,) = ColourSegmenter(dict(COLOURS), ["green"]).blobs(pixels, PANORAMA)
    assert blob.colour == "green"
    assert blob.width == pytest.approx(10.0, abs=1.0)
    assert blob.height == pytest.approx(20.0, abs=1.0)


def test_nothing_in_sight() -> None:
    assert ColourSegmenter(dict(COLOURS), COLOURS).blobs(frame(), PANORAMA) == []


def test_very_many_blobs_are_cut_to_the_largest() -> None:
    boxes = [(4 * i, 4 * j, 4 * i + 2, 4 * j + 2, 60) for i in range(30) for j in range(20)]
    blobs = ColourSegmenter(dict(COLOURS), ["green"]).blobs(
        frame(*boxes, (150, 100, 190, 140, 60)), PANORAMA
    )
    assert len(blobs) == MAX_BLOBS
    assert max(blob.width for blob in blobs) > 30.0


def test_clear_is_of_one_colour() -> None:
    colours = ColourSegmenter(dict(COLOURS), ["yellow", "orange"])
    yellow, half = frame((0, 0, 40, 40, 28)), frame((0, 0, 20, 40, 28), (20, 0, 40, 40, 15))
    assert colours.has_clear_colour(yellow[:40, :40], "yellow")
    assert not colours.has_clear_colour(yellow[:40, :40], "orange")
    assert not colours.has_clear_colour(half[:40, :40], "yellow")
    assert not colours.has_clear_colour(yellow[60:100, :40], "yellow")
