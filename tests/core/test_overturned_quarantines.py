"""Quarantines by comparison that do not outlast what they rested on."""

from typing import Any

import pytest
from msgspec.structs import replace
from support.core import SECOND
from support.trust import AGREES, RULES

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import FadingOffsets, MeanOffset
from cpcbl_team.overturned_quarantines import OVERTURNED_NS, witnesses_of_contest
from cpcbl_team.sender_records import (
    OWN_SENSORS,
    QuarantineReason,
    Rival,
    SenderRecord,
    TeammateReport,
)
from cpcbl_team.trust import assess

NOW_NS = 100 * SECOND
BIASED = QuarantineReason.BIASED


def says(x: float, sigma: float = 0.01, **more: Any) -> SenderRecord:
    """A sender whose reports have this offset on average."""
    covariance = Covariance2(sigma * sigma, 0.0, sigma * sigma)
    mean = MeanOffset(x, 0.0, covariance, stamp_ns=NOW_NS)
    sums = FadingOffsets(stamp_ns=NOW_NS)
    fields = {"last_agreement_ns": NOW_NS, "offsets": (sums, sums), "means": (mean, mean), **more}
    return SenderRecord(NOW_NS, **fields)


def contest(witness: SenderRecord) -> dict[str, SenderRecord]:
    """An echo and a correct sender contradict each other, and a third one is in quarantine."""
    return {
        "echo": says(0.0, rivals=(Rival("correct", 0.2, 0.0),)),
        "correct": says(0.2, rivals=(Rival("echo", -0.2, 0.0),)),
        "witness": witness,
    }


IN_QUARANTINE = says(0.2, reason=BIASED, since_ns=NOW_NS - SECOND, quarantines=1)


@pytest.mark.parametrize("of", ["echo", "correct"])
@pytest.mark.parametrize("x", [0.2, 0.0])
def test_a_quarantined_sender_that_takes_a_side_is_heard_again(of: str, x: float) -> None:
    mean = says(x).means
    senders = contest(replace(IN_QUARANTINE, means=mean))
    assert witnesses_of_contest(senders, of, NOW_NS) == {"witness"}
    decision = assess(senders, of, TeammateReport(NOW_NS, AGREES), 0, RULES)
    assert decision.event == "readmitted"
    assert decision.senders["witness"].reason is None


def test_then_a_majority_decides() -> None:
    """The echo agrees with the estimate, which it leads, and the one that was correct about it was
    in quarantine: now both correct ones are against it."""
    report = TeammateReport(NOW_NS, AGREES)
    senders = assess(contest(IN_QUARANTINE), "correct", report, 0, RULES).senders
    for name, is_wrong in (("echo", True), ("correct", False), ("witness", False)):
        found = assess(senders, name, report, 0, RULES).senders[name]
        assert (found.wrong_ns == NOW_NS) is is_wrong, name


@pytest.mark.parametrize(
    "change",
    [
        {"means": says(0.5).means},  # it contradicts both
        {"means": says(0.1, sigma=0.05).means},  # too vague to contradict either
        {"means": (None, None)},
        {"reason": QuarantineReason.FROZEN},  # odometry contradicts it
        {"reason": QuarantineReason.JUMPS},
        {"since_ns": NOW_NS - OVERTURNED_NS - 1},
        {"last_report_ns": NOW_NS - 4 * SECOND},
        {"is_guest": True},
    ],
)
def test_no_other_quarantine_ends_so(change: dict[str, Any]) -> None:
    senders = contest(replace(IN_QUARANTINE, **change))
    assert witnesses_of_contest(senders, "echo", NOW_NS) == frozenset()


def test_own_sensors_need_no_witness() -> None:
    senders = {**contest(IN_QUARANTINE), OWN_SENSORS: says(0.2)}
    assert witnesses_of_contest(senders, "echo", NOW_NS) == frozenset()


def test_without_a_contest_there_is_nothing_to_witness() -> None:
    senders = {n: replace(r, rivals=()) for n, r in contest(IN_QUARANTINE).items()}
    assert witnesses_of_contest(senders, "echo", NOW_NS) == frozenset()
