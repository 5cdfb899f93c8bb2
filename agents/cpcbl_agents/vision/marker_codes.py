"""What markers say: the bits of a quadrilateral, read cell by cell, and the number they stand for.

Black and white are planes over the marker, fitted to its border and to the margin around it, as in
Wang and Olson's AprilTag 2 (IROS 2016, section III-C): light that falls off over a marker turns no
bit. Small cells are sharpened, because blur mixes them with their neighbours.
"""

from functools import lru_cache
from math import comb
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_team.config import MarkerFamily

MOST_ROWS = 32_766  # cv2.remap numbers the rows of its result with 16 bits
LEAST_CONTRAST = 5.0  # grey levels between a marker's black and its margin's white
BORDER_SPOILT, MARGIN_SPOILT = 0.10, 0.15  # shares of cells that a highlight or a finger may cover
MOST_SCATTER = 0.25  # of the cells of border and margin, as a share of the contrast
SHARPENING = 0.25
MOST_CHANCE, MOST_CHANCE_SPOILT = 2e-4, 3e-5
"""That random bits are taken for a marker of the family: so many wrong bits are corrected. The
second if a part of the border or the margin is covered, which is less evidence for a marker."""
MOST_CORRECTED = 0.5  # share of the bits that a family could set right
CLEAR_BITS = (
    0.45  # mean distance of the bits from the threshold; 1: as black or as white as the rings
)

_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)
_WITHIN = np.array([[x, y] for y in (-0.2, 0.2) for x in (-0.2, 0.2)])


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
        self.is_printed_both_ways = family.startswith("apriltag")
        """Before version 5, OpenCV's AprilTags are upside down beside those of the AprilTag library
        (opencv/opencv#28823); robots are not."""
        self._sample_points = _sample_points(self.cells)
        along = np.arange(self.cells + 2)
        from_side = np.minimum(along, along[::-1])
        rings = np.minimum(from_side[:, None], from_side)
        y, x = np.mgrid[-1.0 : 1.0 : 1j * len(along), -1.0 : 1.0 : 1j * len(along)]
        basis = np.stack([np.ones_like(x), x, y], axis=2)
        self._margin, self._border, self._inside = rings == 0, rings == 1, rings > 1
        self._margin_plane = _Plane(basis, self._margin)
        self._border_plane = _Plane(basis, self._border)
        self._correction_rates = tuple(
            _correction_rate(self.dictionary, chance)
            for chance in (MOST_CHANCE_SPOILT, MOST_CHANCE)
        )

    def read(self, grey: Pixels, quads: Floats) -> dict[int, MarkerCode]:
        """What the quads (m, 4, 2) show, clockwise in the picture: by index, of those that are
        markers."""
        if not len(quads):
            return {}
        samples = sample_grey(grey, _project_to_quads(self._sample_points, quads))
        in_cells = np.sort(samples.reshape(len(quads), self.cells + 2, self.cells + 2, -1), axis=3)
        levels = in_cells[..., 1:-1].mean(axis=3)  # a small highlight is an extreme
        white, black = self._margin_plane.fit(levels), self._border_plane.fit(levels)
        middle = 0.5 * (white + black)
        white = self._margin_plane.fit(np.where(levels < middle, white, levels))
        black = self._border_plane.fit(np.where(levels > middle, black, levels))
        middle, half = 0.5 * (white + black), 0.5 * (white - black)
        spoilt_border = (levels > middle)[:, self._border].mean(axis=1)
        spoilt_margin = (levels < middle)[:, self._margin].mean(axis=1)
        framed = (spoilt_border <= BORDER_SPOILT) & (spoilt_margin <= MARGIN_SPOILT)
        framed &= 2.0 * half.min(axis=(1, 2)) > LEAST_CONTRAST
        framed &= self._scatter(levels, white, black, middle) < MOST_SCATTER
        whole = (spoilt_border == 0.0) & (spoilt_margin == 0.0)
        codes = {}
        for i in framed.nonzero()[0].tolist():
            shades = (_sharpened(levels[i] - middle[i]) / half[i])[self._inside]
            if np.abs(shades).clip(max=1.0).mean() < CLEAR_BITS:
                continue
            square = (shades > 0.0).astype(np.uint8).reshape(self._bits, self._bits)
            rate = self._correction_rates[int(whole[i])]
            is_known, number, turns = self.dictionary.identify(square, rate)
            if is_known:
                codes[i] = MarkerCode(number, -turns % 4)
        return codes

    def _scatter(self, levels: Floats, white: Floats, black: Floats, middle: Floats) -> Floats:
        """The standard deviation of border and margin from black and white, without what is spoilt,
        as a share of the contrast: large in noise and texture."""
        contrast = white - black
        off = np.where(self._margin, levels - white, levels - black) / np.maximum(contrast, 1e-3)
        counts = np.where(self._margin, levels > middle, self._border & (levels < middle))
        squares = (off * off * counts).sum(axis=(1, 2))
        return np.asarray(np.sqrt(squares / np.maximum(counts.sum(axis=(1, 2)), 1)))


