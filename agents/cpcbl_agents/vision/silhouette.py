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

    @staticmethod
    def of(cylinder: Cylinder, lens_m: float) -> "Shape":
        foot = lens_m - cylinder.foot_m
        return Shape(
            cylinder.radius_m,
            foot - cylinder.height_m,
            foot - 0.5 * cylinder.height_m,
            foot,
        )

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

    The rim that is seen is the near one, but for a top seen from above: there it is the far one.
    """
    near = distance - LEVEL * shape.radius
    far = distance + LEVEL * shape.radius
    return (
        shape.top / (near if shape.top < 0.0 else far),
        shape.mid / near,
        shape.foot / near,
        math.asin(min(1.0, shape.radius / distance)),
    )


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
        weigh = _Weights([sigmas[i] for i in use], shared)
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


def off(shape: Shape, distance: float, seen: Sequence[float], what: int) -> float:
    """By how much one of the four numbers is more than a cylinder at this distance has."""
    return seen[what] - looks(shape, distance)[what]
