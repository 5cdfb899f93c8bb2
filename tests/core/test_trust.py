"""Faulty senders are quarantined and readmitted; correct ones, and a lost robot's, are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.core import (
    SECOND,
)
from support.trust import AGREES, CONTRADICTS, MS, RULES, Receiver

from cpcbl_team.contests import contest_m
from cpcbl_team.disputes import united_majority
from cpcbl_team.estimate import Covariance3
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import MeanOffset
from cpcbl_team.sender_records import (
    OWN_SENSORS,
    USUAL_NIS,
    OffsetEvidence,
    QuarantineReason,
    Rival,
    SenderRecord,
    TeammateReport,
)
from cpcbl_team.trust import assess
from cpcbl_team.trust_status import trust_statuses


@pytest.fixture
def receiver() -> Receiver:
    return Receiver()


def test_a_sender_that_contradicts_own_sensors_is_quarantined_within_half_a_second(
    receiver: Receiver,
) -> None:
    receiver.receive(1.0, own=AGREES, liar=AGREES)
    receiver.receive(0.5, own=AGREES, liar=CONTRADICTS)
    assert receiver.quarantined == {"liar": "biased"}
    assert not receiver.decisions[-1][1].trusted


def test_three_teammates_do_not_outvote_own_sensors(receiver: Receiver) -> None:
    receiver.receive(1.0, own=AGREES, a=AGREES, b=AGREES, c=AGREES)
    receiver.receive(1.0, own=AGREES, a=CONTRADICTS, b=CONTRADICTS, c=CONTRADICTS)
    assert receiver.quarantined.keys() == {"a", "b", "c"}


def test_two_correct_teammates_outvote_a_faulty_one(receiver: Receiver) -> None:
    receiver.receive(1.0, a=AGREES, b=AGREES, liar=AGREES)
    receiver.receive(0.6, a=AGREES, b=AGREES, liar=CONTRADICTS)
    assert receiver.quarantined == {"liar": "biased"}


def test_a_faulty_sender_that_the_estimate_followed_is_outvoted(receiver: Receiver) -> None:
    receiver.receive(0.6, a=CONTRADICTS, b=CONTRADICTS, liar=AGREES)
    assert receiver.quarantined == {"liar": "outvoted"}
    (decision,) = (d for _, d in receiver.decisions if d.event)
    assert decision.quarantined == {"liar"}
    assert decision.estimate_error_m == pytest.approx(0.5)


GUESTS = [f"guest{i}" for i in range(5)]


def test_guests_do_not_outvote_two_robots_of_the_team(receiver: Receiver) -> None:
    """Five had both in quarantine within a second, and led the robot 0.5 m away."""
    receiver.receive(1.0, a=AGREES, b=AGREES, **dict.fromkeys(GUESTS, AGREES))
    receiver.receive(1.0, a=AGREES, b=AGREES, **dict.fromkeys(GUESTS, CONTRADICTS))
    assert receiver.quarantined.keys() == {*GUESTS}


@pytest.mark.parametrize("guests", [GUESTS[:1], GUESTS])
def test_guests_do_not_outvote_one_robot_of_the_team(receiver: Receiver, guests: list[str]) -> None:
    """A sudden error is decided by the earlier estimate, which this robot goes on confirming."""
    receiver.receive(1.0, a=AGREES, **dict.fromkeys(guests, AGREES))
    receiver.receive(3.0, a=AGREES, **dict.fromkeys(guests, CONTRADICTS))
    assert receiver.quarantined.keys() == {*guests}
    assert {event for _, event in receiver.events} == {"quarantined"}


@pytest.mark.parametrize("guests", [GUESTS[:1], GUESTS])
def test_an_estimate_that_only_guests_confirm_condemns_no_robot_of_the_team(
    receiver: Receiver, guests: list[str]
) -> None:
    """They may have led it astray while the robot of the team was out of sight: both count."""
    receiver.receive(5.0, **dict.fromkeys(guests, AGREES))
    receiver.receive(1.0, a=CONTRADICTS, **dict.fromkeys(guests, AGREES))
    assert receiver.quarantined == {}
    assert receiver.events == [("a", "contested")]
    assert all(s.contested for s in trust_statuses(receiver.senders, receiver.now_ns))
    for name in ("a", *guests):
        assert contest_m(receiver.senders, name) == pytest.approx(0.5)


def test_one_distance_that_odometry_contradicts_by_chance_gives_guests_no_majority(
    receiver: Receiver,
) -> None:
    """It took the only correct observer's vote as a guest began to lie: the robot followed the
    guest by 0.5 m, sure to 3 cm, and the observer was in quarantine."""
    receiver.receive(1.0, a=AGREES, guest0=AGREES)
    record = receiver.senders["a"]
    conflict = replace(record, odometry_conflicts=1.0, last_conflict_ns=receiver.now_ns)
    receiver.senders = {**receiver.senders, "a": conflict}
    receiver.receive(3.0, a=AGREES, guest0=CONTRADICTS)
    assert receiver.quarantined.keys() == {"guest0"}


def test_guests_that_are_quarantined_together_are_not_released_as_a_majority() -> None:
    right = SenderRecord(last_report_ns=5 * SECOND, last_accepted_ns=5 * SECOND)
    senders = {"a": right, "b": right}
    for name in GUESTS:
        senders[name] = SenderRecord(
            last_report_ns=5 * SECOND,
            mean_offset=(0.5, 0.0),
            reason=QuarantineReason.BIASED,
            since_ns=4 * SECOND,
            is_guest=True,
        )
    senders[GUESTS[0]] = replace(
        senders[GUESTS[0]], reason=None, score=2.0 * RULES.limit, dispute_since_ns=4 * SECOND
    )
    report = TeammateReport(5 * SECOND, CONTRADICTS, (0.5, 0.0), is_guest=True)
    decision = assess(senders, GUESTS[0], report, 0, RULES)
    assert decision.event == "quarantined"


def test_guests_alone_do_not_show_a_robot_that_it_is_elsewhere() -> None:
    against = SenderRecord(last_report_ns=5 * SECOND, last_failure_ns=5 * SECOND)
    guests = {name: replace(against, is_guest=True) for name in GUESTS}
    agreeing = replace(against, last_agreement_ns=4 * SECOND, last_failure_ns=0)
    robots = {"a": agreeing, "b": agreeing}
    assert united_majority(guests | robots, 5 * SECOND) == ()
    assert united_majority({"a": against, "b": against}, 5 * SECOND) == ("a", "b")


def test_own_sensors_and_a_teammate_outvote_a_sender_that_the_estimate_followed(
    receiver: Receiver,
) -> None:
    receiver.receive(1.0, own=CONTRADICTS, right=CONTRADICTS, liar=AGREES)
    assert receiver.quarantined == {"liar": "outvoted"}


def test_own_sensors_alone_outvote_nobody(receiver: Receiver) -> None:
    """Perhaps the heading is off, of which a fix of the position tells nothing."""
    receiver.receive(1.0, own=CONTRADICTS, mate=AGREES)
    assert receiver.quarantined == {}


def test_a_robot_that_every_source_contradicts_quarantines_nobody(receiver: Receiver) -> None:
    """A kidnapped robot detects that it is lost."""
    receiver.receive(1.0, own=AGREES, a=AGREES, b=AGREES)
    receiver.receive(5.0, own=CONTRADICTS, a=CONTRADICTS, b=CONTRADICTS)
    assert receiver.quarantined == {}
    assert all(decision.trusted for _, decision in receiver.decisions)


def test_an_agreement_before_the_dispute_does_not_support_the_estimate(receiver: Receiver) -> None:
    receiver.receive(1.0, own=AGREES, a=AGREES)
    receiver.receive(1.0, a=CONTRADICTS)  # the robot sees no landmark now
    assert receiver.quarantined == {}


def test_a_sender_that_began_to_dissent_does_not_support_the_estimate() -> None:
    """The robot is kidnapped during a dispute, so the last report of `east` contradicts it too."""
    now_ns = 10 * SECOND
    senders = {
        "west": SenderRecord(
            last_report_ns=now_ns - 1, dispute_since_ns=8 * SECOND, score=RULES.limit - 1.0
        ),
        "east": SenderRecord(
            now_ns - 1,
            last_accepted_ns=9 * SECOND,
            dispute_since_ns=now_ns - 1,
            last_failure_ns=now_ns - 1,
            odometry_conflicts=1.0,
        ),
    }
    decision = assess(
        senders, "west", TeammateReport(now_ns, CONTRADICTS, (3.0, 0.0)), now_ns - 1, RULES
    )
    assert not decision.event
    assert not any(record.reason for record in decision.senders.values())


def disputed(**scores: float) -> dict[str, SenderRecord]:
    """Senders of the last moment: those with a score (in limits) dispute the estimate for two
    seconds, the others have just agreed with it."""
    now_ns = 10 * SECOND
    return {
        name: SenderRecord(
            last_report_ns=now_ns - 1,
            last_accepted_ns=now_ns - 1 if not score else 0,
            dispute_since_ns=8 * SECOND if score else 0,
            score=score * RULES.limit,
        )
        for name, score in scores.items()
    }


def test_a_sender_that_is_only_suspected_is_not_used_and_not_quarantined() -> None:
    senders = disputed(west=1.2, east=0.7, a=0.0, b=0.0, c=0.0)
    suspected = assess(senders, "east", TeammateReport(10 * SECOND, USUAL_NIS), 0, RULES)
    assert not suspected.trusted
    assert suspected.quarantined == frozenset()
    found = assess(senders, "west", TeammateReport(10 * SECOND, CONTRADICTS), 0, RULES)
    assert found.quarantined == {"west"}


@pytest.mark.parametrize(("sigma_m", "is_right"), [(0.01, True), (0.04, False)])
def test_one_that_is_too_vague_to_tell_supports_no_side_of_a_dispute(
    sigma_m: float, is_right: bool
) -> None:
    """The estimate followed a liar. A correct sender contradicted it, a vague one agreed with both
    and was the liar's majority: the correct one was in quarantine for 16 s."""
    senders = disputed(honest=1.2, liar=0.0, vague=0.0)
    senders["honest"] = replace(senders["honest"], mean_offset=(0.08, 0.0))
    for name, sigma in (("liar", 0.01), ("vague", sigma_m)):
        mean = MeanOffset(0.01, 0.0, Covariance2(sigma * sigma, 0.0, sigma * sigma))
        senders[name] = replace(senders[name], means=(mean, None))
    report = TeammateReport(10 * SECOND, CONTRADICTS, (0.08, 0.0))
    since = replace(senders["honest"], dispute_since_ns=10 * SECOND - 2 * MS)  # a tie lasts longer
    decision = assess({**senders, "honest": since}, "honest", report, 0, RULES)
    assert bool(decision.quarantined) is is_right


