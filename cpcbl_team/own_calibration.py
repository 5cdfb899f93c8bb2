"""What a robot knows of its own calibration while it drives, as the localizer uses it.

A robot that calibrates itself (`self_calibration.py`) learns scales and a bias all the time; every
other one changes its settings only where they are wrong (`miscalibration.py`, and
`calibration_filter.py` for what its sensor reads).
"""

import math
from collections.abc import Sequence
from typing import Final

from cpcbl_team.calibration_doubt import with_probabilities
from cpcbl_team.calibration_filter import (
    FILTERS,
    LONGEST_NS,
    MOST_REJECTED,
    STRIDE_NS,
    CalibrationFilter,
    Frame,
    SeenLandmark,
    correction,
)
from cpcbl_team.config import Field, LocalizationSettings, OdometryNoise
from cpcbl_team.constant_errors import NO_ERRORS, NO_EVIDENCE, pose_offset
from cpcbl_team.estimate import POSE, Estimate, offset_pose
from cpcbl_team.geometry import new
from cpcbl_team.landmarks import Landmarks, LandmarkUpdate
from cpcbl_team.lost_reasons import no_longer_lost
from cpcbl_team.map_residuals import ResidualSums
from cpcbl_team.measurements import GatedObject
from cpcbl_team.miscalibration import (
    AS_CONFIGURED,
    BLOCK_NS,
    LEAST_DISTANCE_M,
    LEAST_PARTS,
    STEP_NS,
    UNSETTLED,
    Adaptation,
    Corrected,
    ModelCheck,
    Rules,
    adapted,
    check_models,
    doubts_of,
    errors_between,
    noise_with_factor,
)
from cpcbl_team.motion import NO_VARIANCE, MotionVariance, distance_variance, turn_variance
from cpcbl_team.range_errors import NO_RANGE_ERRORS
from cpcbl_team.recovery_evidence import SPACING_NS, WINDOW_NS
from cpcbl_team.rough_pose import rough_pose
from cpcbl_team.self_calibration import ReferencePose, ReferencePoses, self_calibrate
from cpcbl_team.state import (
    CalibrationMemory,
    Evidence,
    State,
    with_calibration,
    with_recovery,
)

MOST_BEGIN_M, MOST_BEGIN_RAD = 0.5, math.radians(15.0)  # sigmas with which a filter begins
ROUGH_NS: Final = 5_000_000_000  # so often a lost robot looks for such a pose


