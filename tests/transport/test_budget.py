"""What a robot may spend: never more, little less, and on what is worth most."""

import math
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import MS, SECOND, examples

from cpcbl_team.config import BudgetSettings
from cpcbl_transport.budget import LONGEST_INTERVAL_S, Budget, bytes_window
from cpcbl_transport.messages import Spending

FIX, BELIEF = 42, 50
HOUR = 3600 * SECOND


class Wish(NamedTuple):
    """A message that a robot would like to send."""

    at_ns: int
    size: int
    urgent: bool = False


def wishes_with_gaps(most_gap_ns: int) -> st.SearchStrategy[list[Wish]]:
    """Gaps of any length, and often none at all."""
    gap = st.integers(0, most_gap_ns) | st.just(0) | st.integers(0, 10)
    sized = st.tuples(gap, st.integers(1, 300), st.booleans())

    def timed(wishes: list[tuple[int, int, bool]]) -> list[Wish]:
        stamps = accumulate(gap for gap, _, _ in wishes)
        return [Wish(at, w[1], w[2]) for at, w in zip(stamps, wishes, strict=True)]

    return st.lists(sized, max_size=150).map(timed)


SHARES = st.floats(0.0, 1.0)
WISHES = wishes_with_gaps(3 * SECOND)


def granted(budget: Budget, wishes: Sequence[Wish]) -> list[Wish]:
    """What the budget admits, whatever it is worth."""
    sent = []
    for wish in wishes:
        if budget.admits(*wish):
            budget.spend(wish.at_ns, wish.size)
            sent.append(wish)
    return sent


def most_within(window_s: float, sent: Sequence[Wish], amount: Callable[[Wish], float]) -> float:
    """The most in any window; what is as far apart as it is long does not share it."""
    window_ns = round(window_s * 1e9)
    return max(
        (
            sum(amount(w) for w in sent if first.at_ns <= w.at_ns < first.at_ns + window_ns)
            for first in sent
        ),
        default=0.0,
    )


def size_of(wish: Wish) -> float:
    return float(wish.size)


def one(_: Wish) -> float:
    return 1.0


# Never more -------------------------------------------------------------------------------------


@examples(100)
@given(st.floats(1.0, 1000.0), SHARES, WISHES)
def test_no_window_holds_more_bytes_than_allowed(
    bytes_per_s: float, share: float, wishes: list[Wish]
) -> None:
    budget = Budget(BudgetSettings(bytes_per_s=bytes_per_s, urgent_share=share), 0)
    sent = granted(budget, wishes)
    _, window_s = bytes_window(bytes_per_s)
    assert most_within(window_s, sent, size_of) <= window_s * bytes_per_s + 1e-6


def test_of_several_limits_the_tightest_makes_the_interval() -> None:
    """Its factor falls by e in the time in which 20 messages are earned: here 20 minutes."""
    limits = BudgetSettings(bytes_per_s=1000.0, messages_per_minute=1.0, urgent_share=0.0)
    budget = Budget(limits, 0)
    assert budget.own_interval_s(2) == 180.0
    budget.spend(0, FIX)
    budget.spend(0, FIX)
    at_once, later = budget.interval_s(0, 2), budget.interval_s(10 * SECOND, 2)
    assert later == pytest.approx(at_once * math.exp(-10.0 / 1200.0))


@pytest.mark.parametrize(
    ("bytes_per_s", "most", "window_s"),
    [
        *((1.0, 500.0, 500.0), (2.0, 500.0, 250.0), (5.0, 500.0, 100.0)),
        *((20.0, 500.0, 25.0), (50.0, 500.0, 10.0), (200.0, 2000.0, 10.0)),
    ],
)
def test_a_small_budget_has_a_longer_window(
    bytes_per_s: float, most: float, window_s: float
) -> None:
    assert bytes_window(bytes_per_s) == pytest.approx((most, window_s))


@examples(100)
@given(st.floats(50.0, 1000.0), WISHES)
def test_from_50_bytes_a_second_on_the_window_is_10_s(
    bytes_per_s: float, wishes: list[Wish]
) -> None:
    sent = granted(Budget(BudgetSettings(bytes_per_s=bytes_per_s), 0), wishes)
    assert most_within(10.0, sent, size_of) <= 10.0 * bytes_per_s + 1e-6