@pytest.mark.parametrize("is_contest", [True, False])
def test_single_readings_of_own_sensors_end_no_contest(is_contest: bool) -> None:
    """Their mean does that: each reading alone agrees with both sides."""
    senders = disputed(honest=1.2, liar=0.0, **{OWN_SENSORS: 0.0})
    if is_contest:
        for name, rival in (("honest", "liar"), ("liar", "honest")):
            senders[name] = replace(senders[name], rivals=(Rival(rival, 0.1, 0.0),))
    report = TeammateReport(10 * SECOND, CONTRADICTS, (0.1, 0.0))
    decision = assess(senders, "honest", report, 0, RULES)
    assert bool(decision.quarantined) is not is_contest


def test_a_sender_below_the_limit_is_used_while_nobody_is_above_it() -> None:
    senders = disputed(east=0.7, a=0.0, b=0.0)
    assert assess(senders, "east", TeammateReport(10 * SECOND, USUAL_NIS), 0, RULES).trusted


def test_a_sender_that_is_suspected_votes_against_the_estimate() -> None:
    senders = disputed(west=1.2, east=0.7, a=0.0)
    decision = assess(senders, "a", TeammateReport(10 * SECOND, AGREES), 0, RULES)
    assert decision.quarantined == {"a"}
    assert decision.event == "outvoted"


