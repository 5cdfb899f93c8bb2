"""Edges to a part of a pixel."""

import math

import numpy as np
import pytest

from cpcbl_agents.vision.camera import Floats
from cpcbl_agents.vision.outlines import Profile, _possible_sides

WALL, RED = np.array([140.0, 142.0, 138.0]), np.array([40.0, 35.0, 205.0])


def line(
    at: float, blur: float, light: float = 1.0, before: Floats = WALL, behind: Floats = RED
) -> Floats:
    """Two colours that meet at a place, blurred: (40, 3)."""
    fine = np.arange(-0.5, 39.5, 0.01) + 0.005
    share = 0.5 * (1.0 + np.vectorize(math.erf)((fine - at) / (blur * math.sqrt(2.0))))
    pixels = share.reshape(40, 100).mean(axis=1)[:, None]
    both: Floats = light * (before + pixels * (behind - before))
    return both


@pytest.mark.parametrize("at", [15.0, 15.25, 15.5, 15.8])
@pytest.mark.parametrize("blur", [0.01, 0.6, 1.2])
@pytest.mark.parametrize("light", [1.0, 0.3])
def test_neither_blur_nor_dim_light_moves_an_edge(at: float, blur: float, light: float) -> None:
    found = Profile(line(at, blur, light), start=100.0).edge(100.0 + at + 1.3, 4.0, 4.0)
    assert found == pytest.approx(100.0 + at, abs=0.13)  # worst where nothing is blurred


def test_either_direction() -> None:
    found = Profile(line(20.3, 0.6, before=RED, behind=WALL), 0.0).edge(19.0, 4.0, 4.0)
    assert found == pytest.approx(20.3, abs=0.06)


@pytest.mark.parametrize("guess", [8.0, 30.0, -20.0, 80.0])
def test_there_is_no_edge(guess: float) -> None:
    assert math.isnan(Profile(line(20.0, 0.6), 0.0).edge(guess, 4.0, 3.0))


@pytest.mark.parametrize("at", [19.0, 20.4])
@pytest.mark.parametrize("shadow_px", [-2.5, -1.5, 1.5, 2.5])
def test_a_shadow_line_beside_an_edge_is_no_edge(at: float, shadow_px: float) -> None:
    light = 1.0 - 0.65 * (line(at + shadow_px, 0.5)[:, :1] - 140.0) / (40.0 - 140.0)
    found = Profile(light * line(at, 0.5), 0.0, in_shadow=True).edge(at, 3.0, 4.0)
    assert found == pytest.approx(at, abs=0.4)


def test_in_shadow_an_edge_of_brightness_alone_is_still_one() -> None:
    found = Profile(line(20.3, 0.6, behind=0.4 * WALL), 0.0, in_shadow=True).edge(19.0, 4.0, 4.0)
    assert found == pytest.approx(20.3, abs=0.06)


def test_faint_change_is_no_edge() -> None:
    faint = line(20.0, 0.6, before=WALL, behind=WALL + 3.0)
    assert math.isnan(Profile(faint, 0.0).edge(20.0, 4.0, 4.0))


def test_the_nearest_of_two_edges() -> None:
    two = np.where(
        np.arange(40)[:, None] < 17, line(14.0, 0.5), line(20.0, 0.5, before=RED, behind=WALL)
    )
    assert Profile(two, 0.0).edge(14.8, 2.5, 2.5) == pytest.approx(14.0, abs=0.1)
    assert Profile(two, 0.0).edge(19.2, 2.5, 2.5) == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize(
    ("lower", "is_one"),
    [
        ((13.0, 33.0), True),  # shifted alike, by a camera that leans
        ((11.0, 31.0), True),
        ((13.0, 30.0), False),  # one side only: something is in front of it
        ((17.0, 37.0), False),  # farther than any camera leans
    ],
)
def test_bands_that_are_shifted_alike_have_one_pair_of_sides(
    lower: tuple[float, float], is_one: bool
) -> None:
    found = _possible_sides((10.0, 30.0), lower, leaning=2.0)
    assert (len(found) == 1) == is_one
