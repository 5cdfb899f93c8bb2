"""Collaborative probabilistic constraint-based landmark localization (Stroupe & Balch).

`Localizer` holds the settings of one robot; each of its methods maps a `State` to the next one.
"""

from collections.abc import Iterable
from typing import Final

from cpcbl_team.common_error_filter import common_error_filter
from cpcbl_team.config import CameraSettings, Field, LocalizationSettings
from cpcbl_team.estimate import Estimate, Scope
from cpcbl_team.fix_claims import FixClaims
from cpcbl_team.fixes import PoseObservation, from_fix, from_position_sensor
from cpcbl_team.fusion import chi_square_bounds, mark_shared
from cpcbl_team.gate import Gate
from cpcbl_team.geometry import new
from cpcbl_team.initial_pose import estimate_of
from cpcbl_team.inputs import (
    Belief,
    BeliefShared,
    Fix,
    InitialPose,
    InputsMended,
    Odometry,
    Position,
    Sighting,
    Sightings,
)
from cpcbl_team.landmark_beliefs import LandmarkBeliefs
from cpcbl_team.landmarks import Landmarks, LandmarkUpdate
from cpcbl_team.lost_reasons import with_innovations
from cpcbl_team.measurements import (
    BELIEF_VALID_BEFORE_NS,
    GatedObjects,
    Measurement,
    constrains,
    measurement_of,
)
from cpcbl_team.mended_inputs import with_mended_inputs
from cpcbl_team.object_timers import ObjectTimers
from cpcbl_team.own_calibration import OwnCalibration
from cpcbl_team.prediction import Prediction
from cpcbl_team.recovery import Recovery
from cpcbl_team.recovery_evidence import (
    evidence_from_observation,
    is_in_quarantine,
    recently_recorded,
    with_evidence,
    with_measurements,
    with_snapshot,
)
from cpcbl_team.relinearization import Relinearization
from cpcbl_team.sensors import sighting_fault
from cpcbl_team.state import (
    LandmarkSnapshot,
    State,
    state_at_start,
    updates_with_frame,
    with_belief,
    with_correction,
    with_recovery,
    with_teammates,
    with_unknown_heading,
    with_uses,
)
from cpcbl_team.stationary_check import StationaryCheck
from cpcbl_team.teammates import TeammateScreen
from cpcbl_team.trusted_pose import agrees
from cpcbl_team.variants import variant_of

_NO_OBJECTS: Final = GatedObjects([], [])


