"""At which pose the measurements of a robot with an uncertain heading are linearized.

That pose is the one on the arc of the prior (`arcs.py`) that fits the measurements best. The prior
is expressed as a Gaussian on the tangent there. So all that follows is linear, as it is for a robot
that knows its heading.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from cpcbl_team.arc_fit import ArcFit, Measure, Scalar, best_fit, least_cost
from cpcbl_team.arcs import Arc, about_own_pose, lever_change, square_root, with_lost_bend
from cpcbl_team.common_error_filter import CommonErrorFilter
from cpcbl_team.config import Field, LocalizationSettings, LocalizerSettings
from cpcbl_team.constraints import TELLS_NOTHING, Constraint, curved_variance
from cpcbl_team.estimate import POSE, ZERO3, Estimate, Row, dot, row_sum
from cpcbl_team.fusion import Observation
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.measurements import GatedObject, Measurement, constraints_of
from cpcbl_team.mixture_update import MixtureUpdate
from cpcbl_team.state import State, with_common_errors, with_mixture

BENT_VARIANCE: Final = math.radians(5.0) ** 2  # of the heading: above, tangents are no arcs
NEARLY_KNOWN: Final = 0.2
"""The ratio of the offset's variance to what the turn adds to that of the position, and to the
squared distance of an object, below which no more than the turn is uncertain."""

NONLINEAR_SHARE: Final = 0.03
"""A reading is nonlinear if the square of what its linear form leaves out, within a sigma of the
turn along the arc or of the offset, is more than this share of its variance. Range and bearing to
the landmark that an arc is about are linear along it."""

# Above the smaller of both, of x and y together, readings may not be linear in a Gaussian. (On a
# map of a single landmark the smaller one is 0: all frames are examined.)
WIDE_VARIANCE: Final = 0.5**2  # m^2
WIDE_SHARE: Final = 0.1**2  # of the square of half the field's diagonal


class Linearization(NamedTuple):
    """A pose on the prior's arc about which measurements are linear."""

    arc: Arc
    fit: ArcFit

    @property
    def pose(self) -> Pose2:
        """The pose itself (field_from_robot)."""
        return self.arc.at(self.fit.offset)

    def constraints_of(
        self, prior: Estimate, m: Measurement, rules: LocalizerSettings
    ) -> list[Constraint]:
        """The constraints on an object with residuals about the mean of `prior`, which is about the
        tangent here; each with the variance that its linear form deserves."""
        offset = self.arc.tangent_offset(self.fit.offset)
        constraints = constraints_of(self.pose, m, POSE, rules)
        if not constraints:
            return []
        left_out = [0.0] * len(constraints)
        if not m.is_dependent:
            left_out = self._left_out(constraints, m, rules)
        found = []
        for c, square in zip(constraints, left_out, strict=True):
            predicted = dot(c.row, prior.covariance.times(c.row))
            sigma = math.sqrt(curved_variance(c.sigma * c.sigma, predicted, square))
            found.append(c._replace(residual=c.residual + dot(c.row, offset), sigma=sigma))
        return found

    def _left_out(
        self, here: list[Constraint], m: Measurement, rules: LocalizerSettings
    ) -> list[float]:
        """The mean square of what each linear constraint leaves out where the pose may be after all
        measurements: E[(e^T M e / 2)^2] = (tr(M)^2 + 2 |M|^2) / 4 of a normal e, with second
        differences M along the columns of a square root of the covariance."""
        a, b, c = square_root(self.fit.covariance)
        pairs = row_sum(a, b), row_sum(a, c), row_sum(b, c)
        along = [self._second_differences(here, by, m, rules) for by in (a, b, c, *pairs)]
        squares = []
        for aa, bb, cc, ab, ac, bc in zip(*along, strict=True):
            mixed = ((ab - aa - bb) ** 2 + (ac - aa - cc) ** 2 + (bc - bb - cc) ** 2) / 4.0
            norm = aa * aa + bb * bb + cc * cc + 2.0 * mixed
            squares.append(0.25 * ((aa + bb + cc) ** 2 + 2.0 * norm))
        return squares

    def _second_differences(
        self, here: list[Constraint], by: Row, m: Measurement, rules: LocalizerSettings
    ) -> list[float]:
        """Of the residual of each constraint, in its unit, when the offset moves by this. A pose
        that touches the object has none, and so these tell nothing."""
        x, y, turn = self.fit.offset
        offsets = [(x + k * by[0], y + k * by[1], turn + k * by[2]) for k in (-1.0, 1.0)]
        before, after = (constraints_of(self.arc.at(offset), m, POSE, rules) for offset in offsets)
        if not len(before) == len(here) == len(after):
            return [TELLS_NOTHING] * len(here)
        return [_second_difference(*beside) for beside in zip(before, here, after, strict=True)]


