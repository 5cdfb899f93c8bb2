"""What a marker says: its bits, read cell by cell between corners that are known exactly.

OpenCV finds markers' outlines but reads them between rough corners: of those 3 m away it reads
three in four, or fewer where the picture is not sharp.
"""

from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_agents.vision.edges import sampled
from cpcbl_team.config import MarkerFamily

DICTIONARIES: dict[MarkerFamily, int] = {
    "aruco_4x4_50": cv2.aruco.DICT_4X4_50,
    "aruco_5x5_50": cv2.aruco.DICT_5X5_50,
    "aruco_6x6_50": cv2.aruco.DICT_6X6_50,
    "apriltag_16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "apriltag_25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
LEAST_CONTRAST = 12.0  # grey levels between a marker's black and its margin's white
WRONG_SHARE = 0.25  # of the bits that a family could set right: a wrong name is worse than none

_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
_WITHIN = np.array([[x, y] for y in (-0.2, 0.0, 0.2) for x in (-0.2, 0.0, 0.2)])


class Code(NamedTuple):
    """A marker's number, and which of the quad's corners is its upper left one."""

    id: int
    first: int


class Codes:
    """Reads the markers of a family."""

    def __init__(self, family: MarkerFamily) -> None:
        self.dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[family])
        self._bits = self.dictionary.markerSize
        self.cells = self._bits + 2
        """Of a marker's side, its black border too."""
        ids = range(len(self.dictionary.bytesList))
        shown = [cv2.aruco.generateImageMarker(self.dictionary, i, self.cells) for i in ids]
        plain = [np.where(one[1:-1, 1:-1] > 0, 1, -1) for one in shown]
        self._signs = np.array([np.rot90(one, turn).ravel() for one in plain for turn in range(4)])
        self._most_wrong = int(WRONG_SHARE * self.dictionary.maxCorrectionBits)
        self._places = _places(self.cells)

    def read(self, grey: Pixels, quads: Floats) -> dict[int, Code]:
        """What the quads (m, 4, 2) show, clockwise in the picture: by index, of those that are
        markers."""
        places = np.stack([_laid(self._places, quad) for quad in quads])
        levels = sampled(grey, places).reshape(len(quads), -1, len(_WITHIN)).mean(axis=2)
        size = self.cells + 2
        codes = {i: self._one(one.reshape(size, size)) for i, one in enumerate(levels)}
        return {i: code for i, code in codes.items() if code is not None}

    def _one(self, levels: Floats) -> Code | None:
        """The code in the levels of a marker's cells and the ring around it."""
        margin, border, bits = _ring(levels), _ring(levels[1:-1, 1:-1]), levels[2:-2, 2:-2]
        white, black = float(np.median(margin)), float(np.median(border))
        middle = 0.5 * (white + black)
        if white - black < LEAST_CONTRAST or border.max() > middle or margin.min() < middle:
            return None
        wrong = (bits.size - self._signs @ np.where(bits > middle, 1, -1).ravel()) // 2
        best = int(wrong.argmin())
        return Code(best // 4, -best % 4) if wrong[best] <= self._most_wrong else None


def _places(cells: int) -> Floats:
    """Where to look in a marker whose corners are (0, 0) to (1, 1), and in a ring around it."""
    middles = (np.arange(-1, cells + 1) + 0.5) / cells
    x, y = np.meshgrid(middles, middles)
    cell: Floats = np.stack([x, y], axis=2).reshape(-1, 1, 2) + _WITHIN / cells
    return cell.reshape(-1, 2)


def _laid(places: Floats, quad: Floats) -> Floats:
    """Places (n, 2) of the unit square, seen within a quad."""
    laid = cv2.getPerspectiveTransform(_CORNERS, quad.astype(np.float32))
    seen: Floats = cv2.perspectiveTransform(places[None], laid)[0].astype(np.float64, copy=False)
    return seen


def _ring(levels: Floats) -> Floats:
    return np.concatenate([levels[0], levels[-1], levels[1:-1, 0], levels[1:-1, -1]])