def test_of_two_contradicting_senders_neither_is_used_until_the_tie_ends(
    receiver: Receiver,
) -> None:
    receiver.receive(1.0, honest=AGREES, liar=AGREES)
    receiver.receive(1.0, honest=AGREES, liar=CONTRADICTS)
    assert receiver.quarantined == {}
    assert [d.trusted for _, d in receiver.decisions[-2:]] == [False, False]
    receiver.receive(1.0, honest=AGREES, liar=CONTRADICTS)
    assert receiver.quarantined == {"liar": "biased"}


def test_imprecise_reports_that_agree_do_not_end_a_dispute(receiver: Receiver) -> None:
    """Fixes contradict the estimate; distant sightings of the same sender are too imprecise to."""
    receiver.receive(1.0, honest=AGREES, liar=AGREES)
    for _ in range(18):
        receiver.receive(0.1, honest=AGREES, liar=CONTRADICTS)
        receiver.report("liar", TeammateReport(receiver.now_ns + 1, AGREES))
    assert receiver.quarantined == {"liar": "biased"}


def test_the_only_sender_is_unconfirmed_and_never_taken_for_biased(receiver: Receiver) -> None:
    receiver.receive(1.0, liar=AGREES)
    receiver.receive(5.0, liar=CONTRADICTS)
    assert receiver.quarantined == {}
    (status,) = trust_statuses(receiver.senders, receiver.now_ns)
    assert status.unconfirmed
    receiver.receive(0.1, liar=CONTRADICTS, other=AGREES)
    assert not any(s.unconfirmed for s in trust_statuses(receiver.senders, receiver.now_ns))


