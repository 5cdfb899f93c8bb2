"""Pairs of blobs that may be the two bands of a cylinder, and its outline to sub-pixels.

An edge lies halfway between the colours of its two sides. Neither dim light nor blur moves that
place, as they would move the place where a threshold is crossed.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Panorama, Pixels
from cpcbl_agents.vision.colours import ColourBlob
from cpcbl_agents.vision.cylinder_fit import FOOT, TOP, WIDTH
from cpcbl_team.config import Bands

MOST_CANDIDATES = 32
GAP_PX, GAP_SHARE = 2.5, 0.15  # between the bands, of the lower height
OVERLAP_SHARE = 1.0  # with something of its colour beside it, a blob goes farther up or down
LEAST_OVERLAP = 0.5  # of the narrower band
SLACK_PX = 2.0
WIDER, HIGHER = 3.0, 4.0  # one band than the other, at most
UNEVEN = 1.4  # then the end of the higher band is looked for where the other band says it is
BORDER_PX = 1.5  # an edge so near to the frame's border is cut
REST_PX = 7.0  # around the farthest edge
LEAST_PATCH_PX = 3
LEAST_WIDTH = 1.0
INSET = 0.2  # of a band, above and below the rows that tell its sides
APART_PX = 1.5  # the sides of two bands
LEAN = 0.05  # of an upright line in the panorama: a roll of 3 deg that the settings do not state
LEAST_CONTRAST = 10.0  # grey levels, over the three channels
NEAREST_PX, FARTHEST_PX = 1.5, 3.0  # from an edge: where the colour of its side is taken
LEAST_SINE = 0.3  # of the angle between two colours that differ in more than brightness
LEAST_LIGHT = 0.01  # in a shadow, over that at the edge
ROUNDS = 4  # until an edge is found
SETTLED_PX = 0.1


class Candidate(NamedTuple):
    """An upper blob and a lower one."""

    upper: ColourBlob
    lower: ColourBlob

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
    """The outline in columns and rows of the panorama.

    `hidden`: which of `TOP`, `FOOT`, `WIDTH` are not at an edge of the cylinder but at the border
    of the frame (`cut`) or at the end of its colour. `unsure`: where the colour continues
    beyond the edge, as in a reflection.
    """

    left: float
    right: float
    top: float
    mid: float
    foot: float
    hidden: frozenset[int] = frozenset()
    cut: bool = False
    unsure: frozenset[int] = frozenset()


class Profile:
    """Colours (n, 3) along a line, the first one at `start`, the next a step farther on.

    `in_shadow`: an edge is where colours change in more than brightness, if they do.
    """

    def __init__(self, colours: Floats, start: float, in_shadow: bool = False) -> None:
        self._colours, self._start, self._in_shadow = colours, start, in_shadow
        self._sums = np.zeros((len(colours) + 1, 3))
        np.cumsum(colours, axis=0, out=self._sums[1:])

    def edge(self, guess: float, farthest: float, reach: float) -> float:
        """The edge near `guess`, within `reach`; NaN if there is none. The colour of either side is
        taken no farther from the edge than `farthest`."""
        first = at = guess - self._start
        farthest = min(max(farthest, NEAREST_PX), FARTHEST_PX)
        for _ in range(ROUNDS):
            last, at = at, self._crossing(at, farthest, reach)
            if not abs(at - first) <= reach:  # NaN too
                return math.nan
            if abs(at - last) < SETTLED_PX:
                break
        return at + self._start

    def _crossing(self, at: float, farthest: float, reach: float) -> float:
        """The place nearest to `at` where it is halfway between its colours at both sides."""
        before = self._mean(at - farthest, at - NEAREST_PX)
        behind = self._mean(at + NEAREST_PX, at + farthest)
        way = behind - before
        contrast = float(way @ way)
        if not contrast >= LEAST_CONTRAST**2:  # NaN too
            return math.nan
        first = max(0, int(at - reach - 1.0))
        part = self._colours[first : int(at + reach + 3.0)]
        share = _share_in_any_light if self._in_shadow else _share
        shares = share(part, before, behind).tolist()
        steps = enumerate(itertools.pairwise(shares), start=first)
        places = [i + (0.5 - a) / (b - a) for i, (a, b) in steps if a < 0.5 <= b]
        return min(places, key=lambda place: abs(place - at), default=math.nan)

    def _mean(self, start: float, end: float) -> Floats:
        """The mean colour of the samples between two places, at least one; NaN beyond the ends."""
        first, last = max(round(start), 0), min(round(end) + 1, len(self._colours))
        if last <= first:
            return np.full(3, math.nan)
        return np.asarray((self._sums[last] - self._sums[first]) / (last - first))


class Patch(NamedTuple):
    """A part of the panorama, (rows, columns, 3), and where it begins.

    `in_shadow`: as in `Profile`.
    """

    pixels: Pixels
    left: int
    top: int
    in_shadow: bool = False

    def region(self, left: float, right: float, top: float, bottom: float) -> Pixels:
        """The pixels between these columns and rows; at least one."""
        return self.pixels[self._rows(top, bottom), self._columns(left, right)]

    def vertical_profile(self, left: float, right: float) -> Profile:
        """The mean of the columns between these, row by row."""
        columns = self.pixels[:, self._columns(left, right)]
        return Profile(_mean(columns, 1), self.top, self.in_shadow)

    def horizontal_profile(self, top: float, bottom: float) -> Profile:
        """The mean of the rows between these, column by column."""
        rows = self.pixels[self._rows(top, bottom)]
        return Profile(_mean(rows, 0), self.left, self.in_shadow)

    def _rows(self, top: float, bottom: float) -> slice:
        return _from_to(top - self.top, bottom - self.top, self.pixels.shape[0])

    def _columns(self, left: float, right: float) -> slice:
        return _from_to(left - self.left, right - self.left, self.pixels.shape[1])


def candidates(blobs: Sequence[ColourBlob]) -> list[Candidate]:
    """The pairs of touching blobs of two colours that may be the bands of a cylinder. Only the
    highest are used if there are very many, which bounds the time for a picture."""
    pairs = [
        Candidate(upper, lower)
        for upper, lower in itertools.permutations(blobs, 2)
        if upper.colour != lower.colour and _is_stacked(upper, lower)
    ]
    return sorted(pairs, key=lambda pair: -pair.height)[:MOST_CANDIDATES]


def _is_stacked(upper: ColourBlob, lower: ColourBlob) -> bool:
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


def panorama_patch(pixels: Pixels, panorama: Panorama, candidate: Candidate) -> Patch | None:
    """The panorama around a candidate; None if it is too small."""
    upper, lower = candidate
    left, right = min(upper.left, lower.left), max(upper.right, lower.right)
    margin = _search_range(right - left) + REST_PX
    top, bottom = upper.top - margin, lower.bottom + margin
    box = panorama.clip_box(left - margin, top, right + margin, bottom)
    if min(box.size) < LEAST_PATCH_PX:
        return None
    return Patch(panorama.crop(pixels, box), box.left, box.top)


def possible_outlines(patch: Patch, panorama: Panorama, candidate: Candidate) -> list[Outline]:
    """The possible outlines of a candidate; empty if there is no edge between its bands.

    A blob may continue in an object of its colour beside or behind it. If the sides of the two
    bands are not one above the other, either may be the true one.
    """
    upper, lower = candidate
    left, right = max(upper.left, lower.left), min(upper.right, lower.right)
    middle, quarter = 0.5 * (left + right), 0.25 * (right - left)
    rows = patch.vertical_profile(middle - quarter, middle + quarter)
    mid = _band_boundary(rows, upper, lower)
    if not upper.top < mid < lower.bottom:  # NaN too
        return []
    top, foot = _top_and_foot(rows, upper.top, mid, lower.bottom)
    inset = INSET * min(mid - upper.top, lower.bottom - mid)
    upper_columns = patch.horizontal_profile(upper.top + inset, mid - inset)
    lower_columns = patch.horizontal_profile(mid + inset, lower.bottom - inset)
    leaning = LEAN * 0.5 * (lower.bottom - upper.top)
    found = _possible_sides(_sides(upper_columns, upper), _sides(lower_columns, lower), leaning)
    missing = {TOP: math.isnan(top), FOOT: math.isnan(foot), WIDTH: not found}
    hidden = frozenset(part for part, is_missing in missing.items() if is_missing)
    found = found or [(min(upper.left, lower.left), max(upper.right, lower.right))]
    top = upper.top if TOP in hidden else top
    foot = lower.bottom if FOOT in hidden else foot
    beyond = GAP_PX + GAP_SHARE * min(mid - top, foot - mid)
    goes_on = {TOP: top - upper.top > beyond, FOOT: lower.bottom - foot > beyond}
    unsure = frozenset(part for part, does_go_on in goes_on.items() if does_go_on)
    outlines = (Outline(*sides, top, mid, foot, hidden, unsure=unsure) for sides in found)
    return [_with_frame_cuts(panorama, outline) for outline in outlines]


Sides = tuple[float, float]


def _sides(columns: Profile, band: ColourBlob) -> Sides:
    return _edge(columns, band.left, band.width), _edge(columns, band.right, band.width)


def _possible_sides(upper: Sides, lower: Sides, leaning: float) -> list[Sides]:
    """The mean sides of both bands if they are one above the other, else all combinations.

    The bands of a camera that leans are shifted against each other, both sides alike.
    """
    left, right = (b - a for a, b in zip(upper, lower, strict=True))
    leans = abs(right - left) <= APART_PX and 0.5 * abs(left + right) <= APART_PX + leaning
    if leans or (abs(left) <= APART_PX and abs(right) <= APART_PX):  # NaN is neither
        return [(0.5 * (upper[0] + lower[0]), 0.5 * (upper[1] + lower[1]))]
    pairs = itertools.product((upper[0], lower[0]), (upper[1], lower[1]))
    return [(left, right) for left, right in pairs if right - left >= LEAST_WIDTH]


def _edge(line: Profile, guess: float, size: float) -> float:
    """The edge near `guess` of a part of this size; NaN if there is none."""
    return line.edge(guess, 0.45 * size, _search_range(size))


def _band_boundary(rows: Profile, upper: ColourBlob, lower: ColourBlob) -> float:
    """The edge between the bands, near the end of either blob; NaN if there is none."""
    size = 0.5 * min(upper.height, lower.height)
    guesses = lower.top, upper.bottom
    if abs(lower.top - upper.bottom) <= GAP_PX:
        guesses = 0.5 * (lower.top + upper.bottom), lower.top
    found = _edge(rows, guesses[0], size)
    return _edge(rows, guesses[1], size) if math.isnan(found) else found


def _top_and_foot(rows: Profile, top: float, mid: float, foot: float) -> tuple[float, float]:
    """Top and foot. A band that is much higher than the other may continue in an object of the same
    colour, such as its reflection, so its end is first searched at the expected place."""
    above, below = mid - top, foot - mid
    tops, feet = (top, mid - below), (foot, mid + above)
    if above > UNEVEN * below + SLACK_PX:
        tops = tops[::-1]
    if below > UNEVEN * above + SLACK_PX:
        feet = feet[::-1]
    size = min(above, below)
    first, second = (
        next((found for guess in guesses if (found := _edge(rows, guess, size)) == found), math.nan)
        for guesses in (tops, feet)
    )
    return first, second


def _with_frame_cuts(panorama: Panorama, outline: Outline) -> Outline:
    """The outline with those edges marked as hidden that are at the border of the frame."""
    left, right, top, mid, foot, hidden, *_ = outline
    middle, rows = 0.5 * (left + right), (0.5 * (top + mid), 0.5 * (mid + foot))
    sides = [(WIDTH, column, row) for column in (left, right) for row in rows]
    edges = [(TOP, middle, top), (FOOT, middle, foot), *sides]
    cut = {part for part, x, y in edges if panorama.is_at_border(x, y, BORDER_PX)}
    return outline._replace(hidden=hidden | cut, cut=bool(cut))


def _search_range(size: float) -> float:
    """How far (px) an edge may be from the end of the colour of a part of this size."""
    return min(max(0.25 * size, 2.5), 8.0)


def _share(colours: Floats, before: Floats, behind: Floats) -> Floats:
    """How far colours (n, 3) are on the way from the one before an edge to the one behind it."""
    way = behind - before
    return np.asarray((colours - before) @ way / (way @ way))


def _share_in_any_light(colours: Floats, before: Floats, behind: Floats) -> Floats:
    """The same where a shadow line is near, which changes how bright both colours are, but not
    what they are: each of the colours (n, 3) is b times the one before and d times the one behind
    (least squares), and the share is d / (b + d)."""
    aa, bb, ab = float(before @ before), float(behind @ behind), float(before @ behind)
    determinant = aa * bb - ab * ab
    if determinant <= LEAST_SINE**2 * aa * bb:  # or one of them is black
        return _share(colours, before, behind)
    first, second = colours @ before, colours @ behind
    b, d = bb * first - ab * second, aa * second - ab * first
    return np.asarray(d / np.maximum(b + d, LEAST_LIGHT * determinant))


def _from_to(start: float, end: float, size: int) -> slice:
    """The whole numbers between two places, one at least, of those below `size`."""
    first = min(max(math.ceil(start), 0), size - 1)
    return slice(first, min(max(math.floor(end), first), size - 1) + 1)


def _mean(pixels: Pixels, axis: int) -> Floats:
    mean = cv2.reduce(pixels, axis, cv2.REDUCE_AVG, dtype=cv2.CV_64F)
    return mean.reshape(-1, 3).astype(np.float64, copy=False)
