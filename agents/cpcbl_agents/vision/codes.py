"""The exact corners of markers, and the bits that are read cell by cell between them.

The edge of each side, a step from dark to bright outwards, is located at many points, and a line is
fitted to them. Corners are the intersections of these lines, as in the edge refinement of
Wang and Olson's AprilTag 2 (IROS 2016, section III). OpenCV's refinement uses only a few pixels
around a corner: on a marker of 20 pixels it errs by half a pixel, this one by a twentieth. Between
its rough corners OpenCV reads only three of four markers at 3 m, and fewer in blurred pictures.
"""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_team.config import MarkerFamily

POINTS_PER_SIDE = 12  # along a side
TAPS = 13  # across it
SHARE = 0.8  # of a cell is looked at on either side: beyond lie the marker's bits
LEAST_PX, MOST_PX = 1.6, 4.0
FAINT = 0.25  # of the steepest step: less is noise
LEAST_CONTRAST = 12.0  # grey levels between a marker's black and its margin's white
WRONG_SHARE = 0.25  # of the bits that a family could set right: a wrong name is worse than none

_ALONG = np.linspace(0.12, 0.88, POINTS_PER_SIDE, dtype=np.float32)[:, None]
"""Not up to the corners, which are round, even where no marker is."""
_ACROSS = np.linspace(-1.0, 1.0, TAPS, dtype=np.float32)
_BETWEEN = 0.5 * (_ACROSS[1:] + _ACROSS[:-1])
_OUTWARDS = np.array([1.0, -1.0], np.float32)
_NEXT = [1, 2, 3, 0]
_WITHIN = np.array([[x, y] for y in (-0.15, 0.15) for x in (-0.15, 0.15)])


