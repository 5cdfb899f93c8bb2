"""What a teammate in quarantine says is tested, but changes nothing of the estimate. (Of what it
says of landmarks: `test_landmark_beliefs.py`; evidence: `test_quarantined_evidence.py`.)"""

import pytest
from msgspec.structs import replace
from support.core import SECOND, belief, diagonal, fix, frame, localizer, state_at

from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_team.sender_records import QuarantineReason, SenderRecord
from cpcbl_team.state import State, with_senders, with_teammates

NOW_NS = 10 * SECOND
HERE = Pose2(0.0, 0.0, 0.0)
reasons = pytest.mark.parametrize("reason", list(QuarantineReason))


def heard(reason: QuarantineReason | None) -> State:
    """A robot that knows roughly where it is, and has heard `mate` a moment ago."""
    state = state_at(HERE, diagonal(0.1, 0.1), NOW_NS)
    record = SenderRecord(NOW_NS - 1, last_failure_ns=NOW_NS - 1, reason=reason)
    teammates = state.memory.teammates._replace(last_report_ns=NOW_NS - 1)
    return with_teammates(state, with_senders(teammates, {"mate": record}))


@reasons
@pytest.mark.parametrize("heading", [None, 0.03], ids=["position", "with a heading"])
def test_a_fix(reason: QuarantineReason, heading: float | None) -> None:
    said = replace(fix(0.04, 0.0, NOW_NS, heading=heading), observer="mate")
    robot = localizer()
    used, unused = (robot.add_fix(heard(r), said) for r in (None, reason))
    assert used.estimate != heard(None).estimate
    assert unused.estimate == heard(reason).estimate
    assert unused.counts["distrusted"] == 1
    assert "fix:mate" not in unused.updates.objects_ns


@reasons
def test_a_belief_of_a_teammate_that_is_seen(reason: QuarantineReason) -> None:
    robot, at_corners = localizer(), frame(HERE, NOW_NS).sightings
    mate = Sighting("mate", 2.0, 0.0)

    def after(reason: QuarantineReason | None, *seen: Sighting) -> State:
        state = robot.add_teammate_belief(heard(reason), belief(2.04, 0.0, NOW_NS, sigma_m=0.01))
        return robot.cycle(state, Sightings(NOW_NS, seen))

    for others in ((), at_corners):
        without = after(reason, *others)
        assert after(None, *others, mate).estimate != without.estimate
        assert after(reason, *others, mate).estimate == without.estimate
    assert "mate" not in after(reason, mate).updates.objects_ns