def _second_difference(before: Constraint, here: Constraint, after: Constraint) -> float:
    """Of the residuals of a constraint, in its unit."""
    steps = before.residual - here.residual, after.residual - here.residual
    return sum(map(wrap_angle, steps) if here.on_heading else steps)


class Relinearization:
    """Finds the pose at which the measurements of one robot are linearized."""

    def __init__(
        self,
        settings: LocalizationSettings,
        gates: tuple[float, float],
        common: CommonErrorFilter | None,
        field: Field,
    ) -> None:
        """`gates`: chi-square bounds of one and of two constraints. `common`: the errors that
        depend on those of the pose."""
        self._rules, self._gates, self._common = settings.localizer, gates, common
        self._mixtures = MixtureUpdate(settings.localizer, gates)
        self._estimates_whole_pose = settings.localizer.estimates_whole_pose_on(field)
        x0, y0, x1, y1 = field.bounds()
        squared = 0.25 * ((x1 - x0) ** 2 + (y1 - y0) ** 2)
        self._wide_variance = min(WIDE_VARIANCE, WIDE_SHARE * squared)

    def is_due(self, state: State) -> bool:
        """Whether a Gaussian may not be what is known of the pose: it is one along an arc only, or
        the position is so uncertain that readings may not be linear in it. (A robot that rejects
        what it measures doubts its estimate.)"""
        if not self._estimates_whole_pose:
            return False
        xx, _, yy, _, _, hh = state.estimate.covariance
        is_due = hh > BENT_VARIANCE or xx + yy > self._wide_variance
        return (is_due or state.mixture is not None) and not _doubts(state)

    def as_mixture(
        self, state: State, measured: Sequence[Measurement]
    ) -> tuple[State, frozenset[str] | None]:
        """The state with its pose as a mixture that the independent ones of these objects have
        updated, and the sources that it accepts. Without a mixture, and None, if their readings are
        linear. (The places of the others have errors that the estimate may contain already.)"""
        independent = [m for m in measured if not m.is_dependent]
        is_due = independent and self._common is None and self.is_due(state)
        if is_due and self._mixtures.is_nonlinear(state.estimate, independent):
            mixture, accepted = self._mixtures.after_frame(state, independent)
            return with_mixture(state, mixture), accepted
        return (state if state.memory.mixture is None else with_mixture(state, None)), None

    def after_position(self, state: State, seen: Observation) -> State | None:
        """The state whose mixture its own position sensor has updated; None without a mixture."""
        mixture = state.mixture
        if mixture is None:
            return None
        mixture = self._mixtures.after_position(mixture, state, seen)
        return with_mixture(state._replace(estimate=mixture.estimate), mixture)

    def _is_bent(self, state: State) -> bool:
        """Whether the estimate is a Gaussian along an arc only."""
        return state.estimate.covariance.hh > BENT_VARIANCE and self.is_due(state)

    def about_best_pose(
        self, state: State, measurements: Iterable[Measurement]
    ) -> tuple[State, Linearization | None] | None:
        """The state with its prior about the pose that fits the objects of the map best, and that
        pose; None if another pose fits nearly as well. The state as it is, and no pose, if its
        estimate is no arc, if these objects leave none, or if all of their readings are linear:
        each fit also follows the noise of its frame, so many fits would make certainty of a turn
        that nothing measures."""
        if not self._is_bent(state):
            return state, None
        prior, objects = with_lost_bend(state.estimate), [m for m in measurements if not m.sender]
        arc = Arc.of(prior)
        if not objects or not all(_leaves_arc(arc, m) for m in objects):
            return state, None
        measures = [self._measure(state, m) for m in objects]
        if not any(_is_nonlinear(arc, measure) for measure in measures):
            return state, None
        accepted: list[Measure] = []
        for measure in measures:
            readings = len(measure(arc.pose))
            gate = self._gates[readings > 1]
            if readings and least_cost(arc, measure, gate) <= gate:
                accepted.append(measure)
        fit = best_fit(arc, lambda pose: [s for measure in accepted for s in measure(pose)])
        if fit is None:
            return None
        return _about(state._replace(estimate=prior), arc, fit.offset), Linearization(arc, fit)

    def after_frame(
        self, state: State, accepted: Sequence[GatedObject], estimate: Estimate
    ) -> tuple[State, Estimate]:
        """The state and its next estimate after a frame whose objects were linearized at the pose
        of the state; where they may leave a turn about one of them undetermined, with covariances
        about its own pose. (A mixture needs none, and places that the robot has found have them.)
        """
        common, before = state.common_errors, state.estimate.pose
        is_done = state.updated_mixture is not None or (common is not None and bool(common.found))
        leaves_a_turn = any(_leaves_a_turn(f.measurement) for f in accepted)
        if is_done or not leaves_a_turn or not self._is_bent(state):
            return state, estimate
        if common is not None:
            dx, dy = estimate.pose.x - before.x, estimate.pose.y - before.y
            state = with_common_errors(state, common.with_pose_mapped(lever_change(dx, dy)))
        return state, about_own_pose(estimate, before)

    def _measure(self, state: State, m: Measurement) -> Measure:
        """What an object says, with the errors of its place and of the camera as noise."""
        place = m.position.covariance
        if self._common is not None:
            place += self._common.place_covariance(state, m)
            m = self._common.as_evidence(state, m)

        def measure(pose: Pose2) -> list[Scalar]:
            return [
                (c.row, c.residual, c.sigma * c.sigma + place.along(*c.place_row))
                for c in constraints_of(pose, m, POSE, self._rules)
            ]

        return measure


