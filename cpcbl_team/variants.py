"""What the four variants of the localizer do differently: one class each.

`joint` estimates position and heading together. `oval` and `circular` keep them apart, as in the
paper. `weighted` is the paper's non-probabilistic variant (section 3).
"""

import math

from cpcbl_team.config import Field, LocalizationSettings, Weights
from cpcbl_team.constraints import Constraint
from cpcbl_team.estimate import (
    HEADING,
    POSE,
    POSITION,
    Covariance3,
    Estimate,
    Information,
    Scope,
    Sums,
    circle_variance,
    merge,
    with_circular_position,
)
from cpcbl_team.fusion import Observation, merge_naive, merge_split, with_all_shared
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.landmarks import LandmarkUpdate
from cpcbl_team.measurements import GatedObject, Measurement, combine
from cpcbl_team.motion import NO_VARIANCE, MotionVariance, move
from cpcbl_team.object_timers import has_passed
from cpcbl_team.state import State

UpdateOrder = tuple[Scope | None, ...]


class JointVariant:
    """An extended Kalman filter over the whole pose."""

    is_probabilistic = True

    def __init__(self, settings: LocalizationSettings) -> None:
        rules = settings.localizer
        self._noise = settings.odometry
        self._least_ns = rules.minimum_interval_s * 1e9
        self._update_orders: tuple[UpdateOrder, UpdateOrder] = ((POSE, None), (POSE, None))
        """What an update is tried for, the last (None) for nothing; after an update of the
        position, and after one of the heading."""
        if rules.alternates:
            self._update_orders = ((HEADING, POSITION, None), (POSITION, HEADING, None))
        splits = settings.collaboration.fusion == "split-ci"
        self._merge_teammate = merge_split if splits else merge_naive

    def update_order(self, state: State) -> UpdateOrder:
        """The parts of the pose that may be updated now, in the order in which to try them: first
        the one that has waited longer, at the end None (nothing). Heading and position have a timer
        each."""
        if state.has_no_heading:
            return (None,)
        now, updates, least = state.stamp_ns, state.updates, self._least_ns
        order = self._update_orders[updates.heading_is_latest]
        if least > 0.0:
            position = has_passed(updates.position_ns, now, least)
            heading = has_passed(updates.heading_ns, now, least)
            may = {POSITION: position, HEADING: heading, POSE: position or heading}
            order = tuple(scope for scope in order if scope is None or may[scope])
        return order

    def scope(self, scope: Scope) -> Scope:
        """What a merge may move, where measurements of this part of the pose are used."""
        return POSE

    def parts(self, m: Measurement) -> tuple[Measurement, ...]:
        """The parts of a measurement that are merged one by one."""
        return (m,)

    def reduce(self, estimate: Estimate) -> Estimate:
        """The estimate in the form that the variant keeps."""
        return estimate

    def move(
        self,
        estimate: Estimate,
        distance: float,
        turn: float,
        crawl_s: float,
        extra: MotionVariance = NO_VARIANCE,
    ) -> Estimate:
        """Step 1: the estimate after an arc of `distance` (m) that turns by `turn` (rad)."""
        return move(estimate, distance, turn, self._noise, crawl_s, extra)

    def merge(self, prior: Estimate, evidence: Sums, scope: Scope) -> Estimate:
        """Step 5: the prior and the evidence as one Gaussian (equations 3 and 4)."""
        return merge(prior, evidence, scope)

    def correct(
        self, prior: Estimate, landmarks: LandmarkUpdate, accepted: list[GatedObject], scope: Scope
    ) -> Estimate:
        """Steps 4 and 5: all evidence combined, then merged with the prior (equations 3 and 4).
        The observations of teammates follow one by one."""
        scope, evidence = self.scope(scope), landmarks.evidence.sums()
        if not accepted:
            return self.merge(prior, evidence, scope)
        estimate = merge(prior, combine(Information.of(evidence), accepted), scope)
        for found in accepted:
            if found.observation is not None:
                dx, dy = estimate.pose.x - prior.pose.x, estimate.pose.y - prior.pose.y
                turn, within = wrap_angle(estimate.pose.heading - prior.pose.heading), scope
                if found.measurement.is_for_heading:
                    within, estimate = HEADING, with_all_shared(estimate)
                observation = found.observation.shifted(dx, dy, turn)
                by_teammate = bool(found.measurement.sender)
                estimate = self.observe(estimate, observation, within, by_teammate)
        return self.reduce(estimate)

    def observe(
        self, prior: Estimate, observation: Observation, scope: Scope, by_teammate: bool = True
    ) -> Estimate:
        """The estimate after an observation with an error that it may contain already: that of a
        teammate's pose, or of a place on the map, which is the same at each sighting."""
        merge_it = self._merge_teammate if by_teammate else merge_split
        return merge_it(prior, observation, scope)

    def correct_position(
        self, prior: Estimate, position: Observation, by_teammate: bool
    ) -> Estimate:
        """The estimate after a teammate, or the position sensor, observed the position."""
        if by_teammate:
            return self.observe(prior, position, self.scope(POSITION))
        return merge(prior, position.information(), self.scope(POSITION))

    def correct_heading(self, prior: Estimate, heading: Observation) -> Estimate:
        """The estimate after a teammate observed the heading."""
        return self.observe(prior, heading, self.scope(HEADING))


