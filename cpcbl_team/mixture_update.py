"""The update of a pose that no Gaussian contains (`pose_mixtures.py`)."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from cpcbl_team.arcs import Arc, with_lost_bend
from cpcbl_team.config import LocalizerSettings
from cpcbl_team.constraints import Constraint
from cpcbl_team.estimate import (
    POSE,
    Estimate,
    FilteredOffset,
    Row,
    pose_difference,
    sharpest,
)
from cpcbl_team.fusion import Observation
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.measurements import Measurement, constraints_of, left_out
from cpcbl_team.pose_mixtures import PARTS, Component, PoseMixture, estimate_of, merged
from cpcbl_team.state import State

LINEAR_SHARE: Final = 0.05
"""A reading is linear in a Gaussian if the mean square of what its linear form leaves out is less
than this share of its variance."""
LINEAR_SHARE_BESIDE_ARC: Final = 1.0
"""The same where the arc about a single landmark is taken away: linear forms of readings on it
follow the arc, and give nothing of it away (see `relinearization.py`)."""
MOST_WORK: Final = 4600
OWN_WORK: Final = 6
"""A component takes as long as so many objects, without those that update it: so a frame of one
object makes 657 components at most, one of 30 objects 127."""
SPLIT_WEIGHT: Final = 1e-4  # of the sum: lighter components are not split,
ACCEPTED_WEIGHT: Final = 1e-3  # and lighter ones than this accept nothing
BEND: Final = 0.75
"""An error e of the heading, of variance s, brings a point at the distance d nearer by d e^2 / 2.
The mean square of that is 3/4 (d s)^2, and d s is the covariance of the position with the heading
where that heading has led the robot here."""


_Reading = tuple[Row, float, float]  # its variance is the last one


class _Nonlinearity(NamedTuple):
    """What the linear form of a reading leaves out. (The larger of two is the one that bends, or
    that has the larger share.)"""

    bends: bool = False
    share: float = 0.0  # its mean square as a share of the reading's variance
    is_bearing: bool = False
    dx: float = 0.0  # where the object is, from the component (m)
    dy: float = 0.0


class _Updated(NamedTuple):
    """A component with what it would be after a frame, and the log of its weight then."""

    before: Component
    after: FilteredOffset
    log_weight: float
    nonlinearity: _Nonlinearity = _Nonlinearity()

    def parts(self) -> list[Component]:
        """The component in parts in which the least linear reading is more linear. The bend of an
        arc goes first, because nothing but a split along the arc follows that."""
        bends, _, is_bearing, dx, dy = self.nonlinearity
        if bends:
            return self.before.split_along_arc()
        xx, xy, yy, _, _, _ = self.before.covariance
        distance = math.hypot(dx, dy)
        u, v = dx / distance, dy / distance
        along = xx * u * u + 2.0 * xy * u * v + yy * v * v
        is_along = is_bearing and along > xx + yy - along
        return self.before.split(*((u, v) if is_along else (-v, u)))

    def component(self, weight: float) -> Component:
        """What it is after the frame."""
        pose, (x, y, turn) = self.before.pose, self.after.offset
        there = Pose2(pose.x + x, pose.y + y, wrap_angle(pose.heading + turn))
        return Component(weight, there, self.after.covariance)


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
            alone = Component(1.0, *with_lost_bend(estimate)[:2])
            mixture = PoseMixture((alone,), estimate, state.stamp_ns)
        components, used = mixture.components_now(), list(measured)
        while used:
            updated = self._split(components, used)
            weights = _weights(updated)
            least = ACCEPTED_WEIGHT * sum(weights)
            heavy = [u for u, weight in zip(updated, weights, strict=True) if weight > least]
            accepted = frozenset(
                m.source for m in used if any(self._accepts(u.before, m) for u in heavy)
            )
            if len(accepted) == len(used):
                return _mixture_of(updated, weights, state), accepted
            used = [m for m in used if m.source in accepted]
        return mixture._replace(updated_ns=state.stamp_ns), frozenset()

    def after_position(self, mixture: PoseMixture, state: State, seen: Observation) -> PoseMixture:
        """The mixture of the state after its own position sensor, whose readings are linear.
        `seen`: about the estimate."""
        updated = []
        for component in mixture.components_now():
            about = seen.shifted(*pose_difference(state.estimate.pose, component.pose))
            readings = about.independent_scalars(about.noise())
            after = FilteredOffset(component.covariance).after(readings)
            updated.append(_Updated(component, after, _log_weight(component, after)))
        return _mixture_of(updated, _weights(updated), state)

    def _split(
        self, components: Sequence[Component], measured: Sequence[Measurement]
    ) -> list[_Updated]:
        """The components, in parts so narrow that readings are linear in each one that counts, the
        heaviest first, as long as there are not too many."""
        updated = [self._updated(c, measured) for c in components]
        most = MOST_WORK // (OWN_WORK + len(measured))
        while (room := (most - len(updated)) // (len(PARTS) - 1)) > 0:
            weights = _weights(updated)
            least = SPLIT_WEIGHT * sum(weights)
            heaviest_first = sorted(range(len(updated)), key=lambda k: -weights[k])
            wide = [
                k
                for k in heaviest_first
                if weights[k] > least and updated[k].nonlinearity.share > LINEAR_SHARE
            ]
            if not wide:
                break
            split = set(wide[:room])
            parts = [self._updated(part, measured) for k in split for part in updated[k].parts()]
            updated = [u for k, u in enumerate(updated) if k not in split] + parts
        return updated

    def _updated(self, component: Component, measured: Sequence[Measurement]) -> _Updated:
        """A component after a frame."""
        prior, worst = Estimate(component.pose, component.covariance), _Nonlinearity()
        readings: list[_Reading] = []
        for m in measured:
            for c, reading, square in self._readings(prior, m):
                worst = max(worst, _nonlinearity(prior, m, c, square))
                readings.append(reading)
        after = FilteredOffset(component.covariance).after(readings)
        return _Updated(component, after, _log_weight(component, after), worst)

    def _accepts(self, component: Component, m: Measurement) -> bool:
        """Whether an object agrees with a component (none does that the component touches)."""
        readings = [r for _, r, _ in self._readings(Estimate(*component[1:]), m)]
        if not readings:
            return False
        cost = FilteredOffset(component.covariance).after(readings).cost
        return cost <= self._gates[len(readings) - 1]

    def _readings(
        self, prior: Estimate, m: Measurement
    ) -> list[tuple[Constraint, _Reading, float]]:
        """The constraints of an object as readings, and the mean square of what each leaves out,
        which counts as noise. None where the pose touches the object."""
        found = []
        constraints = constraints_of(prior.pose, m, POSE, self._rules)
        if constraints:
            for c, square in zip(constraints, left_out(prior, m, constraints), strict=True):
                variance = sharpest(c.sigma * c.sigma) + square
                found.append((c, (c.row, c.residual, variance), square))
        return found


def _log_weight(component: Component, after: FilteredOffset) -> float:
    """The log of a component's weight after readings."""
    return math.log(component.weight) - 0.5 * (after.log_determinant + after.cost)


