"""Dark quadrilaterals: where they are, and which contours are looked at where there are many."""

import cv2
import numpy as np
import pytest

from cpcbl_agents.vision.camera import Floats, Pixels
from cpcbl_agents.vision.quads import MOST_CONTOURS, dark_quads

SUPER = 8  # samples of a pixel, along a side


def nearest(quads: Floats, corners: Floats) -> float:
    """The largest error of a corner, px, of the quad that is nearest to corners (4, 2)."""
    turned = np.array([np.roll(corners, turn, axis=0) for turn in range(4)])
    return float(np.abs(quads[:, None] - turned).max(axis=(2, 3)).min())


def drawn(corners: Floats, paper: Pixels, width: float = 0.2) -> Pixels:
    """A dark frame with corners (4, 2) on white, drawn into a picture; its width is a share of its
    sides."""
    middle = corners.mean(axis=0)
    fine = np.kron(paper, np.ones((SUPER, SUPER), np.uint8))
    for scale, level in ((1.6, 220), (1.0, 30), (1.0 - 2.0 * width, 220)):
        shape = (middle + scale * (corners - middle) + 0.5) * SUPER - 0.5
        cv2.fillConvexPoly(fine, np.round(shape).astype(np.int32), (level,))
    small = cv2.resize(fine, paper.shape[::-1], interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 0.5).astype(np.uint8)


def narrow(random: np.random.Generator, low: float, high: float) -> Floats:
    """A quadrilateral as a marker that is seen from the side: corners (4, 2), px."""
    width, height = random.uniform(low, high), random.uniform(high, 2.0 * high)
    left, right = 0.5 * height * random.uniform(0.85, 1.0, 2)
    middle = np.array([60.0, 60.0]) + random.uniform(0.0, 1.0, 2)
    sides = [[-width / 2, -left], [width / 2, -right], [width / 2, right], [-width / 2, left]]
    return np.asarray(middle + np.array(sides))


@pytest.mark.parametrize(("low", "high", "most"), [(9.0, 14.0, 2.0), (20.0, 40.0, 2.0)])
def test_corners_are_exact_enough_to_find_the_sides(low: float, high: float, most: float) -> None:
    """A side is looked for within 1.6 pixels or more."""
    random, errors = np.random.default_rng(1), []
    for _ in range(60):
        corners = narrow(random, low, high)
        paper = np.full((120, 120), 120, np.uint8)
        errors.append(nearest(dark_quads(drawn(corners, paper)).corners, corners))
    assert np.mean(errors) < 0.5 * most
    assert np.max(errors) < most


def test_a_frame_that_is_not_closed_has_the_same_corners() -> None:
    corners = np.array([[40.0, 40.0], [80.0, 42.0], [79.0, 83.0], [39.0, 80.0]])
    pixels = drawn(corners, np.full((120, 120), 120, np.uint8))
    pixels[56:64, 30:60] = 220
    assert nearest(dark_quads(pixels).corners, corners) < 2.0


def test_a_large_marker_is_looked_at_first_though_its_middle_is_plain() -> None:
    """Ranked by the contrast in its middle, it came after all of a tiled floor and was dropped."""
    tile = np.pad(np.full((7, 7), 60, np.uint8), [(0, 5), (0, 5)], constant_values=150)
    paper = np.tile(tile, (40, 54))[:, :640]
    corners = np.array([[250.0, 150.0], [390.0, 152.0], [388.0, 290.0], [251.0, 288.0]])
    quads = dark_quads(drawn(corners, paper, width=0.15))
    assert quads.dropped > MOST_CONTOURS
    assert nearest(quads.corners[:1], corners) < 1.5


@pytest.mark.parametrize("level", [20.0, 60.0, 160.0])
def test_texture_is_left_out_and_a_marker_of_little_contrast_is_not(level: float) -> None:
    random = np.random.default_rng(3)
    texture = cv2.GaussianBlur(random.normal(size=(480, 640)), (0, 0), 1.0)
    texture *= 0.02 * level / texture.std()
    corners = np.array([[250.0, 150.0], [282.0, 152.0], [280.0, 190.0], [251.0, 188.0]])
    shades = drawn(corners, np.full((480, 640), 120, np.uint8)) / 220.0
    pixels = (level * shades + texture).clip(0, 255).astype(np.uint8)
    quads = dark_quads(pixels)
    assert nearest(quads.corners[:3], corners) < 1.5
    assert quads.dropped == 0
    assert len(quads.corners) < MOST_CONTOURS // 2


def test_nothing_dark_or_nothing_at_all_has_no_quads() -> None:
    for pixels in (np.zeros((48, 64), np.uint8), np.full((48, 64), 255, np.uint8)):
        assert dark_quads(pixels).corners.shape == (0, 4, 2)
    dot = np.full((48, 64), 200, np.uint8)
    dot[20:23, 20:23] = 20
    assert dark_quads(dot).corners.shape == (0, 4, 2)