class OvalVariant(JointVariant):
    """Position and heading apart; the position's covariance has any shape. If the map gives only
    ranges, nothing else would correct the heading, and a linear filter would not know where the
    robot drives. Then ranges correct it through its covariance with the position."""

    def __init__(self, settings: LocalizationSettings, field: Field) -> None:
        super().__init__(settings)
        self._uncoupled = settings.localizer.paper_uncertainty
        self._scopes = {scope: scope for scope in Scope}
        if settings.localizer.estimates_whole_pose_on(field):
            self._scopes[POSITION] = POSE

    def scope(self, scope: Scope) -> Scope:
        return self._scopes[scope]

    def reduce(self, estimate: Estimate) -> Estimate:
        if self._uncoupled:
            covariance = estimate.covariance._replace(xh=0.0, yh=0.0)
            estimate = estimate._replace(covariance=covariance)
        return with_all_shared(estimate)

    def move(
        self,
        estimate: Estimate,
        distance: float,
        turn: float,
        crawl_s: float,
        extra: MotionVariance = NO_VARIANCE,
    ) -> Estimate:
        return self.reduce(move(estimate, distance, turn, self._noise, crawl_s, extra))

    def merge(self, prior: Estimate, evidence: Sums, scope: Scope) -> Estimate:
        return self.reduce(merge(prior, evidence, scope))


class CircularVariant(OvalVariant):
    """Position and heading apart, the position's covariance a circle."""

    def scope(self, scope: Scope) -> Scope:
        return scope

    def parts(self, m: Measurement) -> tuple[Measurement, ...]:
        """The bearing by a sensor that may be turned apart from the range (see `observe`)."""
        return m.independent_parts()

    def reduce(self, estimate: Estimate) -> Estimate:
        if self._uncoupled:
            estimate = super().reduce(estimate)
        return with_all_shared(with_circular_position(estimate))

    def move(
        self,
        estimate: Estimate,
        distance: float,
        turn: float,
        crawl_s: float,
        extra: MotionVariance = NO_VARIANCE,
    ) -> Estimate:
        if self._uncoupled:
            return super().move(estimate, distance, turn, crawl_s, extra)
        return with_all_shared(move(estimate, distance, turn, self._noise, crawl_s, extra, True))

    def observe(
        self, prior: Estimate, observation: Observation, scope: Scope, by_teammate: bool = True
    ) -> Estimate:
        """Covariance intersection makes one axis shorter and the other one longer, and a circle is
        as wide as the longer axis. So an object that is seen again and again would widen the circle
        for ever; such an observation changes nothing."""
        after = super().observe(prior, observation, scope, by_teammate)
        before, now = prior.covariance.position(), after.covariance.position()
        is_wider = circle_variance(*now) > circle_variance(*before)
        return prior if is_wider and not by_teammate else after

    def merge(self, prior: Estimate, evidence: Sums, scope: Scope) -> Estimate:
        if self._uncoupled:
            return super().merge(prior, evidence, scope)
        return with_all_shared(merge(prior, evidence, scope, as_circle=True))


class WeightedVariant(CircularVariant):
    """Weighted averages. Gates and tiers need a covariance, but the variant has no estimate of its
    quality. So its covariance is nominal: what the last disagreement with a sensor left over, and a
    configured value at least."""

    is_probabilistic = False

    def __init__(self, settings: LocalizationSettings, field: Field) -> None:
        super().__init__(settings, field)
        self._weights = settings.localizer.weights

    def correct(
        self, prior: Estimate, landmarks: LandmarkUpdate, accepted: list[GatedObject], scope: Scope
    ) -> Estimate:
        """Steps 4 and 5: inverse-distance weights among readings, then the static weight."""
        constraints = [c for found in accepted for c in found.constraints]
        return self.reduce(merge_weighted(prior, constraints, self._weights))

    def correct_position(
        self, prior: Estimate, position: Observation, by_teammate: bool
    ) -> Estimate:
        x, y = position.residuals
        return weighted_average(prior, (x, y), None, self._weights)

    def correct_heading(self, prior: Estimate, heading: Observation) -> Estimate:
        return weighted_average(prior, (0.0, 0.0), heading.residuals[0], self._weights)


def merge_weighted(prior: Estimate, accepted: list[Constraint], weights: Weights) -> Estimate:
    """Steps 4 and 5 of a cycle: inverse-distance weights among the readings of one type."""
    if not accepted:
        return prior
    total = sum(1.0 / c.distance_m for c in accepted)
    x, y, h = (
        sum(c.residual * c.row[i] / c.distance_m for c in accepted) / total for i in range(3)
    )
    return weighted_average(prior, (x, y), h if accepted[0].on_heading else None, weights)


def weighted_average(
    prior: Estimate, offset: tuple[float, float], heading: float | None, weights: Weights
) -> Estimate:
    """The static weighted average of estimate and sensor: of heading, if one is given, or else of
    position."""
    (x, y, h), c = prior.pose, prior.covariance
    if heading is not None:
        nominal = math.radians(weights.nominal_heading_sigma_deg) ** 2
        variance = max(nominal, ((1.0 - weights.heading) * heading) ** 2)
        pose = Pose2(x, y, wrap_angle(h + weights.heading * heading))
        return Estimate(pose, Covariance3(c.xx, 0.0, c.yy, 0.0, 0.0, variance))
    left_over = (1.0 - weights.position) * math.hypot(*offset)
    p = max(weights.nominal_sigma_m, left_over) ** 2
    pose = Pose2(x + weights.position * offset[0], y + weights.position * offset[1], h)
    return Estimate(pose, Covariance3(p, 0.0, p, 0.0, 0.0, c.hh))


def variant_of(settings: LocalizationSettings, field: Field) -> JointVariant:
    """The variant that the settings name, on a field."""
    name = settings.localizer.variant
    if name == "joint":
        return JointVariant(settings)
    if name == "oval":
        return OvalVariant(settings, field)
    return (CircularVariant if name == "circular" else WeightedVariant)(settings, field)
