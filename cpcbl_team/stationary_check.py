"""What follows when a robot no longer stands where it believed (`stationary_pose.py`)."""

from collections.abc import Callable
from typing import Final

from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.estimate import Estimate, Information, InformationSum, Sums
from cpcbl_team.geometry import new
from cpcbl_team.measurements import GatedObject, combine
from cpcbl_team.state import (
    State,
    TrustedPose,
    at_new_pose,
    with_calibration,
    with_recovery,
)
from cpcbl_team.stationary_pose import (
    SPACING_NS,
    TEST_NS,
    StationaryRecord,
    is_stationary,
    observed,
    started,
)

PUSHED: Final = "pushed"  # the count
ELSEWHERE: Final = "its own sensors contradict the pose at which it stands"
APART_M, APART_RAD = 0.5, 0.5


class StationaryCheck:
    """Makes a standing robot doubt a pose that its own sensors contradict on average."""

    def __init__(
        self,
        settings: LocalizationSettings,
        reduce: Callable[[Estimate], Estimate],
        has_common_errors: bool,
    ) -> None:
        """Where all sightings have errors in common (`has_common_errors`), their mean is not due to
        be right, and the check is off; so it is without a covariance to test against. `reduce`
        gives an estimate the form that the variant keeps."""
        rules, self._reduce = settings.localizer, reduce
        self.is_active = not (
            has_common_errors or rules.variant == "weighted" or rules.paper_uncertainty
        )

    def after_frame(
        self, state: State, prior: Estimate, evidence: InformationSum, accepted: list[GatedObject]
    ) -> State:
        """The state after a frame: what its plain landmarks say about the offset from `prior`, and
        its other objects, as far as they were accepted."""
        waiting = self._waiting(state, prior)
        if waiting is not None:
            return waiting
        own = evidence.sums()
        return self._observed(
            state, prior, combine(Information.of(own), accepted) if accepted else own
        )

    def after_position(self, state: State, prior: Estimate, evidence: Sums) -> State:
        """The state after an accepted reading of the position sensor."""
        waiting = self._waiting(state, prior)
        return waiting if waiting is not None else self._observed(state, prior, evidence)

    def _waiting(self, state: State, prior: Estimate) -> State | None:
        """The state where evidence tells nothing yet; None where it does."""
        stamp_ns, _, place, _, _, _, (recovery, _, calibration, _, _) = state
        record = calibration.stationary
        if record is None:
            return state if recovery.lost else self._with_new_record(state, prior)
        if stamp_ns - record.used_ns < SPACING_NS:
            return state
        if recovery.lost:
            return _with_record(state, None)
        if is_stationary(record, prior, place):
            return None
        is_old = stamp_ns - record.checkpoints[-1].stamp_ns >= TEST_NS
        # One that drives is asked once a second
        return self._with_new_record(state, prior) if is_old else state

    def _observed(self, state: State, prior: Estimate, evidence: Sums) -> State:
        """The state after evidence of its own sensors about the offset from `prior`. Where all of
        it since some time contradicts the pose, the robot was pushed then."""
        record, stamp_ns, place = state.memory.calibration.stationary, state.stamp_ns, state[2]
        assert record is not None
        record, push = observed(record, stamp_ns, prior, evidence)
        if push is None:
            return _with_record(state, record)
        state = at_new_pose(state.counted(PUSHED), self._reduce(push.estimate))
        if push.is_of_one_range or push.distance_m > APART_M or push.turn_rad > APART_RAD:
            # It may be anywhere at that range, or too far for what is linear at the former pose
            memory = state.memory.recovery._replace(
                lost=ELSEWHERE,
                inflated_ns=state.stamp_ns,
                kidnapped_ns=push.stamp_ns,
                trusted=TrustedPose(prior, place),
            )
            state = with_recovery(state, memory).counted("lost")
        return _with_record(state, None)

    def _with_new_record(self, state: State, prior: Estimate) -> State:
        return _with_record(state, started(state.stamp_ns, prior, state.odometry_from_robot))


def _with_record(state: State, record: StationaryRecord | None) -> State:
    *others, _ = state.memory.calibration
    return with_calibration(state, new(CalibrationMemory, (*others, record)))
