"""A teammate's clock that is off is found, reported, and its words refused by a stated rule."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import MS, SECOND, TeamOnBus, robot_at, saw, team_of

from cpcbl_agents.clocks import MIN_MESSAGES, SPAN_NS, ClockMonitor
from cpcbl_team.config import TrustSettings
from cpcbl_team.inputs import Fix, Sighting
from cpcbl_transport import topics
from cpcbl_transport.messages import FUTURE_NS, Refusal, Status

RULES = TrustSettings()
NOW = 3 * SECOND
HOUR = 3600 * SECOND


def heard(
    clocks: ClockMonitor, late_ns: int, words: int = MIN_MESSAGES, now_ns: int = NOW
) -> list[bool]:
    """Which of so many words are refused that arrive at 10 Hz, each so long after its stamp."""
    times = (now_ns + i * 100 * MS for i in range(words))
    return [clocks.rejects("mate", now - late_ns, now) for now in times]


@pytest.mark.parametrize("late_ns", [-100 * MS, 0, 20 * MS, 399 * MS])
def test_a_clock_within_the_bounds_is_tolerated(late_ns: int) -> None:
    clocks = ClockMonitor(RULES)
    assert not any(heard(clocks, late_ns, 200))
    assert clocks.off(NOW) == frozenset()
    assert clocks.late_s("mate") == pytest.approx(late_ns * 1e-9)


@pytest.mark.parametrize("late_ns", [-110 * MS, -500 * MS, -HOUR, 410 * MS, 500 * MS, HOUR])
def test_a_clock_beyond_them_is_found_and_refused(late_ns: int) -> None:
    clocks = ClockMonitor(RULES)
    refused = heard(clocks, late_ns, 20)
    assert all(refused[MIN_MESSAGES:])
    assert clocks.off(NOW) == {"mate"}
    assert clocks.late_s("mate") == pytest.approx(late_ns * 1e-9)


def test_what_arrives_before_it_was_measured_is_refused_at_once() -> None:
    assert heard(ClockMonitor(RULES), -200 * MS, 1) == [True]


def test_a_single_delayed_message_is_used() -> None:
    clocks = ClockMonitor(RULES)
    assert heard(clocks, 1500 * MS, 1) == [False]
    assert not any(heard(clocks, 20 * MS, 20))


def test_a_single_message_from_far_ahead_does_not_affect_the_next() -> None:
    clocks = ClockMonitor(RULES)
    heard(clocks, -FUTURE_NS - 1, 1)
    assert not any(heard(clocks, 20 * MS, 20))


def test_a_congested_link_is_not_taken_for_a_slow_clock_while_some_messages_are_quick() -> None:
    clocks = ClockMonitor(RULES)
    refused = [
        heard(clocks, late * MS, 1, NOW + i * 100 * MS) for i, late in enumerate([50, 900] * 20)
    ]
    assert not any(map(any, refused))


@pytest.mark.parametrize("late_ns", [-500 * MS, 500 * MS])
def test_a_clock_that_was_set_right_is_believed_again(late_ns: int) -> None:
    clocks = ClockMonitor(RULES)
    heard(clocks, late_ns, 50)
    heard(clocks, 20 * MS, 2 * SPAN_NS // (100 * MS), NOW + 5 * SECOND)
    assert not any(heard(clocks, 20 * MS, 10, NOW + 5 * SECOND + 2 * SPAN_NS))
    assert clocks.off(NOW + 6 * SECOND + 2 * SPAN_NS) == frozenset()


def test_of_a_mate_that_has_been_silent_nothing_is_said() -> None:
    clocks = ClockMonitor(RULES)
    heard(clocks, 900 * MS, MIN_MESSAGES)  # after a pause of this robot, say
    assert clocks.off(NOW + 2 * SPAN_NS - 1) == {"mate"}
    assert clocks.off(NOW + 2 * SPAN_NS) == frozenset()


def test_a_clock_that_goes_wrong_is_found_within_two_spans() -> None:
    clocks = ClockMonitor(RULES)
    heard(clocks, 20 * MS, 50)
    assert heard(clocks, 600 * MS, 2 * SPAN_NS // (100 * MS), NOW + 5 * SECOND)[-1]


def test_where_robot_time_runs_faster_links_are_slower_in_it() -> None:
    assert not any(heard(ClockMonitor(RULES, speed=10.0), 3 * SECOND, 20))
    assert any(heard(ClockMonitor(RULES, speed=0.1), 500 * MS, 20))


@given(st.lists(st.integers(0, 400 * MS), max_size=100))
def test_no_link_that_is_quick_enough_makes_a_clock_look_off(delays: list[int]) -> None:
    clocks = ClockMonitor(RULES)
    for i, late_ns in enumerate(delays):
        assert not heard(clocks, late_ns, 1, NOW + i * 50 * MS)[0]


def told(offset_ns: int, trust: TrustSettings = RULES) -> Status:
    """A robot's status after 2 s of fixes from a mate whose clock is ahead by so much."""
    me = robot_at(trust=trust, direction="both-ways")  # whatever its own tier
    stand = TeamOnBus(team_of(me=me, mate=robot_at(4.0)), here=["me"])
    stand.announce("mate", 2)
    stand.stand_still(0.2)
    for _ in range(20):
        stand.stand_still(0.1)
        stamp_ns = stand.now_ns + offset_ns
        part = (1e-4, 0.0, 1e-4)
        fix = Fix("me", "mate", stamp_ns, 0.0, 0.0, part, part)
        stand.put(topics.FIX.at(robot="me", tier=2, observer="mate"), fix)
        stand.sightings("me", saw(stand.now_ns, Sighting("oak", 4.0, 0.0)))
        stand.step()
    return stand.status("me")


@pytest.mark.parametrize("offset_ns", [-500 * MS, 500 * MS, -HOUR, HOUR])
def test_a_robot_reports_the_clock_and_counts_what_it_refused(offset_ns: int) -> None:
    status = told(offset_ns)
    (trust,) = status.trust
    assert (trust.peer, trust.reason) == ("mate", "clock")
    assert trust.late_s == pytest.approx(-offset_ns * 1e-9, abs=0.2)
    assert status.counts[Refusal.CLOCK] >= 10


def test_a_tolerated_clock_is_reported_with_its_difference() -> None:
    status = told(50 * MS)
    (trust,) = status.trust
    assert trust.reason == ""
    assert trust.late_s == pytest.approx(-0.05, abs=0.01)
    assert Refusal.CLOCK not in status.counts


def test_without_trust_clocks_are_not_reported() -> None:
    status = told(-500 * MS, TrustSettings(enabled=False))
    assert status.trust == ()
    assert Refusal.CLOCK not in status.counts
