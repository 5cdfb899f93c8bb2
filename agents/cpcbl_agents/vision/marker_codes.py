"""What markers say: the bits of a quadrilateral, read cell by cell, and the number they stand for.

Black and white are planes over the marker, fitted to its border and to the margin around it, as in
Wang and Olson's AprilTag 2 (IROS 2016, section III-C): light that falls off over a marker turns no
bit. Small cells are sharpened, because blur mixes them with their neighbours.
"""

from math import comb
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_agents.vision.marker_families import marker_layout
from cpcbl_team.config import MarkerFamily

MOST_ROWS = 32_766  # cv2.remap numbers the rows of its result with 16 bits
LEAST_CONTRAST = 5.0  # grey levels between a marker's black and its margin's white
BORDER_SPOILT, MARGIN_SPOILT = 0.10, 0.15  # shares of cells that a highlight or a finger may cover
MOST_SCATTER = 0.25  # of the cells of border and margin, as a share of the contrast
MOST_SCATTER_SPOILT = 0.2  # if a part is covered, and random bits are often a marker of the family
SHARPENING = 0.25
MOST_CHANCE, MOST_CHANCE_SPOILT = 2e-4, 3e-5
"""That random bits are taken for a marker of the family: so many wrong bits are corrected. The
second if a part of the border or the margin is covered, which is less evidence for a marker."""
MOST_CORRECTED = 0.6  # share of the bits that a family could set right
CLEAR_BITS = (
    0.45  # mean distance of the bits from the threshold; 1: as black or as white as the rings
)

OPENCV_TURNED: tuple[MarkerFamily, ...] = ("apriltag_16h5", "apriltag_25h9", "apriltag_36h11")
"""Before version 5, OpenCV's AprilTags are upside down beside those of the AprilTag library
(opencv/opencv#28823); robots are not."""

_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)
_WITHIN = np.array([[x, y] for y in (-0.2, 0.2) for x in (-0.2, 0.2)])


class MarkerCode(NamedTuple):
    """A marker's number, and which of the quad's corners is its upper left one."""

    id: int
    first: int


