"""The pose on an arc that fits best what was measured: where measurements are to be linearized.

It is found by Gauss-Newton steps with a line search (an iterated extended Kalman filter; Bell &
Cathey, IEEE Transactions on Automatic Control 38, 1993), where much is uncertain from several
starts. Where another pose fits nearly as well there is no best one.
"""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

from cpcbl_team.arcs import Arc
from cpcbl_team.estimate import (
    Covariance3,
    InformationSum,
    Row,
    dot,
    posterior_factor,
    sharpest,
    symmetric_product,
)
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.relocalization import RIVAL

Scalar = tuple[Row, float, float]
"""A scalar measurement about a pose: row, residual and variance."""
Measure = Callable[[Pose2], list[Scalar]]
"""What is measured, as it is linear about a pose; as many scalars at each."""

MOST_STEPS: Final = 12
HALVINGS: Final = 6  # of a step that makes the fit worse
LEAST_GAIN: Final = 1e-4  # of the chi-square, by a step
STARTS = (-2.0, -1.0, 1.0, 2.0)  # sigmas of the turn,
SIDE_STARTS = (-1.5, 1.5)  # and of the offset along each axis, besides the mean
SMALL_SHARE: Final = 1.0 / 16.0  # of the prior's determinant: much was uncertain
LIKELY: Final = 2.0  # the chi-square a scalar of a fit beside which no other one is looked for
APART: Final = 16.27  # the chi-square of another pose (99.9 %, three degrees of freedom)


class ArcFit(NamedTuple):
    """An offset along the arc, the chi-square of prior and measurements there, and the Gaussian
    of the offset by the measurements as they are linear there."""

    offset: Row
    cost: float
    mean: Row
    covariance: Covariance3
    measured: int  # scalars: a pose that touches an object has fewer


def best_fit(arc: Arc, measure: Measure) -> ArcFit | None:
    """The best fit; None if another pose fits nearly as well."""
    first = _fit(arc, (0.0, 0.0, 0.0), measure)
    is_small_step = first.covariance.determinant() > SMALL_SHARE * arc.covariance.determinant()
    if is_small_step and first.cost < LIKELY * (1 + first.measured):
        return first
    fits = [first, *(_fit(arc, start, measure) for start in _other_starts(arc))]
    most = max(fit.measured for fit in fits)
    fits = [fit for fit in fits if fit.measured == most]
    best = min(fits, key=lambda fit: fit.cost)
    rivals = (fit for fit in fits if fit.cost < best.cost + RIVAL)
    return None if any(_are_apart(best, rival) for rival in rivals) else best


def least_cost(arc: Arc, measure: Measure, enough: float) -> float:
    """The least chi-square of prior and measurements together, or one that is at most `enough`."""
    cost = _fit(arc, (0.0, 0.0, 0.0), measure).cost
    for start in _other_starts(arc):
        if cost <= enough:
            break
        cost = min(cost, _fit(arc, start, measure).cost)
    return cost


def _other_starts(arc: Arc) -> list[Row]:
    """Where fits begin, besides the mean."""
    xx, _, yy, _, _, hh = arc.covariance
    turn, x, y = math.sqrt(hh), math.sqrt(xx), math.sqrt(yy)
    starts = [(0.0, 0.0, k * turn) for k in STARTS]
    starts += [(k * x, 0.0, 0.0) for k in SIDE_STARTS]
    return starts + [(0.0, k * y, 0.0) for k in SIDE_STARTS]


def _fit(arc: Arc, offset: Row, measure: Measure) -> ArcFit:
    """The fit to which a start leads."""
    fit = _at(arc, offset, measure)
    for _ in range(MOST_STEPS):
        better = _better(arc, fit, measure)
        if better is None:
            break
        gained, fit = fit.cost - better.cost, better
        if gained < LEAST_GAIN:
            break
    return fit


def _better(arc: Arc, fit: ArcFit, measure: Measure) -> ArcFit | None:
    """A better fit towards the mean of this one's Gaussian; None if there is none."""
    (x, y, turn), (to_x, to_y, to_turn) = fit.offset, fit.mean
    k = 1.0
    for _ in range(HALVINGS):
        there = x + k * (to_x - x), y + k * (to_y - y), turn + k * (to_turn - turn)
        found = _at(arc, there, measure)
        if found.measured == fit.measured and found.cost < fit.cost:
            return found
        k *= 0.5
    return None


def _at(arc: Arc, offset: Row, measure: Measure) -> ArcFit:
    """The fit at an offset."""
    a, b, c, d, e, f, _, _, _ = arc.jacobian(offset)
    information, cost = InformationSum(), arc.cost(offset)
    scalars = measure(arc.at(offset))
    for (u, v, w), residual, variance in scalars:
        row = a * u + d * v, b * u + e * v, c * u + f * v + w
        weight = 1.0 / sharpest(variance)
        information.add(*row, residual + dot(row, offset), weight)
        cost += weight * residual * residual
    matrix, vector = information.sums()
    covariance = symmetric_product(posterior_factor(arc.covariance, matrix), arc.covariance)
    return ArcFit(offset, cost, covariance.times(vector), covariance, len(scalars))


def _are_apart(best: ArcFit, other: ArcFit) -> bool:
    """Whether another fit is a pose of its own."""
    (x, y, turn), (to_x, to_y, to_turn) = best.offset, other.offset
    off = to_x - x, to_y - y, wrap_angle(to_turn - turn)
    return dot(off, best.covariance.inverse().times(off)) > APART
