"""What senders said before, carried on by odometry, beside what others say now."""

import math
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.core import SECOND, matrix2
from support.observed_drive import Drive, Observed, correct
from support.sweeps import sampled
from support.trust import AGREES, CONTRADICTS, RULES

from cpcbl_team.carried_positions import (
    LEAST_REPORTS,
    LONGEST_NS,
    CarriedPosition,
    carried_to,
    with_reported_position,
)
from cpcbl_team.contests import (
    AGREEMENT,
    LONGEST_SILENCE_NS,
    contest_m,
    contest_of_sources_m,
    open_rivals,
)
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.mean_offsets import NOTHING
from cpcbl_team.reported_tracks import ReportedPosition
from cpcbl_team.sender_differences import carried_differences
from cpcbl_team.sender_records import OWN_SENSORS, SenderRecord, TeammateReport
from cpcbl_team.trust import assess
from cpcbl_team.trust_status import trust_statuses

Records = Mapping[str, SenderRecord]


def variance(sigma_m: float) -> Covariance2:
    return Covariance2(sigma_m * sigma_m, 0.0, sigma_m * sigma_m)


def reported(
    at_s: float, x: float = 0.0, y: float = 0.0, sigma_m: float = 0.1, dependent_m: float = 0.0
) -> ReportedPosition:
    """A report of a robot that stands, with its independent and its dependent noise."""
    stamp_ns = round(at_s * SECOND)
    noise, dependent = variance(sigma_m), variance(dependent_m) if dependent_m else NOTHING
    whole = sigma_m * sigma_m + dependent_m * dependent_m
    still = Pose2(0.0, 0.0, 0.0)
    return ReportedPosition(stamp_ns, x, y, whole, still, noise=noise, dependent=dependent)


def carried(*reports: ReportedPosition) -> CarriedPosition:
    found = None
    for report in reports:
        found = with_reported_position(found, report)
    assert found is not None
    return found


def test_the_mean_of_independent_reports_is_that_of_least_variance() -> None:
    found = carried(reported(0.0, 0.0, sigma_m=0.1), reported(1.0, 0.3, sigma_m=0.2))
    assert found.at.x == pytest.approx(0.3 * 0.01 / 0.05, rel=1e-3)
    assert found.at.noise.xx == pytest.approx(0.01 * 0.04 / 0.05, rel=1e-3)
    assert found.reports == 2


def test_what_all_reports_have_in_common_does_not_average_away() -> None:
    found = carried(*(reported(t, sigma_m=0.2, dependent_m=0.1) for t in range(30)))
    assert math.sqrt(found.at.dependent.xx) == pytest.approx(0.1)
    assert math.sqrt(found.at.noise.xx) < 0.1


@given(st.lists(st.tuples(*[st.floats(0.01, 2.0)] * 3, st.floats(-1.5, 1.5)), min_size=1))
def test_covariances_stay_positive_and_shrink(
    reports: list[tuple[float, float, float, float]],
) -> None:
    """Whatever the shape of the noise: also that of sightings, which tell little along one axis."""
    found: CarriedPosition | None = None
    for i, (along, across, dependent, angle) in enumerate(reports):
        noise = Covariance2(along**2, 0.0, across**2).rotated(angle)
        now = reported(float(i), dependent_m=dependent)._replace(noise=noise)
        found = with_reported_position(found, now)
        assert np.linalg.eigvalsh(matrix2(found.at.noise))[0] > 0.0
        assert np.trace(matrix2(found.at.noise)) <= np.trace(matrix2(noise)) * 1.01 + dependent**2
        assert found.at.dependent.xx >= 0.0