class OwnCalibration:
    """The calibration of one robot by itself."""

    def __init__(self, settings: LocalizationSettings, field: Field, landmarks: Landmarks) -> None:
        rules = settings.localizer
        self._landmarks = landmarks
        self._noise: OdometryNoise = settings.odometry
        self._learns = rules.learns
        self._is_checked = not (
            rules.learns or rules.variant == "weighted" or rules.paper_uncertainty
        )
        # Of two that contradict each other either one may be wrong
        self._names_misplaced = len(field.names) > 2
        self._field, self._names_of_landmarks = field, frozenset(field.landmarks)
        block_s = BLOCK_NS * 1e-9
        correlation_s, spacing_s = settings.sensor.correlation_s, SPACING_NS * 1e-9
        self._rules = Rules(
            rules.gate_probability,
            independent_share=block_s / (block_s + 2.0 * correlation_s),
            knows_covariance=rules.variant != "circular",
        )
        self._correlation_s, names = correlation_s, sorted(field.landmarks)
        self._left_out = [
            frozenset(names[i::FILTERS] if self._names_misplaced else ()) for i in range(FILTERS)
        ]
        self._independent_frames = spacing_s / (spacing_s + 2.0 * correlation_s)

    def is_known(self, state: State) -> bool:
        """Whether the robot knows anything of its calibration that its settings do not say."""
        return self._learns or state.memory.calibration.adaptation is not AS_CONFIGURED

    def corrected_motion(
        self, state: State, distance: float, turn: float
    ) -> tuple[State, float, float]:
        """A motion by the scales that are known, and the state that counts its turn."""
        memory = state.memory.calibration
        distance *= memory.learned.distance_scale * memory.adaptation.distance_scale
        turn *= memory.learned.turn_scale * memory.adaptation.turn_scale
        memory = memory._replace(total_turn_rad=memory.total_turn_rad + turn)
        return with_calibration(state, memory), distance, turn

    def extra_variance(
        self, state: State, distance: float, turn: float, crawl_s: float
    ) -> MotionVariance:
        """What the motion is less certain than its settings say."""
        factor = state.memory.calibration.adaptation.motion_factor
        if factor == 1.0:
            return NO_VARIANCE
        usual, noise = self._noise, noise_with_factor(self._noise, factor)
        along = distance_variance(distance, turn, noise, crawl_s)
        around = turn_variance(distance, turn, noise)
        return MotionVariance(
            along - distance_variance(distance, turn, usual, crawl_s),
            around - turn_variance(distance, turn, usual),
        )

    def after_rejections(
        self, state: State, landmarks: LandmarkUpdate, others: Sequence[GatedObject]
    ) -> State:
        """The state that has noticed which objects of the map were rejected in a frame."""
        objects = [found.measurement for found in others]
        names = [m.source for m in objects if not m.sender] + landmarks.rejected
        memory = state.memory.calibration
        if not names or state.memory.recovery.lost or not self._is_checked:
            return state
        check, rejections = memory.check.with_rejections(names), memory.rejections
        if self._names_misplaced:
            rejections = rejections.plus(names, state.stamp_ns, state.updates.accepted)
        memory = memory._replace(check=check, rejections=rejections)
        return with_calibration(state, memory)

    def after_update(self, state: State) -> State:
        """The state after an update of the pose, with what the robot learns from it."""
        if self._learns:
            return self._after_learning(state)
        if not self._is_checked:
            return state
        now_ns, _, place, _, _, _, memory = state
        _, _, calibration, _ = memory
        _, _, _, check, present, _, _, common, *_ = calibration
        if common is not None and not common.is_precise:
            return state  # corrections of the pose tell of the camera
        begin, _, _, _, _, _, _, _, path_ns = check
        if begin is None or now_ns - begin.stamp_ns >= BLOCK_NS:
            return self._after_check(self._with_filters(self._with_residuals(state)))
        if now_ns - path_ns >= STEP_NS:
            return self._with_check(state, check.with_place(now_ns, place), present)
        return state

    def after_rejected(self, state: State) -> State:
        """The state after a frame of which nothing was accepted: the error for which the robot
        rejects what it measures may be one of its sensor."""
        filters = state.memory.calibration.filters
        is_due = not filters or state.stamp_ns - filters[0].stamp_ns >= BLOCK_NS
        return self._with_filters(state) if is_due and self._is_checked else state

    def after_odometry(self, state: State) -> State:
        """The state whose second filters have followed the odometry, where nothing is seen."""
        _, _, _, _, _, _, filters, *_ = state.memory.calibration
        if not filters or state.stamp_ns - filters[0].stamp_ns < STRIDE_NS:
            return state
        return self._with_filters(state)

    def without_adaptation(self, state: State) -> State:
        """The state without what the robot noticed of its settings and of its map so far."""
        memory, check = state.memory.calibration, ModelCheck(accepted=state.updates.accepted)
        known = CalibrationMemory(memory.learned, memory.references, memory.total_turn_rad, check)
        return with_calibration(state, known._replace(common=memory.common))

    def _with_residuals(self, state: State) -> State:
        """The state that has compared what it read of landmarks with the map, once a block in which
        it has moved: from one place any of them may be the wrong one."""
        memory, recovery, place = state.memory.calibration, state.memory.recovery, state[2]
        begin = memory.check.begin
        if not self._names_misplaced or begin is None or recovery.lost:
            return state
        moved = place.x - begin.odometry_from_robot.x, place.y - begin.odometry_from_robot.y
        if math.hypot(*moved) < LEAST_DISTANCE_M:
            return state
        field_from_odometry = state.estimate.pose @ place.inverse()
        sums, k = ResidualSums(memory.residuals), 1.0 / math.sqrt(self._independent_frames)
        last_ns, here = -1, state.estimate.pose  # all pieces of a frame have one place
        for e in self._evidence_since(state, begin.stamp_ns):
            stamp_ns, then, name, x, y, range_m, bearing, sigma_m, sigma_rad, _, _, _, _ = e
            if stamp_ns != last_ns:
                last_ns, here = stamp_ns, field_from_odometry @ then
            here_x, here_y, heading = here
            dx, dy = x - here_x, y - here_y
            sums.add(name, dx, dy, heading, range_m, bearing, k * sigma_m, k * sigma_rad)
        residuals = sums.residuals(state.estimate.covariance)
        return with_calibration(state, memory._replace(residuals=residuals))

    def _evidence_since(self, state: State, since_ns: int) -> list[Evidence]:
        """The robot's own evidence of the landmarks of the map after this time."""
        recovery, adaptation = state.memory.recovery, state.memory.calibration.adaptation
        pieces = list(recovery.evidence)
        for snapshot in recovery.snapshots:
            if snapshot[0] > since_ns:
                pieces += self._landmarks.evidence_of(snapshot, adaptation)
        names = self._names_of_landmarks
        return [
            e for e in pieces if e.stamp_ns > since_ns and e.source in names and not e.from_teammate
        ]

    def _with_filters(self, state: State) -> State:
        """The state whose second filters have used the landmarks that were seen, once a block; with
        the errors of the sensor that these are sure of corrected."""
        memory, filters = state.memory.calibration, self._filters_after(state)
        if not filters:
            has_looked = bool(state.lost) and self._is_rough_due(state)
            rough_ns = state.stamp_ns if has_looked else memory.rough_ns
            return with_calibration(state, memory._replace(filters=(), rough_ns=rough_ns))
        present = memory.adaptation
        changed = correction(filters, present) if self._may_correct(state) else None
        if changed is None:
            estimate, place = state.estimate, state.odometry_from_robot
            filters = with_probabilities(filters, present, estimate, place)
            return with_calibration(state, memory._replace(filters=filters))
        is_first = present.bearing_bias_rad == 0.0 != changed.bearing_bias_rad
        is_first |= present.ranges == NO_RANGE_ERRORS != changed.ranges
        if not is_first:
            is_new = present._replace(motion_factor=1.0, sensor_factor=1.0) == AS_CONFIGURED
            check = memory.check.restarted(state.updates.accepted)
            memory = memory._replace(filters=filters, check=check)
            state = _with_adaptation(with_calibration(state, memory), changed)
            return state.counted("miscalibrated") if is_new else state
        # What was found with the errors is void, the pose and other changes of the settings too
        place, estimate = state.odometry_from_robot, state.estimate
        distance, turn, _ = errors_between(present, AS_CONFIGURED)
        filters = tuple([f.with_scales(distance, turn) for f in filters])
        _, _, bias_rad, _, _, ranges = changed
        only = AS_CONFIGURED._replace(bearing_bias_rad=bias_rad, ranges=ranges)
        state = self.without_adaptation(state.counted("miscalibrated"))
        memory = state.memory.calibration._replace(filters=filters, adaptation=only)
        state = with_calibration(state, memory)
        return _at_pose(state, filters[0].estimate_at(place, estimate))

    def _may_correct(self, state: State) -> bool:
        """Whether wrong settings may be corrected: a wrong distance between the only two landmarks
        of a map looks like wrong ranges, and where the robot once found that one is misplaced, that
        is as likely."""
        is_corrected = state.memory.calibration.adaptation.ranges != NO_RANGE_ERRORS
        return self._names_misplaced or is_corrected or not state.memory.recovery.misplaced

    def _filters_after(self, state: State) -> tuple[CalibrationFilter, ...]:
        """The second filters after the landmarks that were seen since; empty before they begin."""
        now_ns, estimate, place, odometry, until_ns, _, (recovery, _, memory, events) = state
        filters, gaps = memory.filters, events.get("odometry_gap", 0)
        if memory.common is not None or not self._names_of_landmarks:
            return filters
        is_known = not recovery.lost and estimate.position_sigma_m < MOST_BEGIN_M
        if not filters or any(f.rejected > MOST_REJECTED for f in filters):
            is_known &= estimate.heading_sigma_rad < MOST_BEGIN_RAD
            begin = estimate if is_known else self._rough_estimate(state)
            if begin is None:
                return ()
            return (CalibrationFilter.at(now_ns, place, begin, gaps),) * FILTERS
        is_broken = gaps > filters[0].gaps or now_ns - filters[0].stamp_ns > LONGEST_NS
        is_broken |= odometry is not None and until_ns < now_ns
        if is_broken:
            known = [f.with_pose(now_ns, place, estimate, gaps) for f in filters]
            return tuple(known) if is_known else ()
        frames = self._frames_since(state, filters[0].stamp_ns)
        if not frames or frames[-1].stamp_ns < now_ns:
            frames.append(Frame(now_ns, place, []))
        return tuple(
            [
                f.after(frames, self._noise, self._correlation_s, self._left_out[i])
                for i, f in enumerate(filters)
            ]
        )

    def _rough_estimate(self, state: State) -> Estimate | None:
        """Where a lost robot is if its ranges are hardly known; None if that determines no pose, or
        if a mistake of its driver explains why it is lost."""
        recovery = state.memory.recovery
        if not recovery.lost or recovery.mistake or not self._is_rough_due(state):
            return None
        evidence = self._evidence_since(state, state.stamp_ns - WINDOW_NS)
        return rough_pose(evidence, state.odometry_from_robot, self._field, self._noise)

    def _is_rough_due(self, state: State) -> bool:
        return state.stamp_ns - state.memory.calibration.rough_ns >= ROUGH_NS

    def _frames_since(self, state: State, since_ns: int) -> list[Frame]:
        """The landmarks that were seen after this time, as the sensor read them."""
        memory = state.memory.calibration
        present, frames = memory.adaptation, dict[int, Frame]()
        for e in self._evidence_since(state, since_ns):
            stamp_ns, place, name, x, y, range_m, bearing, sigma_m, sigma_rad, _, _, _, _ = e
            if name == memory.residuals.misplaced:
                continue
            if range_m is not None:  # evidence is corrected
                range_m = (range_m - present.ranges.offset_m) / present.ranges.scale
            if bearing is not None:
                bearing += present.bearing_bias_rad
            seen = SeenLandmark(name, x, y, range_m, bearing, sigma_m * sigma_m, sigma_rad**2)
            frames.setdefault(stamp_ns, Frame(stamp_ns, place, [])).seen.append(seen)
        return sorted(frames.values())

    def _after_learning(self, state: State) -> State:
        memory, place = state.memory.calibration, state.odometry_from_robot
        here = ReferencePose(state.stamp_ns, state.estimate, place, memory.total_turn_rad)
        if state.memory.recovery.lost:
            memory = memory._replace(references=None)
        elif memory.references is None:
            memory = memory._replace(references=ReferencePoses(here, here))
        else:
            known, references = self_calibrate(memory.learned, memory.references, here, self._noise)
            memory = memory._replace(learned=known, references=references)
        return with_calibration(state, memory)

    def _after_check(self, state: State) -> State:
        """The state at the end of a block."""
        gaps = state.memory.events.get("odometry_gap", 0)
        now_ns, estimate, place, _, odometry_until_ns, _, memory = state
        now = new(Corrected, (now_ns, estimate, place, gaps))
        known = memory.calibration
        check, present, begin = known.check, known.adaptation, known.check.begin
        if begin is None and not check.accepted:
            # In its first block the robot corrects what a wide prior left. Not after it was lost:
            # that may be by the very error that blocks shall tell, time after time
            check = check.from_pose(now._replace(gaps=UNSETTLED))
        elif (
            begin is None
            or memory.recovery.lost
            or odometry_until_ns < now_ns
            or memory.teammates.last_report_ns >= begin.stamp_ns
        ):
            check = check.from_pose(now)
        else:
            noise = noise_with_factor(self._noise, present.motion_factor)
            check = check_models(check, now, noise)
            if check.evidence.parts >= LEAST_PARTS:
                return self._after_judgement(state, check, now)
        return self._with_check(state, check, present)

    def _after_judgement(self, state: State, check: ModelCheck, now: Corrected) -> State:
        """The state at the end of a block, after which there are enough to judge the settings."""
        memory, accepted = state.memory.calibration, state.updates.accepted
        present = memory.adaptation
        changed = adapted(check, present, accepted, self._rules)
        doubts = doubts_of(check, present, changed or present, self._rules.independent_share)
        check = check._replace(doubts=doubts)
        if changed is None:
            return self._with_check(state, check, present)
        is_corrected = errors_between(present, changed) != NO_ERRORS
        state = _with_adaptation(with_calibration(state, memory._replace(check=check)), changed)
        now = now._replace(estimate=state.estimate)
        # Other sigmas whiten otherwise: what was collected with the old ones is void
        evidence = state.memory.calibration.check.evidence if is_corrected else NO_EVIDENCE
        check = ModelCheck(
            now, check.sensitivity, evidence, 0, "", accepted, doubts, (), now.stamp_ns
        )
        return self._with_check(state.counted("miscalibrated"), check, changed)

    def _with_check(self, state: State, check: ModelCheck, present: Adaptation) -> State:
        memory = state.memory.calibration
        learned, references, total_turn_rad, _, _, *others = memory
        parts = learned, references, total_turn_rad, check, present, *others
        return with_calibration(state, new(CalibrationMemory, parts))


def _at_pose(state: State, estimate: Estimate) -> State:
    """The state at another pose. Why the robot was lost before, and what of the map it blamed for
    it, is void."""
    recovery, updates = state.memory.recovery, state.updates
    state = state.counted("found_again") if recovery.lost else state
    state = state._replace(estimate=estimate, updates=updates._replace(innovations=1))
    return with_recovery(state, no_longer_lost(recovery)._replace(misplaced={}))


def _with_adaptation(state: State, changed: Adaptation) -> State:
    """The state with other settings: the pose, and what was collected, as if they had been so all
    the time."""
    memory = state.memory.calibration
    check, errors = memory.check, errors_between(memory.adaptation, changed)
    pose = offset_pose(state.estimate.pose, pose_offset(check.sensitivity, errors), POSE)
    distance, turn, _ = errors
    memory = memory._replace(
        check=check._replace(evidence=check.evidence.without(errors)),
        adaptation=changed,
        filters=tuple([f.with_scales(distance, turn) for f in memory.filters]),
    )
    state = state._replace(estimate=state.estimate._replace(pose=pose))
    return with_calibration(state, memory)
