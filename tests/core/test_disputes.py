"""Who supports the estimate in a dispute: by what a source reports since the dispute began."""

import math

import pytest
from msgspec.structs import replace
from support.core import SECOND
from support.trust import AGREES

from cpcbl_team.disputes import (
    FADING_NS,
    dissenting,
    score_bound,
    supporters_of_dissent,
    supporters_of_estimate,
    with_denial,
)
from cpcbl_team.estimate import Covariance3
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import USUAL, MeanOffset
from cpcbl_team.sender_records import (
    OWN_SENSORS,
    Denial,
    OffsetEvidence,
    QuarantineReason,
    SenderRecord,
    TeammateReport,
    without_comparisons,
)

NOW_NS = 100 * SECOND
BEGAN_NS = NOW_NS - SECOND // 2
CLAIM_M = 0.2
LIMIT = 30.0
DISSENTER = SenderRecord(
    NOW_NS, score=LIMIT + 1.0, dispute_since_ns=BEGAN_NS, mean_offset=(CLAIM_M, 0.0)
)


def report(x: float, sigma_m: float, dependent_m: float = 0.0) -> TeammateReport:
    """A report that the estimate is off by so much in x."""
    a, d = 1.0 / sigma_m**2, dependent_m**2
    matrix = Covariance3(a, 0.0, a, 0.0, 0.0, 0.0)
    evidence = OffsetEvidence((matrix, (a * x, 0.0, 0.0)), Covariance2(d, 0.0, d))
    return TeammateReport(NOW_NS, AGREES, evidence=evidence)


def denial(senders: dict[str, SenderRecord], name: str, said: TeammateReport) -> Denial | None:
    """What is kept of this report."""
    return with_denial(senders[name], senders, name, said).denial


def source(*offsets: float, sigma_m: float = 0.07, mean_m: float | None = None) -> SenderRecord:
    """A source that has reported these offsets since the dispute began, and agreed then. Its mean
    of some seconds is `mean_m`, if it has one."""
    mean = None
    if mean_m is not None:
        mean = MeanOffset(mean_m, 0.0, Covariance2(1e-4, 0.0, 1e-4), stamp_ns=NOW_NS)
    record = SenderRecord(NOW_NS, last_accepted_ns=NOW_NS, means=(mean, mean))
    for x in offsets:
        senders = {"dissenter": DISSENTER, "other": record}
        record = with_denial(record, senders, "other", report(x, sigma_m))
    return record


def supports(record: SenderRecord) -> bool:
    recent = {"dissenter": DISSENTER, "other": record}
    return supporters_of_estimate(recent, {"dissenter"}, LIMIT, BEGAN_NS) == {"other"}


def test_own_sensors_alone_say_not_where_the_robot_is_instead() -> None:
    """They contradict the estimate, whose heading is off. A teammate that comes into sight then
    agrees with its position, and is not to blame."""
    recent = {OWN_SENSORS: replace(DISSENTER, mean_offset=(0.0, 0.0)), "other": source()}
    assert supporters_of_estimate(recent, {OWN_SENSORS}, LIMIT, BEGAN_NS) == set()
    recent["dissenter"] = DISSENTER
    dissenters = {OWN_SENSORS, "dissenter"}
    assert supporters_of_estimate(recent, dissenters, LIMIT, BEGAN_NS) == {"other"}


def test_own_sensors_that_measure_rarely_support_the_estimate_by_what_they_measured() -> None:
    """One landmark a second, which tells the heading and little of the position, agrees with both
    sides. They have no mean of some seconds."""

    def supports_it(record: SenderRecord, dissenter: SenderRecord = DISSENTER) -> bool:
        recent = {"dissenter": dissenter, OWN_SENSORS: record}
        return bool(supporters_of_estimate(recent, {"dissenter"}, LIMIT, BEGAN_NS))

    assert not supports_it(source(0.0, sigma_m=0.5))
    assert supports_it(source(0.0))
    assert not supports_it(source(0.0, mean_m=CLAIM_M))  # their mean tells more
    was_seen = replace(DISSENTER, mean_offset=(0.0, 0.0))  # and has said no place
    assert supports_it(source(0.0, sigma_m=0.5), was_seen)


def test_a_denial_is_the_difference_of_chi_squares() -> None:
    """By the whole noise of each report: its own part, and that which is the same in all."""
    sigma_m, dependent_m = 0.03, 0.04  # 0.05 together
    senders = {"dissenter": DISSENTER, "other": SenderRecord(NOW_NS)}
    found = denial(senders, "other", report(0.05, sigma_m, dependent_m))
    expected = (0.15 / 0.05) ** 2 - (0.05 / 0.05) ** 2
    assert found is not None
    assert found[:2] == ("dissenter", BEGAN_NS)
    assert found.chi_square == pytest.approx(expected)


