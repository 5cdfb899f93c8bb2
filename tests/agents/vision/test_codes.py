"""What markers say: every one of every family is read, in any turn, and none in a mirror."""

from typing import get_args

import cv2
import numpy as np
import pytest
from support.sweeps import sampled

from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.marker_codes import MarkerCode, MarkerReader
from cpcbl_agents.vision.marker_families import marker_layout
from cpcbl_team.config import LIKE_MIRRORED, MARKERS, MarkerFamily

FAMILIES: list[MarkerFamily] = list(get_args(MarkerFamily))
STANDARD: MarkerFamily = "apriltag_standard41h12"
FIRST, QUAD, PICTURE = 30, 60, 120  # pixels: where the quad begins, its side, the picture's
SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * QUAD + FIRST - 0.5
TAG_3 = """
..#.....#
.#######.
.#.....#.
##.###.#.
.#...#.##
##.....#.
##.....##
.########
..#..###.
"""
"""The picture `tag41_12_00003.png` of github.com/AprilRobotics/apriltag-imgs."""


def marker_paper(family: MarkerFamily, number: int) -> Pixels:
    return paper_of(family, marker_layout(family).cells[number])


def paper_of(family: MarkerFamily, cells: Pixels) -> Pixels:
    """Cells in a white picture, their quad in its middle; as the detector looks at it, which is in
    the negative if the family's quads are bright."""
    layout = marker_layout(family)
    side = QUAD * layout.side // layout.quad
    marker = cv2.resize(255 * cells, (side, side), interpolation=cv2.INTER_NEAREST)
    paper = np.pad(marker, (PICTURE - side) // 2, constant_values=255)
    return (255 - paper if layout.is_bright else paper).astype(np.uint8)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_marker_is_read_from_any_corner_on_and_the_table_says_how_many(
    family: MarkerFamily,
) -> None:
    codes = MarkerReader(family)
    assert len(codes.layout.cells) == MARKERS[family]
    turned = np.array([np.roll(SQUARE, turn, axis=0) for turn in range(4)])
    for number in range(0, MARKERS[family], 7):
        read = codes.read(marker_paper(family, number), turned)
        assert read == {turn: MarkerCode(number, turn) for turn in range(4)}


def test_the_standard_tags_are_those_of_the_library_and_far_apart() -> None:
    drawn = np.array([[mark == "." for mark in row] for row in TAG_3.split()])
    cells = marker_layout(STANDARD).cells
    assert (cells[3] == drawn).all()
    turned = np.concatenate([np.rot90(cells, turn, (1, 2)) for turn in range(4)])
    signs = 2.0 * turned.reshape(len(turned), -1).astype(np.float32) - 1.0
    wrong = 0.5 * (signs.shape[1] - signs[: len(cells)] @ signs.T)
    wrong[np.arange(len(cells)), np.arange(len(cells))] = np.inf
    assert wrong.min() == 12.0


@pytest.mark.parametrize("family", sampled(FAMILIES, ["aruco_4x4_50", "apriltag_16h5"]))
def test_of_mirrored_markers_only_those_of_the_table_are_read(family: MarkerFamily) -> None:
    codes, alike = MarkerReader(family), set()
    for number in range(MARKERS[family]):
        mirrored = np.ascontiguousarray(marker_paper(family, number)[:, ::-1])
        for code in codes.read(mirrored, SQUARE[None]).values():
            assert code.id == number
            alike.add(number)
    assert alike == LIKE_MIRRORED.get(family, frozenset())


def test_a_square_without_a_marker_and_one_without_its_border_say_nothing() -> None:
    codes = MarkerReader("aruco_4x4_50")
    grey = np.full((PICTURE, PICTURE), 128, np.uint8)
    black = np.full_like(grey, 255)
    black[FIRST:-FIRST, FIRST:-FIRST] = 0
    bitten = marker_paper("aruco_4x4_50", 3)
    bitten[FIRST : FIRST + 10, FIRST + 10 : -FIRST - 10] = 255
    for pixels in (grey, black, bitten):
        assert codes.read(pixels, SQUARE[None]) == {}


@pytest.mark.parametrize("family", ["aruco_4x4_50", "aruco_5x5_50", "apriltag_25h9"])
def test_a_highlight_on_the_border_is_no_matter_but_then_no_bit_is_corrected(
    family: MarkerFamily,
) -> None:
    codes = MarkerReader(family)
    spotted = marker_paper(family, 3)
    cell = QUAD // codes.layout.quad
    spotted[FIRST : FIRST + cell, FIRST + 20 : FIRST + 20 + cell] = 255
    spotted[FIRST + QUAD + 2 : FIRST + QUAD + 12, FIRST + 25 : FIRST + 32] = 20
    assert codes.read(spotted, SQUARE[None]) == {0: MarkerCode(3, 0)}
    middle = FIRST + int((codes.layout.quad // 2 + 0.5) * QUAD / codes.layout.quad)
    part = spotted[middle - cell // 2 : middle + cell // 2, middle - cell // 2 : middle + cell // 2]
    part[:] = 255 - part
    assert codes.read(spotted, SQUARE[None]) == {}


@pytest.mark.parametrize(
    ("family", "is_read"), [("aruco_4x4_50", False), ("apriltag_25h9", True), (STANDARD, True)]
)
def test_uneven_and_covered_is_no_marker_where_random_bits_often_are(
    family: MarkerFamily, is_read: bool
) -> None:
    """Grass was once marker 16 of 4x4."""
    codes, cell = MarkerReader(family), QUAD // MarkerReader(family).layout.quad
    y, x = np.mgrid[:PICTURE, :PICTURE] // cell
    uneven = np.where((x + y) % 2, 35.0, -35.0)
    pixels = 48.0 + 160.0 / 255.0 * marker_paper(family, 3) + uneven
    pixels[FIRST : FIRST + cell, FIRST + cell : FIRST + 2 * cell] = 208.0
    read = codes.read(pixels.astype(np.uint8), SQUARE[None])
    assert read == ({0: MarkerCode(3, 0)} if is_read else {})


@pytest.mark.parametrize(
    ("family", "most"), [("aruco_4x4_50", 0), ("apriltag_36h11", 2), (STANDARD, 3)]
)
def test_as_many_wrong_bits_are_set_right_as_chance_allows(family: MarkerFamily, most: int) -> None:
    codes, cells = MarkerReader(family), marker_layout(family).cells[3].copy()
    bits = np.argwhere((marker_layout(family).cells != cells).any(axis=0))[::3]
    for wrong in range(5):
        if wrong:
            cells[tuple(bits[wrong])] ^= 1
        read = codes.read(paper_of(family, cells), SQUARE[None])
        assert read == ({0: MarkerCode(3, 0)} if wrong <= most else {})


@pytest.mark.parametrize("family", ["apriltag_36h11", STANDARD])
def test_light_that_falls_off_over_a_marker_turns_no_bit(family: MarkerFamily) -> None:
    shade = np.linspace(0.1, 1.0, PICTURE) * np.linspace(0.6, 1.0, PICTURE)[:, None]
    shaded = (marker_paper(family, 5) * shade).astype(np.uint8)
    assert MarkerReader(family).read(shaded, SQUARE[None]) == {0: MarkerCode(5, 0)}
