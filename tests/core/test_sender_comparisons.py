"""Which senders have a vote in the comparison of means."""

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import FAST, FadingOffsets, MeanOffset
from cpcbl_team.sender_comparisons import OWN_SENSORS, voting_means
from cpcbl_team.sender_records import SenderRecord

NOW_NS = 5_000_000_000


def record(is_guest: bool = False) -> SenderRecord:
    """Of a sender with a mean that is precise."""
    mean = MeanOffset(0.0, 0.0, Covariance2(1e-4, 0.0, 1e-4))
    offsets = FadingOffsets(NOW_NS)
    return SenderRecord(
        last_report_ns=NOW_NS, offsets=(offsets,) * 2, means=(mean,) * 2, is_guest=is_guest
    )


def voters(of: str, *robots: str) -> set[str]:
    senders = {name: record() for name in (*robots, OWN_SENSORS)}
    senders |= {name: record(is_guest=True) for name in ("guest", "visitor")}
    return set(voting_means(senders, NOW_NS, of, FAST)) - {OWN_SENSORS}


def test_a_guest_has_no_vote_on_a_robot_of_the_team_beside_another() -> None:
    """It accused one of two robots while the other agreed with that one."""
    assert voters("north", "north", "south") == {"south"}
    assert voters("north", "north", "south", "west") == {"south", "west"}
    assert voters("guest", "north", "south") == {"north", "south"}


def test_guests_have_a_vote_where_less_than_two_robots_of_the_team_report() -> None:
    assert voters("north", "north") == {"guest", "visitor"}
    assert voters("guest", "north") == {"north", "visitor"}
