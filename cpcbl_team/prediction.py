"""Step 1 of the cycle: the state at a later time, by odometry."""

from cpcbl_team.common_error_filter import CommonErrorFilter
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.estimate import ZERO3, Estimate
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry
from cpcbl_team.motion import (
    NO_VARIANCE,
    MotionVariance,
    PoseTimes,
    bridge,
    guess_variance,
    inflate_by_change,
    inflate_by_gap,
    is_gap,
    part_of_piece,
)
from cpcbl_team.own_calibration import OwnCalibration
from cpcbl_team.recovery_evidence import without_evidence
from cpcbl_team.sensors import time_at_min_speed_s
from cpcbl_team.state import (
    State,
    with_calibration,
    with_mixture,
    with_motion,
    with_odometry,
    with_recovery,
    with_teammates,
)
from cpcbl_team.variants import JointVariant


class Prediction:
    """How the pose of one robot follows its odometry."""

    def __init__(
        self,
        settings: LocalizationSettings,
        variant: JointVariant,
        calibration: OwnCalibration,
        common: CommonErrorFilter | None,
    ) -> None:
        """`common`: the errors that depend on those of the pose."""
        self._odometry, self._moves = settings.odometry, settings.odometry.moves
        self._odometry_timeout_ns = int(settings.odometry.timeout_s * 1e9)
        self._has_dead_zone = settings.odometry.least_speed_m_s > 0.0
        self._variant, self._calibration, self._common = variant, calibration, common

    def add_odometry(self, state: State, odometry: Odometry) -> State:
        """Takes the next piece of odometry; predictions for later times will use it."""
        from_ns, until_ns = odometry.from_ns, odometry.stamp_ns
        if until_ns <= from_ns:
            return state.counted("impossible_duration")
        before, guessed_ns = state.odometry, 0
        if before is not None and from_ns > state.odometry_until_ns:
            if is_gap(from_ns - state.odometry_until_ns, before, odometry):
                state = state.counted("odometry_gap")
                guessed_ns = self._guessed_ns(state, from_ns) if self._moves else 0
            else:
                state = with_odometry(state, before, from_ns)
        if from_ns > state.stamp_ns:
            state = self.predict(state, from_ns, odometry)
        if before is not None and guessed_ns > 0:
            state = self._with_change(state, before, odometry, guessed_ns)
        if before is not None and before.stamp_ns > state.stamp_ns:
            state = state.counted("odometry_overlap")
        state = with_odometry(state, odometry, max(state.odometry_until_ns, until_ns))
        return self._calibration.after_odometry(state)

    def predict(self, state: State, until_ns: int, following: Odometry | None = None) -> State:
        """Step 1: the state at `until_ns`, moved along the known odometry (J C J^T, section 4). If
        odometry was lost, the robot is assumed to drive on as before; `following` is the piece that
        begins at `until_ns`, if there is one."""
        stamp_ns, estimate = state.stamp_ns, state.estimate
        if until_ns <= stamp_ns:
            return state
        odometry_from_robot, piece = state.odometry_from_robot, state.odometry
        if piece is not None and piece.stamp_ns > stamp_ns:
            distance, turn, seconds = part_of_piece(piece, stamp_ns, until_ns)
            crawl_s = 0.0
            if self._has_dead_zone:
                crawl_s = time_at_min_speed_s(distance, seconds, self._odometry)
            extra, own = NO_VARIANCE, self._calibration
            if own.is_known(state):
                state, distance, turn = own.corrected_motion(state, distance, turn)
                estimate = state.estimate
                extra = own.extra_variance(state, distance, turn, crawl_s)
            if self._common is not None:
                state = self._common.before_motion(state, distance, turn, seconds)
            if distance != 0.0 or turn != 0.0:
                odometry_from_robot = step(odometry_from_robot, distance, turn)
                state, estimate = self._after_arc(state, distance, turn, crawl_s, extra)
        state = with_motion(state, until_ns, estimate, odometry_from_robot)
        if self._moves and until_ns > state.odometry_until_ns:
            return self._across_gap(state, stamp_ns, following)
        return state

    def _across_gap(self, state: State, from_ns: int, following: Odometry | None) -> State:
        """The state after the part of a gap in the odometry since `from_ns`."""
        until_ns, _, place, before, begin_ns, _, _ = state
        gap_ns = until_ns - begin_ns
        from_s = max(from_ns - begin_ns, 0) * 1e-9
        motion = bridge(before, following, from_s, gap_ns * 1e-9, self._odometry)
        state, estimate, place = self._after_guess(state, place, *motion)
        silent_ns = min(gap_ns - self._odometry_timeout_ns, until_ns - from_ns)
        if silent_ns > 0:
            estimate = inflate_by_gap(estimate, silent_ns, before, self._odometry.gap_speed_m_s)
            if before is not None and (before.distance_m or before.turn_rad):
                state = with_recovery(state, without_evidence(state.memory.recovery))
        return with_motion(state, until_ns, estimate, place)

    def _guessed_ns(self, state: State, until_ns: int) -> int:
        """Which part of a gap that ends then is crossed without the speed after it: the part that
        other inputs asked for, or all of a long gap."""
        begin_ns = state.odometry_until_ns
        if until_ns - begin_ns > self._odometry_timeout_ns:
            return until_ns - begin_ns
        return min(state.stamp_ns, until_ns) - begin_ns

    def _with_change(
        self, state: State, before: Odometry, after: Odometry, guessed_ns: int
    ) -> State:
        """The state after a gap of which such a part was guessed: more uncertain, if the robot has
        another speed after it. What it saw within the gap tells of the change until then."""
        begin_ns, timeout_s = state.odometry_until_ns, self._odometry_timeout_ns * 1e-9
        gap_s, guessed_s = (after.from_ns - begin_ns) * 1e-9, min(guessed_ns * 1e-9, timeout_s)
        last_ns = state.updates.position_ns, state.updates.heading_ns
        updated = PoseTimes(*(max((ns or begin_ns) - begin_ns, 0) * 1e-9 for ns in last_ns))
        extra = guess_variance(before, after, guessed_s, gap_s, updated)
        place = state.odometry_from_robot
        state, estimate, _ = self._after_guess(state, place, 0.0, 0.0, extra)
        silent = PoseTimes(*(max(gap_s - max(timeout_s, t), 0.0) for t in updated))
        if any(silent):
            estimate = inflate_by_change(estimate, silent, before, after)
        return state._replace(estimate=estimate)

    def _after_guess(
        self, state: State, place: Pose2, distance: float, turn: float, extra: MotionVariance
    ) -> tuple[State, Estimate, Pose2]:
        """The state, the estimate and the place by odometry after a motion that is guessed."""
        if self._calibration.is_known(state):
            state, distance, turn = self._calibration.corrected_motion(state, distance, turn)
        if distance == 0.0 and turn == 0.0 and extra == NO_VARIANCE:
            return state, state.estimate, place
        if self._common is not None:
            state = self._common.before_motion(state, distance, turn, 0.0)
        state, estimate = self._after_arc(state, distance, turn, 0.0, extra)
        return state, estimate, step(place, distance, turn)

    def _after_arc(
        self, state: State, distance: float, turn: float, crawl_s: float, extra: MotionVariance
    ) -> tuple[State, Estimate]:
        """The estimate after an arc, and the state with the effect that wrong scales of the
        odometry have on it."""
        before, memory = state.estimate, state.memory.calibration
        estimate = self._variant.move(before, distance, turn, crawl_s, extra)
        scales, added, mixture = memory.scales, ZERO3, state.mixture
        if not scales.are_exact and not state.lost:
            takes_nothing = self._common is not None or mixture is not None
            scales, added = scales.after_motion(before, distance, turn, takes_nothing)
            covariance = estimate.covariance.plus(added)
            estimate = self._variant.reduce(estimate._replace(covariance=covariance))
            scales = scales._replace(estimate=estimate)
            state = with_calibration(state, memory._replace(scales=scales))
        if mixture is not None:
            motion = self._variant.move(mixture.motion, distance, turn, crawl_s, extra)
            state = with_mixture(state, mixture.after_motion(estimate, motion, added))
        teammates = state.memory.teammates
        own = teammates.own
        if own is not None and not own.is_old(state.stamp_ns):
            own = own.after_step(distance, turn, self._odometry, crawl_s, extra)
            state = with_teammates(state, teammates._replace(own=own))
        return state, estimate
