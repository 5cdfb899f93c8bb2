"""What a robot knows of its own calibration while it drives, as the localizer uses it.

A robot that calibrates itself (`self_calibration.py`) learns scales and a bias all the time; every
other one changes its settings only where they are wrong (`miscalibration.py`).
"""

from collections.abc import Sequence

from cpcbl_team.config import Field, LocalizationSettings, OdometryNoise
from cpcbl_team.constant_errors import NO_ERRORS, Evidence, pose_offset
from cpcbl_team.estimate import POSE, offset_pose
from cpcbl_team.geometry import new
from cpcbl_team.landmarks import LandmarkUpdate
from cpcbl_team.measurements import GatedObject
from cpcbl_team.miscalibration import (
    AS_CONFIGURED,
    BLOCK_NS,
    Corrected,
    ModelCheck,
    adapted,
    check_models,
    errors_between,
    noise_with_factor,
)
from cpcbl_team.motion import NO_VARIANCE, MotionVariance, distance_variance, turn_variance
from cpcbl_team.self_calibration import ReferencePose, ReferencePoses, self_calibrate
from cpcbl_team.state import CalibrationMemory, Memory, State, with_memory


class OwnCalibration:
    """The calibration of one robot by itself."""

    def __init__(self, settings: LocalizationSettings, field: Field) -> None:
        rules = settings.localizer
        self._noise: OdometryNoise = settings.odometry
        self._gate_probability = rules.gate_probability
        self._learns = rules.learns
        # The others do not know how large a correction should be
        knows_covariance = rules.variant in ("joint", "oval") and not rules.paper_uncertainty
        self._is_checked = knows_covariance and not rules.learns
        # Of two that contradict each other either one may be wrong
        self._names_misplaced = len(field.landmarks) + len(field.walls) > 2
        block_s = BLOCK_NS * 1e-9
        self._independent_share = block_s / (block_s + 2.0 * settings.sensor.correlation_s)

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
        return _with_calibration(state, memory), distance, turn

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
        names = [m.source for m in objects if not m.is_teammate] + landmarks.rejected
        memory = state.memory.calibration
        if not names or state.memory.recovery.lost or not self._is_checked:
            return state
        check, rejections = memory.check.with_rejections(names), memory.rejections
        if self._names_misplaced:
            rejections = rejections.plus(names, state.stamp_ns, state.updates.accepted)
        memory = memory._replace(check=check, rejections=rejections)
        return _with_calibration(state, memory)

    def after_update(self, state: State) -> State:
        """The state after an update of the pose, with what the robot learns from it."""
        if self._learns:
            return self._after_learning(state)
        begin = state.memory.calibration.check.begin
        if self._is_checked and (begin is None or state.stamp_ns - begin.stamp_ns >= BLOCK_NS):
            return self._after_check(state)
        return state

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
        return _with_calibration(state, memory)

    def _after_check(self, state: State) -> State:
        """The state at the end of a block."""
        gaps = state.memory.events.get("odometry_gap", 0)
        now = Corrected(state.stamp_ns, state.estimate, state.odometry_from_robot, gaps)
        memory, accepted = state.memory.calibration, state.updates.accepted
        check, present, begin = memory.check, memory.adaptation, memory.check.begin
        if (
            begin is None
            or state.memory.recovery.lost
            or state.odometry_until_ns < state.stamp_ns
            or state.memory.teammates.last_report_ns >= begin.stamp_ns
        ):
            check = check.from_pose(now)
        else:
            noise = noise_with_factor(self._noise, present.motion_factor)
            check = check_models(check, now, noise)
            rules = self._gate_probability, self._independent_share
            changed = adapted(check, present, accepted, *rules)
            if changed is not None:
                errors = errors_between(present, changed)
                pose = offset_pose(
                    state.estimate.pose, pose_offset(check.sensitivity, errors), POSE
                )
                state = state._replace(estimate=state.estimate._replace(pose=pose))
                now = now._replace(estimate=state.estimate)
                # Other sigmas whiten otherwise: what was collected with the old ones is void
                has_errors = errors != NO_ERRORS
                evidence = check.evidence.without(errors) if has_errors else Evidence()
                check = ModelCheck(now, check.sensitivity, evidence, accepted=accepted)
                state, present = state.counted("miscalibrated"), changed
        learned, references, total_turn_rad, _, _, rejections = memory
        parts = learned, references, total_turn_rad, check, present, rejections
        return _with_calibration(state, new(CalibrationMemory, parts))


def _with_calibration(state: State, memory: CalibrationMemory) -> State:
    recovery, teammates, _, events = state.memory
    return with_memory(state, new(Memory, (recovery, teammates, memory, events)))