def test_it_follows_the_robot_and_becomes_less_certain_on_the_way() -> None:
    then = reported(0.0, 1.0, 2.0)._replace(turn_rad=math.pi / 2.0)
    now = reported(4.0)._replace(odometry_from_robot=Pose2(2.0, 0.0, 0.0), turn_rad=math.pi / 2.0)
    found = carried_to(then, now)
    assert found is not None
    assert (found.x, found.y) == pytest.approx((1.0, 4.0))
    assert found.noise.xx > then.noise.xx + (0.2 * 2.0) ** 2 - 1e-9  # a fifth of the way
    turned = carried_to(then, now._replace(turn_variance=0.1))
    assert turned is not None
    assert turned.noise.xx == pytest.approx(found.noise.xx + 0.1 * 2.0**2)


def test_it_is_not_carried_over_a_gap_of_the_odometry_nor_for_ever_nor_back() -> None:
    then = reported(10.0)
    assert carried_to(then, reported(11.0)._replace(gaps=1)) is None
    assert carried_to(then, reported(10.0 + LONGEST_NS / SECOND + 1.0)) is None
    assert carried_to(then, reported(9.0)) is None
    assert carried(then, reported(11.0)._replace(gaps=1)).reports == 1


def test_it_begins_anew_where_a_sender_contradicts_itself() -> None:
    found = carried(reported(0.0), reported(1.0), reported(2.0, 5.0))
    assert (found.at.x, found.reports) == (5.0, 1)
    assert not found.is_confirmed


# Contests with what was said before ---------------------------------------------------------------


def heard(
    senders: Records,
    name: str,
    at: ReportedPosition,
    nis: float = AGREES,
    *,
    is_relay: bool = False,
) -> Records:
    """The records after one more report. It is not compared with the estimate, but by its place."""
    report = TeammateReport(at.stamp_ns, nis, (0.0, 0.0), position=at, is_relay=is_relay)
    return assess(senders, name, report, 0, RULES).senders


def in_turn(places: Mapping[str, float], sigma_m: float = 0.2, after_s: float = 0.0) -> Records:
    """The records after each of these senders reported a robot once a second for five seconds, ten
    seconds after the one before, by its error in x (m)."""
    senders: Records = {}
    for i, (name, x) in enumerate(places.items()):
        for t in range(5):
            senders = heard(senders, name, reported(after_s + 10.0 * i + t, x, sigma_m=sigma_m))
    return senders


def rivals(senders: Records) -> dict[str, set[str]]:
    return {n: {r.name for r in open_rivals(senders, n)} for n in senders if n}


def test_a_sender_is_contested_by_one_that_is_silent_since_and_nobody_is_in_quarantine() -> None:
    senders = in_turn({"west": 0.0, "east": 1.0})
    assert rivals(senders) == {"west": {"east"}, "east": {"west"}}
    assert all(r.reason is None for r in senders.values())
    assert contest_m(senders, "east") == pytest.approx(1.0, abs=0.05)
    statuses = trust_statuses(senders, 14 * SECOND)
    assert {s.robot for s in statuses if s.contested} == {"east", "west"}  # which is away
    as_guests = {name: replace(r, is_guest=True) for name, r in senders.items()}
    assert {s.robot for s in trust_statuses(as_guests, 14 * SECOND)} == {"east"}


@pytest.mark.parametrize(
    "senders",
    [
        in_turn({"west": 0.0, "east": 0.1}),
        in_turn({"west": 0.0, "east": 1.0}, sigma_m=0.9),
    ],
    ids=["they agree", "they are vague"],
)
def test_without_a_contradiction_there_is_no_contest(senders: Records) -> None:
    assert rivals(senders) == {"west": set(), "east": set()}


def test_an_outlier_begins_no_contest() -> None:
    senders = in_turn({"west": 0.0})
    for t in range(LEAST_REPORTS - 1):
        senders = heard(senders, "east", reported(20.0 + t, 5.0))
    assert carried_differences(senders, "east", round((20.0 + t) * SECOND)) == {}
    assert rivals(senders)["east"] == set()


