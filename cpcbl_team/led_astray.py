"""Whether help led the estimate away from where the robot's own sensors say that it is.

Own eyes outweigh any number of voices. The test of means (`sender_comparisons.py`) compares what
sources said of the estimate over some seconds, so it cannot decide where help moves the estimate
faster: along an axis that landmarks measured some seconds ago, they agreed with it then. The pose
by own sensors (`own_pose.py`) does not follow help. If the estimate contradicts it, and so do the
last reports of senders, then these led the estimate astray: they are quarantined, and the robot
goes on from its own pose.
"""

from typing import Final

from msgspec.structs import replace

from cpcbl_team.config import OdometrySettings
from cpcbl_team.estimate import Estimate, Sums, pose_difference
from cpcbl_team.fusion import Observation, mark_shared
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import CONFLICT, CONFLICT_OF_MOST, FAST_COMMON_M
from cpcbl_team.miscalibration import noise_with_factor
from cpcbl_team.own_pose import LONGEST_NS, OwnPose
from cpcbl_team.recovery_evidence import without_senders
from cpcbl_team.sender_comparisons import OWN_SENSORS, RECENT_NS, SenderRecords
from cpcbl_team.sender_records import (
    CONTRADICTING_NIS,
    SILENCE_NS,
    QuarantineReason,
    quarantined,
    released,
)
from cpcbl_team.state import State, at_new_pose, with_memory, with_teammates
from cpcbl_team.trust import BY_COMPARISON, reset_scores

GUESSED_NS: Final = 100_000_000  # odometry that is missing for longer does not only come late


class OwnPoses:
    """The pose by own sensors of one robot, and what follows where help led it astray."""

    def __init__(self, odometry: OdometrySettings) -> None:
        self._noise = odometry

    def after_frame(self, state: State, sums: Sums) -> State:
        """The state after a frame: what own sensors say of the offset of the estimate. The pose
        begins as the estimate when help comes first, and after a gap of the odometry."""
        own, memory = self._present(state), state.memory
        if own is None:
            adaptation, estimate = memory.calibration.adaptation, mark_shared(state.estimate)
            own = OwnPose(
                state.stamp_ns, estimate, state.odometry_from_robot, adaptation, _gaps(state)
            )
        else:
            own = own.with_evidence(state.estimate.pose, sums)
        return with_teammates(state, memory.teammates._replace(own=own))

    def nis(self, state: State, observation: Observation) -> float:
        """How far a report contradicts the pose by own sensors, scaled to two degrees of freedom;
        0 if there is none."""
        own = self._present(state)
        if own is None:
            return 0.0
        offset = pose_difference(state.estimate.pose, own.estimate.pose)
        about = observation.shifted(*offset)
        nis = about.normalized_innovation_squared(own.estimate.covariance)
        return 2.0 * nis / len(observation.rows)

    def is_guessed(self, state: State) -> bool:
        """Whether the robot follows a guess, as before, because its odometry is missing. What
        contradicts that is nobody's fault."""
        if state.odometry is None or not self._noise.moves:
            return False
        return state.stamp_ns - state.odometry_until_ns > GUESSED_NS

    def without_misleading(self, state: State) -> State:
        """The state after a frame was used: at its own pose, if help led it away from there."""
        teammates, now_ns = state.memory.teammates, state.stamp_ns
        own = teammates.own
        if own is None or own.stamp_ns != now_ns or state.lost:
            return state
        names = misleading(teammates.senders, state.estimate, own.estimate, now_ns)
        if not names:
            return state
        recovery = without_senders(state.memory.recovery, names)
        state = with_memory(state, state.memory.counted("outvoted")._replace(recovery=recovery))
        senders = with_misleading(teammates.senders, names, now_ns)
        state = at_new_pose(state, own.estimate)
        return with_teammates(state, teammates._replace(senders=senders, own=own))

    def _present(self, state: State) -> OwnPose | None:
        """The pose by own sensors now, if there is one and it says anything."""
        own, adaptation = state.memory.teammates.own, state.memory.calibration.adaptation
        if own is None or state.lost or own.adaptation != adaptation:
            return None
        is_old = state.stamp_ns - own.stamp_ns > LONGEST_NS
        if is_old or own.gaps != _gaps(state) or self.is_guessed(state):
            return None
        noise = noise_with_factor(self._noise, adaptation.motion_factor)
        scales = state.memory.calibration.scales
        own = own.at(state.stamp_ns, state.odometry_from_robot, noise, scales)
        return own if own.is_known else None


def misleading(
    senders: SenderRecords, estimate: Estimate, own: Estimate, now_ns: int
) -> frozenset[str]:
    """The senders that led the estimate away from the pose by own sensors; none if it agrees with
    that, or if no sender contradicts it as clearly. If these are several and most of all that were
    heard lately, it is less likely that so many are wrong than that own sensors err by chance, so
    twice the chi-square is needed."""
    x, y, _ = pose_difference(own.pose, estimate.pose)
    common = FAST_COMMON_M * FAST_COMMON_M
    covariance = own.covariance.position() + Covariance2(common, 0.0, common)
    apart = covariance.mahalanobis_squared(x, y)
    if apart <= CONFLICT:
        return frozenset()
    heard = {
        name: r
        for name, r in senders.items()
        if name != OWN_SENSORS and now_ns - r.last_report_ns <= SILENCE_NS
    }

    def contradicting(bound: float) -> frozenset[str]:
        return frozenset(
            name
            for name, r in heard.items()
            if not r.reason and now_ns - r.last_report_ns <= RECENT_NS and r.own_nis > bound
        )

    found = contradicting(CONTRADICTING_NIS) if contradicting(CONFLICT) else frozenset[str]()
    if len(found) > 1 and 2 * len(found) > len(heard):
        return contradicting(CONFLICT_OF_MOST) if apart > CONFLICT_OF_MOST else frozenset()
    return found


def with_misleading(senders: SenderRecords, names: frozenset[str], now_ns: int) -> SenderRecords:
    """The records after these senders are found to have led the estimate astray, and another one
    has replaced it. Whom they made look wrong of late is released, if its last report agrees with
    that one."""
    found = dict(reset_scores(senders))
    for name, record in senders.items():
        is_recent = record.reason in BY_COMPARISON and now_ns - record.since_ns <= SILENCE_NS
        if name in names:
            record = replace(found[name], last_failure_ns=now_ns)
            found[name] = quarantined(record, QuarantineReason.OUTVOTED, now_ns)
        elif is_recent and record.own_nis <= CONTRADICTING_NIS:
            found[name] = released(found[name], now_ns)
    return found


def _gaps(state: State) -> int:
    """How often odometry was missing."""
    return state.memory.events.get("odometry_gap", 0)
