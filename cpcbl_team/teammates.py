"""Screening of what teammates report, by how far the robot trusts them (beyond the paper).

`trust.py` assesses every report about this robot's position, and every sighting of a teammate as a
landmark. A report that may not be used is left out. If the estimate has followed it before, the
covariance is inflated.
"""

from collections.abc import Collection, Iterable

from msgspec.structs import replace

from cpcbl_team import trust
from cpcbl_team.common_error_filter import CommonErrorFilter
from cpcbl_team.compromises import compromise, doubt_variance
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.contests import contest_m
from cpcbl_team.estimate import Information, circle_variance
from cpcbl_team.fix_claims import FixClaims
from cpcbl_team.fixes import PoseObservation
from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.hypotheses import at_compromise
from cpcbl_team.inflation import inflate_by_offset, inflate_to
from cpcbl_team.inputs import Belief, Input, LandmarkBelief, Position, Sightings
from cpcbl_team.landmarks import LandmarkUpdate
from cpcbl_team.led_astray import OwnPoses, gaps_of
from cpcbl_team.measurements import (
    GatedObject,
    GatedObjects,
    combine,
    nearest_belief,
    observation_of,
)
from cpcbl_team.offset_evidence import (
    evidence_at,
    evidence_of_sighting,
    own_offset,
    position_by_sighting,
    with_camera,
)
from cpcbl_team.recovery_evidence import without_senders
from cpcbl_team.reported_tracks import OdometryErrors, ReportedPosition
from cpcbl_team.sender_records import (
    NEVER_NS,
    OWN_SENSORS,
    OffsetEvidence,
    TeammateReport,
)
from cpcbl_team.silent_sensors import is_on_trial
from cpcbl_team.state import State, with_memory, with_senders, with_teammates
from cpcbl_team.voters import LEAST_CONFIRMED, RECENT_NS, SenderRecords, voters

MOST_SENDERS = 512  # of which records are kept


