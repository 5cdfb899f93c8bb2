"""The fit of an upright cylinder of two bands, which stands on the floor, to an outline.

Four angles of its silhouette determine its distance from the lens: the slopes of its top, of the
line between its bands and of its foot, and half of its width. Slopes are downwards from the lens
(distance down per distance ahead). All four must agree on one distance, and so with the floor. If
its foot, top or one side is hidden, the rest must agree, and the outline must not extend beyond the
place of the hidden part; then only the bearing is reported.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cpcbl_agents.vision.camera import Floats
from cpcbl_team.config import Cylinder

TOP, MID, FOOT, WIDTH = range(4)
LEVEL = 0.957
"""How far the rim stands out towards the camera, as a share of the radius: the mean of
sqrt(1 - t^2) over the middle half of the width, |t| <= 1/2, where rows are taken."""
ROUNDS = 12
SETTLED = 1e-7
SIGMAS = 3.0
FITS = (
    ((TOP, MID, FOOT, WIDTH), None, 7.8),
    ((TOP, MID, WIDTH), FOOT, 6.0),
    ((MID, FOOT, WIDTH), TOP, 6.0),
    ((TOP, MID, FOOT), WIDTH, 6.0),
)
"""The angles to use, the one that is hidden, and the limit of chi-square (0.95, 3 or 2 degrees of
freedom)."""


class Shape(NamedTuple):
    """The shape of a cylinder with heights below the lens (m)."""

    radius: float
    top: float
    mid: float
    foot: float
    rim: float = 0.0
    """How far (m) its base may extend from its axis: seen from below, that hides its foot."""

    @staticmethod
    def of(cylinder: Cylinder, lens_m: float, rim_m: float = 0.0) -> "Shape":
        foot, half = lens_m - cylinder.foot_m, 0.5 * cylinder.height_m
        return Shape(cylinder.radius_m, foot - 2.0 * half, foot - half, foot, rim_m)


class DistanceFit(NamedTuple):
    """The distance of the axis from the lens along the floor, its sigma (m), and chi-square."""

    distance: float
    sigma: float
    chi2: float


class AngularOutline(NamedTuple):
    """The outline of an object with two bands, as angles.

    The azimuth of its middle; its top, mid, foot and half width with their sigmas; its corners
    (4, 2) in the frame; which of the four angles are known to be hidden; `cut`: whether the border
    of the frame hides them.
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
    """The fit if the outline has this shape; None if it has not, or if that is uncertain. A
    leniency above 1 also accepts outlines that only might have this shape."""
    for use, hidden, limit in FITS:
        if outline.hidden.isdisjoint(use):
            fit = fit_distance(shape, outline.angles, outline.sigmas, outline.tilt_sigma, use)
            if fit.chi2 <= leniency * limit and not _exceeds(shape, outline, fit, hidden):
                half_width = expected_angles(shape, fit.distance)[WIDTH]
                misfit = fit.chi2 / limit
                return CylinderFit(outline, fit.distance, fit.sigma, half_width, misfit, hidden)
    return None


def best_fit(fits: Iterable[CylinderFit | None]) -> CylinderFit | None:
    """A fit with all four angles if there is one; of several, the one with the least misfit."""
    given = [fit for fit in fits if fit is not None]
    return min(given, key=lambda fit: (fit.hidden is not None, fit.misfit), default=None)


def rejection_reason(shape: Shape, lens_m: float, outline: AngularOutline) -> str:
    """Why the outline does not have this shape, or not certainly."""
    if outline.cut:
        return "cut_by_frame"
    if outline.hidden:
        return "wrong_shape"
    top, mid, foot, width = outline.angles
    # The distance by its height alone, wherever it stands.
    near = (shape.foot - shape.top) / max(foot - top, 1e-9)
    expected = math.asin(min(1.0, shape.radius / (near + LEVEL * shape.radius)))
    edge, face = outline.sigmas[MID], max(top, 0.0) * LEVEL * shape.radius / near
    height_sigma = math.hypot(edge * math.sqrt(2.0), face) / (foot - top)
    width_sigma = math.hypot(outline.sigmas[WIDTH], expected * height_sigma)
    if (
        abs(foot - 2.0 * mid + top) > SIGMAS * math.hypot(math.sqrt(6.0) * edge, face)
        or abs(width - expected) > SIGMAS * width_sigma
    ):
        return "wrong_shape"
    return "mirror_image" if lens_m < mid * near else "ranges_disagree"


def _exceeds(shape: Shape, outline: AngularOutline, fit: DistanceFit, hidden: int | None) -> bool:
    """Whether the outline extends beyond the expected place of the hidden part, if there is one."""
    if hidden is None:
        return False
    angle = outline.angles[hidden]
    expected = expected_angles(shape, fit.distance)
    farther = expected_angles(shape, fit.distance + fit.sigma)
    outward = -1.0 if hidden == TOP else 1.0
    sigma = math.hypot(
        outline.sigmas[hidden],
        farther[hidden] - expected[hidden],
        outline.tilt_sigma * (1.0 + angle**2) if hidden != WIDTH else 0.0,
    )
    return outward * (angle - expected[hidden]) > SIGMAS * sigma


