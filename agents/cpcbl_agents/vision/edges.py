"""Where the sides of a marker are, to a fraction of a pixel.

Each side is sought at many places, as a step from dark to bright outwards, and a straight line is
laid through what was found; corners are where lines meet. (So are the refined edges of Wang and
Olson's AprilTag 2, IROS 2016, section III. OpenCV's own refinement looks at the few pixels around a
corner: on a marker of 20 pixels it errs by half a pixel, this by a twentieth.)
"""

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels

PLACES = 12  # along a side
TAPS = 13  # across it
SHARE = 0.8  # of a cell is looked at on either side: beyond lie the marker's bits
LEAST_PX, MOST_PX = 1.6, 4.0
FAINT = 0.25  # of the steepest step: less is noise

_ALONG = np.linspace(0.12, 0.88, PLACES)[:, None]  # corners are round, even where no marker is
_ACROSS = np.linspace(-1.0, 1.0, TAPS)


def sampled(grey: Pixels, points: Floats) -> Floats:
    """The grey levels (...) at points (..., 2), pixels."""
    flat = points.astype(np.float32).reshape(-1, points.shape[-2], 2)
    levels = cv2.remap(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR)
    return levels.astype(np.float64).reshape(points.shape[:-1])


def steps(grey: Pixels, quads: Floats, cells: int) -> Floats:
    """Places on the sides of dark quads, (m, 4, PLACES, 2), pixels.

    `quads`: corners (m, 4, 2), clockwise in the picture, right to about two pixels; `cells`: how
    many of them a side has.
    """
    ways = np.roll(quads, -1, axis=1) - quads
    lengths = np.linalg.norm(ways, axis=2)
    outwards = np.stack([ways[..., 1], -ways[..., 0]], axis=2) / lengths[..., None]
    reach = np.clip(SHARE * lengths.min(axis=1) / cells, LEAST_PX, MOST_PX)
    across = reach[:, None] * _ACROSS
    places = quads[:, :, None] + _ALONG * ways[:, :, None]
    aside = across[:, None, :, None] * outwards[:, :, None]
    levels = sampled(grey, places[:, :, :, None] + aside[:, :, None])
    slopes = np.diff(levels, axis=3).clip(0.0)
    slopes = (slopes - FAINT * slopes.max(axis=3, keepdims=True)).clip(0.0) + 1e-9
    middles = 0.5 * (across[:, 1:] + across[:, :-1])[:, None, None]
    offsets = (slopes * middles).sum(axis=3) / slopes.sum(axis=3)
    found: Floats = places + offsets[..., None] * outwards[:, :, None]
    return found


def corners(sides: Floats) -> Floats:
    """Where lines through the points of neighbouring sides (m, 4, n, 2) meet: (m, 4, 2)."""
    lines = _lines(sides)
    met = np.cross(np.roll(lines, 1, axis=1), lines)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings: Floats = met[..., :2] / met[..., 2:]
    return crossings


def _lines(points: Floats) -> Floats:
    """The lines (..., 3) through points (..., n, 2), homogeneous, by least squares."""
    middle = points.mean(axis=-2)
    x, y = np.moveaxis(points - middle[..., None, :], -1, 0)
    angle = 0.5 * np.arctan2(2.0 * (x * y).sum(-1), (x * x - y * y).sum(-1))
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    return np.concatenate([normal, -(normal * middle).sum(-1, keepdims=True)], axis=-1)
