"""Landmarks in shadow and in poor light: what is ranged, and that nothing is wrong.

The bounds are below what `make bench-degraded ARGS='--landmarks 100'` measures by what 8 frames
leave to chance.
"""

from functools import cache

import numpy as np
import pytest
from benchmarks.degraded_frames import Pixels, textures
from benchmarks.landmark_frames import LIGHTS, LightKind, Lit
from benchmarks.shaded_landmarks import false_landmarks, printed, score_of, shaded_frames

from cpcbl_agents.vision import cylinders

FEW, MANY = 8, 16


@cache
def backgrounds() -> list[Pixels]:
    return textures(6, np.random.default_rng(3))


@cache
def frames_of(light: LightKind, count: int = FEW) -> list[tuple[str, Lit]]:
    return list(shaded_frames(light, count, backgrounds(), seed=4))


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.long)])
@pytest.mark.thorough
@pytest.mark.parametrize("light", LIGHTS)
def test_landmarks_in_any_light_are_ranged_and_none_is_wrong(light: LightKind, count: int) -> None:
    score = score_of(light, frames_of(light, count))
    assert score.wrong == 0
    assert score.ranged >= (0.7 if light in {"low light", "warm lamp"} else 0.8)
    for errors in (score.ranges, score.bearings):
        off, sigmas = np.abs(np.array(errors)).T
        assert (off < 4.0 * sigmas).all()
    assert printed([score]).row_count == 1


@pytest.mark.thorough
def test_edges_by_colour_alone_find_landmarks_that_a_shadow_line_crosses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = score_of("vertical edge", frames_of("vertical edge"))
    monkeypatch.setattr(cylinders, "_is_wide", lambda pair: False)
    without = score_of("vertical edge", frames_of("vertical edge"))
    assert found.ranged > without.ranged
    assert found.wrong == without.wrong == 0


@pytest.mark.thorough
def test_no_landmark_is_in_pictures_without_one() -> None:
    assert false_landmarks(textures(12, np.random.default_rng(4)), 16) == (0, 0)
