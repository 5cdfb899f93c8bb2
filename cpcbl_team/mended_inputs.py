"""What the state of a robot is after its inputs were wrong for some time."""

from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.geometry import Pose2, new, wrap_angle
from cpcbl_team.inputs import InputsMended
from cpcbl_team.own_errors import forgive
from cpcbl_team.state import State, with_recovery, with_senders, with_teammates


def with_mended_inputs(state: State, event: InputsMended) -> State:
    """The state with its heading turned back, and less certain by what the wrong inputs may have
    done. The teammates that they made look wrong are no longer blamed, those that were blamed
    before are. The pose from before them is no longer trusted, and nothing that contradicted it
    stands elsewhere for that."""
    (x, y, heading), covariance, shared = state.estimate
    p, h = event.position_sigma_m**2, event.turn_rad**2
    grown = covariance.plus(Covariance3(p, 0.0, p, 0.0, 0.0, h))
    pose = new(Pose2, (x, y, wrap_angle(heading + event.turn_rad)))
    state = state._replace(estimate=Estimate(pose, grown, shared))
    recovery = state.memory.recovery._replace(
        trusted=None, mistake="", suspected_ns=-1, misplaced={}
    )
    state = with_recovery(state, recovery)
    teammates = state.memory.teammates._replace(own=None)
    senders = forgive(teammates.senders, event.stamp_ns, event.since_ns)
    return with_teammates(state, with_senders(teammates, senders))
