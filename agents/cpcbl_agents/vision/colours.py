"""Blobs of one colour in a frame, by the thresholds of the team file."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_agents.vision.panorama import Panorama
from cpcbl_team.config import Colour

MOST_BLOBS = 30  # of a colour; the largest
LEAST_PX = 2  # high and wide
STRAY = 0.04  # share of an outline that may stick out


class Blob(NamedTuple):
    """A patch of one colour; its extent is in columns and rows of the panorama."""

    colour: str
    left: float
    top: float
    right: float
    bottom: float
    outline: Floats
    """Corners (4, 2) of the box around it in the frame, in pixels."""

    @property
    def width(self) -> float:
        return self.right - self.left

    @property
    def height(self) -> float:
        return self.bottom - self.top


class Colours:
    """Finds blobs of those colours that are looked for."""

    def __init__(self, colours: dict[str, Colour], used: Iterable[str]) -> None:
        self._bounds = {name: tuple(_bounds(colours[name])) for name in sorted(set(used))}

    def blobs(self, pixels: Pixels, panorama: Panorama) -> list[Blob]:
        hsv = cv2.cvtColor(pixels, cv2.COLOR_BGR2HSV)
        return [
            _blob(name, outline, panorama)
            for name, bounds in self._bounds.items()
            for outline in _outlines(hsv, bounds)
        ]


Bounds = tuple[tuple[tuple[int, int, int], tuple[int, int, int]], ...]


def _bounds(colour: Colour) -> Iterator[tuple[tuple[int, int, int], tuple[int, int, int]]]:
    """(from, to) in HSV; two of them for a colour whose hue goes through red."""
    (first, last), (dull, bright), (dark, light) = colour.hue, colour.saturation, colour.value
    parts = [(first, last)] if first <= last else [(first, 179), (0, last)]
    for start, end in parts:
        yield (start, dull, dark), (end, bright, light)


def _outlines(hsv: cv2.typing.MatLike, bounds: Bounds) -> list[cv2.typing.MatLike]:
    """The outer contours of a colour's blobs, the largest of them."""
    mask = cv2.inRange(hsv, *bounds[0])
    for more in bounds[1:]:
        mask = cv2.bitwise_or(mask, cv2.inRange(hsv, *more))
    found, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    long = [outline for outline in found if len(outline) >= 2 * LEAST_PX]
    if len(long) > MOST_BLOBS:
        long = sorted(long, key=len)[-MOST_BLOBS:]
    return [outline for outline in long if min(cv2.boundingRect(outline)[2:]) >= LEAST_PX]


def _blob(colour: str, outline: cv2.typing.MatLike, panorama: Panorama) -> Blob:
    x, y = outline[:, 0, 0], outline[:, 0, 1]
    columns, rows = np.sort(panorama.columns[y, x]), np.sort(panorama.rows[y, x])
    stray = int(STRAY * len(x))
    left, top, width, height = cv2.boundingRect(outline)
    right, bottom = left + width - 1, top + height - 1
    return Blob(
        colour,
        float(columns[stray]) - 0.5,
        float(rows[stray]) - 0.5,
        float(columns[-1 - stray]) + 0.5,
        float(rows[-1 - stray]) + 0.5,
        np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=np.float64),
    )