def test_one_that_agreed_before_the_estimate_was_led_away_does_not_support_it() -> None:
    """Its mean of some seconds agrees still, and each report is too vague to contradict: it was
    counted against the one that was precise and right."""
    led_away = source(0.14, 0.16, 0.05, 0.15, mean_m=0.0)
    assert not supports(led_away)
    assert supports(replace(led_away, denial=None))  # by that mean
    assert supports(source(0.01, -0.05, 0.03, mean_m=0.0))


@pytest.mark.parametrize(("sigma_m", "is_told"), [(0.05, True), (0.2, False)])
def test_one_that_is_too_vague_to_tell_supports_nobody(sigma_m: float, is_told: bool) -> None:
    assert supports(source(0.0, sigma_m=sigma_m)) is is_told
    assert (CLAIM_M / sigma_m) ** 2 > USUAL if is_told else (CLAIM_M / sigma_m) ** 2 < USUAL


def test_each_dispute_begins_anew() -> None:
    told = source(0.0, 0.0)
    assert told.denial is not None
    said = report(0.0, 0.07)
    later = replace(DISSENTER, dispute_since_ns=NOW_NS)
    again = denial({"dissenter": later, "other": told}, "other", said)
    assert again is not None
    assert again.chi_square == pytest.approx(told.denial.chi_square / 2.0)
    louder = {"dissenter": DISSENTER, "x": replace(DISSENTER, score=2.0 * LIMIT), "other": told}
    assert math.isclose(again.chi_square, (CLAIM_M / 0.07) ** 2)
    found = denial(louder, "other", said)
    assert found is not None
    assert found.of == "x"
    none = {"dissenter": replace(DISSENTER, score=0.0), "other": told}
    assert denial(none, "other", said) is None
    assert without_comparisons(told).denial is None


def test_nobody_denies_itself_or_one_in_quarantine() -> None:
    said = report(0.0, 0.02)
    senders = {"dissenter": DISSENTER, "other": SenderRecord(NOW_NS)}
    assert denial(senders, "dissenter", said) is None
    senders["dissenter"] = replace(DISSENTER, reason=QuarantineReason.BIASED)
    assert denial(senders, "other", said) is None


# Both sides ---------------------------------------------------------------------------------------


def test_one_that_leads_the_estimate_within_its_gate_supports_it() -> None:
    """An echo that amplified the error of the estimate by 0.3 never agreed with it, and never
    contradicted it clearly, so no dispute was decided while it led a blind robot on at 1.4 m/s."""
    leads = replace(source(0.0, 0.0), dispute_since_ns=NOW_NS, score=3.0)
    assert supports(leads)
    assert not supports(replace(leads, last_failure_ns=NOW_NS))
    assert not supports(replace(leads, last_accepted_ns=BEGAN_NS - 1))


def test_one_that_is_too_vague_to_contradict_supports_what_it_is_nearer_to() -> None:
    """Two correct observers said the same of the estimate, but only one was precise enough to
    contradict it alone. It stood against one liar, and came into quarantine."""
    vague = source(CLAIM_M, CLAIM_M, CLAIM_M)
    recent = {"dissenter": DISSENTER, "other": vague}
    assert supporters_of_dissent(recent, LIMIT) == {"other"}
    assert supporters_of_dissent({**recent, "other": source(0.0, 0.0)}, LIMIT) == set()
    assert supporters_of_dissent({**recent, "other": source(CLAIM_M, sigma_m=0.5)}, LIMIT) == set()
    over = replace(DISSENTER, score=LIMIT - 1.0)
    assert supporters_of_dissent({**recent, "dissenter": over}, LIMIT) == set()


def test_what_was_said_before_the_estimate_moved_fades() -> None:
    senders = {"dissenter": DISSENTER, "other": source(0.0, 0.0)}
    before = senders["other"].denial
    later = report(0.0, 10.0)._replace(stamp_ns=NOW_NS + FADING_NS)
    after = denial(senders, "other", later)
    assert before is not None
    assert after is not None
    assert after.chi_square == pytest.approx(before.chi_square / math.e, rel=1e-3)


def test_dissenters_on_both_sides_of_the_estimate_are_not_one_side() -> None:
    """A liar that amplifies by 2.5 contradicts the estimate in one direction, a correct observer in
    the other. Counted as one side they outvoted the other correct observer."""
    liar = replace(DISSENTER, score=LIMIT + 2.0, mean_offset=(-CLAIM_M, 0.01))
    senders = {"honest": DISSENTER, "liar": liar}
    assert dissenting(senders, LIMIT) == {"liar"}
    assert score_bound(senders, LIMIT) == LIMIT
    both = {"honest": DISSENTER, "other": replace(DISSENTER, score=0.6 * LIMIT)}
    assert dissenting(both, LIMIT) == {"honest", "other"}
    assert score_bound(both, LIMIT) == 0.5 * LIMIT
    guests = {name: replace(record, is_guest=True) for name, record in both.items()}
    assert score_bound(guests, LIMIT) == LIMIT
    assert dissenting({"honest": replace(DISSENTER, score=0.4 * LIMIT)}, LIMIT) == set()
