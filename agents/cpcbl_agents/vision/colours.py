"""Blobs of one colour in a frame, by the thresholds of the team file."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Panorama, Pixels
from cpcbl_team.config import Colour

BITS = 8  # colours that are told apart in one go
MAX_BLOBS = 16  # of a colour; the largest
MIN_PX = 2  # high and wide
LEAST_SHARE = 0.3  # of a patch: light and shade take some beyond the thresholds
MOST_OTHERS = 0.3  # of other colours, as a share of its own
STRAY = 0.04  # share of an outline that may stick out


class ColourBlob(NamedTuple):
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


class ColourSegmenter:
    """Segments a frame into blobs of the colours in use."""

    def __init__(self, colours: dict[str, Colour], used: Iterable[str]) -> None:
        names = sorted(set(used))
        groups = [names[i : i + BITS] for i in range(0, len(names), BITS)]
        self._groups = [(group, _lookup_table([colours[n] for n in group])) for group in groups]

    def blobs(self, pixels: Pixels, panorama: Panorama) -> list[ColourBlob]:
        """The blobs of all colours in a frame (height, width, 3), BGR."""
        hsv = cv2.cvtColor(pixels, cv2.COLOR_BGR2HSV)
        return [
            _colour_blob(name, outline, panorama)
            for names, table in self._groups
            for name, outline in _contours(_colour_bits(hsv, table), names)
        ]

    def has_clear_colour(self, pixels: Pixels, colour: str) -> bool:
        """Whether a patch (height, width, 3), BGR, is of this colour and of no other."""
        hsv = cv2.cvtColor(pixels, cv2.COLOR_BGR2HSV)
        own = others = 0
        for names, table in self._groups:
            bits = _colour_bits(hsv, table)
            if colour in names:
                of_colour = bits & np.uint8(1 << names.index(colour))
                own = cv2.countNonZero(of_colour)
                bits = bits ^ of_colour
            others += cv2.countNonZero(bits)
        return own > LEAST_SHARE * hsv.shape[0] * hsv.shape[1] and others <= MOST_OTHERS * own


def _lookup_table(colours: Sequence[Colour]) -> Pixels:
    """For each hue, saturation and value, (256, 1, 3), a bit for each colour that accepts it. A
    pixel has the colours whose bit is set for all three."""
    table = np.zeros((256, 1, 3), np.uint8)
    for bit, colour in enumerate(colours):
        first, last = colour.hue
        hues = [(first, last)] if first <= last else [(first, 179), (0, last)]
        for channel, ranges in enumerate((hues, [colour.saturation], [colour.value])):
            for low, high in ranges:
                table[low : high + 1, 0, channel] |= 1 << bit
    return table


def _colour_bits(hsv: cv2.typing.MatLike, table: Pixels) -> Pixels:
    """The bits of the colours of each pixel."""
    hue, saturation, value = cv2.split(cv2.LUT(hsv, table))
    both = cv2.bitwise_and(hue, saturation)
    return cv2.bitwise_and(both, value).astype(np.uint8, copy=False)


def _contours(bits: Pixels, names: Sequence[str]) -> Iterator[tuple[str, cv2.typing.MatLike]]:
    """The outer contours of each colour's blobs, the largest of them."""
    left, top, width, height = cv2.boundingRect(bits)
    if not width:
        return
    bits = bits[top : top + height, left : left + width]
    for bit, name in enumerate(names):
        mask, mode = np.bitwise_and(bits, np.uint8(1 << bit), dtype=np.uint8), cv2.RETR_EXTERNAL
        found, _ = cv2.findContours(mask, mode, cv2.CHAIN_APPROX_NONE, offset=(left, top))
        long = [outline for outline in found if len(outline) >= 2 * MIN_PX]
        if len(long) > MAX_BLOBS:
            long = sorted(long, key=len)[-MAX_BLOBS:]
        yield from ((name, o) for o in long if min(cv2.boundingRect(o)[2:]) >= MIN_PX)


def _colour_blob(colour: str, outline: cv2.typing.MatLike, panorama: Panorama) -> ColourBlob:
    x, y = outline[:, 0, 0], outline[:, 0, 1]
    columns, rows = np.sort(panorama.columns[y, x]), np.sort(panorama.rows[y, x])
    stray = int(STRAY * len(x))
    left, top, width, height = cv2.boundingRect(outline)
    right, bottom = left + width - 1, top + height - 1
    return ColourBlob(
        colour,
        float(columns[stray]) - 0.5,
        float(rows[stray]) - 0.5,
        float(columns[-1 - stray]) + 0.5,
        float(rows[-1 - stray]) + 0.5,
        np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=np.float64),
    )
