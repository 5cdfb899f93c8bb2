"""Draws into a frame what was found in it, and what was not reported, with the reason."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_agents.vision.detections import Doubt, Glimpses
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


class Label(NamedTuple):
    """What is written about something in a frame, and where."""

    lines: tuple[str, ...]
    colour: Colour
    box: Box


def annotated(pixels: Pixels, glimpses: Glimpses) -> Pixels:
    """A copy of a frame (height, width, 3) with outlines and labels."""
    drawn, scale = pixels.copy(), _scale(pixels.shape[1])
    for found in glimpses.found:
        _outline(drawn, found.outline, FOUND, scale)
    for doubt in glimpses.doubts:
        _outline(drawn, doubt.outline, DOUBTED, scale)
    for label in labels(glimpses, (pixels.shape[1], pixels.shape[0])):
        _write(drawn, label, scale)
    return drawn


def labels(glimpses: Glimpses, size_px: tuple[int, int]) -> list[Label]:
    """Beside what they are about, inside of a frame of this size (width, height), apart from each
    other as long as there is room."""
    said = [(f.outline, labelled(f.sighting), FOUND) for f in glimpses.found]
    said += [(d.outline, doubted(d), DOUBTED) for d in glimpses.doubts]
    placed: list[Label] = []
    for outline, lines, colour in said:
        box = _place(size_px, outline, lines, [label.box for label in placed])
        placed.append(Label(tuple(lines), colour, box))
    return placed


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
    size_px: tuple[int, int], outline: Floats, lines: Sequence[str], taken: Sequence[Box]
) -> Box:
    """Right of its outline or left of it, as high as it, or as near to that as there is room."""
    (width, height), scale = size_px, _scale(size_px[0])
    sizes = [cv2.getTextSize(text, FONT, TEXT_SCALE * scale, 1)[0][0] for text in lines]
    wide, high = max(sizes) + round(6 * scale), round((LINE_PX * len(lines) + 4) * scale)
    corners = _corners(outline)
    least, most = (corners.min(axis=0), corners.max(axis=0)) if len(corners) else ((0, 0), (0, 0))
    gap, last = round(4 * scale), max(width - wide, 0)
    beside = int(most[0]) + gap, int(least[0]) - gap - wide
    lefts = [left for left in beside if 0 <= left <= last] or [min(max(beside[1], 0), last)]
    top = min(max(int(least[1]), 0), max(height - high, 0))
    tops = sorted({top, *range(0, height - high + 1, LINE_PX)}, key=lambda y: abs(y - top))
    places = [Box(left, y, left + wide, y + high) for y in tops for left in lefts]
    free = (place for place in places if not any(place.meets(other) for other in taken))
    return next(free, places[0])


def _write(drawn: Pixels, label: Label, scale: float) -> None:
    """On dark paper, so that it can be read on anything."""
    box = label.box
    part = drawn[box.top : box.bottom, box.left : box.right]
    part[:] = part // 4 + np.array(PAPER, np.uint8) // 2
    for n, text in enumerate(label.lines, start=1):
        at = box.left + round(3 * scale), box.top + round((LINE_PX * n - BASELINE_PX + 2) * scale)
        cv2.putText(drawn, text, at, FONT, TEXT_SCALE * scale, label.colour, 1, cv2.LINE_AA)


def _scale(width_px: int) -> float:
    """Of text and lines in a picture of this width."""
    return max(1.0, width_px / PLAIN_WIDTH_PX)
