"""How long a sender stays in quarantine after its reports are right again."""

import pytest
from support.core import SECOND
from support.trust import AGREES, CONTRADICTS, RULES, Receiver

from cpcbl_team.sender_records import (
    QuarantineReason,
    SenderRecord,
    quarantined,
    readmitted,
    released,
)


@pytest.fixture
def receiver() -> Receiver:
    return Receiver()


def test_one_that_was_outvoted_is_readmitted_after_as_long_as_others(receiver: Receiver) -> None:
    """It had never contradicted the estimate, so it came back after ten reports, and an echo led
    the estimate away again."""
    receiver.receive(1.0, own=CONTRADICTS, right=CONTRADICTS, liar=AGREES)
    assert receiver.quarantined == {"liar": "outvoted"}
    receiver.receive(RULES.readmit_s - 1.0, own=AGREES, liar=AGREES)
    assert receiver.quarantined
    receiver.receive(2.0, own=AGREES, liar=AGREES)
    assert receiver.quarantined == {}


def test_one_that_relapses_is_readmitted_later_each_time(receiver: Receiver) -> None:
    """An echo was readmitted as soon as the estimate was right, and led it away again."""
    waited_s = []
    for _ in range(5):
        receiver.receive(1.0, own=AGREES, liar=CONTRADICTS)
        assert receiver.quarantined
        begin_ns = receiver.now_ns
        while receiver.quarantined:
            receiver.receive(0.5, own=AGREES, liar=AGREES)
        waited_s.append(round((receiver.now_ns - begin_ns) / SECOND))
    readmit_s = RULES.readmit_s
    assert waited_s == [readmit_s * k for k in (1, 2, 4, 8, 8)]
    receiver.receive(61.0, own=AGREES, liar=AGREES)
    receiver.receive(1.0, own=AGREES, liar=CONTRADICTS)
    receiver.receive(readmit_s + 0.5, own=AGREES, liar=AGREES)
    assert receiver.quarantined == {}


def test_one_that_was_released_as_innocent_has_no_relapse() -> None:
    record = quarantined(SenderRecord(), QuarantineReason.BIASED, SECOND)
    again = quarantined(released(record, 2 * SECOND), QuarantineReason.BIASED, 3 * SECOND)
    assert again.relapses == 0
    again = quarantined(readmitted(record, 2 * SECOND), QuarantineReason.BIASED, 3 * SECOND)
    assert again.relapses == 1
