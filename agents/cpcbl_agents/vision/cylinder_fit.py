"""Tests whether an outline can be a cylinder of a known shape that stands on the floor.

Its top, mid-line, foot and width must agree on one distance, and so with the floor. If its foot,
top or one side is hidden, the rest must agree, and the outline must not extend beyond the place of
the hidden part; then only the bearing is reported.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cpcbl_agents.vision.camera import Floats
from cpcbl_agents.vision.silhouette import (
    FOOT,
    LEVEL,
    MID,
    TOP,
    WIDTH,
    DistanceFit,
    Shape,
    expected_angles,
    fit_distance,
)

WHOLE = (TOP, MID, FOOT, WIDTH)
WHOLE_GATE = 7.8  # chi-square, 3 degrees of freedom, 0.95
PARTS = (((TOP, MID, WIDTH), FOOT), ((MID, FOOT, WIDTH), TOP), ((TOP, MID, FOOT), WIDTH))
"""The angles to use, and the one that is hidden."""
PART_GATE = 6.0  # 2 degrees of freedom, 0.95
SIGMAS = 3.0


class AngularOutline(NamedTuple):
    """The outline of an object with two bands, as angles.

    The azimuth of its middle; `angles`: top, mid, foot and half width as in `silhouette`, with
    their sigmas; its corners (4, 2) in the frame; which of the four angles are known to be hidden;
    `cut`: whether the border of the frame hides them.
    """

    azimuth: float
    angles: tuple[float, float, float, float]
    sigmas: tuple[float, float, float, float]
    tilt_sigma: float
    corners: Floats
    hidden: frozenset[int] = frozenset()
    cut: bool = False


class CylinderFit(NamedTuple):
    """The distance of the axis from the lens and its sigma (m), half of its width there (rad), and
    its misfit (chi-square over its limit); `hidden`: the one of the four angles not used."""

    outline: AngularOutline
    distance: float
    sigma: float
    half_width: float
    misfit: float
    hidden: int | None = None


def fit_cylinder(
    shape: Shape, outline: AngularOutline, leniency: float = 1.0
) -> CylinderFit | None:
    """The fit if the outline has this shape; None if it has not, or if that is uncertain.

    A leniency above 1 also accepts outlines that only might have this shape.
    """
    if not outline.hidden:
        whole = _fit(shape, outline, WHOLE)
        if whole.chi2 <= leniency * WHOLE_GATE:
            return _cylinder_fit(shape, outline, whole, None)
    for use, hidden in PARTS:
        if outline.hidden.isdisjoint(use):
            part = _fit(shape, outline, use)
            if part.chi2 <= leniency * PART_GATE and not _exceeds_hidden_part(
                shape, outline, part, hidden
            ):
                return _cylinder_fit(shape, outline, part, hidden)
    return None


def best_fit(verdicts: Iterable[CylinderFit | None]) -> CylinderFit | None:
    """A fit with all four angles if there is one; of several, the one with the least misfit."""
    given = [one for one in verdicts if one is not None]
    return min(given, key=lambda one: (one.hidden is not None, one.misfit), default=None)


def rejection_reason(shape: Shape, lens_m: float, outline: AngularOutline) -> str:
    """Why the outline does not have this shape, or not certainly."""
    if outline.cut:
        return "cut_by_frame"
    if outline.hidden:
        return "wrong_shape"
    top, mid, foot, width = outline.angles
    near = shape.height / max(foot - top, 1e-9)  # by its height alone, wherever it stands
    expected = math.asin(min(1.0, shape.radius / (near + LEVEL * shape.radius)))
    edge = outline.sigmas[MID]
    width_sigma = math.hypot(outline.sigmas[WIDTH], expected * edge * math.sqrt(2.0) / (foot - top))
    if (
        abs(foot - 2.0 * mid + top) > SIGMAS * math.sqrt(6.0) * edge
        or abs(width - expected) > SIGMAS * width_sigma
    ):
        return "wrong_shape"
    return "mirror_image" if lens_m < mid * near else "ranges_disagree"


def _cylinder_fit(
    shape: Shape, outline: AngularOutline, fitted: DistanceFit, hidden: int | None
) -> CylinderFit:
    distance, sigma, chi2 = fitted
    misfit = chi2 / (WHOLE_GATE if hidden is None else PART_GATE)
    return CylinderFit(
        outline, distance, sigma, expected_angles(shape, distance)[WIDTH], misfit, hidden
    )


def _fit(shape: Shape, outline: AngularOutline, use: Sequence[int]) -> DistanceFit:
    return fit_distance(shape, outline.angles, outline.sigmas, outline.tilt_sigma, use)


def _exceeds_hidden_part(
    shape: Shape, outline: AngularOutline, part: DistanceFit, hidden: int
) -> bool:
    """Whether the outline extends beyond the expected place of the hidden part."""
    angles = outline.angles[hidden]
    expected = expected_angles(shape, part.distance)
    farther = expected_angles(shape, part.distance + part.sigma)
    outward = -1.0 if hidden == TOP else 1.0
    sigma = math.hypot(
        outline.sigmas[hidden],
        farther[hidden] - expected[hidden],
        outline.tilt_sigma * (1.0 + angles**2) if hidden != WIDTH else 0.0,
    )
    return outward * (angles - expected[hidden]) > SIGMAS * sigma
