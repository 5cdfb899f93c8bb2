"""How an upright cylinder of two bands looks from a camera, and how far away it is by its looks.

Four numbers tell: the slopes at which its top, the line between its bands and its foot are seen,
and half of its width as an angle. Slopes are downwards (way down by way ahead), from the lens.
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
    """A cylinder as a camera's height makes it: heights are below the lens (m)."""

    radius: float
    top: float
    mid: float
    foot: float
    rim: float = 0.0
    """How far what it stands on may reach from its axis: seen from below, that hides its foot."""

    @staticmethod
    def of(cylinder: Cylinder, lens_m: float, rim_m: float = 0.0) -> "Shape":
        foot, half = lens_m - cylinder.foot_m, 0.5 * cylinder.height_m
        return Shape(cylinder.radius_m, foot - 2.0 * half, foot - half, foot, rim_m)

    @property
    def height(self) -> float:
        return self.foot - self.top


class Fit(NamedTuple):
    """The distance of the axis from the lens along the floor, and how well the looks agree."""

    distance: float
    sigma: float
    chi2: float


def looks(shape: Shape, distance: float) -> tuple[float, float, float, float]:
    """(top, mid, foot, half width) of a cylinder at this distance, more than its radius.

    All three lines are on the side that is near: a lid that is seen from above, or what is seen of
    it from below, is not of the colour of the bands.
    """
    near = distance - LEVEL * shape.radius
    return (
        shape.top / near,
        shape.mid / near,
        shape.foot / near + _hidden(shape, distance),
        math.asin(min(1.0, shape.radius / distance)),
    )


def _hidden(shape: Shape, distance: float) -> float:
    """Half of what may be hidden of the foot, as a slope: the foot is expected there, give or take
    as much."""
    if shape.foot >= 0.0 or shape.rim <= shape.radius:
        return 0.0
    near = distance - LEVEL * shape.radius
    return 0.5 * (shape.foot / max(distance - shape.rim, 0.5 * near) - shape.foot / near)


def fit(
    shape: Shape,
    seen: Sequence[float],
    sigmas: Sequence[float],
    tilt_sigma: float,
    use: Sequence[int],
) -> Fit:
    """Least squares over those of the four numbers that are used.

    An error of the tilt moves all slopes alike: heights are free of it, foot points are not. That
    covariance weighs them against each other.
    """
    shared = [tilt_sigma * (1.0 + seen[i] ** 2) if i != WIDTH else 0.0 for i in use]
    least = 1.01 * shape.radius
    distance = max(least, _first_guess(shape, seen, use))
    for _ in range(ROUNDS):
        expected = looks(shape, distance)
        a_little = looks(shape, distance * 1.0001)
        slopes = [(a_little[i] - expected[i]) / (1e-4 * distance) for i in use]
        errors = [seen[i] - expected[i] for i in use]
        unsure = [_hidden(shape, distance) if i == FOOT else 0.0 for i in use]
        own = [math.hypot(sigmas[i], more) for i, more in zip(use, unsure, strict=True)]
        weigh = _Weights(own, shared)
        information = weigh(slopes, slopes)
        if information <= 0.0:
            return Fit(distance, math.inf, math.inf)
        change = weigh(slopes, errors) / information
        distance = max(least, distance + min(max(change, -0.5 * distance), distance))
        if abs(change) < SETTLED * distance:
            break
    errors = [seen[i] - e for i, e in enumerate(looks(shape, distance)) if i in use]
    return Fit(distance, 1.0 / math.sqrt(information), weigh(errors, errors))


def _first_guess(shape: Shape, seen: Sequence[float], use: Sequence[int]) -> float:
    """By the height of what is used, else by the width."""
    heights = (shape.top, shape.mid, shape.foot)
    rows = [i for i in use if i != WIDTH]
    if len(rows) > 1:
        height = seen[rows[-1]] - seen[rows[0]]
        if height > 0.0:
            return (heights[rows[-1]] - heights[rows[0]]) / height + shape.radius
    return shape.radius / max(math.sin(min(seen[WIDTH], 0.5 * math.pi)), 1e-6)


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
