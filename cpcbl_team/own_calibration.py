"""What a robot knows of its own calibration while it drives, as the localizer uses it.

A robot that calibrates itself (`self_calibration.py`) learns scales and a bias all the time; every
other one changes its settings only where they are wrong (`miscalibration.py`, and
`calibration_filter.py` for what its sensor reads).
"""

import math
from collections.abc import Sequence

from cpcbl_team.calibration_filter import (
    STRIDE_NS,
)
from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.config import Field, LocalizationSettings, OdometryNoise
from cpcbl_team.constant_errors import NO_ERRORS, NO_EVIDENCE
from cpcbl_team.estimate import POSE, offset_pose
from cpcbl_team.geometry import new
from cpcbl_team.landmarks import Landmarks, LandmarkUpdate
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
from cpcbl_team.parameters import NO_COVARIANCE
from cpcbl_team.recovery_evidence import SPACING_NS
from cpcbl_team.scale_errors import ScaleErrors
from cpcbl_team.second_filters import SecondFilters, has_second_filters, with_adaptation
from cpcbl_team.self_calibration import ReferencePose, ReferencePoses, self_calibrate
from cpcbl_team.state import (
    State,
    with_calibration,
)


def is_precise(common: CommonErrors | None) -> bool:
    """Whether the errors that sightings have in common do not matter beside others."""
    return common is None or common.is_precise


class OwnCalibration:
    """The calibration of one robot by itself."""

    def __init__(self, settings: LocalizationSettings, field: Field, landmarks: Landmarks) -> None:
        rules = settings.localizer
        self._noise: OdometryNoise = settings.odometry
        self._learns = rules.learns
        self._is_checked = not (
            rules.learns or rules.variant == "weighted" or rules.paper_uncertainty
        )
        # Of two that contradict each other either one may be wrong
        self._names_misplaced = len(field.names) > 2
        self.filters = SecondFilters(settings, field, landmarks)
        block_s = BLOCK_NS * 1e-9
        correlation_s, spacing_s = settings.sensor.correlation_s, SPACING_NS * 1e-9
        self._rules = Rules(
            rules.gate_probability,
            independent_share=block_s / (block_s + 2.0 * correlation_s),
            knows_covariance=rules.variant != "circular",
            finds_scales=self.filters.scales.are_exact or not self.filters.estimates_scales,
        )
        self._independent_frames = spacing_s / (spacing_s + 2.0 * correlation_s)

    def started(self, state: State) -> State:
        """The state at the start: the scales of the odometry are known as the settings have it."""
        scales, memory = self.filters.scales, state.memory.calibration
        if scales.are_exact:
            return state
        if self._learns:
            learned = memory.learned._replace(
                distance_variance=scales.distance.first, turn_variance=scales.turn.first
            )
            memory = memory._replace(learned=learned)
        return with_calibration(state, memory._replace(scales=scales))

    def is_known(self, state: State) -> bool:
        """Whether the robot knows anything of its calibration that its settings do not say."""
        memory = state.memory.calibration
        is_adapted = memory.adaptation is not AS_CONFIGURED
        return is_adapted or self._learns or not memory.scales.are_exact

    def corrected_motion(
        self, state: State, distance: float, turn: float
    ) -> tuple[State, float, float]:
        """A motion by the scales that are known, and the state that counts its turn. What updates
        since the last motion say of the scales is known then."""
        memory = state.memory.calibration
        scales = memory.scales
        if not scales.are_exact:
            state, scales = self._scales_after_updates(state)
            distance *= scales.distance.factor
            turn *= scales.turn.factor
        distance *= memory.learned.distance_scale * memory.adaptation.distance_scale
        turn *= memory.learned.turn_scale * memory.adaptation.turn_scale
        memory = memory._replace(total_turn_rad=memory.total_turn_rad + turn, scales=scales)
        return with_calibration(state, memory), distance, turn

    def _scales_after_updates(self, state: State) -> tuple[State, ScaleErrors]:
        """What is known of the scales of the odometry after the updates since the last motion; and
        the state at the pose without the errors of these that are corrected now."""
        scales, estimate = state.memory.calibration.scales, state.estimate
        if state.lost:
            return state, scales.at_new_pose()
        known = scales.after_updates(estimate, self.filters.estimates_scales)
        known, offset = known.corrected()
        if known.contradict_settings and not scales.contradict_settings:
            state = state.counted("miscalibrated")
        if offset != NO_COVARIANCE:
            estimate = estimate._replace(pose=offset_pose(estimate.pose, offset, POSE))
            state = state._replace(estimate=estimate)
        return state, known

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
        calibration = memory.calibration
        _, _, _, check, present, _, _, common, *_ = calibration
        if not (has_second_filters(common) or is_precise(common)):
            return state
        begin, _, _, _, _, _, _, _, path_ns = check
        if begin is None or now_ns - begin.stamp_ns >= BLOCK_NS:
            return self._after_check(self.filters.after_block(self._with_residuals(state)))
        if now_ns - path_ns >= STEP_NS:
            return self._with_check(state, check.with_place(now_ns, place), present)
        return state

    def after_rejected(self, state: State) -> State:
        """The state after a frame of which nothing was accepted: the error for which the robot
        rejects what it measures may be one of its sensor."""
        filters = state.memory.calibration.filters
        is_due = not filters or state.stamp_ns - filters[0].stamp_ns >= BLOCK_NS
        return self.filters.after_block(state) if is_due and self._is_checked else state

    def after_odometry(self, state: State) -> State:
        """The state whose second filters have followed the odometry, where nothing is seen."""
        _, _, _, _, _, _, filters, *_ = state.memory.calibration
        if not filters or state.stamp_ns - filters[0].stamp_ns < STRIDE_NS:
            return state
        return self.filters.after_block(state)

    def without_adaptation(self, state: State) -> State:
        """The state without what the robot noticed of its settings and of its map so far, for its
        inputs were wrong."""
        state = self.filters.without_adaptation(state)
        memory = state.memory.calibration
        # Those of a robot that calibrates itself are what it has learned before
        scales = memory.scales if self._learns else self.filters.scales
        return with_calibration(state, memory._replace(scales=scales))

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
        for e in self.filters.evidence_since(state, begin.stamp_ns):
            stamp_ns, then, name, x, y, range_m, bearing, sigma_m, sigma_rad, _, _, _, _ = e
            if stamp_ns != last_ns:
                last_ns, here = stamp_ns, field_from_odometry @ then
            here_x, here_y, heading = here
            dx, dy = x - here_x, y - here_y
            sums.add(name, dx, dy, heading, range_m, bearing, k * sigma_m, k * sigma_rad)
        residuals = sums.residuals(state.estimate.covariance)
        return with_calibration(state, memory._replace(residuals=residuals))

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
        scales = memory.scales
        if not scales.are_exact:
            learned = memory.learned
            variances = learned.distance_variance, learned.turn_variance
            scales = scales.with_considered(*variances, state.estimate)
        return with_calibration(state, memory._replace(scales=scales))

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
            or not is_precise(known.common)  # corrections of the pose tell of the sensor
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
        if not memory.scales.are_exact:  # those of odometry are in the estimate already
            doubts = 0.0, 0.0, doubts[2]
        check = check._replace(doubts=doubts)
        if changed is None:
            return self._with_check(state, check, present)
        is_corrected = errors_between(present, changed) != NO_ERRORS
        state = with_adaptation(with_calibration(state, memory._replace(check=check)), changed)
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