def _doubts(state: State) -> bool:
    """Whether a robot doubts its estimate, because it rejects what it measures."""
    memory = state.memory.recovery
    return memory.suspected_ns >= 0 or memory.kidnapped_ns >= 0


def _is_nonlinear(arc: Arc, measure: Measure) -> bool:
    """Whether a reading is nonlinear within a sigma of the turn along the arc, or of the offset."""
    here, mean = measure(arc.pose), (0.0, 0.0, 0.0)
    for axis in square_root(arc.covariance):
        before, after = (measure(arc.at(row_sum(mean, axis, k))) for k in (-1.0, 1.0))
        if not len(before) == len(here) == len(after):  # a pose on it touches the object
            return True
        for (_, first, _), (row, middle, variance), (_, last, _) in zip(
            before, here, after, strict=True
        ):
            steps = first - middle, last - middle
            left_out = 0.5 * sum(map(wrap_angle, steps) if row[2] else steps)
            if left_out * left_out > NONLINEAR_SHARE * variance:
                return True
    return False


def _leaves_a_turn(m: Measurement) -> bool:
    """Whether an object leaves only a turn about it undetermined: range and bearing to a point."""
    return m.range_m is not None and m.bearing is not None and m.wall is None


def _leaves_arc(arc: Arc, m: Measurement) -> bool:
    """Whether the poses that agree with an object are an arc. Range and bearing to one point leave
    only a turn about that point undetermined, whatever the prior is. Other objects leave other
    curves if more than the turn is uncertain."""
    if _leaves_a_turn(m):
        return True
    xx, _, yy, _, _, hh = arc.covariance
    apart, by_turn = xx + yy, hh * (arc.x * arc.x + arc.y * arc.y)
    dx, dy = m.position.x - arc.pose.x, m.position.y - arc.pose.y
    return apart <= NEARLY_KNOWN * min(dx * dx + dy * dy, by_turn)


def _about(state: State, arc: Arc, offset: Row) -> State:
    """The state with its prior on the tangent at this offset along the arc."""
    if offset == (0.0, 0.0, 0.0):
        return state
    prior, there = state.estimate, arc.at(offset)
    (dx, dy, turn), moved = arc.tangent_offset(offset), arc.tangent_map(offset)
    mean = Pose2(there.x - dx, there.y - dy, wrap_angle(there.heading - turn))
    shared = prior.shared if prior.shared is ZERO3 else prior.shared.transformed(moved)
    state = state._replace(estimate=Estimate(mean, prior.covariance.transformed(moved), shared))
    if (common := state.common_errors) is not None:
        state = with_common_errors(state, common.with_pose_mapped(moved))
    return state