def test_guests_and_robots_with_sensors_of_their_own_have_no_such_contests() -> None:
    """Anybody may come as several guests. Own sensors tell more than what was said before."""
    senders = in_turn({"west": 0.0})
    as_guest, seeing = dict(senders), dict(senders)
    for t in range(5):
        at = reported(20.0 + t, 1.0, sigma_m=0.2)
        report = TeammateReport(at.stamp_ns, AGREES, (0.0, 0.0), position=at, is_guest=True)
        as_guest = dict(assess(as_guest, "east", report, 0, RULES).senders)
        seeing[OWN_SENSORS] = SenderRecord(at.stamp_ns, last_agreement_ns=at.stamp_ns)
        seeing = dict(heard(seeing, "east", at))
    assert rivals(as_guest)["east"] == rivals(seeing)["east"] == set()


def test_a_contest_lasts_while_nothing_tells_and_ends_when_both_agree_again() -> None:
    senders = in_turn({"west": 0.0, "east": 1.0})
    vague = senders
    for t in range(20, 25):
        vague = heard(vague, "east", reported(float(t), 0.6, sigma_m=2.0))
    assert rivals(vague)["east"] == {"west"}
    again = senders
    for t in range(70, 90):  # what both said before is too old
        again = heard(again, "west", reported(float(t), 0.0, sigma_m=0.2))
        again = heard(again, "east", reported(t + 0.5, 0.0, sigma_m=0.2))
    assert rivals(again) == {"west": set(), "east": set()}
    assert AGREEMENT < (1.0 / 0.2) ** 2


def test_a_contest_with_a_robot_that_left_for_good_is_forgotten() -> None:
    """Or else one chance would leave a robot uncertain for ever."""
    senders = in_turn({"west": 0.0, "east": 1.0})
    long_s = LONGEST_SILENCE_NS / SECOND
    for at_s, left in ((long_s - 1.0, {"west"}), (long_s + 10.0, set())):
        senders = heard(senders, "east", reported(at_s, 1.0))
        assert rivals(senders)["east"] == left


def test_of_three_a_majority_speaks_for_a_sender_and_no_contest_begins() -> None:
    """A relay is no witness: what it says may come from either side."""
    senders = in_turn({"west": 0.0, "north": 0.05, "east": 1.0})
    assert rivals(senders)["east"] == set()
    relayed: Records = {**senders, "north": replace(senders["north"], is_relay=True)}
    for t in range(30, 32):
        relayed = heard(relayed, "east", reported(float(t), 1.0, sigma_m=0.2))
    assert "west" in rivals(relayed)["east"]


def test_a_third_robot_ends_a_contest_though_one_side_is_silent() -> None:
    """In random world 8057 one by chance lasted for half of the run, because one side had left."""
    senders = in_turn({"west": 0.0, "east": 1.0})
    for t in range(20, 30):
        senders = heard(senders, "north", reported(float(t), 0.0, sigma_m=0.2))
        senders = heard(senders, "west", reported(t + 0.5, 0.0, sigma_m=0.2))
    assert rivals(senders) == {"west": set(), "east": set(), "north": set()}


def test_two_of_four_end_no_contest_while_one_is_too_vague_to_take_a_side() -> None:
    """Two liars that agreed with each other quarantined a correct robot, because the other correct
    one was vague: 71 % inside 3 sigma."""
    senders = in_turn({"west": 0.0, "east": 1.0})
    for t in range(20, 25):
        senders = heard(senders, "south", reported(float(t), 0.0, sigma_m=1.0))
    for t in range(30, 40):
        senders = heard(senders, "north", reported(float(t), 1.0, sigma_m=0.2))
        senders = heard(senders, "east", reported(t + 0.5, 1.0, sigma_m=0.2))
    assert rivals(senders)["east"] == {"west"}


