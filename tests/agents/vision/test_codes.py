"""What markers say: every one of every family is read, in any turn, and none in a mirror."""

from typing import get_args

import cv2
import numpy as np
import pytest

from cpcbl_agents.vision.marker_codes import MarkerCode, MarkerReader
from cpcbl_team.config import LIKE_MIRRORED, MARKERS, MarkerFamily

FAMILIES: list[MarkerFamily] = list(get_args(MarkerFamily))
SQUARE = np.array([[20, 20], [80, 20], [80, 80], [20, 80]]) - 0.5


def detect_and_annotate(
    codes: MarkerReader, number: int
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """A marker of 60 pixels in a white picture of 100."""
    small = cv2.aruco.generateImageMarker(codes.dictionary, number, codes.cells)
    marker = cv2.resize(small, (60, 60), interpolation=cv2.INTER_NEAREST)
    return cv2.copyMakeBorder(marker, *(20,) * 4, cv2.BORDER_CONSTANT, value=(255,)).astype(
        np.uint8
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_every_marker_is_read_from_any_corner_on_and_the_table_says_how_many(
    family: MarkerFamily,
) -> None:
    codes = MarkerReader(family)
    assert len(codes.dictionary.bytesList) == MARKERS[family]
    turned = np.array([np.roll(SQUARE, turn, axis=0) for turn in range(4)])
    for number in range(0, MARKERS[family], 7):
        read = codes.read(detect_and_annotate(codes, number), turned)
        assert read == {turn: MarkerCode(number, turn) for turn in range(4)}


@pytest.mark.parametrize("family", FAMILIES)
def test_of_mirrored_markers_only_those_of_the_table_are_read(family: MarkerFamily) -> None:
    codes, alike = MarkerReader(family), set()
    for number in range(MARKERS[family]):
        mirrored = np.ascontiguousarray(detect_and_annotate(codes, number)[:, ::-1])
        for code in codes.read(mirrored, SQUARE[None]).values():
            assert code.id == number
            alike.add(number)
    assert alike == LIKE_MIRRORED.get(family, frozenset())


def test_a_square_without_a_marker_and_one_without_its_border_say_nothing() -> None:
    codes = MarkerReader("aruco_4x4_50")
    grey = np.full((100, 100), 128, np.uint8)
    black = cv2.rectangle(np.full((100, 100), 255, np.uint8), (20, 20), (79, 79), (0,), -1)
    bitten = detect_and_annotate(codes, 3)
    bitten[20:30, 30:70] = 255
    for pixels in (grey, black.astype(np.uint8), bitten):
        assert codes.read(pixels, SQUARE[None]) == {}


@pytest.mark.parametrize("family", ["aruco_4x4_50", "aruco_5x5_50", "apriltag_25h9"])
def test_a_highlight_on_the_border_is_no_matter_but_then_no_bit_is_corrected(
    family: MarkerFamily,
) -> None:
    codes = MarkerReader(family)
    spotted = detect_and_annotate(codes, 3)
    cell = 60 // codes.cells
    spotted[20 : 20 + cell, 40 : 40 + cell] = 255
    spotted[82:92, 45:52] = 20
    assert codes.read(spotted, SQUARE[None]) == {0: MarkerCode(3, 0)}
    middle = 20 + int((codes.cells // 2 + 0.5) * 60 / codes.cells)
    part = spotted[middle - cell // 2 : middle + cell // 2, middle - cell // 2 : middle + cell // 2]
    part[:] = 255 - part
    assert codes.read(spotted, SQUARE[None]) == {}


@pytest.mark.parametrize(("family", "most"), [("aruco_4x4_50", 0), ("apriltag_36h11", 2)])
def test_as_many_wrong_bits_are_set_right_as_chance_allows(family: MarkerFamily, most: int) -> None:
    codes = MarkerReader(family)
    small = cv2.aruco.generateImageMarker(codes.dictionary, 3, codes.cells)
    for wrong in range(4):
        if wrong:
            small[wrong, 2] = 255 - small[wrong, 2]
        marker = cv2.resize(small, (60, 60), interpolation=cv2.INTER_NEAREST)
        paper = cv2.copyMakeBorder(marker, *(20,) * 4, cv2.BORDER_CONSTANT, value=(255,))
        read = codes.read(paper.astype(np.uint8), SQUARE[None])
        assert read == ({0: MarkerCode(3, 0)} if wrong <= most else {})


def test_light_that_falls_off_over_a_marker_turns_no_bit() -> None:
    codes = MarkerReader("apriltag_36h11")
    shade = np.linspace(0.1, 1.0, 100) * np.linspace(0.6, 1.0, 100)[:, None]
    shaded = (detect_and_annotate(codes, 5) * shade).astype(np.uint8)
    assert codes.read(shaded, SQUARE[None]) == {0: MarkerCode(5, 0)}