class MarkerReader:
    """Reads the markers of a family: in the picture if its quads are dark, else in the negative."""

    def __init__(self, family: MarkerFamily) -> None:
        self.layout = marker_layout(family)
        self.is_printed_both_ways = family in OPENCV_TURNED
        outer = max(1, (self.layout.side - self.layout.quad) // 2)
        self._grid = self.layout.quad + 2 * outer
        self._sample_points = _sample_points(self.layout.quad, outer)
        along = np.arange(self._grid)
        from_side = np.minimum(along, along[::-1])
        rings = np.minimum(from_side[:, None], from_side)
        y, x = np.mgrid[-1.0 : 1.0 : 1j * len(along), -1.0 : 1.0 : 1j * len(along)]
        basis = np.stack([np.ones_like(x), x, y], axis=2)
        self._margin, self._border = rings == outer - 1, rings == outer
        self._data = ~(self._margin | self._border)
        self._margin_plane = _Plane(basis, self._margin)
        self._border_plane = _Plane(basis, self._border)
        self._codes = self._turned_codes()
        patterns, bits = self._codes.shape
        self._is_telling = patterns < MOST_CHANCE * 2.0**bits
        self._correctable, self._correctable_spoilt = (
            _correctable(self._codes.shape, self.layout.correctable, chance)
            for chance in (MOST_CHANCE, MOST_CHANCE_SPOILT)
        )

    def read(self, grey: Pixels, quads: Floats) -> dict[int, MarkerCode]:
        """What the quads (m, 4, 2) show, clockwise in the picture: by index, of those that are
        markers."""
        if not len(quads):
            return {}
        samples = sample_grey(grey, _project_to_quads(self._sample_points, quads))
        in_cells = np.sort(samples.reshape(len(quads), self._grid, self._grid, -1), axis=3)
        levels = in_cells[..., 1:-1].mean(axis=3)  # a small highlight is an extreme
        white, black = self._margin_plane.fit(levels), self._border_plane.fit(levels)
        middle = 0.5 * (white + black)
        white = self._margin_plane.fit(np.where(levels < middle, white, levels))
        black = self._border_plane.fit(np.where(levels > middle, black, levels))
        middle, half = 0.5 * (white + black), 0.5 * (white - black)
        spoilt_border = (levels > middle)[:, self._border].mean(axis=1)
        spoilt_margin = (levels < middle)[:, self._margin].mean(axis=1)
        framed = (spoilt_border <= BORDER_SPOILT) & (spoilt_margin <= MARGIN_SPOILT)
        framed &= 2.0 * half[:, ~self._margin].min(axis=1) > LEAST_CONTRAST
        whole = (spoilt_border == 0.0) & (spoilt_margin == 0.0)
        most_scatter = np.where(whole | self._is_telling, MOST_SCATTER, MOST_SCATTER_SPOILT)
        framed &= self._scatter(levels, white, black, middle) < most_scatter
        (at,) = framed.nonzero()
        shades = _sharpened(levels[at] - middle[at]) / half[at]
        bits = shades[:, self._data]
        most = np.where(whole[at], self._correctable, self._correctable_spoilt)
        most[np.abs(bits).clip(max=1.0).mean(axis=1) < CLEAR_BITS] = -1
        return {
            quad: code
            for quad, code in zip(at.tolist(), self._identify(bits, most), strict=True)
            if code is not None
        }

    def _identify(self, bits: Floats, most: NDArray[np.int64]) -> list[MarkerCode | None]:
        """The markers whose bits (m, k; positive where bright) these are but for `most` (m,)."""
        signs = np.where(bits > 0.0, 1.0, -1.0).astype(np.float32)
        wrong = 0.5 * (self._codes.shape[1] - signs @ self._codes.T)
        nearest = wrong.argmin(axis=1)
        is_known = wrong[np.arange(len(wrong)), nearest] <= most
        return [
            MarkerCode(*divmod(one, 4)) if known else None
            for one, known in zip(nearest.tolist(), is_known.tolist(), strict=True)
        ]

    def _turned_codes(self) -> NDArray[np.float32]:
        """The bits of all markers in all four turns, (4 n, k): 1 where bright, else -1."""
        beyond = (self._grid - self.layout.side) // 2
        cells = np.pad(self.layout.cells, [(0, 0), (beyond, beyond), (beyond, beyond)])
        turned = [np.rot90(cells, -first, (1, 2))[:, self._data] for first in range(4)]
        codes = 2.0 * np.stack(turned, axis=1).reshape(4 * len(cells), -1) - 1.0
        return np.asarray(-codes if self.layout.is_bright else codes, np.float32)

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


def _correctable(codes: tuple[int, ...], most: int, most_chance: float) -> int:
    """The wrong bits that are set right in a family of so many codes and bits, of which its
    distance allows `most`."""
    (patterns, bits), found = codes, 0
    for wrong in range(1, int(MOST_CORRECTED * most) + 1):
        if patterns * sum(comb(bits, k) for k in range(wrong + 1)) > most_chance * 2.0**bits:
            break
        found = wrong
    return found


def _sharpened(levels: Floats) -> Floats:
    """Grids (m, n, n) with the differences of their cells from their neighbours enlarged; what is
    beyond counts as 0, neither black nor white."""
    sharp = (1.0 + 4.0 * SHARPENING) * levels
    sharp[:, 1:] -= SHARPENING * levels[:, :-1]
    sharp[:, :-1] -= SHARPENING * levels[:, 1:]
    sharp[..., 1:] -= SHARPENING * levels[..., :-1]
    sharp[..., :-1] -= SHARPENING * levels[..., 1:]
    return np.asarray(sharp)


def _sample_points(quad: int, outer: int) -> Floats:
    """The points to sample in a quad of so many cells with corners (0, 0) to (1, 1), and in the
    `outer` rings of cells around it."""
    middles = (np.arange(-outer, quad + outer) + 0.5) / quad
    x, y = np.meshgrid(middles, middles)
    cell_points = np.stack([x, y], axis=2).reshape(-1, 1, 2) + _WITHIN / quad
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