@lru_cache(maxsize=8)
def marker_dictionary(family: MarkerFamily) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family."""
    name = f"DICT_{family.removeprefix('aruco_').upper()}"
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


class MarkerCode(NamedTuple):
    """A marker's number, and which of the quad's corners is its upper left one."""

    id: int
    first: int


class MarkerReader:
    """Reads the markers of a family."""

    def __init__(self, family: MarkerFamily) -> None:
        self.dictionary = marker_dictionary(family)
        self._bits = self.dictionary.markerSize
        self.cells = self._bits + 2
        """Of a marker's side, its black border too."""
        ids = range(len(self.dictionary.bytesList))
        images = [cv2.aruco.generateImageMarker(self.dictionary, i, self.cells) for i in ids]
        patterns = [np.where(one[1:-1, 1:-1] > 0, 1, -1) for one in images]
        turned = [np.rot90(one, turn).ravel() for one in patterns for turn in range(4)]
        self._signs = np.array(turned)
        self._most_wrong = int(WRONG_SHARE * self.dictionary.maxCorrectionBits)
        self._sample_points = _sample_points(self.cells)
        self._ring_numbers = _ring_numbers(self.cells)

    def read(self, grey: Pixels, quads: Floats) -> dict[int, MarkerCode]:
        """What the quads (m, 4, 2) show, clockwise in the picture: by index, of those that are
        markers."""
        if not len(quads):
            return {}
        samples = _sample_grey(grey, _project_to_quads(self._sample_points, quads))
        levels = samples.reshape(len(quads), -1, len(_WITHIN)).mean(axis=2)
        margins, borders = levels[:, self._ring_numbers == 0], levels[:, self._ring_numbers == 1]
        white, black = margins.mean(axis=1), borders.mean(axis=1)
        middle = 0.5 * (white + black)
        framed = (borders.max(axis=1) < middle) & (middle < margins.min(axis=1))
        framed &= white - black > LEAST_CONTRAST
        bits = np.where(levels[:, self._ring_numbers > 1] > middle[:, None], 1, -1)
        wrong = (self._bits**2 - bits @ self._signs.T) // 2
        best = wrong.argmin(axis=1)
        read = framed & (wrong.min(axis=1) <= self._most_wrong)
        return {int(i): MarkerCode(int(best[i]) // 4, -int(best[i]) % 4) for i in read.nonzero()[0]}


def _sample_points(cells: int) -> Floats:
    """The points to sample in a marker with corners (0, 0) to (1, 1), and in a ring around it."""
    middles = (np.arange(-1, cells + 1) + 0.5) / cells
    x, y = np.meshgrid(middles, middles)
    cell: Floats = np.stack([x, y], axis=2).reshape(-1, 1, 2) + _WITHIN / cells
    return cell.reshape(-1, 2)


def _project_to_quads(points: Floats, quads: Floats) -> Floats:
    """Points (n, 2) of the unit square, projected into each of the quads: (m, n, 2). (Heckbert,
    Fundamentals of texture mapping, 1989, section 2.2.3.)"""
    a, b, c, d = quads.transpose(1, 0, 2)
    right, below, bend = b - c, d - c, a - b + c - d
    size = _cross(right, below)
    across, down = _cross(bend, below) / size, _cross(right, bend) / size
    x = b - a + across[:, None] * b
    y = d - a + down[:, None] * d
    s, t = points.T[:, None, :, None]
    deep = 1.0 + across[:, None, None] * s + down[:, None, None] * t
    projected: Floats = (s * x[:, None] + t * y[:, None] + a[:, None]) / deep
    return projected


def _cross(a: Floats, b: Floats) -> Floats:
    crossed: Floats = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return crossed


def _ring_numbers(cells: int) -> NDArray[np.int64]:
    """The distance of each cell from the outside, including the ring around the marker."""
    along = np.arange(cells + 2)
    from_side = np.minimum(along, along[::-1])
    return np.minimum(from_side[:, None], from_side).ravel()


def side_edge_points(grey: Pixels, quads: Floats, cells: int) -> Floats:
    """Points on the sides of dark quads, (m, 4, POINTS_PER_SIDE, 2), pixels.

    `quads`: corners (m, 4, 2), clockwise in the picture, exact to about two pixels; `cells`: the
    number of cells of a side.
    """
    quads = quads.astype(np.float32)  # as exact as is needed, in half the time
    ways = quads[:, _NEXT] - quads
    lengths = np.linalg.norm(ways, axis=2)
    reach = np.clip(SHARE * lengths.min(axis=1) / cells, LEAST_PX, MOST_PX)
    outwards = ways[..., ::-1] * _OUTWARDS * (reach[:, None] / lengths)[..., None]
    places = quads[:, :, None] + _ALONG * ways[:, :, None]
    aside = _ACROSS[:, None] * outwards[:, :, None]
    levels = _sample_grey(grey, places[:, :, :, None] + aside[:, :, None])
    slopes = levels[..., 1:] - levels[..., :-1]
    slopes -= FAINT * slopes.max(axis=3, keepdims=True)
    slopes = slopes.clip(0.0) + 1e-6
    offsets = (slopes @ _BETWEEN) / slopes.sum(axis=3)
    found: Floats = (places + offsets[..., None] * outwards[:, :, None]).astype(np.float64)
    return found


def line_intersections(sides: Floats) -> Floats:
    """Intersections (m, 4, 2) of lines through the points of neighbouring sides (m, 4, n, 2)."""
    middle = sides.mean(axis=2)
    x, y = (sides - middle[:, :, None]).transpose(3, 0, 1, 2)
    angle = 0.5 * np.arctan2(2.0 * (x * y).sum(axis=2), (x * x - y * y).sum(axis=2))
    c, s = np.cos(angle), np.sin(angle)
    offset = c * middle[..., 1] - s * middle[..., 0]
    before = [3, 0, 1, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = s[:, before] * c - c[:, before] * s
        x = (c[:, before] * offset - c * offset[:, before]) / turn
        y = (s[:, before] * offset - s * offset[:, before]) / turn
    return np.stack([x, y], axis=2)


def _sample_grey(grey: Pixels, points: Floats | NDArray[np.float32]) -> NDArray[np.float32]:
    """The grey levels (...) at points (..., 2), pixels."""
    if not points.size:
        return np.zeros(points.shape[:-1], np.float32)
    flat = points.astype(np.float32, copy=False).reshape(-1, points.shape[-2], 2)
    levels = cv2.remap(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR)
    return levels.astype(np.float32).reshape(points.shape[:-1])
