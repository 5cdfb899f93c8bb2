"""What is drawn into a frame, and where."""

import itertools
import math

import numpy as np
import pytest
from support.cameras import picture

from cpcbl_agents.vision.annotate import (
    AMBIGUOUS_BGR,
    DETECTED_BGR,
    annotate,
    place_labels,
    sighting_lines,
)
from cpcbl_agents.vision.camera import Box, Floats
from cpcbl_agents.vision.detections import Ambiguity, Detection, Detections
from cpcbl_team.inputs import Sighting

SIZE = (640, 480)
OAK = Sighting("oak", 2.034, math.radians(12.04), 0.031, math.radians(0.3))
MATE = Sighting("mate", 1.2, -0.6, 0.02, 0.005, math.radians(-120.0), math.radians(3.0))


def box(left: float, top: float, right: float, bottom: float) -> Floats:
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


HERE, THERE = box(200, 100, 240, 260), box(400, 220, 450, 250)
SEEN = Detections((Detection(OAK, HERE),), (Ambiguity("ambiguous", ("r2", "r3"), THERE),))


@pytest.mark.parametrize(
    ("sighting", "lines"),
    [
        (OAK, ["oak", "2.03 +-0.03 m", "12.0 +-0.3 deg"]),
        (MATE, ["mate", "1.20 +-0.02 m", "-34.4 +-0.3 deg", "looks -120.0 +-3.0 deg"]),
        (Sighting("elm", None, 0.1), ["elm", "5.7 deg"]),
        (Sighting("ash", 3.0), ["ash", "3.00 m"]),
    ],
    ids=lambda part: getattr(part, "id", ""),
)
def test_a_label_says_what_the_sighting_says(sighting: Sighting, lines: list[str]) -> None:
    assert sighting_lines(sighting) == lines


def test_what_was_found_and_what_was_not_reported_are_labelled() -> None:
    found, ambiguity = place_labels(SEEN, SIZE)
    assert (found.lines, found.colour) == (tuple(sighting_lines(OAK)), DETECTED_BGR)
    assert (ambiguity.lines, ambiguity.colour) == (("ambiguous", "r2 or r3"), AMBIGUOUS_BGR)


def inside(one: Box) -> bool:
    return 0 <= one.left < one.right <= SIZE[0] and 0 <= one.top < one.bottom <= SIZE[1]


def test_labels_are_inside_and_apart_wherever_things_are() -> None:
    places = [box(x, y, x + 30, y + 60) for x in (-20, 300, 630) for y in (-40, 210, 215, 470)]
    shown = Detections(tuple(Detection(MATE, place) for place in places))
    boxes = [label.box for label in place_labels(shown, SIZE)]
    assert all(map(inside, boxes))
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_without_room_labels_are_still_inside() -> None:
    crowd = Detections(tuple(Detection(MATE, HERE) for _ in range(40)))
    assert all(inside(label.box) for label in place_labels(crowd, SIZE))


def test_only_outlines_and_labels_are_drawn() -> None:
    before = picture(5, SIZE)
    kept = before.copy()
    after = annotate(before, SEEN)
    assert (before == kept).all()
    changed = (after != before).any(axis=2)
    allowed = np.zeros_like(changed)
    for left, top, right, bottom in (label.box for label in place_labels(SEEN, SIZE)):
        allowed[top:bottom, left:right] = True
    for place, colour in ((HERE, DETECTED_BGR), (THERE, AMBIGUOUS_BGR)):
        (left, top), (right, bottom) = place[0].astype(int), place[2].astype(int)
        assert np.abs(after[top + 3 : bottom - 2, left].astype(int) - colour).max() < 30
        allowed[top - 4 : bottom + 5, left - 4 : right + 5] = True
    assert changed[~allowed].sum() == 0
    assert (after[155:250, 205:235] == before[155:250, 205:235]).all()  # what is seen stays so


@pytest.mark.parametrize(
    "outline",
    [np.full((4, 2), np.nan), np.empty((0, 2)), box(-1e9, -1e9, 1e9, 1e9), box(9e3, 0, 1e4, 9)],
    ids=["nowhere", "empty", "endless", "beside the frame"],
)
def test_an_outline_may_be_anywhere(outline: Floats) -> None:
    shown = annotate(picture(5, SIZE), Detections((Detection(OAK, outline),)))
    assert (shown != picture(5, SIZE)).any()


@pytest.mark.parametrize("size", [(16, 16), (64, 48), (1920, 1080)], ids=str)
def test_frames_of_any_size_are_drawn_into(size: tuple[int, int]) -> None:
    assert annotate(picture(5, size), SEEN).shape == (size[1], size[0], 3)


def test_nothing_found_leaves_the_frame_as_it_is() -> None:
    assert (annotate(picture(5, SIZE), Detections()) == picture(5, SIZE)).all()
