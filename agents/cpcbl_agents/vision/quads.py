"""Dark quadrilaterals in a grey picture: where markers may be.

Each tile of 4 x 4 pixels has its own threshold, in the middle between the darkest and the brightest
pixel of it and its neighbours, as in Wang and Olson's AprilTag 2 (IROS 2016, section III-A). So
shade, glare and low light need no other parameters than bright light. Tiles that have no more
contrast than the texture of the picture are left out: most contours would be theirs. The contours
of what is darker are ranked by contrast and area before any of them costs more than a few numbers,
so a picture that is full of contours costs no more than a bound. All hulls are looked at together:
the largest quadrilateral in each has its corners where a polygon that approximates the hull may be
three pixels off.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Floats, Pixels

TILE_PX = 4
LEAST_CONTRAST = 5.0  # grey levels between black and white: less is noise of any camera
NOISE_SIGMAS = 6  # of the noise: less contrast is noise of this camera
DARKER = 1.0  # sigmas of the noise: what is dark is so much darker than the middle
NOISY = 1.0  # grey levels: from this noise on a picture is smoothed
CALM = 0.25  # of the tiles have less contrast than the texture of a picture
TEXTURES = 1.4  # times that: less contrast is texture
MOST_TEXTURE = 24.0  # grey levels: glare leaves a marker little more
LEAST_BOX_PX = 5  # high and wide
MOST_ELONGATED = 8.0
MOST_RAGGED = 4.5  # length of a contour, in half circumferences of its box
MOST_CONTOURS = 300  # whose hulls are looked at; the others are dropped
FILLED = 0.75  # of the convex hull of a contour, at least, is in its quad
LEAST_CORNER = 0.2  # of a quad's area is the triangle of a corner and its neighbours, at least
LEAST_SINE = 0.2  # of the angle of two sides
_PARENT = 3  # in a hierarchy of contours
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
    response = cv2.filter2D(grey, cv2.CV_16S, _LAPLACE)[1::8, 1::4]
    return float(np.median(np.abs(response))) / _LAPLACE_SIGMA


def dark_quads(grey: Pixels) -> Quads:
    """The dark quadrilaterals of a picture (height, width)."""
    noise = noise_sigma(grey)
    if noise > NOISY:
        grey = cv2.GaussianBlur(grey, (3, 3), 0.0).astype(np.uint8, copy=False)
        noise *= 0.375  # the root of the sum of the squared weights of that filter
    dark, contrast = _threshold(grey, noise)
    contours, hierarchy = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return Quads(np.empty((0, 4, 2)), 0)
    lengths = np.array([len(c) for c in contours])
    is_outer = np.asarray(hierarchy)[0, :, _PARENT] < 0  # else the rim of a bright hole
    long = np.flatnonzero(is_outer & (lengths >= 4 * (LEAST_BOX_PX - 1)))
    rects = [cv2.boundingRect(contours[k]) for k in long.tolist()]
    width, height = np.array(rects, np.intp).reshape(-1, 4)[:, 2:].T
    low, high = np.minimum(width, height), np.maximum(width, height)
    is_likely = (low >= LEAST_BOX_PX) & (high <= MOST_ELONGATED * low)
    is_likely &= lengths[long] <= MOST_RAGGED * (width + height)
    likely, sizes = long[is_likely], np.sqrt(low * high)[is_likely]
    x, y = (
        np.array([contours[k][0, 0] for k in likely.tolist()], np.intp).reshape(-1, 2).T // TILE_PX
    )
    ranked = likely[np.argsort(contrast[y, x] * -sizes, kind="stable")].tolist()
    hulls = [cv2.convexHull(contours[k]) for k in ranked[:MOST_CONTOURS]]
    return Quads(_quads(hulls), max(0, len(ranked) - MOST_CONTOURS))


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
    least = max(LEAST_CONTRAST, NOISE_SIGMAS * noise, _texture_contrast(contrast))
    middle[contrast < least] = 0  # nothing is darker
    size = TILE_PX * width, TILE_PX * height
    threshold = cv2.resize(middle, size, interpolation=cv2.INTER_NEAREST)
    return cv2.compare(whole, threshold, cv2.CMP_LT).astype(np.uint8, copy=False), contrast


def _texture_contrast(contrast: Pixels) -> float:
    """What tiles without a marker may reach, where the picture is full of texture."""
    counts = np.bincount(contrast.reshape(-1), minlength=256).cumsum()
    calm = int(np.searchsorted(counts, CALM * counts[-1]))
    return min(TEXTURES * calm, MOST_TEXTURE)


def _quads(hulls: Sequence[cv2.typing.MatLike]) -> Floats:
    """Corners (m, 4, 2) of those hulls (n, 1, 2; clockwise) that are nearly quadrilaterals: of the
    largest quadrilaterals within them, moved outwards to where the dark pixels end."""
    if not hulls:
        return np.empty((0, 4, 2))
    sizes = np.array([len(hull) for hull in hulls])
    ends = sizes.cumsum()
    places = np.minimum(np.arange(sizes.max()), sizes[:, None] - 1)  # the last one again and again
    points = np.concatenate(hulls)[:, 0][places + (ends - sizes)[:, None]].astype(np.float64)
    quads = _largest_quads(points)
    areas = _areas(quads)
    corners = [_areas(quads[:, [k - 1, k, (k + 1) % 4]]) for k in range(4)]
    fit = (areas > FILLED * _areas(points)) & (np.min(corners, axis=0) > LEAST_CORNER * areas)
    return _moved_outwards(quads[fit])


def _largest_quads(points: Floats) -> Floats:
    """The quadrilaterals (m, 4, 2) of large area whose corners are points of convex polygons
    (m, n, 2): each corner in turn becomes the point that is farthest from its diagonal."""
    rows = np.arange(len(points))
    away = points - points.mean(axis=1, keepdims=True)
    first = points[rows, (away * away).sum(axis=2).argmax(axis=1)]
    away = points - first[:, None]
    third = points[rows, (away * away).sum(axis=2).argmax(axis=1)]
    quads = np.stack([first, first, third, third], axis=1)
    for corner in (1, 3, *range(4), *range(4)):
        x, y = (quads[:, corner - 1] - quads[:, (corner + 1) % 4]).T
        farthest = (points[..., 1] * x[:, None] - points[..., 0] * y[:, None]).argmax(axis=1)
        quads[:, corner] = points[rows, farthest]
    return quads


def _areas(polygons: Floats) -> Floats:
    """Of polygons (m, n, 2), clockwise in the picture."""
    x, y = np.moveaxis(polygons, 2, 0)
    return np.asarray(0.5 * (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1))


def _moved_outwards(quads: Floats) -> Floats:
    """Quads (m, 4, 2) whose sides are moved outwards by half a pixel."""
    ways = np.roll(quads, -1, axis=1) - quads
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    before = np.roll(ways, 1, axis=1)
    sine = before[..., 0] * ways[..., 1] - before[..., 1] * ways[..., 0]
    return np.asarray(quads + 0.5 * (before - ways) / np.maximum(sine, LEAST_SINE)[..., None])