def _weights(updated: Sequence[_Updated]) -> list[float]:
    """The weights of components after a frame, as shares of the largest one."""
    largest = max(u.log_weight for u in updated)
    return [math.exp(u.log_weight - largest) for u in updated]


def _mixture_of(updated: Sequence[_Updated], weights: Sequence[float], state: State) -> PoseMixture:
    """The mixture that has become of the state's."""
    found = merged(u.component(w) for u, w in zip(updated, weights, strict=True))
    return PoseMixture(found, estimate_of(found, state.estimate), state.stamp_ns)


def _nonlinearity(
    prior: Estimate, m: Measurement, constraint: Constraint, square: float
) -> _Nonlinearity:
    """Of one reading, by the mean `square` that its linear form leaves out of the position, and by
    the bend of the arc that the prior is on."""
    _, _, _, xh, yh, _ = prior.covariance
    dx, dy = m.position.x - prior.pose.x, m.position.y - prior.pose.y
    variance = sharpest(constraint.sigma * constraint.sigma)
    in_metres = variance * (dx * dx + dy * dy) if constraint.is_bearing else variance
    of_bend = BEND * (xh * xh + yh * yh) / in_metres
    if of_bend > LINEAR_SHARE:
        return _Nonlinearity(True, of_bend, constraint.is_bearing, dx, dy)
    return _Nonlinearity(False, square / variance, constraint.is_bearing, dx, dy)
