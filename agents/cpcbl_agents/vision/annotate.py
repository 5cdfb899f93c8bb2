"""Draws into a frame what was found in it, and what was not reported, with the reason."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_agents.vision.glimpses import Doubt, Glimpses
from cpcbl_team.inputs import Sighting

Colour = tuple[int, int, int]

FOUND: Colour = (80, 255, 80)  # BGR
DOUBTED: Colour = (60, 160, 255)
PAPER: Colour = (32, 32, 32)
FONT, TEXT_SCALE, LINE_PX, BASELINE_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.42, 15, 4
PLAIN_WIDTH_PX = 640  # at which text has that size
FARTHEST_PX = 10_000.0  # outlines may reach far beyond the picture


class Box(NamedTuple):
    """Left, top, right and bottom edges (px)."""

    left: int
    top: int
    right: int
    bottom: int

    def meets(self, other: "Box") -> bool:
        apart_x = self.right <= other.left or other.right <= self.left
        return not (apart_x or self.bottom <= other.top or other.bottom <= self.top)

    def moved(self, down: int) -> "Box":
        return self._replace(top=self.top + down, bottom=self.bottom + down)


def annotated(pixels: Pixels, glimpses: Glimpses) -> Pixels:
    """A copy of a frame (height, width, 3) with outlines and labels."""
    drawn = pixels.copy()
    scale = max(1.0, pixels.shape[1] / PLAIN_WIDTH_PX)
    marks = [(f.outline, labelled(f.sighting), FOUND) for f in glimpses.found]
    marks += [(d.outline, doubted(d), DOUBTED) for d in glimpses.doubts]
    for outline, _, colour in marks:
        _outline(drawn, outline, colour, scale)
    taken: list[Box] = []
    for outline, lines, colour in marks:
        box = _place(drawn, outline, lines, taken, scale)
        taken.append(box)
        _write(drawn, lines, box, colour, scale)
    return drawn


def labelled(sighting: Sighting) -> list[str]:
    """What a sighting says, in ASCII as OpenCV's fonts are: its id, then a number a line."""
    lines = [sighting.id]
    s = sighting
    if s.range_m is not None:
        lines.append(f"{s.range_m:.2f}{_spread(s.range_sigma_m, 2)} m")
    if s.bearing_rad is not None:
        lines.append(f"{_degrees(s.bearing_rad, s.bearing_sigma_rad)} deg")
    if s.heading_rad is not None:
        lines.append(f"looks {_degrees(s.heading_rad, s.heading_sigma_rad)} deg")
    return lines


def doubted(doubt: Doubt) -> list[str]:
    """Why something is not reported, and what it could be."""
    names = [" or ".join(doubt.names)] if doubt.names else []
    return [doubt.reason, *names]


def _degrees(angle: float, sigma: float | None) -> str:
    return f"{math.degrees(angle):.1f}{_spread(None if sigma is None else math.degrees(sigma), 1)}"


def _spread(sigma: float | None, digits: int) -> str:
    return "" if sigma is None else f" +-{sigma:.{digits}f}"


def _outline(drawn: Pixels, outline: Floats, colour: Colour, scale: float) -> None:
    corners = _corners(outline)
    if len(corners):
        thick = round(scale)
        cv2.polylines(drawn, [corners], True, PAPER, 3 * thick, cv2.LINE_AA)
        cv2.polylines(drawn, [corners], True, colour, thick, cv2.LINE_AA)


def _corners(outline: Floats) -> "np.typing.NDArray[np.int32]":
    """Whole pixels (n, 2), without corners that are nowhere."""
    there = outline[np.isfinite(outline).all(axis=1)]
    return np.clip(there, -FARTHEST_PX, FARTHEST_PX).round().astype(np.int32)


def _place(
    drawn: Pixels, outline: Floats, lines: Sequence[str], taken: Sequence[Box], scale: float
) -> Box:
    """Where a label goes: right of its outline or left of it, inside of the frame, below others."""
    height, width = drawn.shape[:2]
    sizes = [cv2.getTextSize(text, FONT, TEXT_SCALE * scale, 1)[0][0] for text in lines]
    wide, high = max(sizes) + round(6 * scale), round((LINE_PX * len(lines) + 4) * scale)
    corners = _corners(outline)
    least, most = (corners.min(axis=0), corners.max(axis=0)) if len(corners) else ((0, 0), (0, 0))
    gap = round(4 * scale)
    left = int(most[0]) + gap
    if left + wide > width:
        left = int(least[0]) - gap - wide
    left = min(max(left, 0), max(width - wide, 0))
    top = min(max(int(least[1]), 0), max(height - high, 0))
    box = Box(left, top, left + wide, top + high)
    places = [box.moved(step) for step in range(0, height - box.bottom + 1, LINE_PX)]
    places += [box.moved(-step) for step in range(LINE_PX, box.top + 1, LINE_PX)]
    free = (p for p in places if not any(p.meets(other) for other in taken))
    return next(free, box)


def _write(drawn: Pixels, lines: Sequence[str], box: Box, colour: Colour, scale: float) -> None:
    """On dark paper, so that it can be read on anything."""
    part = drawn[max(box.top, 0) : box.bottom, max(box.left, 0) : box.right]
    part[:] = part // 4 + np.array(PAPER, np.uint8) // 2
    for n, text in enumerate(lines, start=1):
        at = box.left + round(3 * scale), box.top + round((LINE_PX * n - BASELINE_PX + 2) * scale)
        cv2.putText(drawn, text, at, FONT, TEXT_SCALE * scale, colour, 1, cv2.LINE_AA)
