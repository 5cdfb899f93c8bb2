"""The sides of a marker to a fraction of a pixel.

The edge of each side, a step from dark to bright outwards, is located at many points, and a line is
fitted to them. Corners are the intersections of these lines, as in the edge refinement of
Wang and Olson's AprilTag 2 (IROS 2016, section III). OpenCV's refinement uses only a few pixels
around a corner: on a marker of 20 pixels it errs by half a pixel, this one by a twentieth.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Floats, Pixels

POINTS_PER_SIDE = 12  # along a side
TAPS = 13  # across it
SHARE = 0.8  # of a cell is looked at on either side: beyond lie the marker's bits
LEAST_PX, MOST_PX = 1.6, 4.0
FAINT = 0.25  # of the steepest step: less is noise

_ALONG = np.linspace(0.12, 0.88, POINTS_PER_SIDE, dtype=np.float32)[
    :, None
]  # corners are round, even where no marker is
_ACROSS = np.linspace(-1.0, 1.0, TAPS, dtype=np.float32)
_BETWEEN = 0.5 * (_ACROSS[1:] + _ACROSS[:-1])
_OUTWARDS = np.array([1.0, -1.0], np.float32)
_NEXT = [1, 2, 3, 0]


def sample_grey(grey: Pixels, points: Floats | NDArray[np.float32]) -> NDArray[np.float32]:
    """The grey levels (...) at points (..., 2), pixels."""
    if not points.size:
        return np.zeros(points.shape[:-1], np.float32)
    flat = points.astype(np.float32, copy=False).reshape(-1, points.shape[-2], 2)
    levels = cv2.remap(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR)
    return levels.astype(np.float32).reshape(points.shape[:-1])


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
    levels = sample_grey(grey, places[:, :, :, None] + aside[:, :, None])
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
