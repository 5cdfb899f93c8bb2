"""Which senders have a vote in the comparison of means."""

import pytest

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import FAST, FadingOffsets, MeanOffset
from cpcbl_team.sender_comparisons import compare, voting_means
from cpcbl_team.sender_records import OWN_SENSORS, SenderRecord
from cpcbl_team.voters import voters, votes

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


def voters_on(of: str, *robots: str) -> set[str]:
    senders = {name: record() for name in (*robots, OWN_SENSORS)}
    senders |= {name: record(is_guest=True) for name in ("guest", "visitor")}
    return set(voting_means(senders, NOW_NS, of, FAST)) - {OWN_SENSORS}


def test_a_guest_has_no_vote_on_a_robot_of_the_team_beside_another() -> None:
    """It accused one of two robots while the other agreed with that one."""
    assert voters_on("north", "north", "south") == {"south"}
    assert voters_on("north", "north", "south", "west") == {"south", "west"}
    assert voters_on("guest", "north", "south") == {"north", "south"}


def test_all_guests_have_one_vote_beside_one_robot_of_the_team() -> None:
    """Five guests were its majority."""
    assert voters_on("north", "north") == {"guest"}  # or the other, for both agree with it
    assert voters_on("guest", "north") == {"north"}
    assert voters_on("guest") == {"visitor"}


def test_of_several_guests_the_one_that_agrees_most_speaks_for_all() -> None:
    senders = {"north": record(), "far": record(True, 1.0), "near": record(True, 0.1)}
    assert set(voting_means(senders, NOW_NS, "north", FAST)) == {"near"}


def test_guests_that_say_the_same_are_no_majority_against_a_robot_of_the_team() -> None:
    senders = {"north": record()} | {f"guest{i}": record(True, 1.0) for i in range(5)}
    for name in ("north", "guest0"):
        found = compare(senders, name, NOW_NS)
        assert found is not None
        assert found.is_contested
        assert not found.is_wrong
    found = compare({**senders, "south": record()}, "guest0", NOW_NS)
    assert found is not None
    assert found.is_wrong


@pytest.mark.parametrize(
    ("robots", "guests", "expected"), [(0, 3, 3), (1, 3, 2), (1, 0, 1), (2, 5, 2), (3, 1, 3)]
)
def test_guests_vote_as_robots_of_the_team_are_few(robots: int, guests: int, expected: int) -> None:
    senders = {f"r{i}": record() for i in range(robots)}
    senders |= {f"g{i}": record(is_guest=True) for i in range(guests)}
    assert votes(senders, senders, senders) == expected
    assert len(voters(senders, NOW_NS)) == expected
    assert votes(senders, [n for n in senders if n[0] == "g"], senders) == expected - robots


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
