"""Two bands, one on the other: which blobs may be such a cylinder, and its outline to a part of a
pixel."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_agents.vision.colours import Blob
from cpcbl_agents.vision.panorama import Panorama
from cpcbl_agents.vision.profiles import Profile
from cpcbl_team.config import Bands

GAP_PX, GAP_SHARE = 2.5, 0.15  # between the bands, of the lower height
OVERLAP_SHARE = 0.7  # with something of its colour beside it, a blob goes farther up or down
LEAST_OVERLAP = 0.5  # of the narrower band
SLACK_PX = 2.0
WIDER, HIGHER = 2.0, 4.0  # one band than the other, at most
UNEVEN = 1.4  # then the end of the higher band is looked for where the other band says it is
BORDER_PX = 1.5  # an edge so near to the frame's border is cut
REST_PX = 7.0  # around the farthest edge
LEAST_PATCH_PX = 3
LEAST_WIDTH = 1.0
INSET = 0.2  # of a band, above and below the rows that tell its sides
APART_PX = 1.5  # the sides of two bands


class Candidate(NamedTuple):
    """An upper blob and a lower one."""

    upper: Blob
    lower: Blob

    @property
    def colours(self) -> Bands:
        return self.upper.colour, self.lower.colour

    @property
    def height(self) -> float:
        return self.lower.bottom - self.upper.top

    @property
    def outline(self) -> Floats:
        """Corners (4, 2) of the box around both, in pixels of the frame."""
        corners = np.vstack([self.upper.outline, self.lower.outline])
        (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
        return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


class Outline(NamedTuple):
    """Columns and rows of the panorama; NaN for a top or foot that is not found. `cut`: which of
    "left", "right", "top", "foot" is the frame's border.
    """

    left: float
    right: float
    top: float
    mid: float
    foot: float
    cut: frozenset[str]


def candidates(blobs: Sequence[Blob]) -> list[Candidate]:
    """All pairs of touching blobs of two colours that might be the bands of a cylinder."""
    return [
        Candidate(upper, lower)
        for upper, lower in itertools.permutations(blobs, 2)
        if upper.colour != lower.colour and _stacked(upper, lower)
    ]


def _stacked(upper: Blob, lower: Blob) -> bool:
    heights = sorted((upper.height, lower.height))
    gap = lower.top - upper.bottom
    if not -OVERLAP_SHARE * heights[0] < gap < GAP_PX + GAP_SHARE * heights[0]:
        return False
    widths = sorted((upper.width, lower.width))
    overlap = min(upper.right, lower.right) - max(upper.left, lower.left)
    return (
        overlap >= LEAST_OVERLAP * widths[0]
        and widths[1] <= WIDER * widths[0] + SLACK_PX
        and heights[1] <= HIGHER * heights[0] + SLACK_PX
    )


def outlined(pixels: Pixels, panorama: Panorama, candidate: Candidate) -> list[Outline]:
    """What the outline of a candidate may be; empty if it has no sides, or no line between its
    bands. If its bands do not end one above the other, each of them may be the one that is whole.
    """
    upper, lower = candidate
    mid = 0.5 * (upper.bottom + lower.top)
    left, right = 0.5 * (upper.left + lower.left), 0.5 * (upper.right + lower.right)
    margin = _reach(right - left) + REST_PX
    box = panorama.clipped(left - margin, upper.top - margin, right + margin, lower.bottom + margin)
    patch = panorama.cut(pixels, box)
    if min(patch.shape[:2]) < LEAST_PATCH_PX:
        return []
    middle, quarter = 0.5 * (left + right) - box.left, 0.25 * (right - left)
    rows = Profile(_mean(patch, middle - quarter, middle + quarter, axis=1), box.top)
    mid = _edge(rows, mid, 0.5 * min(upper.height, lower.height))
    if math.isnan(mid):
        return []
    top, foot = _ends(rows, upper.top, mid, lower.bottom)
    sides = []
    for start, end in ((upper.top, mid), (mid, lower.bottom)):
        inset = INSET * (end - start)
        part = _mean(patch, start + inset - box.top, end - inset - box.top, axis=0)
        columns = Profile(part, box.left)
        sides.append((_edge(columns, left, right - left), _edge(columns, right, right - left)))
    found = (
        Outline(left, right, top, mid, foot, frozenset())
        for left, right in _choices(sides[0], sides[1])
        if right - left >= LEAST_WIDTH
    )
    return [outline._replace(cut=frozenset(_cut(panorama, outline))) for outline in found]


Sides = tuple[float, float]


def _choices(upper: Sides, lower: Sides) -> Sequence[Sides]:
    """The sides of both bands: their mean, if they are one above the other; else either's."""
    apart = (abs(a - b) for a, b in zip(upper, lower, strict=True))
    if all(px <= APART_PX for px in apart):
        return [(0.5 * (upper[0] + lower[0]), 0.5 * (upper[1] + lower[1]))]
    return upper, lower


def _edge(line: Profile, guess: float, size: float) -> float:
    """The edge about there, of something so large; NaN if there is none."""
    return line.edge(guess, 0.45 * size, _reach(size))


def _ends(rows: Profile, top: float, mid: float, foot: float) -> tuple[float, float]:
    """Top and foot. A band that is much higher than the other may go on in something of the same
    colour, such as its own reflection: its end is first looked for where it ought to be."""
    above, below = mid - top, foot - mid
    if above > UNEVEN * below + SLACK_PX:
        nearer = _edge(rows, mid - below, below)
        top = _edge(rows, top, above) if math.isnan(nearer) else nearer
        return top, _edge(rows, foot, below)
    if below > UNEVEN * above + SLACK_PX:
        nearer = _edge(rows, mid + above, above)
        foot = _edge(rows, foot, below) if math.isnan(nearer) else nearer
        return _edge(rows, top, above), foot
    return _edge(rows, top, above), _edge(rows, foot, below)


def _cut(panorama: Panorama, outline: "Outline") -> Iterator[str]:
    """Which edges are the frame's border, or beyond it."""
    left, right, top, mid, foot = outline[:5]
    middle = 0.5 * (left + right)
    places = {
        "left": ((left, 0.5 * (top + mid)), (left, 0.5 * (mid + foot))),
        "right": ((right, 0.5 * (top + mid)), (right, 0.5 * (mid + foot))),
        "top": ((middle, top),),
        "foot": ((middle, foot),),
    }
    for name, points in places.items():
        if any(panorama.at_border(column, row, BORDER_PX) for column, row in points):
            yield name


def _reach(size: float) -> float:
    """How far the edge of something so large may be from where its colour ends."""
    return _between(0.25 * size, 2.5, 8.0)


def _mean(patch: Pixels, start: float, end: float, axis: int) -> Floats:
    """The mean colours (n, 3) of the rows (axis 0) or columns (axis 1) from start to end."""
    size = patch.shape[axis]
    first = int(_between(math.ceil(start), 0, size - 1))
    last = int(_between(math.floor(end), first, size - 1)) + 1
    part = patch[first:last] if axis == 0 else patch[:, first:last]
    mean = cv2.reduce(part, axis, cv2.REDUCE_AVG, dtype=cv2.CV_64F)
    return mean.reshape(-1, 3).astype(np.float64, copy=False)


def _between(value: float, least: float, most: float) -> float:
    return min(max(value, least), most)
