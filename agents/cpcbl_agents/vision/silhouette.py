"""The silhouette of an upright cylinder of two bands, and its distance from a camera.

Four angles determine the distance: the slopes of its top, of the line between its bands and of its
foot, and half of its width. Slopes are downwards from the lens (distance down per distance ahead).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from cpcbl_team.config import Cylinder

TOP, MID, FOOT, WIDTH = range(4)
LEVEL = 0.957
"""How far the rim stands out towards the camera, as a share of the radius: the mean of
sqrt(1 - t^2) over the middle half of the width, |t| <= 1/2, where rows are taken."""
ROUNDS = 12
SETTLED = 1e-7


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

    @property
    def height(self) -> float:
        return self.foot - self.top


class DistanceFit(NamedTuple):
    """The distance of the axis from the lens along the floor, its sigma (m), and chi-square."""

    distance: float
    sigma: float
    chi2: float


def expected_angles(shape: Shape, distance: float) -> tuple[float, float, float, float]:
    """(top, mid, foot, half width) of a cylinder at this distance (m), which exceeds its radius.

    All three lines are on the near side: the top and bottom faces do not have the bands' colours.
    """
    near = distance - LEVEL * shape.radius
    return (
        shape.top / near,
        shape.mid / near,
        shape.foot / near + _hidden_foot(shape, distance),
        math.asin(min(1.0, shape.radius / distance)),
    )


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
        unsure = [_hidden_foot(shape, distance) if i == FOOT else 0.0 for i in use]
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
