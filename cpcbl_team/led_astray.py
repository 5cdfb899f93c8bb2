"""Whether help led the estimate away from where the robot's own sensors say that it is.

Own eyes outweigh any number of voices. The test of means (`sender_comparisons.py`) compares what
sources said of the estimate over some seconds, so it cannot decide where help moves the estimate
faster: along an axis that landmarks measured some seconds ago, they agreed with it then. The pose
by own sensors (`own_pose.py`) does not follow help. If the estimate contradicts it, and so do the
last reports of senders, then these led the estimate astray: they are quarantined, and the robot
goes on from its own pose.
"""

from collections.abc import Collection, Sequence
from typing import Final

from msgspec.structs import replace

from cpcbl_team.augmented_update import Reading
from cpcbl_team.common_error_filter import CommonErrorFilter, common_errors_of
from cpcbl_team.config import OdometrySettings
from cpcbl_team.estimate import Estimate, Sums, pose_difference
from cpcbl_team.fusion import Observation, mark_shared, merge_split
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.hypotheses import with_faded_gains, with_gains, with_hypotheses
from cpcbl_team.mean_offsets import FAST_COMMON_M
from cpcbl_team.measurements import GatedObject
from cpcbl_team.own_errors import reset_scores
from cpcbl_team.own_pose import OwnPose
from cpcbl_team.own_pose_conflicts import own_pose_conflict
from cpcbl_team.parameters import Sensitivity, sensitivity_dot
from cpcbl_team.recovery_evidence import without_senders
from cpcbl_team.sender_records import (
    BY_COMPARISON,
    CONTRADICTING_NIS,
    OWN_SENSORS,
    SILENCE_NS,
    QuarantineReason,
    quarantined,
    released,
)
from cpcbl_team.state import (
    State,
    at_new_pose,
    with_common_errors,
    with_memory,
    with_teammates,
)
from cpcbl_team.voters import SenderRecords

GUESSED_NS: Final = 100_000_000  # odometry that is missing for longer does not only come late


