"""Dark quadrilaterals in a grey picture: where markers may be.

Each tile of 4 x 4 pixels has its own threshold, in the middle between the darkest and the brightest
pixel of it and its neighbours, as in Wang and Olson's AprilTag 2 (IROS 2016, section III-A). So
shade, glare and low light need no other parameters than bright light. The contours of what is
darker are ranked by contrast and area before any of them costs more than a few numbers, so a
picture that is full of contours costs no more than a bound.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Floats, Pixels

TILE_PX = 4
LEAST_CONTRAST = 5.0  # grey levels between black and white: less is noise of any camera
NOISE_SIGMAS = 5  # of the noise: less contrast is noise of this camera
DARKER = 2.0  # sigmas of the noise: what is dark is so much darker than the middle
NOISY = 1.0  # grey levels: from this noise on a picture is smoothed
LEAST_BOX_PX = 5  # high and wide
MOST_ELONGATED = 6.0
MOST_RAGGED = 3.0  # length of a contour, in half circumferences of its box
MOST_CONTOURS = 300  # that are approximated; the others are dropped
APPROXIMATIONS = (0.05, 0.09)  # of a hull by a polygon, as shares of its length
FILLED = 0.7  # of the convex hull of a contour, at least, is in its quad
_TILE = np.ones((TILE_PX, TILE_PX), np.uint8)
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_LAPLACE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_LAPLACE_SIGMA = 6.0 * 0.6745  # the median of its absolute response to noise of 1 grey level


class Quads(NamedTuple):
    """Corners (n, 4, 2), clockwise in the picture, those of large contrast and area first, and how
    many contours were dropped."""

    corners: Floats
    dropped: int


def noise_sigma(grey: Pixels) -> float:
    """The sigma of the noise, grey levels: from the median response to a mask that does not see
    edges and slopes (Immerkaer, Fast noise variance estimation, CVIU 1996)."""
    response = cv2.filter2D(grey, cv2.CV_16S, _LAPLACE)[1::4, 1::2]
    return float(np.median(np.abs(response))) / _LAPLACE_SIGMA


def dark_quads(grey: Pixels) -> Quads:
    """The dark quadrilaterals of a picture (height, width)."""
    noise = noise_sigma(grey)
    if noise > NOISY:
        grey = cv2.GaussianBlur(grey, (3, 3), 0.0).astype(np.uint8, copy=False)
        noise *= 0.375  # the root of the sum of the squared weights of that filter
    dark, contrast = _threshold(grey, noise)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    long = [c for c in contours if len(c) >= 4 * (LEAST_BOX_PX - 1)]
    if not long:
        return Quads(np.empty((0, 4, 2)), 0)
    x, y, width, height = np.array([cv2.boundingRect(c) for c in long]).T
    low, high = np.minimum(width, height), np.maximum(width, height)
    lengths = np.array([len(c) for c in long])
    is_likely = (low >= LEAST_BOX_PX) & (high <= MOST_ELONGATED * low)
    (fit,) = (is_likely & (lengths <= MOST_RAGGED * (width + height))).nonzero()
    levels = contrast[(y + height // 2) // TILE_PX, (x + width // 2) // TILE_PX]
    scores = (levels * np.sqrt(low * high))[fit]
    ranked = fit[np.argsort(-scores, kind="stable")].tolist()
    found = (_quad(long[k]) for k in ranked[:MOST_CONTOURS])
    quads = [quad for quad in found if quad is not None]
    corners = np.array(quads, np.float64).reshape(-1, 4, 2)
    return Quads(corners, max(0, len(ranked) - MOST_CONTOURS))


def _threshold(grey: Pixels, noise: float) -> tuple[Pixels, NDArray[np.uint8]]:
    """Where a picture is dark (height, width), and the contrast of its tiles."""
    height, width = (size // TILE_PX for size in grey.shape)
    whole = grey[: TILE_PX * height, : TILE_PX * width]
    # The kernel's anchor is its pixel (2, 2), so the tile of row r has its extremes at 4 r + 2
    at = slice(TILE_PX // 2, None, TILE_PX)
    darkest = cv2.erode(cv2.erode(whole, _TILE)[at, at], _NEIGHBOURS)
    brightest = cv2.dilate(cv2.dilate(whole, _TILE)[at, at], _NEIGHBOURS)
    contrast = cv2.subtract(brightest, darkest).astype(np.uint8, copy=False)
    middle = cv2.addWeighted(darkest, 0.5, brightest, 0.5, -DARKER * noise)
    middle[contrast < max(LEAST_CONTRAST, NOISE_SIGMAS * noise)] = 0  # nothing is darker
    size = TILE_PX * width, TILE_PX * height
    threshold = cv2.resize(middle, size, interpolation=cv2.INTER_NEAREST)
    return cv2.compare(whole, threshold, cv2.CMP_LT).astype(np.uint8, copy=False), contrast


def _quad(contour: cv2.typing.MatLike) -> Floats | None:
    """The corners (4, 2) of the quadrilateral that a contour is nearly, clockwise; or None."""
    if cv2.contourArea(contour, True) > 0.0:  # a bright hole
        return None
    hull = cv2.convexHull(contour)
    length, area = cv2.arcLength(hull, True), cv2.contourArea(hull)
    for share in APPROXIMATIONS:
        corners = cv2.approxPolyDP(hull, share * length, True)
        if len(corners) == 4:
            if cv2.contourArea(corners) < FILLED * area:
                return None
            quad = corners.reshape(4, 2).astype(np.float64)
            return quad if cv2.contourArea(corners, True) > 0.0 else quad[::-1]
    return None