def test_a_sender_that_is_right_again_is_readmitted_after_the_set_time(receiver: Receiver) -> None:
    receiver.receive(1.0, own=AGREES, liar=AGREES)
    receiver.receive(1.0, own=AGREES, liar=CONTRADICTS)
    receiver.receive(RULES.readmit_s - 0.1, own=AGREES, liar=AGREES)
    assert receiver.quarantined
    receiver.receive(0.2, own=AGREES, liar=AGREES)
    assert receiver.quarantined == {}
    assert receiver.events == [("liar", "quarantined"), ("liar", "readmitted")]
    assert receiver.decisions[-1][1].trusted
    assert trust_statuses(receiver.senders, receiver.now_ns)[0].quarantines == 1


def test_a_sender_that_is_wrong_now_and_then_stays_in_quarantine(receiver: Receiver) -> None:
    receiver.receive(1.0, own=AGREES, liar=CONTRADICTS)
    for _ in range(10):
        receiver.receive(3.0, own=AGREES, liar=AGREES)
        receiver.receive(0.1, own=AGREES, liar=CONTRADICTS)
    assert receiver.quarantined == {"liar": "biased"}
    assert trust_statuses(receiver.senders, receiver.now_ns)[0].quarantines == 1


def test_no_sender_is_readmitted_without_a_second_source(receiver: Receiver) -> None:
    receiver.receive(1.0, own=AGREES, liar=CONTRADICTS)
    receiver.receive(20.0, liar=AGREES)
    assert receiver.quarantined == {"liar": "biased"}


def test_single_outliers_quarantine_nobody(receiver: Receiver) -> None:
    for _ in range(50):
        receiver.receive(0.1, own=AGREES, honest=CONTRADICTS)
        receiver.receive(0.9, own=AGREES, honest=AGREES)
    assert receiver.quarantined == {}


@given(st.lists(st.floats(0.0, USUAL_NIS), max_size=200))
def test_a_usual_nis_never_quarantines(all_nis: list[float]) -> None:
    receiver = Receiver()
    for nis in all_nis:
        receiver.receive(0.1, own=AGREES, honest=nis)
    assert receiver.quarantined == {}


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["own", "a", "b", "c"]), st.sampled_from([AGREES, 8.0, CONTRADICTS])
        ),
        max_size=150,
    )
)
def test_own_sensors_are_never_quarantined_and_each_quarantine_counts_once(
    reports: list[tuple[str, float]],
) -> None:
    receiver = Receiver()
    for name, nis in reports:
        receiver.receive(0.1, **{name: nis})
    assert OWN_SENSORS not in receiver.quarantined
    for name, record in receiver.senders.items():
        assert 0.0 <= record.score <= 2.0 * RULES.limit
        quarantines = sum(name in d.quarantined for _, d in receiver.decisions)
        assert record.quarantines == quarantines


def test_chi_square_noise_quarantines_nobody_in_half_an_hour() -> None:
    receiver, rng = Receiver(), np.random.default_rng(1)
    for nis in rng.chisquare(2, 18_000):
        receiver.receive(0.1, own=AGREES, honest=float(nis))
    assert receiver.events == []


def test_a_dispute_of_contested_senders_stays_undecided_after_their_means_are_stale(
    receiver: Receiver,
) -> None:
    """A robot that was lost meanwhile has no means; the first dispute decided for one side."""
    receiver.receive(1.0, a=AGREES, b=AGREES)
    rivals = {"a": (Rival("b", 0.5, 0.0),), "b": (Rival("a", -0.5, 0.0),)}
    receiver.senders = {n: replace(r, rivals=rivals[n]) for n, r in receiver.senders.items()}
    receiver.receive(13.0, a=AGREES, b=CONTRADICTS)
    assert receiver.quarantined == {}
    assert all(d.least_sigma_m == pytest.approx(0.5) for _, d in receiver.decisions[-20:])
    assert all(s.contested for s in trust_statuses(receiver.senders, receiver.now_ns))


def test_a_report_that_contradicts_the_estimate_has_less_weight_in_the_mean() -> None:
    """Without any, the mean of the others would seem to agree with the estimate."""
    evidence = OffsetEvidence((Covariance3(100.0, 0.0, 100.0, 0.0, 0.0, 0.0), (10.0, 0.0, 0.0)))
    sums = {}
    for nis in (1.0, 27.6, 100.0):
        report = TeammateReport(SECOND, nis, (0.1, 0.0), evidence=evidence)
        ((xx, *_), _) = assess({}, "a", report, 0, RULES).senders["a"].offsets[0].evidence
        sums[nis] = xx
    assert sums == {1.0: 100.0, 27.6: pytest.approx(50.0), 100.0: 0.0}
