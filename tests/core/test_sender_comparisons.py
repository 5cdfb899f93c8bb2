"""Which senders have a vote in the comparison of means."""

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import FAST, FadingOffsets, MeanOffset
from cpcbl_team.sender_comparisons import OWN_SENSORS, compare, voting_means
from cpcbl_team.sender_records import SenderRecord

NOW_NS = 5_000_000_000
THIN, VAGUE = (0.01, 0.25), (0.25, 0.25)
Sigmas = tuple[float, float]


def record(
    is_guest: bool = False, x: float = 0.0, y: float = 0.0, sigmas: Sigmas = (0.01, 0.01)
) -> SenderRecord:
    """Of a sender with this mean, which is precise if nothing is said."""
    along_x, along_y = sigmas
    mean = MeanOffset(x, y, Covariance2(along_x * along_x, 0.0, along_y * along_y))
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


def test_one_that_is_vague_along_one_axis_is_judged_along_the_other() -> None:
    """It led a blind robot astray by ten times its error, and had two correct ones expelled."""
    honest = {"north": record(), "south": record()}
    for x, y, sigmas, is_wrong in (
        (0.2, 0.0, THIN, True),
        (0.0, 0.5, THIN, False),  # as uncertain as it says
        (0.02, 0.5, THIN, False),
    ):
        found = compare({**honest, "west": record(x=x, y=y, sigmas=sigmas)}, "west", NOW_NS)
        assert found is not None
        assert found.is_wrong is is_wrong
    assert compare({**honest, "west": record(x=1.0, sigmas=VAGUE)}, "west", NOW_NS) is None


def test_one_that_is_vague_along_one_axis_has_no_vote() -> None:
    senders = {"north": record(), "south": record(y=0.3), "west": record(sigmas=THIN)}
    assert set(voting_means(senders, NOW_NS, "north", FAST)) == {"south"}
