"""The update of a pose that no Gaussian contains (`pose_mixtures.py`)."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from cpcbl_team.arcs import Arc
from cpcbl_team.config import LocalizerSettings
from cpcbl_team.constraints import Constraint
from cpcbl_team.estimate import POSE, Estimate, FilteredOffset, Row, dot, sharpest
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.measurements import Measurement, constraints_of, left_out
from cpcbl_team.pose_mixtures import Component, PoseMixture, estimate_of, merged
from cpcbl_team.state import State

LINEAR_SHARE: Final = 0.05
"""A reading is linear in a Gaussian if the mean square of what its linear form leaves out is less
than this share of its variance."""
LINEAR_SHARE_BESIDE_ARC: Final = 1.0
"""The same where the arc about a single landmark is taken away: linear forms of readings on it
follow the arc, and give nothing of it away (see `relinearization.py`)."""
MOST_COMPONENTS: Final = 1000
SPLIT_WEIGHT: Final = 1e-4  # of the sum: lighter components are not split,
ACCEPTED_WEIGHT: Final = 1e-3  # and lighter ones than this accept nothing
ALONG_ARC: Final = (0.0, 0.0)  # no direction of the field
BEND: Final = 0.75
"""An error e of the heading, of variance s, brings a point at the distance d nearer by d e^2 / 2.
The mean square of that is 3/4 (d s)^2, and d s is the covariance of the position with the heading
where that heading has led the robot here."""


class _Nonlinearity(NamedTuple):
    """What linear forms leave out: the largest mean square as a share of a reading's variance, and
    the direction in which a component is to be split for that. (The larger of two is the one that
    bends, or that has the larger share.)"""

    bends: bool = False
    share: float = 0.0
    direction: tuple[float, float] = ALONG_ARC


class _Updated(NamedTuple):
    """A component with what it would be after a frame, and the log of its weight then."""

    before: Component
    pose: Pose2
    offset: FilteredOffset
    log_weight: float
    nonlinearity: _Nonlinearity
    accepted: frozenset[str]

    def parts(self) -> list[Component]:
        """The component in parts in which readings are more linear."""
        direction = self.nonlinearity.direction
        if direction == ALONG_ARC:
            return self.before.split_along_arc()
        return self.before.split(*direction)


class MixtureUpdate:
    """Updates a mixture by what one robot measures."""

    def __init__(self, rules: LocalizerSettings, gates: tuple[float, float]) -> None:
        """`gates`: chi-square bounds of one and of two constraints."""
        self._rules, self._gates = rules, gates

    def is_nonlinear(self, estimate: Estimate, measured: Sequence[Measurement]) -> bool:
        """Whether readings of independent objects are not linear within an estimate. Objects that
        all give range and bearing may leave an arc, which is no reason for a mixture."""
        if any(m.range_m is None or m.bearing is None or m.wall is not None for m in measured):
            whole = Component(1.0, *estimate[:2])
            return self._updated(whole, measured).nonlinearity.share > LINEAR_SHARE
        apart = Component(1.0, estimate.pose, Arc.of(estimate).covariance)
        return self._updated(apart, measured).nonlinearity.share > LINEAR_SHARE_BESIDE_ARC

    def after_frame(
        self, state: State, measured: Sequence[Measurement]
    ) -> tuple[PoseMixture, frozenset[str]]:
        """The mixture after a frame, and the sources that it accepts. What no component accepts
        changes nothing."""
        mixture, estimate = state.mixture, state.estimate
        if mixture is None:
            alone = Component(1.0, *estimate[:2])
            mixture = PoseMixture((alone,), estimate, state.stamp_ns)
        components, used = mixture.components_now(), list(measured)
        while used:
            updated = self._split(components, used)
            weights = _weights(updated)
            least = ACCEPTED_WEIGHT * sum(weights)
            heavy = [u for u, weight in zip(updated, weights, strict=True) if weight > least]
            accepted = frozenset().union(*(u.accepted for u in heavy))
            if len(accepted) == len(used):
                after = [
                    Component(weight, u.pose, u.offset.covariance)
                    for u, weight in zip(updated, weights, strict=True)
                ]
                found = merged(after)
                known = estimate_of(found, estimate)
                return PoseMixture(found, known, state.stamp_ns), accepted
            used = [m for m in used if m.source in accepted]
        return mixture._replace(updated_ns=state.stamp_ns), frozenset()

    def _split(
        self, components: Sequence[Component], measured: Sequence[Measurement]
    ) -> list[_Updated]:
        """The components, in parts so narrow that readings are linear in each one that counts."""
        updated = [self._updated(c, measured) for c in components]
        while len(updated) < MOST_COMPONENTS:
            weights = _weights(updated)
            least, after = SPLIT_WEIGHT * sum(weights), []
            for u, weight in zip(updated, weights, strict=True):
                if weight > least and u.nonlinearity.share > LINEAR_SHARE:
                    after += [self._updated(part, measured) for part in u.parts()]
                else:
                    after.append(u)
            is_split = len(after) > len(updated)
            updated = after
            if not is_split:
                break
        return updated

    def _updated(self, component: Component, measured: Sequence[Measurement]) -> _Updated:
        """A component after a frame. What linear forms leave out counts as noise."""
        weight, pose, covariance = component
        prior, worst, accepted = Estimate(pose, covariance), _Nonlinearity(), []
        begin = after = FilteredOffset(covariance)
        log_determinant = 0.0
        for m in measured:
            constraints = constraints_of(pose, m, POSE, self._rules)
            if not constraints:  # it touches the object
                continue
            squares = left_out(prior, m, constraints)
            readings: list[tuple[Row, float, float]] = []
            for c, square in zip(constraints, squares, strict=True):
                variance = sharpest(c.sigma * c.sigma)
                worst = max(worst, _nonlinearity(prior, m, c, square / variance))
                readings.append((c.row, c.residual, variance + square))
            if begin.after(readings).cost <= self._gates[len(readings) - 1]:
                accepted.append(m.source)
            for reading in readings:
                row, _, variance = reading
                log_determinant += math.log(dot(row, after.covariance.times(row)) + variance)
                after = after.after((reading,))
        x, y, turn = after.offset
        there = Pose2(pose.x + x, pose.y + y, wrap_angle(pose.heading + turn))
        log_weight = math.log(weight) - 0.5 * (log_determinant + after.cost)
        return _Updated(component, there, after, log_weight, worst, frozenset(accepted))


def _weights(updated: Sequence[_Updated]) -> list[float]:
    """The weights of components after a frame, as shares of the largest one."""
    largest = max(u.log_weight for u in updated)
    return [math.exp(u.log_weight - largest) for u in updated]


def _nonlinearity(
    prior: Estimate, m: Measurement, constraint: Constraint, share: float
) -> _Nonlinearity:
    """Of one reading: `share` is what the position makes of it. The bend of an arc goes first,
    because nothing but a split along the arc follows that."""
    xx, xy, yy, xh, yh, _ = prior.covariance
    dx, dy = m.position.x - prior.pose.x, m.position.y - prior.pose.y
    squared = dx * dx + dy * dy
    variance = sharpest(constraint.sigma * constraint.sigma)
    in_metres = variance * squared if constraint.is_bearing else variance
    of_bend = BEND * (xh * xh + yh * yh) / in_metres
    if of_bend > LINEAR_SHARE:
        return _Nonlinearity(True, of_bend, ALONG_ARC)
    distance = math.sqrt(squared)
    u, v = dx / distance, dy / distance
    along = xx * u * u + 2.0 * xy * u * v + yy * v * v
    is_along = constraint.is_bearing and along > xx + yy - along
    return _Nonlinearity(False, share, (u, v) if is_along else (-v, u))