@examples(100)
@given(st.floats(0.1, 60.0), SHARES, wishes_with_gaps(20 * SECOND))
def test_no_window_holds_more_messages_than_allowed(
    per_minute: float, share: float, wishes: list[Wish]
) -> None:
    budget = Budget(BudgetSettings(messages_per_minute=per_minute, urgent_share=share), 0)
    sent = granted(budget, wishes)
    most = math.ceil(per_minute)
    assert most_within(60.0 * most / per_minute, sent, one) <= most


@examples(100)
@given(st.integers(1, 60), wishes_with_gaps(20 * SECOND))
def test_no_minute_holds_more_messages_than_a_whole_number(
    per_minute: int, wishes: list[Wish]
) -> None:
    sent = granted(Budget(BudgetSettings(messages_per_minute=per_minute), 0), wishes)
    assert most_within(60.0, sent, one) <= per_minute


def test_of_two_and_a_half_messages_a_minute_three_come_in_72_s() -> None:
    budget = Budget(BudgetSettings(messages_per_minute=2.5, urgent_share=0.0), 0)
    wishes = [Wish(n * 100 * MS, FIX) for n in range(1500)]
    stamps = [wish.at_ns // SECOND for wish in granted(budget, wishes)]
    assert stamps == [0, 0, 0, 72, 72, 72, 144, 144, 144]


@examples(100)
@given(st.floats(0.001, 5.0), SHARES, WISHES, st.lists(st.integers(0, 200), max_size=3))
def test_a_match_never_costs_more_than_was_earned_whatever_was_restarted(
    rate_hz: float, share: float, wishes: list[Wish], restarts_s: list[int]
) -> None:
    settings, sent = BudgetSettings(urgent_share=share), list[Wish]()
    begins = [0, *sorted(s * SECOND for s in restarts_s)]
    for begin, end in zip(begins, [*begins[1:], HOUR], strict=True):
        budget = Budget(settings, begin, rate_hz, restarted=begin > 0)
        sent += granted(budget, [w for w in wishes if begin <= w.at_ns < end])
    for number, wish in enumerate(sent, start=1):
        assert number <= rate_hz * wish.at_ns * 1e-9 + 1e-6


@examples(100)
@given(st.floats(50.0, 500.0), st.integers(1, 30), WISHES, st.integers(0, 100 * SECOND))
def test_no_window_holds_more_after_a_restart_either(
    bytes_per_s: float, per_minute: int, wishes: list[Wish], restart_ns: int
) -> None:
    settings = BudgetSettings(bytes_per_s=bytes_per_s, messages_per_minute=per_minute)
    before = [w for w in wishes if w.at_ns <= restart_ns]
    sent = granted(Budget(settings, 0), before)
    sent += granted(Budget(settings, restart_ns, restarted=True), wishes[len(before) :])
    assert most_within(10.0, sent, size_of) <= 10.0 * bytes_per_s + 1e-6
    assert most_within(60.0, sent, one) <= per_minute


def test_after_a_restart_there_is_something_to_spend_again_one_window_later() -> None:
    budget = Budget(BudgetSettings(bytes_per_s=100.0), 5 * SECOND, restarted=True)
    assert not budget.admits(15 * SECOND - 1, 1, urgent=True)
    assert budget.admits(15 * SECOND, 1000, urgent=True)


def test_what_is_larger_than_all_there_is_is_never_sent() -> None:
    budget = Budget(BudgetSettings(bytes_per_s=10.0), 0)
    assert budget.admits(0, 500, urgent=True)
    assert not budget.admits(0, 501, urgent=True)


def test_what_is_taken_back_can_be_spent_again() -> None:
    settings = BudgetSettings(bytes_per_s=50.0, messages_per_minute=3.0, urgent_share=0.0)
    budget = Budget(settings, 0, match_rate_hz=1.0)
    for _ in range(10):
        budget.spend(5 * SECOND, FIX)
        budget.refund(5 * SECOND, FIX)
    assert budget.interval_s(5 * SECOND, 1) == budget.own_interval_s(1)
    assert len(granted(budget, [Wish(5 * SECOND, FIX)] * 5)) == 3


# The reserve ------------------------------------------------------------------------------------


@examples(100)
@given(SHARES, WISHES)
def test_the_reserve_is_there_for_what_is_urgent_and_only_for_that(
    share: float, wishes: list[Wish]
) -> None:
    """Of 10 s with 1,000 bytes."""
    budget = Budget(BudgetSettings(bytes_per_s=100.0, urgent_share=share), 0)
    sent: list[Wish] = []
    for wish in wishes:
        inside = sum(w.size for w in sent if w.at_ns > wish.at_ns - 10 * SECOND)
        room = 1000.0 - inside - (0.0 if wish.urgent else share * 1000.0)
        assert budget.admits(*wish) is (wish.size <= room + 1e-9)
        sent += granted(budget, [wish])


def test_the_reserve_of_messages_is_whole_messages() -> None:
    budget = Budget(BudgetSettings(messages_per_minute=9.0, urgent_share=0.3), 0)
    assert len(granted(budget, [Wish(0, FIX)] * 20)) == 7
    assert len(granted(budget, [Wish(0, FIX, urgent=True)] * 20)) == 2


def test_the_reserve_of_a_match_is_a_share_of_what_was_earned() -> None:
    budget = Budget(BudgetSettings(urgent_share=0.2), 0, match_rate_hz=1.0)
    assert len(granted(budget, [Wish(100 * SECOND, FIX)] * 200)) == 80
    assert len(granted(budget, [Wish(100 * SECOND, FIX, urgent=True)] * 200)) == 20


@pytest.mark.parametrize("first_s", [300, 1200, 36_000])
def test_a_match_has_no_more_messages_however_early_the_robot_is_switched_on(first_s: int) -> None:
    """A quarter of 1,200 in 1,200 s is 300: one in 4 s."""
    budget = Budget(BudgetSettings(urgent_share=0.0), 0, 300 / 1200, match_s=1200.0)
    early = granted(budget, [Wish(first_s * SECOND, FIX)] * 1000)
    assert len(early) == min(first_s, 1200) / 4
    late = granted(budget, [Wish(100 * HOUR, FIX, urgent=True)] * 1000)
    assert len(early) + len(late) == 300
    (spending,) = budget.spending(100 * HOUR)
    assert (spending.most, spending.allowed) == (300.0, 300.0)


# The interval -----------------------------------------------------------------------------------

LIMITED = [
    Budget(BudgetSettings(bytes_per_s=100.0), 0),
    Budget(BudgetSettings(messages_per_minute=10.0), 0),
    Budget(BudgetSettings(), 0, match_rate_hz=0.5),
]


def test_the_own_interval_earns_a_fix_for_each_teammate_and_a_belief_beside_the_reserve() -> None:
    """At 2 B/s of which a fifth is reserved; at too little; at 5 a minute; without a limit."""
    by_bytes = Budget(BudgetSettings(bytes_per_s=2.0, urgent_share=0.2), 0)
    assert by_bytes.own_interval_s(4) == pytest.approx((4 * FIX + BELIEF) / 1.6)
    tiny = Budget(BudgetSettings(bytes_per_s=0.5, urgent_share=0.2), 0)
    assert tiny.own_interval_s(4) == LONGEST_INTERVAL_S
    by_number = Budget(BudgetSettings(messages_per_minute=5.0, urgent_share=0.0), 0)
    assert by_number.own_interval_s(2) == pytest.approx(36.0)
    assert Budget(BudgetSettings(), 0).own_interval_s(4) == 0.0


@pytest.mark.parametrize("budget", LIMITED, ids=["bytes", "messages", "match"])
def test_the_interval_rises_with_each_message_and_falls_to_the_own_one_while_nothing_is_sent(
    budget: Budget,
) -> None:
    own_s = budget.own_interval_s(3)
    intervals = [budget.interval_s(0, 3)]
    assert intervals == [own_s]
    for _ in range(40):
        budget.spend(0, FIX)
        intervals.append(budget.interval_s(0, 3))
    assert intervals == sorted(intervals)
    assert intervals[-1] == pytest.approx(math.exp(2.0) * own_s)
    later = [budget.interval_s(10 * SECOND * n, 3) for n in range(600)]
    assert later == sorted(later, reverse=True)
    assert later[0] == intervals[-1]
    assert later[-1] == own_s


def test_the_interval_stays_where_as_much_is_sent_as_is_not_reserved() -> None:
    """Four fifths of 42 B/s are four fixes in 5 s."""
    budget = Budget(BudgetSettings(bytes_per_s=42.0), 0)
    for _ in range(10):
        budget.spend(0, FIX)
    at_first = budget.interval_s(0, 1)
    for n in range(1, 400):
        budget.spend(n * 1250 * MS, FIX)
    assert budget.interval_s(400 * 1250 * MS, 1) == pytest.approx(at_first, rel=0.1)


def test_the_interval_does_not_fall_while_only_the_limits_hold_back_messages() -> None:
    budget = Budget(BudgetSettings(messages_per_minute=4.0, urgent_share=0.0), 0)
    assert len(granted(budget, [Wish(0, FIX)] * 5)) == 4
    interval_s = budget.interval_s(0, 1)
    for second in range(1, 30):
        assert not budget.admits(second * SECOND, FIX, urgent=False)
        budget.refuse(second * SECOND)
    assert budget.interval_s(29 * SECOND, 1) == interval_s
    assert budget.interval_s(59 * SECOND, 1) < interval_s


@examples(100)
@given(WISHES)
def test_without_limits_all_is_admitted_and_always_due(wishes: list[Wish]) -> None:
    budget = Budget(BudgetSettings(), 0)
    for wish in wishes:
        assert budget.interval_s(wish.at_ns, 3) == 0.0
        assert budget.admits(*wish)
        budget.spend(wish.at_ns, wish.size)
    assert budget.spending(HOUR) == ()


def ages_sent(budget: Budget, ages_s: Sequence[float], *, when_due: bool) -> list[float]:
    """Of fixes of these effective ages, offered at 5 Hz, those that are sent."""
    sent = []
    for n, age_s in enumerate(ages_s, start=1):
        now_ns = n * 200 * MS
        if when_due and age_s < budget.interval_s(now_ns, 1):
            continue
        if budget.admits(now_ns, FIX, urgent=False):
            budget.spend(now_ns, FIX)
            sent.append(age_s)
        else:
            budget.refuse(now_ns)
    return sent


MATCH_HZ = 0.25
TEN_MINUTES_OF = [
    pytest.param(BudgetSettings(bytes_per_s=50.0, urgent_share=0.0), None, 600 * 50 / FIX),
    pytest.param(BudgetSettings(messages_per_minute=10.0, urgent_share=0.0), None, 100),
    pytest.param(BudgetSettings(urgent_share=0.0), MATCH_HZ, 600 * MATCH_HZ),
]


@pytest.mark.parametrize(("settings", "match_hz", "whole"), TEN_MINUTES_OF)
@pytest.mark.parametrize("seed", range(3))
def test_the_interval_spends_the_budget_on_what_waited_longest(
    seed: int, settings: BudgetSettings, match_hz: float | None, whole: float
) -> None:
    own_s = Budget(settings, 0, match_hz).own_interval_s(1)
    ages_s = (own_s * np.random.default_rng(seed).exponential(1.0, 3000)).tolist()
    due, first_come = (
        ages_sent(Budget(settings, 0, match_hz), ages_s, when_due=when_due)
        for when_due in (True, False)
    )
    assert 0.6 * whole < len(due) <= 1.1 * whole
    assert np.mean(due) > 2.0 * np.mean(first_come)
    assert sum(due) > 1.5 * sum(first_come)


# What is reported -------------------------------------------------------------------------------


@examples(100)
@given(st.floats(1.0, 1000.0), st.floats(0.1, 60.0), st.floats(0.001, 5.0), WISHES)
def test_spending_contains_the_largest_use_of_each_limit(
    bytes_per_s: float, per_minute: float, match_hz: float, wishes: list[Wish]
) -> None:
    budget = Budget(
        BudgetSettings(bytes_per_s=bytes_per_s, messages_per_minute=per_minute), 0, match_hz
    )
    sent = granted(budget, wishes)
    in_bytes, in_messages, in_match = budget.spending(HOUR)
    allowed, window_s = bytes_window(bytes_per_s)
    spent = most_within(window_s, sent, size_of)
    assert in_bytes == Spending("bytes", in_bytes.window_s, allowed, spent)
    assert in_bytes.window_s == pytest.approx(window_s)
    most = math.ceil(per_minute)
    window_s = 60.0 * most / per_minute
    assert in_messages == Spending("messages", window_s, most, most_within(window_s, sent, one))
    assert (in_match.unit, in_match.window_s, in_match.most) == ("messages", 0.0, len(sent))
    assert in_match.allowed == pytest.approx(3600.0 * match_hz)
