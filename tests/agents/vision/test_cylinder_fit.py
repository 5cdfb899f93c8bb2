"""What may be a cylinder, what is good for a bearing only, and what is refused."""

import math

import numpy as np
import pytest

from cpcbl_agents.vision.cylinder_fit import Look, best, reason, verdict
from cpcbl_agents.vision.silhouette import FOOT, TOP, WIDTH, Shape, looks
from cpcbl_team.config import Cylinder

LENS_M = 0.2
LANDMARK = Shape.of(Cylinder(), LENS_M)
MAST = Shape.of(Cylinder(radius_m=0.04, height_m=0.16, foot_m=0.25), LENS_M, 0.12)
EDGE = 0.4 / 400.0


def look(
    shape: Shape,
    distance: float,
    *,
    cut: bool = False,
    hidden: frozenset[int] = frozenset(),
    **changed: float,
) -> Look:
    top, mid, foot, width = looks(shape, distance)
    seen = (
        changed.get("top", top),
        changed.get("mid", mid),
        changed.get("foot", foot),
        changed.get("width", width),
    )
    sigmas = (EDGE, EDGE, EDGE, EDGE / math.sqrt(2.0))
    return Look(0.0, seen, sigmas, math.radians(0.2), np.zeros((4, 2)), hidden, cut)


@pytest.mark.parametrize("distance", [0.4, 1.0, 3.0, 6.0])
def test_whole(distance: float) -> None:
    told = verdict(LANDMARK, look(LANDMARK, distance))
    assert told is not None
    assert told.hidden is None
    assert told.distance == pytest.approx(distance, rel=1e-6)


@pytest.mark.parametrize("distance", [1.0, 3.0])
def test_hidden_foot_and_hidden_top_leave_the_bearing(distance: float) -> None:
    foot = looks(LANDMARK, distance)[FOOT]
    no_foot, no_top = (
        look(LANDMARK, distance, foot=0.6 * foot),
        look(LANDMARK, distance, top=-0.6 * foot),
    )
    for part, hidden in ((no_foot, FOOT), (no_top, TOP)):
        told = verdict(LANDMARK, part)
        assert told is not None
        assert told.hidden == hidden
        assert told.distance == pytest.approx(distance, rel=0.1)


def test_hidden_side_leaves_a_rough_bearing() -> None:
    width = looks(LANDMARK, 2.0)[WIDTH]
    told = verdict(LANDMARK, look(LANDMARK, 2.0, width=0.5 * width))
    assert told is not None
    assert told.hidden == WIDTH
    assert told.half_width == pytest.approx(width, rel=1e-3)


def test_what_sticks_out_is_not_hidden() -> None:
    top, _, foot, width = looks(LANDMARK, 2.0)
    assert verdict(LANDMARK, look(LANDMARK, 2.0, foot=2.0 * foot)) is None
    assert verdict(LANDMARK, look(LANDMARK, 2.0, top=2.0 * top)) is None
    assert verdict(LANDMARK, look(LANDMARK, 2.0, width=2.0 * width)) is None


def test_two_hidden_edges_are_too_many() -> None:
    _, _, foot, width = looks(LANDMARK, 2.0)
    refused = look(LANDMARK, 2.0, foot=0.6 * foot, width=0.5 * width)
    assert verdict(LANDMARK, refused) is None
    assert reason(LANDMARK, LENS_M, refused) == "wrong_shape"
    cut = look(LANDMARK, 2.0, hidden=frozenset({FOOT, WIDTH}), cut=True)
    assert verdict(LANDMARK, cut) is None
    assert reason(LANDMARK, LENS_M, cut) == "cut_by_frame"


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0, 4.0])
def test_mirror_image(distance: float) -> None:
    beneath = Shape(LANDMARK.radius, 0.2, 0.4, 0.6)  # below the lens: from the floor downwards
    refused = look(beneath, distance)
    assert verdict(LANDMARK, refused, leniency=3.0) is None
    assert reason(LANDMARK, LENS_M, refused) == "mirror_image"


@pytest.mark.parametrize("lift_m", [-0.1, 0.1, 0.3])
def test_the_same_shape_at_another_height(lift_m: float) -> None:
    lifted = Shape(*(v - lift_m if i else v for i, v in enumerate(LANDMARK[:4])))
    refused = look(lifted, 1.5)
    assert verdict(LANDMARK, refused) is None
    assert reason(LANDMARK, LENS_M, refused) == "ranges_disagree"


@pytest.mark.parametrize("distance", [0.6, 1.0, 2.0, 3.0, 4.0])
def test_landmarks_and_masts_are_not_taken_for_each_other(distance: float) -> None:
    assert verdict(LANDMARK, look(MAST, distance), leniency=3.0) is None
    assert verdict(MAST, look(LANDMARK, distance), leniency=3.0) is None


def test_best_tells_the_most() -> None:
    whole = verdict(LANDMARK, look(LANDMARK, 2.0))
    close = verdict(LANDMARK, look(LANDMARK, 2.0, mid=0.0012))
    part = verdict(LANDMARK, look(LANDMARK, 2.0, width=0.5 * looks(LANDMARK, 2.0)[WIDTH]))
    assert best([None, part, close, whole]) is whole
    assert best([part, None]) is part
    assert best([]) is None
