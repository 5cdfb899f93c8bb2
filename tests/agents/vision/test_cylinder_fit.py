"""What may be a cylinder, what is good for a bearing only, and what is refused."""

import math

import numpy as np
import pytest

from cpcbl_agents.vision.cylinder_fit import (
    FOOT,
    TOP,
    WIDTH,
    AngularOutline,
    Shape,
    best_fit,
    expected_angles,
    fit_cylinder,
    rejection_reason,
)
from cpcbl_team.config import Cylinder

LENS_M = 0.2
LANDMARK = Shape.of(Cylinder(), LENS_M)
MAST = Shape.of(Cylinder(radius_m=0.04, height_m=0.16, foot_m=0.25), LENS_M, 0.12)
EDGE = 0.4 / 400.0


def angular_outline(
    shape: Shape,
    distance: float,
    *,
    cut: bool = False,
    hidden: frozenset[int] = frozenset(),
    **changed: float,
) -> AngularOutline:
    top, mid, foot, width = expected_angles(shape, distance)
    angles = (
        changed.get("top", top),
        changed.get("mid", mid),
        changed.get("foot", foot),
        changed.get("width", width),
    )
    sigmas = (EDGE, EDGE, EDGE, EDGE / math.sqrt(2.0))
    return AngularOutline(0.0, angles, sigmas, math.radians(0.2), np.zeros((4, 2)), hidden, cut)


@pytest.mark.parametrize("distance", [0.4, 1.0, 3.0, 6.0])
def test_whole(distance: float) -> None:
    told = fit_cylinder(LANDMARK, angular_outline(LANDMARK, distance))
    assert told is not None
    assert told.hidden is None
    assert told.distance == pytest.approx(distance, rel=1e-6)


@pytest.mark.parametrize("distance", [1.0, 3.0])
def test_hidden_foot_and_hidden_top_leave_the_bearing(distance: float) -> None:
    foot = expected_angles(LANDMARK, distance)[FOOT]
    no_foot, no_top = (
        angular_outline(LANDMARK, distance, foot=0.6 * foot),
        angular_outline(LANDMARK, distance, top=-0.6 * foot),
    )
    for part, hidden in ((no_foot, FOOT), (no_top, TOP)):
        told = fit_cylinder(LANDMARK, part)
        assert told is not None
        assert told.hidden == hidden
        assert told.distance == pytest.approx(distance, rel=0.1)


def test_hidden_side_leaves_a_rough_bearing() -> None:
    width = expected_angles(LANDMARK, 2.0)[WIDTH]
    told = fit_cylinder(LANDMARK, angular_outline(LANDMARK, 2.0, width=0.5 * width))
    assert told is not None
    assert told.hidden == WIDTH
    assert told.half_width == pytest.approx(width, rel=1e-3)


def test_what_sticks_out_is_not_hidden() -> None:
    top, _, foot, width = expected_angles(LANDMARK, 2.0)
    assert fit_cylinder(LANDMARK, angular_outline(LANDMARK, 2.0, foot=2.0 * foot)) is None
    assert fit_cylinder(LANDMARK, angular_outline(LANDMARK, 2.0, top=2.0 * top)) is None
    assert fit_cylinder(LANDMARK, angular_outline(LANDMARK, 2.0, width=2.0 * width)) is None


def test_two_hidden_edges_are_too_many() -> None:
    _, _, foot, width = expected_angles(LANDMARK, 2.0)
    refused = angular_outline(LANDMARK, 2.0, foot=0.6 * foot, width=0.5 * width)
    assert fit_cylinder(LANDMARK, refused) is None
    assert rejection_reason(LANDMARK, LENS_M, refused) == "wrong_shape"
    cut = angular_outline(LANDMARK, 2.0, hidden=frozenset({FOOT, WIDTH}), cut=True)
    assert fit_cylinder(LANDMARK, cut) is None
    assert rejection_reason(LANDMARK, LENS_M, cut) == "cut_by_frame"


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0, 4.0])
def test_mirror_image(distance: float) -> None:
    beneath = Shape(LANDMARK.radius, 0.2, 0.4, 0.6)  # below the lens: from the floor downwards
    refused = angular_outline(beneath, distance)
    assert fit_cylinder(LANDMARK, refused, leniency=3.0) is None
    assert rejection_reason(LANDMARK, LENS_M, refused) == "mirror_image"


@pytest.mark.parametrize("lift_m", [-0.1, 0.1, 0.3])
def test_the_same_shape_at_another_height(lift_m: float) -> None:
    lifted = Shape(*(v - lift_m if i else v for i, v in enumerate(LANDMARK[:4])))
    refused = angular_outline(lifted, 1.5)
    assert fit_cylinder(LANDMARK, refused) is None
    assert rejection_reason(LANDMARK, LENS_M, refused) == "ranges_disagree"


@pytest.mark.parametrize("distance", [0.6, 1.0, 2.0, 3.0, 4.0])
def test_landmarks_and_masts_are_not_taken_for_each_other(distance: float) -> None:
    assert fit_cylinder(LANDMARK, angular_outline(MAST, distance), leniency=3.0) is None
    assert fit_cylinder(MAST, angular_outline(LANDMARK, distance), leniency=3.0) is None


def test_best_tells_the_most() -> None:
    whole = fit_cylinder(LANDMARK, angular_outline(LANDMARK, 2.0))
    close = fit_cylinder(LANDMARK, angular_outline(LANDMARK, 2.0, mid=0.0012))
    part = fit_cylinder(
        LANDMARK, angular_outline(LANDMARK, 2.0, width=0.5 * expected_angles(LANDMARK, 2.0)[WIDTH])
    )
    assert best_fit([None, part, close, whole]) is whole
    assert best_fit([part, None]) is part
    assert best_fit([]) is None