def test_two_that_report_often_are_compared_by_their_means() -> None:
    senders: Records = {}
    for i in range(40):
        senders = heard(senders, "west", reported(0.1 * i, 0.0))
        senders = heard(senders, "east", reported(0.1 * i + 0.05, 1.0))
    assert carried_differences(senders, "east", round(3.95 * SECOND)) == {}


def test_what_a_relay_says_is_no_more_certain_than_the_contest_of_its_sources() -> None:
    """A blind robot passed on the position by one side, which made another robot certain of it."""
    senders = in_turn({"west": 0.0, "east": 1.0})
    for is_relay, least_m in ((True, 1.0), (False, 0.0)):
        known = heard(senders, "scout", reported(20.0, 1.0), is_relay=is_relay)
        assert contest_of_sources_m(known, "scout") == pytest.approx(least_m, abs=0.05)


def test_who_contradicts_the_estimate_alone_is_contested_by_those_that_are_away() -> None:
    """Where its place is vague, the estimate still contradicts it clearly. The robot may have been
    carried away, so nobody is in quarantine. Own sensors tell that: with a contest a robot that was
    carried past landmarks found itself 5 to 9 s later."""
    for is_seeing in (False, True):
        senders = in_turn({"west": 0.0})
        for t in range(20, 24):
            at = reported(float(t), 1.0, sigma_m=0.9)
            if is_seeing:
                senders = {**senders, OWN_SENSORS: SenderRecord(at.stamp_ns)}
            report = TeammateReport(at.stamp_ns, CONTRADICTS, (1.0, 0.0), position=at)
            senders = assess(senders, "east", report, 0, RULES).senders
        assert rivals(senders)["east"] == (set() if is_seeing else {"west"})
        assert senders["east"].reason is None


def test_of_two_a_newcomer_is_contested_and_one_that_changed_is_quarantined() -> None:
    """The estimate decides between one and one only if it agreed with both before."""
    for agreed, reason in ((True, "biased"), (False, None)):
        senders: Records = {}
        for i in range(20):
            now = round((1.0 + 0.1 * i) * SECOND)
            senders = assess(senders, "west", TeammateReport(now, AGREES), 0, RULES).senders
            if agreed:
                senders = assess(senders, "east", TeammateReport(now, AGREES), 0, RULES).senders
        for i in range(25):
            now = round((3.0 + 0.1 * i) * SECOND)
            senders = assess(senders, "west", TeammateReport(now, AGREES), 0, RULES).senders
            report = TeammateReport(now, CONTRADICTS, (1.0, 0.0))
            senders = assess(senders, "east", report, 0, RULES).senders
        assert senders["east"].reason == reason
        assert rivals(senders)["east"] == (set() if agreed else {"west"})


# In the filter ------------------------------------------------------------------------------------


def seen(observed: Observed, from_s: float, until_s: float, error_m: float = 0.0) -> Observed:
    """An observer that sees the robot twice a second, in this time only, with this error."""

    def position(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float] | None:
        if not from_s * SECOND <= ns < until_s * SECOND or ns % (SECOND // 2):
            return None
        place = observed(ns, truth, rng)
        return None if place is None else (place[0] + error_m, place[1])

    return position


@pytest.mark.parametrize("seed", sampled(range(8), [1, 2]))
@pytest.mark.parametrize("error_m", [1.0, 2.0])
def test_sigma_holds_where_a_liar_comes_while_the_correct_observer_is_away(
    error_m: float, seed: int
) -> None:
    observers = {"west": seen(correct, 0.0, 6.0), "east": seen(correct, 10.0, 30.0, error_m)}
    drive = Drive(observers, seed=seed)
    assert drive.quarantines == {}
    assert drive.inside_3_sigma > 0.97
    honest = Drive({**observers, "east": seen(correct, 10.0, 30.0)}, seed=seed)
    assert honest.inside_3_sigma > 0.97
    assert not any(r.rivals for r in honest.state.memory.teammates.senders.values())
    assert honest.rmse_m < 0.2