def expected_angles(shape: Shape, distance: float) -> tuple[float, float, float, float]:
    """(top, mid, foot, half width) of a cylinder at this distance (m), which exceeds its radius.

    All three lines are on the near side: the top and bottom faces do not have the bands' colours.
    """
    near = distance - LEVEL * shape.radius
    return (
        shape.top / near - _top_face(shape, distance),
        shape.mid / near,
        shape.foot / near + _hidden_foot(shape, distance),
        math.asin(min(1.0, shape.radius / distance)),
    )


def _top_face(shape: Shape, distance: float) -> float:
    """Half of the top face as a slope, where the lens looks down on it: the expected value and the
    sigma of how far the top edge moves up. A face of a few pixels is not told from the band."""
    if shape.top <= 0.0:
        return 0.0
    near, far = distance - LEVEL * shape.radius, distance + LEVEL * shape.radius
    return 0.5 * shape.top * (1.0 / near - 1.0 / far)


def _hidden_foot(shape: Shape, distance: float) -> float:
    """Half of the possibly hidden part of the foot, as a slope: its expected value and sigma."""
    if shape.foot >= 0.0 or shape.rim <= shape.radius:
        return 0.0
    near = distance - LEVEL * shape.radius
    return 0.5 * (shape.foot / max(distance - shape.rim, 0.5 * near) - shape.foot / near)


def fit_distance(
    shape: Shape,
    angles: Sequence[float],
    sigmas: Sequence[float],
    tilt_sigma: float,
    use: Sequence[int],
) -> DistanceFit:
    """Least squares over those of the four numbers that are used.

    An error of the tilt moves all slopes alike: heights are free of it, foot points are not. That
    covariance weighs them against each other.
    """
    shared = [tilt_sigma * (1.0 + angles[i] ** 2) if i != WIDTH else 0.0 for i in use]
    least = 1.01 * shape.radius
    distance = max(least, _first_guess(shape, angles, use))
    for _ in range(ROUNDS):
        expected = expected_angles(shape, distance)
        a_little = expected_angles(shape, distance * 1.0001)
        slopes = [(a_little[i] - expected[i]) / (1e-4 * distance) for i in use]
        errors = [angles[i] - expected[i] for i in use]
        hidden = {FOOT: _hidden_foot(shape, distance), TOP: _top_face(shape, distance)}
        unsure = [hidden.get(i, 0.0) for i in use]
        own = [math.hypot(sigmas[i], more) for i, more in zip(use, unsure, strict=True)]
        weigh = _Weights(own, shared)
        information = weigh(slopes, slopes)
        if information <= 0.0:
            return DistanceFit(distance, math.inf, math.inf)
        change = weigh(slopes, errors) / information
        distance = max(least, distance + min(max(change, -0.5 * distance), distance))
        if abs(change) < SETTLED * distance:
            break
    errors = [angles[i] - e for i, e in enumerate(expected_angles(shape, distance)) if i in use]
    return DistanceFit(distance, 1.0 / math.sqrt(information), weigh(errors, errors))


def _first_guess(shape: Shape, angles: Sequence[float], use: Sequence[int]) -> float:
    """The distance from the height of the used part, else from the width."""
    heights = (shape.top, shape.mid, shape.foot)
    rows = [i for i in use if i != WIDTH]
    if len(rows) > 1:
        height = angles[rows[-1]] - angles[rows[0]]
        if height > 0.0:
            return (heights[rows[-1]] - heights[rows[0]]) / height + shape.radius
    return shape.radius / max(math.sin(min(angles[WIDTH], 0.5 * math.pi)), 1e-6)


class _Weights:
    """The product a' C^-1 b for C = diag(sigmas^2) + shared shared' (Sherman and Morrison)."""

    def __init__(self, sigmas: Sequence[float], shared: Sequence[float]) -> None:
        self._weights = [sigma**-2 for sigma in sigmas]
        self._shared = [w * s for w, s in zip(self._weights, shared, strict=True)]
        inner = sum(w * s for w, s in zip(self._shared, shared, strict=True))
        self._scale = 1.0 / (1.0 + inner)

    def __call__(self, a: Sequence[float], b: Sequence[float]) -> float:
        own = sum(w * x * y for w, x, y in zip(self._weights, a, b, strict=True))
        in_a = sum(s * x for s, x in zip(self._shared, a, strict=True))
        in_b = sum(s * y for s, y in zip(self._shared, b, strict=True))
        return own - self._scale * in_a * in_b
