"""The pose that a robot had before it began to reject what it measures, and what may replace it.

A robot that rejects most of what it measures was carried elsewhere, or its driver makes a mistake.
Odometry brings its trusted pose to the present. Where a mistake in sightings explains the evidence
there, nothing moves the robot; where it is found elsewhere all the same, that is a jump.
"""

import math
from collections.abc import Callable, Sequence
from typing import Final

from cpcbl_team.estimate import Covariance3, Estimate, pose_chi_square
from cpcbl_team.fusion import chi_square_bound
from cpcbl_team.geometry import Pose2
from cpcbl_team.motion import drift_sigmas
from cpcbl_team.relocalization import UNKNOWNS, are_apart
from cpcbl_team.sensor_mistakes import ExplainingMistake, mistake_in_evidence
from cpcbl_team.state import Evidence, Jump, RecoveryMemory, State, TrustedPose, with_recovery

LATEST_NS: Final = 5_000_000_000  # evidence by which a mistake is looked for
OR_MOVED: Final = "or the robot was moved without odometry"


def trusted_pose(state: State) -> TrustedPose:
    """The present pose as the trusted one."""
    return TrustedPose(state.estimate, state.odometry_from_robot)


def propagated_pose(trusted: TrustedPose, odometry_from_robot: Pose2) -> Estimate:
    """The trusted pose at present, by odometry alone: wider by what dead reckoning may err."""
    moved = trusted.odometry_from_robot.inverse() @ odometry_from_robot
    p, h = (sigma * sigma for sigma in drift_sigmas(moved))
    pose = trusted.estimate.pose @ moved
    return Estimate(pose, trusted.estimate.covariance.plus(Covariance3(p, 0.0, p, 0.0, 0.0, h)))


def expected_pose(state: State, memory: RecoveryMemory) -> Estimate:
    """Where odometry alone leads the robot from its trusted pose, or else its estimate."""
    place = state.odometry_from_robot
    return propagated_pose(memory.trusted or trusted_pose(state), place)


def agrees(estimate: Estimate, found: Estimate, stands: bool = False) -> bool:
    """Whether a pose from recent evidence is the estimate's, by the chi-square bound of 99.9 %; a
    small difference may have other causes than a wrong pose, unless the robot `stands`."""
    if not stands and not are_apart(estimate.pose, found.pose):
        return True
    return pose_chi_square(estimate, found) <= chi_square_bound(UNKNOWNS)


def explaining_mistake(
    state: State, memory: RecoveryMemory, evidence: Sequence[Evidence], found: Estimate | None
) -> ExplainingMistake | None:
    """The driver's mistake that explains the latest evidence at the trusted pose; None without one,
    and if the pose that was found is the trusted one."""
    trusted = memory.trusted
    if trusted is None:
        return None
    known = propagated_pose(trusted, state.odometry_from_robot)
    if found is not None and agrees(known, found):
        return None
    since_ns = max(memory.suspected_ns, state.stamp_ns - LATEST_NS)
    latest = [e for e in evidence if e.stamp_ns >= since_ns]
    return mistake_in_evidence(known, latest, state.odometry_from_robot)


def keep_trusted_pose(
    state: State,
    memory: RecoveryMemory,
    mistake: ExplainingMistake | None,
    reduce: Callable[[Estimate], Estimate],
) -> State:
    """The state of a robot whose driver probably makes a mistake: it is lost, and stays where it
    is if the mistake is undone. Between two pieces of evidence (`mistake` is None) odometry leads
    it. `reduce`: to the form that the variant keeps."""
    trusted, place = memory.trusted or trusted_pose(state), state.odometry_from_robot
    if mistake is not None:
        lost = f"{mistake.text}; {OR_MOVED}"
        corrected = Estimate(mistake.pose, trusted.estimate.covariance)
        trusted = TrustedPose(corrected, place)
        memory = memory._replace(lost=lost, mistake=mistake.text, trusted=trusted, kidnapped_ns=-1)
    estimate = reduce(propagated_pose(trusted, place))
    return with_recovery(state, memory)._replace(estimate=estimate)


def with_jump(state: State, memory: RecoveryMemory, pose: Pose2) -> RecoveryMemory:
    """The memory of a robot that was found at a pose: a jump, if that is elsewhere than odometry
    led it from its trusted pose."""
    trusted, jump = memory.trusted, memory.jump
    if trusted is not None:
        due = propagated_pose(trusted, state.odometry_from_robot).pose
        if are_apart(due, pose):
            turn = math.remainder(pose.heading - due.heading, math.tau)
            jump = Jump(state.stamp_ns, math.hypot(pose.x - due.x, pose.y - due.y), turn)
    return memory._replace(trusted=None, mistake="", jump=jump)