class _Plane:
    """Planes of grey levels over a grid of cells, fitted to some of them by least squares."""

    def __init__(self, basis: Floats, of: NDArray[np.bool_]) -> None:
        self._basis, self._of = basis, of
        self._solution = np.linalg.pinv(basis[of])

    def fit(self, levels: Floats | NDArray[np.float32]) -> Floats:
        """The plane of each grid (m, n, n), in all of its cells."""
        found = levels[:, self._of] @ self._solution.T
        return np.asarray(np.einsum("mk,ijk->mij", found, self._basis))


def _correction_rate(dictionary: cv2.aruco.Dictionary, most_chance: float) -> float:
    """The wrong bits that are corrected in a family, as a share of those that could be."""
    bits = dictionary.markerSize**2
    patterns, most = 4 * len(dictionary.bytesList), 0
    for wrong in range(1, int(MOST_CORRECTED * dictionary.maxCorrectionBits) + 1):
        if patterns * sum(comb(bits, k) for k in range(wrong + 1)) > most_chance * 2.0**bits:
            break
        most = wrong
    # Half a bit more than what OpenCV rounds down
    return (most + 0.5) / dictionary.maxCorrectionBits if most else 0.0


def _sharpened(levels: Floats) -> Floats:
    """A grid (n, n) with the differences of its cells from their neighbours enlarged; not at its
    margin."""
    sharp = levels.copy()
    inner = levels[1:-1, 1:-1]
    around = levels[:-2, 1:-1] + levels[2:, 1:-1] + levels[1:-1, :-2] + levels[1:-1, 2:]
    sharp[1:-1, 1:-1] += SHARPENING * (4.0 * inner - around)
    return sharp


def _sample_points(cells: int) -> Floats:
    """The points to sample in a marker with corners (0, 0) to (1, 1), and in a ring around it."""
    middles = (np.arange(-1, cells + 1) + 0.5) / cells
    x, y = np.meshgrid(middles, middles)
    cell_points = np.stack([x, y], axis=2).reshape(-1, 1, 2) + _WITHIN / cells
    return np.asarray(cell_points.reshape(-1, 2))


def _project_to_quads(points: Floats, quads: Floats) -> Floats:
    """Points (n, 2) of the unit square, projected into each of the quads: (m, n, 2)."""
    maps = (cv2.getPerspectiveTransform(_SQUARE, quad) for quad in quads.astype(np.float32))
    return np.stack([cv2.perspectiveTransform(points[None], one)[0] for one in maps])


def sample_grey(grey: Pixels, points: Floats | NDArray[np.float32]) -> NDArray[np.float32]:
    """The grey levels (...) at points (..., 2), pixels."""
    if not points.size:
        return np.zeros(points.shape[:-1], np.float32)
    flat = points.astype(np.float32, copy=False).reshape(-1, points.shape[-2], 2)
    parts = (flat[i : i + MOST_ROWS] for i in range(0, len(flat), MOST_ROWS))
    levels = [cv2.remap(grey, p[..., 0], p[..., 1], cv2.INTER_LINEAR) for p in parts]
    return np.concatenate(levels).astype(np.float32).reshape(points.shape[:-1])