class TeammateScreen:
    """Leaves out what untrusted teammates report, and keeps the trust up to date."""

    def __init__(
        self,
        settings: LocalizationSettings,
        gates: tuple[float, float],
        is_probabilistic: bool,
        teammates: Collection[str] | None = None,
        common: CommonErrorFilter | None = None,
        claims: FixClaims | None = None,
    ) -> None:
        """`gates`: chi-square bounds of one and of two degrees of freedom. Without a covariance
        there is no NIS, and nothing is screened. `teammates`: the robots of the team; all others
        are guests (None: there are no guests). `common`: the errors that own sightings have in
        common. `claims`: of these, who knows its place only by what others tell it."""
        self._teammates = teammates
        self._relays = frozenset[str]() if claims is None else claims.relays
        self._collaboration, self._rules = settings.collaboration, settings.collaboration.trust
        self._localizer_rules = settings.localizer
        self._gates = gates
        o = settings.odometry
        self.own = OwnPoses(o, common, gates[1])
        self._odometry_errors = OdometryErrors.of(o)
        self.is_active = self._rules.enabled and is_probabilistic

    def has_recent_reports(self, state: State, now_ns: int) -> bool:
        """Whether a teammate has recently reported anything that must be screened."""
        return self.is_active and now_ns - state.memory.teammates.last_report_ns <= RECENT_NS

    def is_due(self, state: State, gated: GatedObjects) -> bool:
        """Whether teammates' information must be screened in this frame: because one of them
        reported recently, or because a landmark of the frame stands where a teammate says."""
        if self.has_recent_reports(state, state.stamp_ns):
            return True
        return self.is_active and any(f.measurement.sender for objects in gated for f in objects)

    def screen_frame(
        self, state: State, landmarks: LandmarkUpdate, gated: GatedObjects
    ) -> tuple[State, GatedObjects]:
        """The state, and the gated objects without the teammates that the robot does not trust."""
        is_lost = bool(state.memory.recovery.lost)
        accepted, rejected = (
            sum(not found.measurement.sender for found in objects) for objects in gated
        )
        accepted, rejected = accepted + len(landmarks.used), rejected + len(landmarks.rejected)
        if (accepted or rejected) and not is_lost:
            sums = combine(Information.of(landmarks.evidence.sums()), gated.accepted)
            own = own_offset(state, sums, gated.accepted)
            state = self._with_own_sensors(state, accepted, rejected, own)
            if accepted:
                state = self.own.after_frame(state, sums, gated.accepted)
        state, distrusted = self._screen_reports(state, gated)
        if distrusted:
            gated = GatedObjects(*(_without(objects, distrusted) for objects in gated))
        accepted_ = [self._with_caution(state, found) for found in gated.accepted]
        return state, gated._replace(accepted=accepted_)

    def _screen_reports(self, state: State, gated: GatedObjects) -> tuple[State, set[str]]:
        """The state after the objects of a frame that teammates report, and the senders that are
        not trusted. Each teammate that is seen is one report. All landmarks that stand where one
        teammate says are one report together, because they have the error of this robot's own pose
        in common."""
        reports: dict[tuple[str, bool], list[GatedObject]] = {}
        for found in (*gated.accepted, *gated.rejected):
            m = found.measurement
            if m.sender:
                reports.setdefault((m.sender, m.is_teammate), []).append(found)
        now, distrusted = state.stamp_ns, set()
        for (sender, is_teammate), objects in reports.items():
            beliefs = state.memory.teammates.beliefs
            is_fresh = not is_teammate or _has_fresh(beliefs[sender], now)
            of_two, evidence, seen_at, (first, *_) = None, None, None, objects
            if is_fresh and not state.lost and not self.own.is_guessed(state):
                freedom = sum(len(found.constraints) for found in objects)
                of_two = 2.0 * sum(found.nis for found in objects) / freedom
                if first.observation:
                    seen = first.observation
                    sums, dependent = seen.information(seen.noise(0.0)), seen.dependent
                    of_it = evidence_of_sighting(state, sums, dependent)
                    evidence = with_camera(state, first.measurement, of_it)
                    if is_teammate:
                        errors = self._odometry_errors
                        seen_at = position_by_sighting(state, sums, dependent, errors)
            report = TeammateReport(
                now,
                of_two,
                evidence=evidence,
                is_guest=self._is_guest(sender),
                is_relay=sender in self._relays,
                seen_at=seen_at,
                seen_offset=seen_at and seen_at.minus(state.estimate.pose),
                compared=self.own.compared(state),
            )
            if first.observation:
                report = report._replace(own_nis=self.own.nis_of_sighting(state, first))
                of_first = first.observation, self._rules.least_sigma_m, first.sensitivities
                state = self.own.after_report(state, sender, *of_first)
            state, is_trusted = self._assess(state, sender, report, first.measurement.source)
            if not is_fresh and not state.lost:  # it was not tested
                senders = state.memory.teammates.senders
                is_trusted = is_trusted and not is_on_trial(senders, sender, now)
            if not is_trusted:
                distrusted.add(sender)
        if not all(is_teammate for _, is_teammate in reports):  # used now, whenever it was said
            memory = state.memory.teammates
            state = with_teammates(state, memory._replace(last_report_ns=now))
        return state, distrusted

    def _with_caution(self, state: State, found: GatedObject) -> GatedObject:
        """A teammate, or a landmark that stands where a teammate says, with the increased
        covariance that `cautious` gives its position."""
        m = found.measurement
        if not m.sender:
            return found
        covariance = self.cautious(state, m.sender, m.position.covariance)
        between = compromise(state.memory.teammates.senders, m.sender)
        if between is not None or covariance is not m.position.covariance:
            x, y = (0.0, 0.0) if between is None else (between.x, between.y)
            position = Gaussian2(m.position.x + x, m.position.y + y, covariance)
            m = replace(m, position=position)
        return found._replace(
            measurement=m, observation=observation_of(state.estimate, m, found.constraints)
        )

    def screen_landmark_belief(
        self, state: State, belief: LandmarkBelief, nis: float
    ) -> tuple[State, bool]:
        """The state after a teammate's belief about a landmark of which the robot knows the place,
        and whether it may be used. `nis`: of the two places, of two degrees of freedom."""
        if not self.is_active:
            return state, True
        memory = state.memory.teammates
        state = with_teammates(state, memory._replace(last_report_ns=state.stamp_ns))
        report = TeammateReport(state.stamp_ns, nis, is_guest=self._is_guest(belief.robot))
        return self._assess(state, belief.robot, report, belief.landmark)

    def with_caution(
        self, state: State, observation: PoseObservation, nis: float
    ) -> tuple[PoseObservation, float]:
        """A teammate's fix, with the observer's part of its covariance increased by `cautious`, at
        the compromise between it and its opponents, and its NIS there."""
        if observation.observer is None:
            return observation, nis
        observer = self.cautious(state, observation.sender, observation.observer)
        observation, nis = at_compromise(state, observation, nis)
        return observation._replace(observer=observer), nis

    def cautious(self, state: State, sender: str, dependent: Covariance2) -> Covariance2:
        """The part of a teammate's covariance that is the same in all its reports, increased to the
        least that this robot assumes of any teammate, and by the bias that others find in the
        teammate. Split covariance intersection does not average this part away, so it bounds the
        weight of all its reports together."""
        record = state.memory.teammates.senders.get(sender)
        rules = self._rules
        is_new = record is None or record.confirmed < LEAST_CONFIRMED
        is_new_guest = is_new and self._is_guest(sender)
        least = (rules.guest_sigma_m if is_new_guest else rules.least_sigma_m) ** 2
        more = max(0.0, least - min(dependent.xx, dependent.yy))
        senders = state.memory.teammates.senders
        if record is not None and record.behind:
            more += doubt_variance(senders, sender)
        if record is not None and compromise(senders, sender) is None:
            more += max(record.bias_variance, contest_m(senders, sender) ** 2)
        return dependent + Covariance2(more, 0.0, more) if more else dependent

    def has_no_vote(self, state: State, observation: PoseObservation) -> bool:
        """Whether this is of a guest whose rejected reports do not count towards being lost.
        Otherwise several guests beside robots of the team could make it lost whenever they like."""
        is_own, sender = observation.observer is None, observation.sender
        if is_own or not self.is_active or not self._is_guest(sender):
            return False
        return sender not in voters(state.memory.teammates.senders, state.stamp_ns)

    def _is_guest(self, sender: str) -> bool:
        return self._teammates is not None and sender not in self._teammates

    def screen_observation(
        self, state: State, observation: PoseObservation, position: Observation, nis: float
    ) -> tuple[State, bool]:
        """The state after an observation of the robot's pose, and whether it may be used.

        `position` is its position about the estimate, `nis` that position's normalized innovation
        squared. The robot's own position sensor is always used.
        """
        now, is_lost = state.stamp_ns, bool(state.memory.recovery.lost)
        is_guessed = self.own.is_guessed(state)
        if observation.observer is None:
            if self.has_recent_reports(state, now) and not is_lost:
                is_accepted = nis <= self._gates[1]
                sums = position.information(position.noise(0.0))
                own = evidence_at(state, sums)
                state = self._with_own_sensors(state, is_accepted, not is_accepted, own)
                state = self.own.after_position(state, position, is_accepted)
            return state, True
        _, nis = at_compromise(state, observation, nis)
        heading, of_heading = observation.of_heading(state.estimate.pose), None
        if heading is not None:  # three degrees of freedom, scaled to two
            nis += heading.normalized_innovation_squared(state.estimate.covariance)
            nis *= 2.0 / 3.0
            of_heading = heading.residuals[0], heading.noise().xx
        noise, (ex, ey) = position.noise(), position.residuals
        variance = circle_variance(*noise)  # it may jump along the major axis
        odometry_from_robot = state.odometry_from_robot
        turn_rad = state.estimate.pose.heading - odometry_from_robot.heading
        where = now, observation.x, observation.y, variance, odometry_from_robot, turn_rad
        independent, turn_variance = position.noise(0.0), state.estimate.covariance.hh
        known = gaps_of(state), self._odometry_errors, independent, position.dependent
        report = TeammateReport(
            now,
            None if is_lost or is_guessed else nis,
            (ex, ey),
            None if is_guessed else ReportedPosition(*where, *known, turn_variance),
            evidence_at(state, position.information(independent), position.dependent),
            self._is_guest(observation.sender),
            of_heading,
            self.own.nis(state, position),
            is_relay=observation.sender in self._relays,
            compared=self.own.compared(state),
        )
        of_it = observation.sender, position, self._rules.least_sigma_m
        state = self.own.after_report(self.own.without_misleading(state), *of_it)
        return self._assess(state, observation.sender, report, observation.source)

    def is_changed_by_beliefs(self, item: Input, before: State, after: State, robot: str) -> bool:
        """Whether an input gives another result in `after` than in `before`, which differ in
        nothing but the beliefs of `robot`, in forgotten beliefs, and in when teammates reported."""
        if not isinstance(item, Sightings | Position):
            return False
        now_ns, rules = item.stamp_ns, self._collaboration
        if self.is_active and not self.has_recent_reports(before, now_ns):
            return True
        earlier_ns, later_ns = (s.memory.teammates.last_report_ns for s in (before, after))
        begin = before.memory.calibration.check.begin  # of a block without any report, perhaps
        if begin is not None and earlier_ns < begin.stamp_ns <= later_ns:
            return True
        if isinstance(item, Position) or all(s.id != robot for s in item.sightings):
            return False
        old, new = (state.memory.teammates.beliefs.get(robot, ()) for state in (before, after))
        if nearest_belief(old, now_ns, rules) != nearest_belief(new, now_ns, rules):
            return True
        return _has_fresh(old, now_ns) is not _has_fresh(new, now_ns)

    def _with_own_sensors(
        self, state: State, accepted: int, rejected: int, evidence: OffsetEvidence
    ) -> State:
        """The state with the record of how well the robot's own sensors agree with the estimate."""
        memory = state.memory.teammates
        result = state.stamp_ns, accepted, rejected, self._rules.limit, evidence
        senders = trust.with_own_sensor_result(memory.senders, *result)
        return with_teammates(state, with_senders(memory, senders))

    def _assess(
        self, state: State, sender: str, report: TeammateReport, source: str
    ) -> tuple[State, bool]:
        """The state after a report of a teammate, and whether the report may be used."""
        memory, estimate = state.memory, state.estimate
        senders, used_ns = state.senders, state.updates.objects_ns.get(source)
        before_ns = NEVER_NS if used_ns is None else used_ns
        decision = trust.assess(senders, sender, report, before_ns, self._rules)
        if decision.event:
            recovery = without_senders(memory.recovery, decision.quarantined)
            memory = memory.counted(decision.event)._replace(recovery=recovery)
        if not decision.trusted:
            memory = memory.counted("distrusted")
        state = with_memory(state, memory)
        errors = decision.estimate_error_m, decision.estimate_error_rad
        if any(errors):
            estimate = inflate_by_offset(estimate, *errors, self._localizer_rules)
            state = state._replace(estimate=estimate)
        if decision.least_sigma_m:
            estimate = inflate_to(state.estimate, decision.least_sigma_m, self._localizer_rules)
            state = state._replace(estimate=estimate)
        teammates = with_senders(memory.teammates, _bounded(decision.senders))
        return with_teammates(state, teammates), decision.trusted


def _bounded(senders: SenderRecords) -> SenderRecords:
    """The records without the older half of them, by their last reports, if there are too many:
    guests may come under ever new names."""
    if len(senders) <= MOST_SENDERS:
        return senders
    names = sorted(senders, key=lambda name: senders[name].last_report_ns)
    kept = {*names[len(names) // 2 :], OWN_SENSORS}
    return {name: record for name, record in senders.items() if name in kept}


def _without(objects: list[GatedObject], distrusted: set[str]) -> list[GatedObject]:
    return [found for found in objects if found.measurement.sender not in distrusted]


def _has_fresh(beliefs: Iterable[Belief], now_ns: int) -> bool:
    """Whether one of these beliefs is fresh enough to test its robot's reports by it."""
    return any(abs(now_ns - b.stamp_ns) <= trust.FRESH_BELIEF_NS for b in beliefs)
