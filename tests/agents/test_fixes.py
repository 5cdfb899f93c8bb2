"""Which fixes a robot sends, and what its budget pays for."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.buses import MS, SECOND, examples
from support.collaboration import GOOD, MATES, POOR, POORER, SIGMA_M, Alone, ahead, robots

from cpcbl_agents.agent import BeliefSubscribers, Presence
from cpcbl_team.config import (
    BudgetSettings,
    CollaborationSettings,
)
from cpcbl_team.inputs import Sighting
from cpcbl_team.tiers import LOWEST_TIER, next_tier
from cpcbl_transport.messages import Flow


def turned(
    name: str = "mate", range_m: float = 2.0, heading_rad: float = 0.5, sigma_rad: float = 0.05
) -> Sighting:
    """A teammate ahead whose heading is seen, too."""
    seen = ahead(name, range_m)
    return replace(seen, heading_rad=heading_rad, heading_sigma_rad=sigma_rad)


@pytest.mark.parametrize("tier", range(LOWEST_TIER + 1))
def test_a_robot_sends_fixes_to_worse_teammates_only(tier: int) -> None:
    alone = Alone(POOR, least_value=0.0)
    alone.tell(Presence("mate", tier))
    assert robots(alone.sees(ahead())) == (["mate"] if tier > POOR else [])


@pytest.mark.parametrize("tier", range(LOWEST_TIER + 1))
def test_both_ways_a_robot_helps_all(tier: int) -> None:
    alone = Alone(POOR, least_value=0.0, direction="both-ways")
    alone.tell(Presence("mate", tier))
    assert robots(alone.sees(ahead())) == ["mate"]


def test_a_teammate_of_which_the_bus_knows_nothing_is_not_helped() -> None:
    alone = Alone()
    assert alone.sees(ahead()) == []
    alone.tell(Presence("mate", POOR))
    assert len(alone.sees(ahead())) == 1
    alone.tell(Presence("mate", None))
    assert alone.sees(ahead(), after_ns=10 * SECOND) == []
    assert alone.agent.counters.flows() == (Flow("fix", "mate", 1, 42, latest_ns=2),)


@pytest.mark.parametrize(("wait_s", "is_sent"), [(0.3, True), (1.3, True), (2.0, False)])
def test_a_fix_waits_for_the_tier_of_its_robot(wait_s: float, is_sent: bool) -> None:
    """At a rare meeting there is no second sighting."""
    alone = Alone()
    assert alone.sees(ahead()) == []
    alone.later(wait_s)
    assert alone.early == []
    alone.tell(Presence("mate", POOR))
    alone.later(0.1)
    assert robots(alone.early) == (["mate"] if is_sent else [])
    alone.later(3.0)
    assert len(alone.early) == is_sent


def test_a_fix_waits_for_its_subscriber() -> None:
    alone = Alone()
    alone.tell(Presence("mate", POOR))
    alone.heard = False
    (fix,) = alone.sees(ahead())
    alone.later(0.2)
    alone.early.clear()
    alone.heard = True
    alone.later(1.0)
    assert alone.early == [fix]


def test_a_newer_fix_takes_the_place_of_one_that_waits() -> None:
    alone = Alone()
    alone.sees(ahead(range_m=2.0))
    alone.sees(ahead(range_m=3.0), after_ns=SECOND // 10)
    alone.tell(Presence("mate", POOR))
    (fix,) = alone.sees(ahead(range_m=4.0), after_ns=SECOND // 10)
    alone.later(1.0)
    assert fix.x_m == pytest.approx(4.0, abs=0.005)
    assert alone.early == []


def test_the_sigma_of_a_range_does_not_follow_its_own_error() -> None:
    """A short reading would count for more than a long one, and pull the teammate nearer."""
    alone = Alone(least_value=0.0, fix_interval_s=0.0)
    alone.tell(Presence("mate", POORER))
    alone.sees(ahead(range_m=4.0))
    short, long = (alone.sees(ahead(range_m=r))[0].sensor_covariance[0] for r in (3.5, 4.5))
    assert long == pytest.approx(short, rel=0.01)
    late = alone.sees(ahead(range_m=4.5), after_ns=2 * SECOND)[0].sensor_covariance[0]
    assert late == pytest.approx((4.5 / 4.0) ** 2 * long, rel=0.01)


def test_the_fix_with_the_largest_gain_comes_first() -> None:
    for names in (("mate", "other"), ("other", "mate")):
        alone = Alone()
        alone.tell(Presence("mate", POOR), Presence("other", POORER))
        assert robots(alone.sees(*map(ahead, names))) == ["other", "mate"]


def test_a_budget_for_one_message_goes_to_the_fix_with_the_largest_gain() -> None:
    alone = Alone(budget=BudgetSettings(messages_per_minute=1.0, urgent_share=0.0))
    alone.tell(Presence("mate", POORER), Presence("other", LOWEST_TIER - 1))
    frame = ahead("mate"), ahead("other")
    assert robots(alone.sees(*frame, after_ns=200 * SECOND)) == ["other"]
    assert [alone.tally("fix", name).over_budget for name in ("mate", "other")] == [1, 0]
    assert [alone.tally("fix", name).messages for name in ("mate", "other")] == [0, 1]


def test_a_budget_for_one_message_goes_to_the_teammate_that_was_not_helped_for_longer() -> None:
    alone = Alone(budget=BudgetSettings(messages_per_minute=1.0, urgent_share=0.0))
    alone.tell(Presence("mate", LOWEST_TIER - 1), Presence("other", LOWEST_TIER - 1))
    frame = ahead("mate"), ahead("other")
    first, second, third = (robots(alone.sees(*frame, after_ns=200 * SECOND)) for _ in range(3))
    assert sorted(first + second) == ["mate", "other"]
    assert third == first


def test_with_a_tight_budget_the_first_fix_waits_longer() -> None:
    """Its teammate counts as last helped a minute ago; two messages take four minutes."""
    sent = []
    for per_minute in (0.0, 4000.0, 0.5):
        alone = Alone(budget=BudgetSettings(messages_per_minute=per_minute, urgent_share=0.0))
        alone.tell(Presence("mate", GOOD + 4))
        sent.append(len(alone.sees(ahead(range_m=1.2))))
    assert sent == [1, 1, 0]
    assert alone.tally("fix", "mate").over_budget == 1


def test_what_a_late_frame_costs_is_of_the_time_at_which_it_is_sent() -> None:
    alone = Alone(budget=BudgetSettings(messages_per_minute=1.0, urgent_share=0.0))
    alone.tell(Presence("mate", LOWEST_TIER))
    assert len(alone.sees(ahead(), after_ns=2 * SECOND, late_ns=SECOND)) == 1
    assert alone.sees(ahead(), after_ns=60 * SECOND - 1) == []
    assert len(alone.sees(ahead())) == 1


def test_a_fix_without_a_subscriber_costs_nothing_and_is_offered_again() -> None:
    alone = Alone(
        budget=BudgetSettings(messages_per_minute=30.0, urgent_share=0.0),
        fix_interval_s=60.0,
        belief_silence_s=60.0,
    )
    alone.tell(Presence("mate", POORER), BeliefSubscribers(present=True))
    alone.heard = False
    alone.later(0.1)
    for _ in range(20):
        assert len(alone.sees(ahead())) == len(alone.later(0.1)) == 1
    assert alone.agent.counters.flows() == ()
    alone.heard = True
    assert len(alone.sees(ahead())) == len(alone.later(0.2)) == 1
    assert (alone.sees(ahead()), alone.later(0.2)) == ([], [])


def test_a_fix_of_a_close_teammate_has_a_larger_gain() -> None:
    alone = Alone()
    alone.tell(Presence("mate", POOR), Presence("other", POOR))
    assert robots(alone.sees(ahead("mate", 4.0), ahead("other", 1.2))) == ["other", "mate"]


def test_a_lost_teammate_comes_first_whatever_the_gain() -> None:
    """Far away, its fix is worth less than that of a teammate close by."""
    for names in (("mate", "other"), ("other", "mate")):
        alone = Alone(tier_width=1.5)
        alone.tell(Presence("mate", LOWEST_TIER), Presence("other", LOWEST_TIER - 1))
        ranges = {"mate": 40.0, "other": 0.5}
        fixes = alone.sees(*(ahead(name, ranges[name]) for name in names))
        assert robots(fixes) == ["mate", "other"]
        sure = [fix.sensor_covariance[0] for fix in fixes]
        assert sure[0] > 1000.0 * sure[1]


def test_a_lost_teammate_gets_a_fix_that_is_not_due() -> None:
    """Far away, right after the interval has risen."""
    alone = Alone(budget=BudgetSettings(bytes_per_s=1000.0))
    alone.tell(Presence("mate", LOWEST_TIER), Presence("other", LOWEST_TIER - 1))
    for _ in range(150):
        alone.agent.budget.spend(alone.now_ns, 42)
    assert alone.agent.budget.admits(alone.now_ns, 42, urgent=False)
    assert alone.sees(ahead("other", 1.0)) == []
    assert robots(alone.sees(ahead("mate", 60.0))) == ["mate"]


def test_the_reserve_is_for_lost_teammates() -> None:
    alone = Alone(budget=BudgetSettings(messages_per_minute=2.0, urgent_share=0.5))
    others = (Presence(name, LOWEST_TIER - 1) for name in ("other", "third"))
    alone.tell(Presence("mate", LOWEST_TIER), *others)
    assert len(alone.sees(ahead("other"), after_ns=100 * SECOND)) == 1
    assert alone.sees(ahead("third")) == []
    assert len(alone.sees(ahead("mate"))) == 1


def test_a_fix_with_too_little_gain_is_not_sent_but_counted() -> None:
    """A teammate hardly worse off, far away."""
    alone = Alone()
    alone.tell(Presence("mate", GOOD + 1))
    assert alone.sees(ahead(range_m=7.0)) == []
    assert alone.agent.counters.flows() == (Flow("fix", "mate", worthless=1),)


def test_a_fix_that_is_not_due_is_counted_as_beyond_the_budget() -> None:
    alone = Alone(budget=BudgetSettings(bytes_per_s=100.0))
    alone.tell(*(Presence(name, POORER) for name in MATES))
    while alone.sees(*map(ahead, sorted(MATES)), after_ns=20 * MS):
        pass
    spent = sum(alone.tally("fix", name).messages for name in MATES)
    assert 0 < spent * 42 < 800
    assert sum(alone.tally("fix", name).over_budget for name in MATES) > 0


def test_a_teammate_that_was_just_helped_waits_for_the_interval() -> None:
    """Though it still announces a bad tier, and the budget would allow four fixes a minute."""
    alone = Alone(budget=BudgetSettings(messages_per_minute=4.0, urgent_share=0.0))
    alone.tell(Presence("mate", POORER), Presence("other", GOOD + 2))
    sent = [n for n in range(150) if alone.sees(ahead(), after_ns=SECOND)]
    assert 2 <= len(sent) <= 6
    assert min(b - a for a, b in pairwise(sent)) > 10
    assert alone.sees(ahead("other", 0.2)) == []


@pytest.mark.parametrize("tier", [GOOD + 5, POORER])
def test_fixes_come_at_the_interval_of_the_budget_however_large_the_errors_are(tier: int) -> None:
    """A fix and a belief are earned in 28.75 s."""
    alone = Alone(budget=BudgetSettings(bytes_per_s=4.0))
    alone.tell(Presence("mate", tier))
    sent = [n for n in range(300) if alone.sees(ahead(range_m=0.3), after_ns=SECOND)]
    assert sent[0] == 0
    assert all(28 < b - a < 40 for a, b in pairwise(sent))


def test_a_teammate_whose_error_grows_faster_is_helped_more_often() -> None:
    alone = Alone(budget=BudgetSettings(bytes_per_s=4.0))
    alone.tell(Presence("mate", POOR), Presence("other", POORER))
    frame, sent = [ahead("mate", 1.0), ahead("other", 1.0)], list[str]()
    for _ in range(600):
        sent += robots(alone.sees(*frame, after_ns=SECOND))
    assert sent.count("other") > 1.5 * sent.count("mate") > 1.5


def helped(alone: Alone, frames: int, range_m: float = 2.0) -> list[int]:
    """The frames with a fix for a mate that knows what they tell it, and announces its tier."""
    sigma_m, sent = SIGMA_M[POORER], []
    for frame in range(frames):
        alone.tell(Presence("mate", next_tier(None, sigma_m, False, CollaborationSettings())))
        for fix in alone.sees(ahead(range_m=range_m), after_ns=100 * MS):
            told = sum(fix.sensor_covariance[::2] + fix.observer_covariance[::2]) / 2.0
            sigma_m = math.hypot(SIGMA_M[GOOD], (sigma_m**-2 + 1.0 / told) ** -0.5)
            sent.append(frame)
    return sent


def test_repeated_fixes_for_a_teammate_have_no_gain_until_it_has_moved() -> None:
    alone = Alone()
    sent = helped(alone, 50)
    assert sent == list(range(len(sent)))
    assert len(sent) < 10
    assert alone.tally("fix", "mate").worthless == 50 - len(sent)
    alone.tell(Presence("mate", POOR))
    assert len(alone.sees(ahead(range_m=4.0), after_ns=100 * MS)) == 1


def test_a_teammate_that_stays_poorly_localized_gets_another_fix() -> None:
    """It may not have heard, or not have believed."""
    alone = Alone()
    alone.tell(Presence("mate", POORER))
    assert all(len(alone.sees(ahead(), after_ns=100 * MS)) == 1 for _ in range(3))


def test_within_a_tier_motion_increases_the_gain_of_a_fix() -> None:
    """After a short and a long way at the same distance, at a least value between the two."""
    sent = []
    for bearing_rad in (0.02, 1.5):
        alone = Alone(least_value=0.25)
        alone.tell(Presence("mate", 6))
        assert len(alone.sees(ahead())) == 1
        sent.append(len(alone.sees(Sighting("mate", 2.0, bearing_rad), after_ns=SECOND)))
    assert sent == [0, 1]


def test_a_heading_is_sent_with_the_fix_and_charged() -> None:
    alone = Alone(budget=BudgetSettings(bytes_per_s=100.0))
    alone.tell(Presence("mate", POORER))
    (fix,) = alone.sees(turned())
    assert fix.heading_rad == pytest.approx(0.5)
    assert fix.heading_observer_variance == pytest.approx(0.02**2)
    (spending,) = alone.agent.budget.spending(alone.now_ns)
    assert spending.most == alone.tally("fix", "mate").bytes == 49


def test_a_heading_without_a_subscriber_costs_nothing() -> None:
    alone = Alone(budget=BudgetSettings(bytes_per_s=50.0, urgent_share=0.0))
    alone.tell(Presence("mate", POORER))
    alone.heard = False
    for _ in range(50):
        (fix,) = alone.sees(turned())
        assert fix.heading_rad is not None
    assert alone.agent.budget.admits(alone.now_ns, 500, urgent=False)


def test_a_teammate_with_a_known_position_gets_headings_while_they_have_a_gain() -> None:
    """Far away, its position alone would be worth too little; the same again is, too."""
    alone = Alone()
    alone.tell(Presence("mate", GOOD + 1))
    assert alone.sees(ahead(range_m=7.0)) == []
    fixes = [fix for _ in range(20) for fix in alone.sees(turned(range_m=7.0))]
    assert 0 < len(fixes) < 8
    assert all(fix.heading_rad is not None for fix in fixes)
    assert alone.tally("fix", "mate").worthless == 1 + 20 - len(fixes)


def test_a_heading_without_gain_is_left_out_of_a_fix_with_gain() -> None:
    """Of a teammate that drives across; its heading is known by then to what this robot knows."""
    alone = Alone(tier_width=1.5)
    alone.tell(Presence("mate", POOR))
    told = [fix for _ in range(30) for fix in alone.sees(turned())]
    (later,) = alone.sees(
        Sighting("mate", 2.0, 0.4, heading_rad=0.5, heading_sigma_rad=1.0), after_ns=SECOND
    )
    assert told[0].heading_rad is not None
    assert later.heading_rad is None
    assert later.heading_sensor_variance == later.heading_observer_variance == 0.0


def test_a_lost_teammate_gets_its_heading_every_time() -> None:
    alone = Alone()
    alone.tell(Presence("mate", LOWEST_TIER))
    for _ in range(10):
        (fix,) = alone.sees(turned(), after_ns=100 * MS)
        assert fix.heading_rad is not None


def test_without_a_covariance_every_heading_is_sent() -> None:
    alone = Alone(variant="weighted")
    alone.tell(Presence("mate", POOR))
    fixes = [fix for _ in range(10) for fix in alone.sees(turned())]
    assert len(fixes) == 10
    assert all(fix.heading_rad is not None for fix in fixes)


def test_no_fixes_where_active_help_is_switched_off_or_has_not_begun() -> None:
    for rules, then in (({"active": False}, 0), ({"after_s": 2.0}, 1)):
        alone = Alone(**rules)
        alone.tell(Presence("mate", POORER))
        assert alone.sees(ahead()) == []
        alone.later(2.0)
        assert len(alone.sees(ahead())) == then


@examples(50)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(sorted(MATES)),
            st.integers(0, LOWEST_TIER),
            st.floats(0.3, 8.0),
            st.integers(1, 500).map(lambda n: n * MS),
            st.booleans(),
        ),
        max_size=60,
    ),
    st.floats(20.0, 200.0),
)
def test_every_offer_is_sent_or_counted_and_the_budget_holds(
    seen: list[tuple[str, int, float, int, bool]], bytes_per_s: float
) -> None:
    """Of fixes with a heading, too, by what each takes."""
    alone = Alone(budget=BudgetSettings(bytes_per_s=bytes_per_s))
    offers, sent = 0, [(0, 0)]
    for name, tier, range_m, after_ns, headed in seen:
        alone.tell(Presence(name, tier))
        sight = (turned if headed else ahead)(name, range_m)
        fixes = alone.sees(sight, after_ns=after_ns)
        sent += [(alone.now_ns, 42 if fix.heading_rad is None else 49) for fix in fixes]
        offers += tier > alone.agent.tier
    flows = alone.agent.counters.flows()
    assert sum(f.messages + f.worthless + f.over_budget for f in flows) == offers
    (spending,) = alone.agent.budget.spending(alone.now_ns)
    assert spending.most <= spending.allowed
    window_ns = round(spending.allowed / bytes_per_s * SECOND)
    for end_ns, _ in sent:
        within = [size for at_ns, size in sent if end_ns - window_ns < at_ns <= end_ns]
        assert sum(within) <= spending.allowed
    assert sum(size for _, size in sent) == sum(f.bytes for f in flows)
