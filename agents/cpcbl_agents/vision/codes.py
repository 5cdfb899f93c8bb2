"""What a marker says: its bits, read cell by cell between corners that are known exactly.

OpenCV finds markers' outlines but reads them between rough corners: of those 3 m away it reads
three in four, or fewer where the picture is not sharp.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

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

_WITHIN = np.array([[x, y] for y in (-0.15, 0.15) for x in (-0.15, 0.15)])


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
        self._places, self._rings = _places(self.cells), _rings(self.cells)

    def read(self, grey: Pixels, quads: Floats) -> dict[int, Code]:
        """What the quads (m, 4, 2) show, clockwise in the picture: by index, of those that are
        markers."""
        if not len(quads):
            return {}
        levels = (
            sampled(grey, _laid(self._places, quads))
            .reshape(len(quads), -1, len(_WITHIN))
            .mean(axis=2)
        )
        margins, borders = levels[:, self._rings == 0], levels[:, self._rings == 1]
        white, black = margins.mean(axis=1), borders.mean(axis=1)
        middle = 0.5 * (white + black)
        framed = (borders.max(axis=1) < middle) & (middle < margins.min(axis=1))
        framed &= white - black > LEAST_CONTRAST
        bits = np.where(levels[:, self._rings > 1] > middle[:, None], 1, -1)
        wrong = (self._bits**2 - bits @ self._signs.T) // 2
        best = wrong.argmin(axis=1)
        read = framed & (wrong.min(axis=1) <= self._most_wrong)
        return {int(i): Code(int(best[i]) // 4, -int(best[i]) % 4) for i in read.nonzero()[0]}


def _places(cells: int) -> Floats:
    """Where to look in a marker whose corners are (0, 0) to (1, 1), and in a ring around it."""
    middles = (np.arange(-1, cells + 1) + 0.5) / cells
    x, y = np.meshgrid(middles, middles)
    cell: Floats = np.stack([x, y], axis=2).reshape(-1, 1, 2) + _WITHIN / cells
    return cell.reshape(-1, 2)


def _laid(places: Floats, quads: Floats) -> Floats:
    """Places (n, 2) of the unit square, seen within each of the quads: (m, n, 2). (Heckbert,
    Fundamentals of texture mapping, 1989, section 2.2.3.)"""
    a, b, c, d = quads.transpose(1, 0, 2)
    right, below, bend = b - c, d - c, a - b + c - d
    size = _crossed(right, below)
    across, down = _crossed(bend, below) / size, _crossed(right, bend) / size
    x = b - a + across[:, None] * b
    y = d - a + down[:, None] * d
    s, t = places.T[:, None, :, None]
    deep = 1.0 + across[:, None, None] * s + down[:, None, None] * t
    laid: Floats = (s * x[:, None] + t * y[:, None] + a[:, None]) / deep
    return laid


def _crossed(a: Floats, b: Floats) -> Floats:
    crossed: Floats = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return crossed


def _rings(cells: int) -> NDArray[np.int64]:
    """Of each cell, of the ring around the marker too, how far it is from the outside."""
    along = np.arange(cells + 2)
    from_side = np.minimum(along, along[::-1])
    return np.minimum(from_side[:, None], from_side).ravel()
