"""What the markers of a family look like, cell by cell.

Most are a square of bits within a black border, on white paper: OpenCV has them all. AprilTag's
tagStandard41h12 (Krogius, Haggenmiller and Olson, Flexible layouts for fiducial tags, IROS 2019)
is the other way round: a white border within a black one, with bits inside of both and around both.
What its detector finds is the white square, where the two borders meet.
"""

from functools import lru_cache
from importlib.resources import files
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Pixels
from cpcbl_team.config import MarkerFamily

Cells = NDArray[np.uint8]
NOT_IN_OPENCV: frozenset[MarkerFamily] = frozenset({"apriltag_standard41h12"})
STANDARD_QUAD, STANDARD_SIDE = 5, 9  # cells of a side: the white square, all
_STANDARD_ERRORS = 5  # bits that its distance of 12 could set right
_STANDARD_CODES = "standard41h12.txt"
_QUARTER = [*((x, -2) for x in range(-2, 6)), (1, 1), (2, 1)]
"""Places (x, y) of the first ten bits, from the white square's upper left cell on; the next ten are
these, turned by a quarter about the middle."""


class MarkerLayout(NamedTuple):
    """A family: the cells of its markers (n, side, side), with their borders, 1 where white."""

    cells: Cells
    quad: int
    """Cells of a side of the quadrilateral that is looked for."""
    is_bright: bool
    """Whether that quadrilateral is bright in something dark."""
    correctable: int
    """Wrong bits that the family's distance could set right."""

    @property
    def side(self) -> int:
        """Cells of a side of the whole marker."""
        return int(self.cells.shape[-1])


@lru_cache(maxsize=8)
def marker_layout(family: MarkerFamily) -> MarkerLayout:
    if family in NOT_IN_OPENCV:
        return MarkerLayout(_standard_cells(), STANDARD_QUAD, True, _STANDARD_ERRORS)
    dictionary = opencv_dictionary(family)
    side, numbers = dictionary.markerSize + 2, range(len(dictionary.bytesList))
    drawn = [cv2.aruco.generateImageMarker(dictionary, number, side) for number in numbers]
    cells = (np.array(drawn) > 0).astype(np.uint8)
    return MarkerLayout(cells, side, False, dictionary.maxCorrectionBits)


def opencv_dictionary(family: MarkerFamily) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family that it has."""
    name = f"DICT_{family.removeprefix('aruco_').upper()}"
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def marker_image(family: MarkerFamily, number: int, cell_px: int) -> Pixels:
    """A marker with white around, one cell wide, grey, `cell_px` pixels a cell."""
    cells = np.pad(marker_layout(family).cells[number], 1, constant_values=1)
    return np.kron(255 * cells, np.ones((cell_px, cell_px), np.uint8))


def _standard_cells() -> Cells:
    text = files("cpcbl_agents.vision").joinpath(_STANDARD_CODES).read_text(encoding="ascii")
    lines = (line for line in text.splitlines() if not line.startswith("#"))
    codes = np.array([int(code, 16) for line in lines for code in line.split()])
    places = _standard_places()
    shifts = np.arange(len(places))[::-1]
    cells = np.zeros((len(codes), STANDARD_SIDE, STANDARD_SIDE), np.uint8)
    cells[:, 2:-2, 2:-2] = 1
    cells[:, places[:, 1], places[:, 0]] = (codes[:, None] >> shifts) & 1
    return cells


def _standard_places() -> NDArray[np.int64]:
    """The cells (x, y) of the bits, (41, 2), in the order of a code from its highest bit on."""
    places, quarter = [], np.array(_QUARTER)
    for _ in range(4):
        places.append(quarter)
        quarter = np.column_stack([STANDARD_QUAD - 1 - quarter[:, 1], quarter[:, 0]])
    middle = np.full((1, 2), STANDARD_QUAD // 2)
    return np.concatenate([*places, middle]) + (STANDARD_SIDE - STANDARD_QUAD) // 2