class OwnPoses:
    """The pose by own sensors of one robot, and what follows where help led it astray."""

    def __init__(
        self, odometry: OdometrySettings, common: CommonErrorFilter | None, gate: float
    ) -> None:
        """`common`: the errors that own sightings have in common. `gate`: the chi-square bound of
        two constraints."""
        self._moves, self._common, self._gate = odometry.moves, common, gate

    def after_frame(self, state: State, sums: Sums, accepted: Sequence[GatedObject]) -> State:
        """The state after a frame: what own sensors say of the offset of the estimate, as sums, or
        where these have errors in common as the `accepted` objects. The pose begins as the estimate
        when help comes first, and after a gap of the odometry."""
        own = self._present(state, with_hypotheses=True)
        if own is None:
            return self._begun_anew(state)
        readings = () if self._common is None else self._common.own_readings(accepted)
        return self._updated(state, own, sums, readings)

    def _updated(
        self, state: State, own: OwnPose, sums: Sums, readings: Sequence[Reading]
    ) -> State:
        """The state after own readings about the estimate: as sums, or where they have errors in
        common one by one. Each hypothesis is judged by how likely they are before it uses them."""
        about, common = state.estimate.pose, self._common

        def after(pose: OwnPose) -> OwnPose:
            if common is None:
                return pose.with_evidence(about, sums)
            return common.own_pose_with(pose, state, readings)

        def log_likelihood(pose: OwnPose) -> float:
            if common is None:
                return pose.log_likelihood(about, sums)
            return common.log_likelihood(pose, state, readings)

        teammates = state.memory.teammates
        senders, by_sender = teammates.senders, own.by_sender
        before_ns = own.stamp_ns if teammates.own is None else teammates.own.stamp_ns
        if by_sender:
            gains = {n: log_likelihood(pose) for n, pose in by_sender.items()}
            gains[OWN_SENSORS] = log_likelihood(own)
            senders = with_gains(senders, gains, before_ns, state.stamp_ns)
            by_sender = {name: after(pose) for name, pose in by_sender.items()}
        else:
            senders = with_faded_gains(senders, before_ns, state.stamp_ns)
        own = with_hypotheses(after(own)._replace(by_sender=by_sender), senders)
        return with_teammates(state, teammates._replace(senders=senders, own=own))

    def after_report(
        self,
        state: State,
        sender: str,
        observation: Observation,
        least_sigma_m: float,
        sensitivities: tuple[Sensitivity, ...] = (),
    ) -> State:
        """The state after a report about the estimate, with which the pose of its sender's
        hypothesis is updated, if there is one. `least_sigma_m`: of the part of the noise that all
        its reports have in common. `sensitivities`: to the errors that own sightings have in
        common."""
        own = state.memory.teammates.own
        pose = None if own is None else own.by_sender.get(sender)
        if own is None or pose is None or self._present(state) is None:
            return state
        pose = self._by_odometry(pose, state)
        dependent = observation.dependent
        more = max(0.0, least_sigma_m**2 - min(dependent.xx, dependent.yy))
        observation = observation._replace(dependent=dependent + Covariance2(more, 0.0, more))
        observation = observation.shifted(*pose_difference(state.estimate.pose, pose.estimate.pose))
        if self._common is None:
            pose = pose._replace(estimate=merge_split(pose.estimate, observation))
        else:
            pose = self._common.with_report(pose, state, observation, sensitivities)
        return with_own_pose(state, own._replace(by_sender={**own.by_sender, sender: pose}))

    def after_position(self, state: State, position: Observation, is_accepted: bool) -> State:
        """The state after a reading of the position sensor about the estimate, which has accepted
        it or not. Whether the pose by own sensors accepts it is another question: help may have led
        the estimate away."""
        own = self._present(state, with_hypotheses=True)
        if own is None:
            return self._begun_anew(state) if is_accepted else state
        if _nis(own, state, position) > self._gate:
            return state
        readings = () if self._common is None else self._common.position_readings(position)
        return self._updated(state, own, position.information(), readings)

    def nis(self, state: State, observation: Observation) -> float:
        """How far a report contradicts the pose by own sensors, scaled to two degrees of freedom;
        0 if there is none."""
        own = self._present(state)
        return 0.0 if own is None else _nis(own, state, observation)

    def nis_of_sighting(self, state: State, found: GatedObject) -> float:
        """The same of a teammate that the robot saw where that says it is, or of a landmark that
        stands where it says. What the estimate knows of the errors that own sightings have in
        common is replaced by what own sensors say of them."""
        own, observation, known = self._present(state), found.observation, state.common_errors
        if own is None or observation is None:
            return 0.0
        if own.common is not None and known is not None:
            rows, sensitivities = observation.rows, found.sensitivities
            values = tuple(b - a for a, b in zip(known.values, own.common.values, strict=True))
            pairs = zip(observation.residuals, sensitivities, strict=True)
            added = own.common.innovation(rows, sensitivities)
            replaced = known.innovation(rows, sensitivities)
            observation = observation._replace(
                residuals=tuple(e - sensitivity_dot(c, values) for e, c in pairs),
                dependent=observation.dependent + replaced.scaled(-1.0) + added,
            )
        return _nis(own, state, observation)

    def is_guessed(self, state: State) -> bool:
        """Whether the robot follows a guess, as before, because its odometry is missing. What
        contradicts that is nobody's fault."""
        if state.odometry is None or not self._moves:
            return False
        return state.stamp_ns - state.odometry_until_ns > GUESSED_NS

    def without_misleading(self, state: State) -> State:
        """The state after a frame was used, or before a fix: at its own pose, if help led it away
        from there. Between frames that pose follows odometry. Without this a robot that sees no
        landmark in a turn would be carried on until it sees the next one. (While a frame is being
        used, that pose has its readings already, and the estimate does not.)"""
        teammates, now_ns = state.memory.teammates, state.stamp_ns
        names, bound = own_pose_conflict(teammates.senders, now_ns)
        own = self._present(state, with_hypotheses=True) if names else None
        if own is None:
            return state
        if own.common is not None and own.common.found != common_errors_of(state).found:
            return state  # a landmark that the robot had found stands elsewhere now
        if distance_squared(state.estimate, own.estimate) <= bound:
            return state
        recovery = without_senders(state.memory.recovery, names)
        state = with_memory(state, state.memory.counted("outvoted")._replace(recovery=recovery))
        senders = with_misleading(teammates.senders, names, now_ns)
        state = at_new_pose(state, own.estimate)
        if own.common is not None:
            state = with_common_errors(state, own.common)
        return with_teammates(state, teammates._replace(senders=senders, own=own))

    def _present(self, state: State, with_hypotheses: bool = False) -> OwnPose | None:
        """The pose by own sensors now, if there is one and it says anything; perhaps those of the
        hypotheses as well."""
        own, adaptation = state.memory.teammates.own, state.memory.calibration.adaptation
        if own is None or state.lost or own.adaptation != adaptation:
            return None
        if own.is_old(state.stamp_ns) or own.gaps != gaps_of(state) or self.is_guessed(state):
            return None
        own = self._by_odometry(own if with_hypotheses else own.alone, state)
        if not own.is_known:
            return None
        return own if self._common is None else self._common.own_pose_for(own, state)

    def _by_odometry(self, own: OwnPose, state: State) -> OwnPose:
        """A pose at the time of the state, by odometry."""
        return own.at(state.stamp_ns, state.memory.calibration.scales)

    def _begun_anew(self, state: State) -> State:
        """The state where the pose by own sensors begins, as the estimate."""
        teammates, known, now_ns = state.memory.teammates, state.memory.calibration, state.stamp_ns
        estimate, gaps = mark_shared(state.estimate), gaps_of(state)
        own = OwnPose(now_ns, estimate, known.adaptation, gaps, known.common)
        senders = teammates.senders
        if teammates.own is not None:
            senders = with_faded_gains(senders, teammates.own.stamp_ns, now_ns)
        return with_teammates(state, teammates._replace(senders=senders, own=own))

    def compared(self, state: State) -> Collection[str]:
        """The senders of which own readings judge hypotheses at present."""
        own = state.memory.teammates.own
        return () if own is None or own.is_old(state.stamp_ns) else own.by_sender


def distance_squared(estimate: Estimate, own: Estimate) -> float:
    """How far the estimate is from the pose by own sensors: the chi-square of two degrees of
    freedom, by the covariance of that."""
    x, y, _ = pose_difference(own.pose, estimate.pose)
    common = FAST_COMMON_M * FAST_COMMON_M
    covariance = own.covariance.position() + Covariance2(common, 0.0, common)
    return covariance.mahalanobis_squared(x, y)


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


def with_own_pose(state: State, own: OwnPose) -> State:
    """The state with this pose by own sensors."""
    return with_teammates(state, state.memory.teammates._replace(own=own))


def _nis(own: OwnPose, state: State, observation: Observation) -> float:
    """Of an observation about the estimate, scaled to two degrees of freedom."""
    offset = pose_difference(state.estimate.pose, own.estimate.pose)
    about = observation.shifted(*offset)
    nis = about.normalized_innovation_squared(own.estimate.covariance)
    return 2.0 * nis / len(observation.rows)


def gaps_of(state: State) -> int:
    """How often odometry was missing."""
    return state.memory.events.get("odometry_gap", 0)
