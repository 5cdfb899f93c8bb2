"""The second filters of one robot: when they begin, what they see, and what follows from them.

Beside its pose filter a robot has three that know less of its settings (`calibration_filter.py`).
What all of them find wrong is corrected, and what they do not know of the scales of the odometry
makes the pose less certain (`scale_errors.py`).
"""

import math
from typing import Final

from cpcbl_team.calibration_doubt import scale_variances, with_probabilities
from cpcbl_team.calibration_filter import (
    FILTERS,
    FIRST_SIGMAS,
    LONGEST_NS,
    MOST_REJECTED,
    CalibrationFilter,
    Filters,
    Frame,
    SeenLandmark,
)
from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.constant_errors import pose_offset
from cpcbl_team.estimate import POSE, Estimate, offset_pose
from cpcbl_team.filter_corrections import KindsOfError, correction
from cpcbl_team.landmarks import Landmarks
from cpcbl_team.lost_reasons import no_longer_lost
from cpcbl_team.miscalibration import AS_CONFIGURED, Adaptation, ModelCheck, errors_between
from cpcbl_team.range_errors import NO_RANGE_ERRORS
from cpcbl_team.recovery_evidence import WINDOW_NS
from cpcbl_team.rough_pose import rough_pose
from cpcbl_team.scale_errors import EXACT, ScaleErrors
from cpcbl_team.state import (
    Evidence,
    Jump,
    State,
    at_new_pose,
    with_calibration,
    with_common_errors,
    with_recovery,
)

MOST_BEGIN_M, MOST_BEGIN_RAD = 0.5, math.radians(15.0)  # sigmas with which a filter begins
ROUGH_NS: Final = 5_000_000_000  # so often a lost robot looks for such a pose
CONFIRMED_NS: Final = 10_000_000_000  # in which a robot that was carried away rejects nothing


