"""What a teammate in quarantine sends is no evidence for a robot that looks for its pose."""

import pytest
from msgspec.structs import replace
from support.core import SECOND, belief, fix, localizer

from cpcbl_team.config import Field, OdometrySettings, Start
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_team.sender_records import QuarantineReason, SenderRecord
from cpcbl_team.state import TeammateMemory

STILL = OdometrySettings(moves=False)
UNKNOWN = Start(known=False, x_m=0.0, y_m=0.0)


def test_a_quarantined_teammate_does_not_relocalize_the_robot() -> None:
    robot = localizer("joint", Field(), start=UNKNOWN, odometry=STILL)
    state = robot.start(0)
    state = robot.add_fix(state, fix(1.0, 2.0, 1, heading=0.5))
    voice = replace(state.memory.teammates.senders["mate"], reason=QuarantineReason.BIASED)
    lost = robot.start(0).memory._replace(teammates=TeammateMemory(senders={"mate": voice}))
    state = robot.start(0)._replace(memory=lost)
    for i in range(1, 5):
        state = robot.add_fix(state, fix(1.0, 2.0, i * SECOND, heading=0.5))
    assert state.lost != ""
    assert state.memory.recovery.evidence == ()


@pytest.mark.parametrize("reason", [None, QuarantineReason.BIASED])
def test_a_quarantined_teammate_that_is_seen_is_no_evidence(
    reason: QuarantineReason | None,
) -> None:
    robot = localizer("joint", Field(), start=Start(x_m=1.0, y_m=2.0), odometry=STILL)
    state = robot.add_teammate_belief(robot.start(0), belief(3.0, 2.0))
    teammates = state.memory.teammates._replace(senders={"mate": SenderRecord(reason=reason)})
    state = state._replace(memory=state.memory._replace(teammates=teammates))
    seen = Sighting("mate", 2.0, 0.0, 0.1, 0.05)
    state = robot.cycle(state, Sightings(SECOND // 10, (seen,)))
    assert len(state.memory.recovery.evidence) == (reason is None)
