"""A new guest is as doubtful as the guests before it that were caught."""

import pytest
from msgspec.structs import replace
from support.core import SECOND
from support.trust import AGREES, CONTRADICTS, Receiver

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import FAST, FadingOffsets, MeanOffset
from cpcbl_team.sender_comparisons import voting_means
from cpcbl_team.sender_records import SILENCE_NS, QuarantineReason, Rival, SenderRecord
from cpcbl_team.voters import (
    DOUBT_NS,
    LEAST_CONFIRMED,
    SenderRecords,
    doubted_guests,
    is_left_out_guest,
    senders_with_a_say,
    voters,
)

NOW_NS = 100 * SECOND
SIGMA2 = 0.01**2


def record(is_guest: bool, x: float = 0.0) -> SenderRecord:
    mean = MeanOffset(x, 0.0, Covariance2(SIGMA2, 0.0, SIGMA2), stamp_ns=NOW_NS)
    offsets = FadingOffsets(stamp_ns=NOW_NS)
    return SenderRecord(
        last_report_ns=NOW_NS, offsets=(offsets,) * 2, means=(mean,) * 2, is_guest=is_guest
    )


CAUGHT = replace(record(is_guest=True, x=0.25), reason=QuarantineReason.BIASED)
CONTESTED = replace(
    record(is_guest=True, x=0.25), confirmed=LEAST_CONFIRMED, rivals=(Rival("north", -0.25, 0.0),)
)


def team_with(earlier: SenderRecord, new: SenderRecord) -> SenderRecords:
    return {"north": record(is_guest=False), "guest1": earlier, "guest2": new}


def test_an_honest_guest_is_used_at_once_beside_a_robot_of_the_team() -> None:
    receiver = Receiver()
    receiver.receive(1.0, a=AGREES)
    receiver.receive(2.0, a=AGREES, guest1=AGREES)
    assert all(decision.trusted for _, decision in receiver.decisions)


@pytest.mark.parametrize("confirmed", [0, LEAST_CONFIRMED])
def test_a_new_guest_that_contradicts_the_estimate_is_not_used_when_it_seems_to_agree(
    confirmed: int,
) -> None:
    """Odometry makes the estimate less certain, and then anybody seems to agree."""
    receiver = Receiver()
    receiver.receive(1.0, a=AGREES)
    receiver.receive(0.1, a=AGREES, guest1=CONTRADICTS)
    proven = replace(receiver.senders["guest1"], confirmed=confirmed)
    receiver.senders = {**receiver.senders, "guest1": proven}
    receiver.receive(0.1, a=AGREES, guest1=5.0)
    assert receiver.decisions[-1][1].trusted is (confirmed == LEAST_CONFIRMED)


def test_a_new_name_does_not_free_a_guest_from_doubt() -> None:
    receiver = Receiver()
    receiver.receive(1.0, a=AGREES)
    receiver.receive(2.0, a=AGREES, guest1=CONTRADICTS)
    assert receiver.quarantined.keys() == {"guest1"}
    receiver.receive(1.0, a=AGREES, guest2=AGREES)
    used = {d.trusted for name, d in receiver.decisions if name == "guest2"}
    assert used == {False}
    receiver.receive(61.0, a=AGREES)
    receiver.receive(0.1, a=AGREES, guest3=AGREES)
    assert receiver.decisions[-1][1].trusted


@pytest.mark.parametrize("earlier", [CAUGHT, CONTESTED])
def test_a_doubted_guest_has_neither_weight_nor_vote(earlier: SenderRecord) -> None:
    """Each new name made the only correct observer contested, and led the robot astray."""
    senders = team_with(earlier, record(is_guest=True, x=0.25))
    assert "guest2" in doubted_guests(senders, NOW_NS)
    assert is_left_out_guest(senders, "guest2", NOW_NS)
    assert "guest2" not in voting_means(senders, NOW_NS, "north", FAST)
    assert "guest2" not in voters(senders, NOW_NS)
    assert "guest2" not in senders_with_a_say(senders, "north", NOW_NS)
    assert "guest2" in senders_with_a_say(senders, "guest2", NOW_NS)  # its own dispute is decided


def test_the_silent_side_of_a_contest_has_no_vote_if_it_is_a_doubted_guest() -> None:
    """It has left, and its claim would last for ever."""
    left = replace(
        record(is_guest=True),
        last_report_ns=NOW_NS - 5 * SECOND,
        means=(None, None),
        rivals=(Rival("north", -0.25, 0.0),),
    )
    north = replace(record(is_guest=False), rivals=(Rival("guest1", 0.25, 0.0),))
    assert voting_means({"north": north, "guest1": left}, NOW_NS, "north", FAST) == {}


def test_a_guest_is_proven_by_reports_with_which_others_agreed() -> None:
    proven = replace(record(is_guest=True), confirmed=LEAST_CONFIRMED)
    senders = team_with(CAUGHT, proven)
    assert not is_left_out_guest(senders, "guest2", NOW_NS)
    assert "guest2" in voting_means(senders, NOW_NS, "north", FAST)


@pytest.mark.parametrize(
    ("team", "earlier"),
    [
        ({}, CAUGHT),
        ({"last_report_ns": NOW_NS - SILENCE_NS - 1}, CAUGHT),
        ({"reason": QuarantineReason.BIASED}, CAUGHT),
        ({}, replace(CAUGHT, last_report_ns=NOW_NS - DOUBT_NS - 1)),
        ({}, record(is_guest=True)),
    ],
)
def test_without_a_robot_of_the_team_or_after_a_minute_nobody_is_doubted(
    team: dict[str, object], earlier: SenderRecord
) -> None:
    """Where only guests are heard, they are all the help that there is."""
    senders = team_with(earlier, record(is_guest=True))
    north = replace(senders["north"], **team)
    is_doubt = not team and earlier is CAUGHT
    found = doubted_guests({**senders, "north": north}, NOW_NS)
    assert ("guest2" in found) is is_doubt