class SecondFilters:
    """Those of one robot."""

    def __init__(self, settings: LocalizationSettings, field: Field, landmarks: Landmarks) -> None:
        odometry = settings.odometry
        self._landmarks, self._field, self._noise = landmarks, field, odometry
        self._correlation_s = settings.sensor.correlation_s
        self._bearing_variance = settings.sensor.bearing_sigma_rad**2
        self._names_of_landmarks, names = frozenset(field.landmarks), sorted(field.landmarks)
        self._has_other_landmarks = len(field.names) > 2
        self._has_two_ranges = not self._has_other_landmarks and field.gives_only_ranges
        self._left_out = [
            frozenset(names[i::FILTERS] if self._has_other_landmarks else ())
            for i in range(FILTERS)
        ]
        distance, turn = odometry.distance_scale_sigma, odometry.turn_scale_sigma
        rules = settings.localizer
        is_of_paper = rules.variant == "weighted" or rules.paper_uncertainty
        self.scales = EXACT if is_of_paper else ScaleErrors.of_sigmas(distance, turn)
        """As the settings have them; the variants of the paper know of no such errors."""
        self.estimates_scales = rules.estimates_whole_pose and not rules.learns
        """Whether updates of the pose tell of them. Where heading and position are updated apart,
        their covariance with each other is not that of their errors."""
        *of_sensor, usual_distance, usual_turn = FIRST_SIGMAS
        self._first_sigmas = (*of_sensor, distance or usual_distance, turn or usual_turn)

    def after_block(self, state: State) -> State:
        """The state whose second filters have used the landmarks that were seen, once a block."""
        return self._with_scales(self._corrected(state))

    def _with_scales(self, state: State) -> State:
        """The state whose covariance contains what the second filters do not know of the scales
        of the odometry."""
        memory = state.memory.calibration
        if self.scales.are_exact or (self.estimates_scales and not memory.filters):
            return state
        scales = memory.scales.after_updates(state.estimate, self.estimates_scales)
        variances = scale_variances(memory.filters, self.scales)
        scales = scales.with_considered(*variances, state.estimate)
        return with_calibration(state, memory._replace(scales=scales))

    def without_adaptation(self, state: State) -> State:
        """The state without what the robot noticed of its settings and of its map so far."""
        memory, check = state.memory.calibration, ModelCheck(accepted=state.updates.accepted)
        known = CalibrationMemory(memory.learned, memory.references, memory.total_turn_rad, check)
        known = known._replace(common=memory.common, scales=memory.scales)
        return with_calibration(state, known)

    def evidence_since(self, state: State, since_ns: int) -> list[Evidence]:
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

    def _corrected(self, state: State) -> State:
        """The state whose second filters have used the landmarks that were seen, once a block; with
        the errors of the sensor that these are sure of corrected."""
        memory, filters = state.memory.calibration, self._filters_after(state)
        if not filters:
            has_looked = bool(state.lost) and self._is_rough_due(state)
            rough_ns = state.stamp_ns if has_looked else memory.rough_ns
            return with_calibration(state, memory._replace(filters=(), rough_ns=rough_ns))
        present = memory.adaptation
        changed = self._correction(state, filters)
        if changed is None:
            estimate, place = state.estimate, state.odometry_from_robot
            considered = KindsOfError(not self.scales.are_exact, memory.common is not None)
            filters = with_probabilities(filters, present, estimate, place, considered)
            return with_calibration(state, memory._replace(filters=filters))
        is_first = present.bearing_bias_rad == 0.0 != changed.bearing_bias_rad
        is_first |= present.ranges == NO_RANGE_ERRORS != changed.ranges
        if not is_first:
            is_new = present._replace(motion_factor=1.0, sensor_factor=1.0) == AS_CONFIGURED
            check = memory.check.restarted(state.updates.accepted)
            memory = memory._replace(filters=filters, check=check)
            state = with_adaptation(with_calibration(state, memory), changed)
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
        return _at_pose(state, filters[0])

    def _correction(self, state: State, filters: Filters) -> Adaptation | None:
        """What these filters are sure of; None if it changes nothing."""
        if not self._may_correct(state) or _is_jump_new(state, filters):
            return None
        present, are_doubtful = state.memory.calibration.adaptation, not self.scales.are_exact
        are_estimated = self.estimates_scales and are_doubtful
        estimated = KindsOfError(are_estimated, state.common_errors is not None)
        return correction(filters, present, estimated, are_doubtful)

    def _may_correct(self, state: State) -> bool:
        """Whether wrong settings may be corrected: a wrong distance between the only two landmarks
        of a map looks like wrong ranges, and where the robot once found that one is misplaced, that
        is as likely. Two ranges fit the mirror image of a way as well, with other errors."""
        if self._has_two_ranges:
            return False
        is_corrected = state.memory.calibration.adaptation.ranges != NO_RANGE_ERRORS
        return self._has_other_landmarks or is_corrected or not state.memory.recovery.misplaced

    def _filters_after(self, state: State) -> tuple[CalibrationFilter, ...]:
        """The second filters after the landmarks that were seen since; empty before they begin."""
        now_ns, estimate, place, odometry, until_ns, _, (recovery, _, memory, events, _) = state
        filters, gaps = memory.filters, events.get("odometry_gap", 0)
        if not self._names_of_landmarks or not has_second_filters(memory.common):
            return filters
        is_known = not recovery.lost and estimate.position_sigma_m < MOST_BEGIN_M
        if not filters or any(f.rejected > MOST_REJECTED for f in filters):
            is_known &= estimate.heading_sigma_rad < MOST_BEGIN_RAD
            is_known &= state.mixture is None
            begin = estimate if is_known else self._rough_estimate(state)
            return () if begin is None else self._begun_at(state, begin)
        if _was_carried_away(state, filters):
            return self._begun_at(state, estimate)
        filters = tuple([f.for_scales(*memory.scales.factors) for f in filters])
        is_broken = gaps > filters[0].gaps or now_ns - filters[0].stamp_ns > LONGEST_NS
        is_broken |= odometry is not None and until_ns < now_ns
        if is_broken:
            known = [f.with_pose(now_ns, place, estimate, gaps) for f in filters]
            return tuple(known) if is_known else ()
        frames = self._frames_since(state, filters[0].stamp_ns)
        if not frames or frames[-1].stamp_ns < now_ns:
            frames.append(Frame(now_ns, place, []))
        after = [
            f.after(frames, self._noise, self._correlation_s, self._left_out[i])
            for i, f in enumerate(filters)
        ]
        if not is_known:
            return tuple(after)
        of_blind = now_ns, place, estimate, gaps
        return tuple([f.with_pose(*of_blind) if f.is_blind else f for f in after])

    def _begun_at(self, state: State, begin: Estimate) -> tuple[CalibrationFilter, ...]:
        """Filters that know nothing yet but about where the robot is."""
        now_ns, _, place, _, _, _, (recovery, _, memory, events, _) = state
        gaps = events.get("odometry_gap", 0)
        first = CalibrationFilter.at(now_ns, place, begin, gaps, self._first_sigmas)
        jumped_ns = recovery.jump.stamp_ns if recovery.jump else -1
        return (first._replace(scales=memory.scales.factors, jumped_ns=jumped_ns),) * FILTERS

    def _rough_estimate(self, state: State) -> Estimate | None:
        """Where a lost robot is if its ranges are hardly known; None if that determines no pose, or
        if a mistake of its driver explains why it is lost."""
        recovery = state.memory.recovery
        if not recovery.lost or recovery.mistake or not self._is_rough_due(state):
            return None
        evidence = self.evidence_since(state, state.stamp_ns - WINDOW_NS)
        return rough_pose(evidence, state.odometry_from_robot, self._field, self._noise)

    def _is_rough_due(self, state: State) -> bool:
        return state.stamp_ns - state.memory.calibration.rough_ns >= ROUGH_NS

    def _frames_since(self, state: State, since_ns: int) -> list[Frame]:
        """The landmarks that were seen after this time, as the sensor read them."""
        memory = state.memory.calibration
        present, common, frames = memory.adaptation, memory.common, dict[int, Frame]()
        for e in self.evidence_since(state, since_ns):
            stamp_ns, place, name, x, y, range_m, bearing, sigma_m, sigma_rad, _, _, _, _ = e
            if name == memory.residuals.misplaced:
                continue
            if range_m is not None:  # evidence is corrected
                range_m = (range_m - present.ranges.offset_m) / present.ranges.scale
            if bearing is not None:
                bearing += present.bearing_bias_rad
            variance = sigma_rad**2
            if common is not None:  # its bias is a state here, not noise
                _, of_bias = common.reading_variances(common.axis_rad)
                variance = max(variance - of_bias, self._bearing_variance)
                bearing = None if bearing is None else bearing + common.errors.yaw_rad
            seen = SeenLandmark(name, x, y, range_m, bearing, sigma_m * sigma_m, variance)
            frames.setdefault(stamp_ns, Frame(stamp_ns, place, [])).seen.append(seen)
        return sorted(frames.values())


