"""Draws detections into a frame, and rejected objects with the reason."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Box, Floats, Pixels
from cpcbl_agents.vision.detections import Detections
from cpcbl_team.inputs import Sighting

Colour = tuple[int, int, int]

DETECTED_BGR: Colour = (80, 255, 80)  # BGR
AMBIGUOUS_BGR: Colour = (60, 160, 255)
BACKGROUND_BGR: Colour = (32, 32, 32)
FONT, TEXT_SCALE, LINE_PX, BASELINE_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.42, 15, 4
REFERENCE_WIDTH_PX = 640  # at which text has that size
MAX_COORDINATE_PX = 10_000.0  # outlines may reach far beyond the picture


class Label(NamedTuple):
    """The text of a label, its place in the frame, and the outline (n, 2) of its object."""

    lines: tuple[str, ...]
    colour: Colour
    box: Box
    outline: Floats


def annotate(pixels: Pixels, detections: Detections) -> Pixels:
    """A copy of a frame (height, width, 3) with outlines and labels."""
    drawn, scale = pixels.copy(), _scale(pixels.shape[1])
    labels = place_labels(detections, (pixels.shape[1], pixels.shape[0]))
    for label in labels:
        _draw_outline(drawn, label.outline, label.colour, round(scale))
    for label in labels:
        _draw_label(drawn, label, scale)
    return drawn


def place_labels(detections: Detections, size_px: tuple[int, int]) -> list[Label]:
    """The labels beside their outlines, inside a frame of this size (width, height). They do not
    overlap as long as there is room."""
    texts = [(f.outline, sighting_lines(f.sighting), DETECTED_BGR) for f in detections.found]
    for a in detections.ambiguities:  # the reason, and the objects that it could be
        lines = [a.reason, " or ".join(a.names)] if a.names else [a.reason]
        texts.append((a.outline, lines, AMBIGUOUS_BGR))
    placed: list[Label] = []
    for outline, lines, colour in texts:
        box = _label_box(size_px, outline, lines, [label.box for label in placed])
        placed.append(Label(tuple(lines), colour, box, outline))
    return placed


def sighting_lines(sighting: Sighting) -> list[str]:
    """The lines of a label in ASCII, as OpenCV's fonts require: the id, then one value a line."""
    s, lines = sighting, [sighting.id]
    if s.range_m is not None:
        lines.append(f"{s.range_m:.2f}{_spread(s.range_sigma_m, 2)} m")
    if s.bearing_rad is not None:
        lines.append(f"{_degrees(s.bearing_rad, s.bearing_sigma_rad)} deg")
    if s.heading_rad is not None:
        lines.append(f"looks {_degrees(s.heading_rad, s.heading_sigma_rad)} deg")
    return lines


def _degrees(angle: float, sigma: float | None) -> str:
    return f"{math.degrees(angle):.1f}{_spread(None if sigma is None else math.degrees(sigma), 1)}"


def _spread(sigma: float | None, digits: int) -> str:
    return "" if sigma is None else f" +-{sigma:.{digits}f}"


def _draw_outline(drawn: Pixels, outline: Floats, colour: Colour, thick: int) -> None:
    corners = _corners(outline)
    if len(corners):
        cv2.polylines(drawn, [corners], True, BACKGROUND_BGR, 3 * thick, cv2.LINE_AA)
        cv2.polylines(drawn, [corners], True, colour, thick, cv2.LINE_AA)


def _corners(outline: Floats) -> "np.typing.NDArray[np.int32]":
    """Whole pixels (n, 2), without corners that are not finite."""
    there = outline[np.isfinite(outline).all(axis=1)]
    return np.clip(there, -MAX_COORDINATE_PX, MAX_COORDINATE_PX).round().astype(np.int32)


def _label_box(
    size_px: tuple[int, int], outline: Floats, lines: Sequence[str], taken: Sequence[Box]
) -> Box:
    """The box of a label: right or left of its outline, as near to its height as there is room."""
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
    free = (place for place in places if not any(place.overlaps(other) for other in taken))
    return next(free, places[0])


def _draw_label(drawn: Pixels, label: Label, scale: float) -> None:
    """Draws a label on a dark background, which makes it readable on anything."""
    part, box = drawn[label.box.slices], label.box
    part[:] = part // 4 + np.array(BACKGROUND_BGR, np.uint8) // 2
    for n, text in enumerate(label.lines, start=1):
        at = box.left + round(3 * scale), box.top + round((LINE_PX * n - BASELINE_PX + 2) * scale)
        cv2.putText(drawn, text, at, FONT, TEXT_SCALE * scale, label.colour, 1, cv2.LINE_AA)


def _scale(width_px: int) -> float:
    """The scale of text and lines in a picture of this width."""
    return max(1.0, width_px / REFERENCE_WIDTH_PX)