class Localizer:
    """The localizer of one robot on one field."""

    def __init__(
        self,
        settings: LocalizationSettings,
        field: Field,
        team: frozenset[str] | None = None,
        camera: CameraSettings | None = None,
        claims: FixClaims | None = None,
    ) -> None:
        """`team`: the robots of the team; every other sender is a guest (None: there are no
        guests). `camera`: that of a robot whose sightings come from its camera; their sigmas do not
        contain the errors that all of them have in common. `claims`: how certain fixes can be."""
        self.settings, self.field, rules = settings, field, settings.localizer
        gates = chi_square_bounds(rules.gate_probability)
        self._rules, self._gates, self._window = rules, gates, rules.lost_window
        self._has_map = field.has_surveyed
        self._belief_age_ns = int(settings.collaboration.max_age_s * 1e9)
        self._timers = ObjectTimers(settings)
        self._variant = variant_of(settings, field)
        self._common = common_error_filter(settings, field, camera)
        self._relinearization = Relinearization(settings, gates, self._common, field)
        self._gate = Gate(settings, gates, self._relinearization)
        self._landmarks = Landmarks(field, settings, gates, self._common is not None)
        self._calibration = OwnCalibration(settings, field, self._landmarks)
        self._prediction = Prediction(settings, self._variant, self._calibration, self._common)
        has_common = self._common is not None or not field.is_exact
        self._stationary = StationaryCheck(settings, self._variant.reduce, has_common)
        self.recovery = Recovery(settings, field, self._landmarks, self._variant.reduce)
        common, is_probabilistic = self._common, self._variant.is_probabilistic
        self.screen = TeammateScreen(settings, gates, is_probabilistic, team, common, claims)
        self._claims = claims if self.screen.is_active else None
        self.landmark_beliefs = LandmarkBeliefs(settings, field, self._common, self.screen)

    def cycle(self, state: State, frame: Sightings) -> State:
        """One cycle (paper, section 3, figure 1). Pure: the same inputs give the same bits.

        `landmarks` holds the combined evidence of plain landmarks (`landmarks.py`), `others` all
        other measurements. `scope` is the part of the pose that this frame updates.
        """
        now = frame.stamp_ns
        state = self.predict(state, now)  # 1. differential motion
        state, scope, landmarks, others = self.measure(state, frame)  # 2. measurements
        if scope is None:  # nothing may be updated
            if state.lost:
                state = self._calibration.after_rejected(state)
            return self.recovery.check(state)
        gated, before = _NO_OBJECTS, state.estimate
        if others:
            state, gated = self._gate.constrain(state, others, scope)  # 3. constraints
        if self.screen.is_due(state, gated):  # beyond the paper: trust
            state, gated = self.screen.screen_frame(state, landmarks, gated)
        prior = state.estimate
        if self._common is None:
            estimate = self.correct(state, landmarks, gated, scope)
        else:
            state, estimate = self._common.correct(state, gated.accepted)
        if prior is before:  # else it is about the best pose on its arc
            state, estimate = self._relinearization.after_frame(state, gated.accepted, estimate)
        state = self._with_frame(state, estimate, landmarks, gated, scope)
        state = self.screen.own.without_misleading(state)
        if self._stationary.is_active:
            parts = prior, landmarks.evidence, gated.accepted
            state = self._stationary.after_frame(state, *parts)
        return self.recovery.check(state)

    # Step 1 -----------------------------------------------------------------------------------

    def add_odometry(self, state: State, odometry: Odometry) -> State:
        """Takes the next piece of odometry; predictions for later times will use it."""
        return self._prediction.add_odometry(state, odometry)

    def predict(self, state: State, until_ns: int) -> State:
        """Step 1: the state at `until_ns`, moved along the known odometry."""
        return self._prediction.predict(state, until_ns)

    # Step 2 -----------------------------------------------------------------------------------

    def measure(
        self, state: State, frame: Sightings
    ) -> tuple[State, Scope | None, LandmarkUpdate, list[Measurement]]:
        """Step 2: which part of the pose the frame may update (None: no part), what its plain
        landmarks say about that part, and its other usable measurements.

        The state that is returned remembers the frame as evidence for recovery, and counts its
        faults.
        """
        now, stamp_ns, updates = frame.stamp_ns, state.stamp_ns, state.updates
        recovery = state.memory.recovery
        recorded = recently_recorded(recovery, stamp_ns)
        unusable = self._timers.unusable(state, now)
        not_plain = self._landmarks.names if self._relinearization.is_due(state) else unusable
        for scope in self._variant.update_order(state):
            landmarks = self._landmarks.update(state, frame.sightings, scope, not_plain, recorded)
            measured: list[Measurement] = []
            faults: list[str] = []
            if landmarks.others:
                state, measured, faults = self._measure_others(state, landmarks.others, now)
            usable = measured and self._timers.usable(updates, measured, now, unusable)
            if landmarks.constrains or any(constrains(m, scope, self._rules) for m in usable):
                break
        if landmarks.unrecorded:
            sightings = tuple(landmarks.unrecorded)
            pose = state.estimate.pose
            fields = stamp_ns, state.odometry_from_robot, pose, sightings
            snapshot = new(LandmarkSnapshot, fields)
            state = with_recovery(state, with_snapshot(recovery, snapshot))
        if measured or faults:
            evidence, common = measured, self._common
            if common is not None:
                evidence = [common.as_evidence(state, m) for m in measured]
            state = with_recovery(state, with_measurements(state, evidence)).counted(*faults)
        return state, scope, landmarks, [part for m in usable for part in self._variant.parts(m)]

    def _measure_others(
        self, state: State, sightings: Iterable[Sighting], now_ns: int
    ) -> tuple[State, list[Measurement], list[str]]:
        """Measures the sightings that are not plain landmarks: the state with what it now knows of
        their places, the usable measurements, and the faults of the others."""
        mates, believed = state.memory.teammates, self.landmark_beliefs.usable(state)
        measured: list[Measurement] = []
        faults: list[str] = []
        calibration = state.memory.calibration
        bias, adaptation = calibration.bearing_bias_rad, calibration.adaptation
        factor, is_wrong = adaptation.sensor_factor, bias != 0.0 or any(adaptation.ranges)
        for sighting in sightings:
            fault = sighting_fault(sighting)
            if fault:
                faults.append(fault)
                continue
            if self._common is not None:
                state = self._common.with_object(state, sighting.id)
                state = self.landmark_beliefs.after_sighting(state, sighting.id)
                sighting = self._common.corrected(state, sighting)
                if sighting.id not in believed and self._common.has_no_place(state, sighting.id):
                    state = self._common.with_reading(state, sighting, now_ns)
                    continue
            known = mates.beliefs, self.settings, state.common_errors, believed
            m = measurement_of(sighting, now_ns, state.estimate.pose, self.field, *known)
            if m is not None:
                m = m.corrected(bias, adaptation.ranges) if is_wrong else m
                measured.append(m if factor == 1.0 else m.inflated(factor))
        return state, measured, faults

    # Steps 4 and 5 ----------------------------------------------------------------------------

    def correct(
        self, state: State, landmarks: LandmarkUpdate, gated: GatedObjects, scope: Scope
    ) -> Estimate:
        """Step 4: the closest points of all constraints as one Gaussian. Step 5: its merge with the
        prior (equations 3 and 4). What has updated a mixture is in its estimate."""
        prior, accepted, mixture = state.estimate, gated.accepted, state.updated_mixture
        if accepted and mixture is not None:
            prior = mixture.estimate
            accepted = [found for found in accepted if found.measurement.is_dependent]
            if not accepted:
                return prior
        return self._variant.correct(prior, landmarks, accepted, scope)

    def _with_frame(
        self,
        state: State,
        estimate: Estimate,
        landmarks: LandmarkUpdate,
        gated: GatedObjects,
        scope: Scope,
    ) -> State:
        """The state with the estimate after a frame, and with the frame's counts, timers and
        rejections."""
        used, (accepted, others_rejected) = landmarks.used, gated
        if accepted:
            used = used | {found.measurement.source: state.stamp_ns for found in accepted}
        rejected = len(landmarks.rejected) + len(others_rejected)
        if rejected:
            state = self._calibration.after_rejections(state, landmarks, others_rejected)
        return self._with_update(state, estimate, scope, used, rejected)

    def _with_update(
        self,
        state: State,
        estimate: Estimate,
        scope: Scope | None,
        used: dict[str, int],
        rejected: int,
    ) -> State:
        """The state after an update: the new estimate, the timers, the window of innovations and
        the counts. `used`: the objects that were used, and when (now)."""
        now, updates, accepted = state.stamp_ns, state.updates, len(used)
        window = with_innovations(updates.innovations, accepted, rejected, self._window)
        updates = updates_with_frame(updates, now, scope, used, rejected, window)
        state = with_correction(state, estimate, updates)
        if accepted:
            return self._calibration.after_update(state)
        return self._calibration.after_rejected(state) if rejected else state

    # Teammates and the position sensor --------------------------------------------------------

    def add_fix(self, state: State, fix: Fix) -> State:
        """Active collaboration: a teammate saw this robot's position, perhaps its heading. The
        heading is merged after the position, as a measurement of its own. Tests of the fix take the
        covariance that it states, and the estimate the one that its sender's sensor can have."""
        stated = used = from_fix(fix)
        if self._claims is not None:
            state, used = self._claims.used(state, stated)
        return self._observe_pose(state, fix.stamp_ns, used, stated)

    def add_position(self, state: State, position: Position) -> State:
        """Merges a position of the robot's own sensor. It is like a fix that contains no teammate's
        error."""
        before = self.predict(state, position.stamp_ns)
        observation, prior = from_position_sensor(position), before.estimate
        state = self._observe_pose(before, position.stamp_ns, observation, observation)
        if self._stationary.is_active and state.updates.accepted > before.updates.accepted:
            evidence = observation.of_position(prior.pose).information()
            state = self._stationary.after_position(state, prior, evidence)
        return state

    def _observe_pose(
        self, state: State, stamp_ns: int, observation: PoseObservation, stated: PoseObservation
    ) -> State:
        state = self._record_observation(self.predict(state, stamp_ns), observation)
        state = state if self._has_map else with_unknown_heading(state)
        updates, prior, source = state.updates, state.estimate, observation.source
        if self._timers.is_cooling_down(updates, source, stamp_ns):
            return state
        if self._timers.inflates:
            factor = self._timers.inflation(updates, source, stamp_ns)
            observation, stated = observation.inflated(factor), stated.inflated(factor)
        position = stated.of_position(prior.pose)
        nis = position.normalized_innovation_squared(prior.covariance)
        if self.screen.is_active:
            state, is_trusted = self.screen.screen_observation(state, stated, position, nis)
            if not is_trusted or state.estimate is not prior:
                return self.recovery.check(state)
            observation, nis = self.screen.with_caution(state, observation, nis)
            position = observation.of_position(prior.pose)
        if nis > self._gates[1]:
            if self.screen.has_no_vote(state, observation):  # whether the robot is lost
                return self.recovery.check(state.counted("distrusted"))
            state = self._with_update(state, prior, None, {}, 1)
            return self._after_observation(state, observation)
        by_teammate = observation.observer is not None
        of_mixture = None if by_teammate else self._relinearization.after_position(state, position)
        if of_mixture is not None:
            state, estimate = of_mixture, of_mixture.estimate
        elif self._common is not None:
            state, estimate = self._common.observed(state, prior, position, by_teammate)
        else:
            estimate = self._variant.correct_position(prior, position, by_teammate)
        return self._observe_heading(state, estimate, observation)

    def _observe_heading(
        self, state: State, estimate: Estimate, observation: PoseObservation
    ) -> State:
        """The state after the rest of an observation whose position is in the estimate already."""
        used, rejected = {observation.source: state.stamp_ns}, 0
        heading = observation.of_heading(estimate.pose)
        if heading is not None:
            if heading.normalized_innovation_squared(estimate.covariance) <= self._gates[0]:
                if self._common is not None:
                    state, estimate = self._common.observed(state, estimate, heading, True)
                else:
                    estimate = self._variant.correct_heading(estimate, heading)
            else:
                # The position is kept, for a marker's angle is measured wrong more often than its
                # place. Still the fix counts as rejected: so a robot whose own heading is wrong
                # finds out that it is lost.
                updates = state.updates
                updates = updates._replace(objects_ns=with_uses(updates.objects_ns, used))
                state = state.counted("heading_gated")._replace(updates=updates)
                used, rejected = {}, 1
        estimate = self._variant.reduce(estimate)
        state = self._with_update(state, estimate, None, used, rejected)
        return self._after_observation(state, observation)

    def _after_observation(self, state: State, observation: PoseObservation) -> State:
        """The state after an observation was used, or was not: at the robot's own pose if help led
        it away from there, as far as the robot's position sensor tells."""
        if observation.observer is None:
            state = self.screen.own.without_misleading(state)
        return self.recovery.check(state)

    def _record_observation(self, state: State, observation: PoseObservation) -> State:
        """The state that keeps this observation as evidence for recovery, unless its sender is in
        quarantine."""
        memory = state.memory.teammates
        if not is_in_quarantine(state, observation.sender):
            evidence = evidence_from_observation(state, observation)
            state = with_recovery(state, with_evidence(state.memory.recovery, [evidence]))
        if observation.observer is not None:
            state = with_teammates(state, memory._replace(last_report_ns=state.stamp_ns))
        return state

    def add_teammate_belief(self, state: State, belief: Belief) -> State:
        """Passive collaboration: keeps a teammate's belief until the teammate is seen. The time of
        the state does not change, because dividing a motion would change the last bits of later
        poses."""
        now_ns = belief.stamp_ns - BELIEF_VALID_BEFORE_NS
        return with_belief(state, belief, now_ns, now_ns - self._belief_age_ns)

    def mark_shared(self, state: State, event: BeliefShared) -> State:
        """This robot's belief goes to a teammate, so its information may come back."""
        state = self.predict(state, event.stamp_ns)
        return state._replace(estimate=mark_shared(state.estimate))

    def forget_wrong_inputs(self, state: State, event: InputsMended) -> State:
        """Resets what the robot changed in its settings because of wrong inputs."""
        state = self._calibration.without_adaptation(self.predict(state, event.stamp_ns))
        state = with_mended_inputs(state, event)
        return state if self._common is None else self._common.started(state)

    # The start --------------------------------------------------------------------------------

    def set_pose(self, state: State, given: InitialPose) -> State:
        """Somebody says where the robot is. This replaces all that it believed."""
        state = self.predict(state, given.stamp_ns)
        was_wrong = not state.lost and not agrees(state.estimate, estimate_of(given))
        if self._common is not None and was_wrong:
            state = self._common.without_objects(state)
        return self.recovery.check(self.recovery.with_given_pose(state, given))

    def start(self, stamp_ns: int) -> State:
        """The state at the start: at the configured pose, or lost somewhere on the field."""
        state = state_at_start(stamp_ns, self.settings.start, self.field)
        state = self._calibration.started(state)
        return state if self._common is None else self._common.started(state)