def has_second_filters(common: CommonErrors | None) -> bool:
    """Whether a robot with these errors beside its pose has second filters: they know of no errors
    but a bias of bearings and those of ranges."""
    return common is None or common.is_of_bearings


def _jump_since(state: State, filters: Filters) -> Jump | None:
    """The jump of the robot to another place since these filters began: either it was carried away,
    which they take for wrong settings, or its settings are wrong. None if it has not jumped."""
    jump = state.memory.recovery.jump
    return jump if jump is not None and jump.stamp_ns > filters[0].jumped_ns else None


def _is_jump_new(state: State, filters: Filters) -> bool:
    """Whether it is open yet if the robot was carried away: nothing is corrected so soon."""
    jump = _jump_since(state, filters)
    if jump is None or state.lost:
        return False
    return state.stamp_ns - jump.stamp_ns <= CONFIRMED_NS


def _was_carried_away(state: State, filters: Filters) -> bool:
    """Whether all that the robot measures since its jump confirms that it is there: then what the
    filters found on the way is void."""
    jump, recovery = _jump_since(state, filters), state.memory.recovery
    if jump is None or recovery.lost or recovery.suspected_ns >= 0:
        return False
    return state.stamp_ns - jump.stamp_ns > CONFIRMED_NS


def _at_pose(state: State, known: CalibrationFilter) -> State:
    """The state at the pose of a second filter. Why the robot was lost before, and what of the map
    it blamed for it, is void."""
    recovery, updates, common = state.memory.recovery, state.updates, state.common_errors
    estimate = known.estimate_at(state.odometry_from_robot, state.estimate)
    state = state.counted("found_again") if recovery.lost else state
    state = at_new_pose(state, estimate)._replace(updates=updates._replace(innovations=1))
    if common is not None:
        state = with_common_errors(state, common.with_bearing_bias(*known.bearing_bias))
    return with_recovery(state, no_longer_lost(recovery)._replace(misplaced={}))


def with_adaptation(state: State, changed: Adaptation) -> State:
    """The state with other settings: the pose, and what was collected, as if they had been so all
    the time."""
    memory = state.memory.calibration
    check, errors = memory.check, errors_between(memory.adaptation, changed)
    distance, turn, bias_rad = errors
    if memory.scales.are_exact:
        offset = pose_offset(check.sensitivity, errors)
    else:
        dx, dy, turned = memory.scales.pose_offset(state.estimate, distance, turn)
        x, y, heading = pose_offset(check.sensitivity, (0.0, 0.0, bias_rad))
        offset = x + dx, y + dy, heading + turned
    pose = offset_pose(state.estimate.pose, offset, POSE)
    memory = memory._replace(
        check=check._replace(evidence=check.evidence.without(errors)),
        adaptation=changed,
        filters=tuple([f.with_scales(distance, turn) for f in memory.filters]),
    )
    state = state._replace(estimate=state.estimate._replace(pose=pose))
    return with_calibration(state, memory)
