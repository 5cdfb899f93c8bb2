"""What the state is after a robot's inputs were wrong."""

import math

import pytest
from msgspec.structs import replace
from support.core import SECOND

from cpcbl_team.config import Field, LocalizationSettings, Start
from cpcbl_team.inputs import InputsMended
from cpcbl_team.localizer import Localizer
from cpcbl_team.own_errors import forgive
from cpcbl_team.sender_records import QuarantineReason, SenderRecord
from cpcbl_team.state import with_senders, with_teammates
from cpcbl_team.timeline import Timeline


def test_the_heading_turns_the_covariance_grows_and_teammates_are_forgiven() -> None:
    settings = LocalizationSettings(start=Start(x_m=1.0, y_m=2.0, heading_deg=179.0))
    localizer = Localizer(settings, Field())
    state = localizer.start(0)
    biased = SenderRecord(reason=QuarantineReason.BIASED, score=50.0, quarantines=1)
    senders = {
        "north": biased,
        "west": replace(biased, reason=QuarantineReason.JUMPS),
        "east": SenderRecord(score=20.0),
    }
    state = with_teammates(state, with_senders(state.memory.teammates, senders))
    timeline = Timeline(localizer, state)
    timeline.add(InputsMended(1, math.radians(3.0), 0.1))
    after = timeline.state
    assert math.degrees(after.estimate.pose.heading) == pytest.approx(-178.0)
    before, now = state.estimate.covariance, after.estimate.covariance
    assert now.xx == pytest.approx(before.xx + 0.01)
    assert now.hh == pytest.approx(before.hh + math.radians(3.0) ** 2)
    assert now.xy == before.xy
    records = after.memory.teammates.senders
    assert records["north"].reason is None
    assert records["west"].reason is QuarantineReason.JUMPS  # odometry contradicts it
    assert all(record.score == 0.0 for record in records.values())


def test_a_quarantine_from_before_the_inputs_were_wrong_goes_on() -> None:
    """The inputs were wrong from the tenth second; a liar was found in the ninth."""
    localizer = Localizer(LocalizationSettings(), Field())
    state = localizer.start(0)
    biased = SenderRecord(reason=QuarantineReason.BIASED, since_ns=9 * SECOND, quarantines=1)
    senders = {"liar": biased, "correct": replace(biased, since_ns=12 * SECOND)}
    state = with_teammates(state, with_senders(state.memory.teammates, senders))
    for since_ns, is_liar_released in ((10 * SECOND, False), (0, True)):
        event = InputsMended(17 * SECOND, since_ns=since_ns)
        records = localizer.forget_wrong_inputs(state, event).memory.teammates.senders
        assert records["correct"].reason is None
        assert (records["liar"].reason is None) is is_liar_released


def test_where_nobody_else_is_left_older_quarantines_end_too() -> None:
    biased = SenderRecord(reason=QuarantineReason.BIASED, since_ns=9 * SECOND, quarantines=1)
    jumping = replace(biased, reason=QuarantineReason.JUMPS)
    for others, is_released in (
        ({"west": jumping}, True),
        ({"west": SenderRecord()}, False),
        ({"west": replace(biased, since_ns=12 * SECOND)}, False),
    ):
        records = forgive({"north": biased, **others}, 17 * SECOND, 10 * SECOND)
        assert (records["north"].reason is None) is is_released
    assert forgive({}, 17 * SECOND, 10 * SECOND) == {}
