"""The collaboration agent alone: whom it helps, when it speaks, whom it listens to."""

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.buses import MS, SECOND, examples
from support.core import diagonal

from cpcbl_agents.agent import BeliefSubscribers, FrameEstimate, HelpSent, PoseEstimate, Presence
from cpcbl_agents.collaboration import CollaborationAgent
from cpcbl_agents.counters import MessageCounter
from cpcbl_team.collaboration import LOWEST_TIER, next_tier
from cpcbl_team.config import (
    BudgetSettings,
    CollaborationSettings,
    LocalizationSettings,
    LocalizerSettings,
    SensorSettings,
    Variant,
)
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Belief, Fix, Sighting, Sightings
from cpcbl_transport.budget import Budget
from cpcbl_transport.compact import help_bytes
from cpcbl_transport.link_size import sent_bytes
from cpcbl_transport.messages import Flow, Track

GOOD, POOR, POORER = 2, 9, 12  # tiers
SIGMA_M = {GOOD: 0.019, POOR: 0.2, POORER: 0.6}
Help = TypeVar("Help", Belief, Fix)
MATES = frozenset({"mate", "other", "third"})
LOST = "no evidence"


class Alone:
    """The agent of a robot at the origin; time passes only where a test says so."""

    def __init__(
        self,
        tier: int = GOOD,
        *,
        sensor: SensorSettings | None = None,
        budget: BudgetSettings | None = None,
        variant: Variant = "joint",
        **rules: Any,
    ) -> None:
        budget = budget or BudgetSettings()
        settings = LocalizationSettings(
            localizer=LocalizerSettings(variant=variant),
            sensor=sensor or SensorSettings(),
            collaboration=CollaborationSettings(budget=budget, **rules),
        )
        self.agent = CollaborationAgent("me", settings, MATES, 0, Budget(budget, 0))
        self.now_ns = 0
        self.heard = True
        self.here = PoseEstimate(
            0, Estimate(Pose2(0.0, 0.0, 0.0), diagonal(SIGMA_M[tier], 0.02)), "", 0.0, 0.0
        )
        self.report_estimate()
        assert self.agent.tier == tier

    def tell(self, *presences: Presence | BeliefSubscribers) -> None:
        for presence in presences:
            assert self.agent.handle(presence, self.now_ns) == ()

    def becomes(self, **changes: Any) -> None:
        """So the robot will find itself from now on."""
        self.here = self.here._replace(**changes)

    def report_estimate(self) -> list[Belief]:
        """The agent learns where it is; its beliefs."""
        self.here = self.here._replace(stamp_ns=self.now_ns)
        track, *said = self.agent.handle(self.here, self.now_ns)
        assert isinstance(track, Track)
        assert track.tier == self.agent.tier
        return self._sent(said, Belief)

    def later(self, seconds: float) -> list[Belief]:
        """Time passes, the robot goes on as it said; its beliefs, at most ten a second."""
        said = []
        for _ in range(round(10 * seconds)):
            self.now_ns += 100 * MS
            x, y, heading = self.here.estimate.pose
            pose = Pose2(x + 0.1 * self.here.speed_m_s, y, heading)
            self.becomes(estimate=self.here.estimate._replace(pose=pose))
            said += self.report_estimate()
        return said

    def sees(self, *sightings: Sighting, after_ns: int = 1, late_ns: int = 0) -> list[Fix]:
        """A frame; its fixes."""
        self.now_ns += after_ns
        frame = Sightings(self.now_ns - late_ns, sightings)
        seen = FrameEstimate(frame, self.here.estimate, self.here.lost)
        return self._sent(self.agent.handle(seen, self.now_ns), Fix)

    def _sent(self, said: Sequence[object], kind: type[Help]) -> list[Help]:
        """They leave the robot."""
        messages = [m for m in said if isinstance(m, kind)]
        assert len(messages) == len(said)
        for message in messages:
            size = sent_bytes(help_bytes(message))
            self.agent.handle(HelpSent(message, size if self.heard else 0), self.now_ns)
        return messages

    def tally(self, topic: str, peer: str = "") -> MessageCounter:
        return self.agent.counters.of(topic, peer)


def ahead(name: str = "mate", range_m: float = 2.0) -> Sighting:
    return Sighting(name, range_m, 0.0)


def turned(
    name: str = "mate", range_m: float = 2.0, heading_rad: float = 0.5, sigma_rad: float = 0.05
) -> Sighting:
    """A teammate ahead whose heading is seen, too."""
    seen = ahead(name, range_m)
    return replace(seen, heading_rad=heading_rad, heading_sigma_rad=sigma_rad)


def robots(fixes: list[Fix]) -> list[str]:
    return [fix.robot for fix in fixes]


# Whom it helps ----------------------------------------------------------------------------------


@pytest.mark.parametrize("tier", range(LOWEST_TIER + 1))
def test_a_robot_helps_who_is_worse_and_nobody_else(tier: int) -> None:
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


def test_the_fix_that_is_worth_most_comes_first() -> None:
    for names in (("mate", "other"), ("other", "mate")):
        alone = Alone()
        alone.tell(Presence("mate", POOR), Presence("other", POORER))
        assert robots(alone.sees(*map(ahead, names))) == ["other", "mate"]


def test_a_budget_for_one_goes_to_the_fix_that_is_worth_most() -> None:
    alone = Alone(budget=BudgetSettings(messages_per_minute=1.0, urgent_share=0.0))
    alone.tell(Presence("mate", POOR), Presence("other", POORER))
    assert robots(alone.sees(ahead("mate"), ahead("other"))) == ["other"]
    assert [alone.tally("fix", name).over_budget for name in ("mate", "other")] == [1, 0]
    assert [alone.tally("fix", name).messages for name in ("mate", "other")] == [0, 1]


def test_what_a_late_frame_costs_is_of_the_time_at_which_it_is_sent() -> None:
    alone = Alone(budget=BudgetSettings(messages_per_minute=1.0, urgent_share=0.0))
    alone.tell(Presence("mate", POORER))
    assert len(alone.sees(ahead(), after_ns=2 * SECOND, late_ns=SECOND)) == 1
    assert alone.sees(ahead(), after_ns=60 * SECOND - 1) == []
    assert len(alone.sees(ahead())) == 1


def test_help_that_nobody_heard_costs_nothing_and_is_offered_again() -> None:
    alone = Alone(
        budget=BudgetSettings(messages_per_minute=2.0, urgent_share=0.0),
        fix_interval_s=60.0,
        belief_silence_s=60.0,
    )
    alone.tell(Presence("mate", POORER), BeliefSubscribers(present=True))
    alone.heard = False
    for _ in range(5):
        assert len(alone.sees(ahead())) == len(alone.later(0.2)) == 1
    assert alone.agent.counters.flows() == ()
    alone.heard = True
    assert len(alone.sees(ahead())) == len(alone.later(0.2)) == 1
    assert (alone.sees(ahead()), alone.later(0.2)) == ([], [])


def test_what_is_close_by_is_seen_better_and_worth_more() -> None:
    alone = Alone()
    alone.tell(Presence("mate", POOR), Presence("other", POOR))
    assert robots(alone.sees(ahead("mate", 4.0), ahead("other", 1.2))) == ["other", "mate"]


def test_who_is_lost_comes_first_whatever_it_is_worth() -> None:
    """Far away, its fix is worth less than that of a teammate close by."""
    for names in (("mate", "other"), ("other", "mate")):
        alone = Alone(tier_width=1.5)
        alone.tell(Presence("mate", LOWEST_TIER), Presence("other", LOWEST_TIER - 1))
        ranges = {"mate": 40.0, "other": 0.5}
        fixes = alone.sees(*(ahead(name, ranges[name]) for name in names))
        assert robots(fixes) == ["mate", "other"]
        sure = [fix.sensor_covariance[0] for fix in fixes]
        assert sure[0] > 1000.0 * sure[1]


def test_the_reserve_is_for_who_is_lost() -> None:
    alone = Alone(budget=BudgetSettings(messages_per_minute=2.0, urgent_share=0.5))
    alone.tell(Presence("mate", LOWEST_TIER), Presence("other", POOR), Presence("third", POOR))
    assert len(alone.sees(ahead("other"))) == 1
    assert alone.sees(ahead("third")) == []
    assert len(alone.sees(ahead("mate"))) == 1


def test_what_is_worth_too_little_is_not_sent_and_counted() -> None:
    """A teammate hardly worse off, far away."""
    alone = Alone()
    alone.tell(Presence("mate", GOOD + 1))
    assert alone.sees(ahead(range_m=7.0)) == []
    assert alone.agent.counters.flows() == (Flow("fix", "mate", worthless=1),)


def test_a_message_that_is_not_worth_its_price_is_counted_as_beyond_the_budget() -> None:
    alone = Alone(budget=BudgetSettings(bytes_per_s=100.0))
    alone.tell(*(Presence(name, POORER) for name in MATES))
    while alone.sees(*map(ahead, sorted(MATES)), after_ns=20 * MS):
        pass
    spent = sum(alone.tally("fix", name).messages for name in MATES)
    assert 0 < spent * 42 < 800
    assert sum(alone.tally("fix", name).over_budget for name in MATES) > 0


def test_a_budget_just_free_again_does_not_go_to_what_is_worth_little() -> None:
    weak = Presence("other", GOOD + 2)
    at_first = Alone(budget=BudgetSettings(messages_per_minute=4.0, urgent_share=0.0))
    at_first.tell(weak)
    assert robots(at_first.sees(ahead("other", 1.2))) == ["other"]
    alone = Alone(budget=BudgetSettings(messages_per_minute=4.0, urgent_share=0.0))
    alone.tell(Presence("mate", POORER), weak)
    sent = [bool(alone.sees(ahead(), after_ns=SECOND)) for _ in range(60)]
    assert sent == [True] * 4 + [False] * 56
    assert alone.sees(ahead("other", 1.2), after_ns=SECOND) == []
    assert len(alone.sees(ahead())) == 1


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


def test_fixes_for_a_teammate_soon_are_worth_nothing_until_it_has_driven_away() -> None:
    alone = Alone()
    sent = helped(alone, 50)
    assert sent == list(range(len(sent)))
    assert len(sent) < 10
    assert alone.tally("fix", "mate").worthless == 50 - len(sent)
    alone.tell(Presence("mate", POOR))
    assert len(alone.sees(ahead(range_m=4.0), after_ns=100 * MS)) == 1


def test_a_teammate_that_stays_bad_is_told_again() -> None:
    """It may not have heard, or not have believed."""
    alone = Alone()
    alone.tell(Presence("mate", POORER))
    assert all(len(alone.sees(ahead(), after_ns=100 * MS)) == 1 for _ in range(3))


def test_within_its_tier_a_way_makes_a_fix_worth_more() -> None:
    """After a short and a long way at the same distance, at a least value between the two."""
    sent = []
    for bearing_rad in (0.02, 1.5):
        alone = Alone(least_value=0.25)
        alone.tell(Presence("mate", 6))
        assert len(alone.sees(ahead())) == 1
        sent.append(len(alone.sees(Sighting("mate", 2.0, bearing_rad), after_ns=SECOND)))
    assert sent == [0, 1]


# What it tells of headings ----------------------------------------------------------------------


def test_a_heading_is_told_with_the_fix_and_paid_for() -> None:
    alone = Alone(budget=BudgetSettings(bytes_per_s=100.0))
    alone.tell(Presence("mate", POORER))
    (fix,) = alone.sees(turned())
    assert fix.heading_rad == pytest.approx(0.5)
    assert fix.heading_observer_variance == pytest.approx(0.02**2)
    (spending,) = alone.agent.budget.spending(alone.now_ns)
    assert spending.most == alone.tally("fix", "mate").bytes == 49


def test_a_heading_that_nobody_heard_costs_nothing() -> None:
    alone = Alone(budget=BudgetSettings(bytes_per_s=50.0, urgent_share=0.0))
    alone.tell(Presence("mate", POORER))
    alone.heard = False
    for _ in range(50):
        (fix,) = alone.sees(turned())
        assert fix.heading_rad is not None
    assert alone.agent.budget.admits(alone.now_ns, 500, urgent=False)


def test_who_knows_its_place_is_told_its_heading_until_that_is_no_news() -> None:
    """Far away, its position alone would be worth too little; the same again is, too."""
    alone = Alone()
    alone.tell(Presence("mate", GOOD + 1))
    assert alone.sees(ahead(range_m=7.0)) == []
    fixes = [fix for _ in range(20) for fix in alone.sees(turned(range_m=7.0))]
    assert 0 < len(fixes) < 8
    assert all(fix.heading_rad is not None for fix in fixes)
    assert alone.tally("fix", "mate").worthless == 1 + 20 - len(fixes)


def test_a_heading_that_is_no_news_is_left_out_of_a_fix_that_is() -> None:
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


def test_who_is_lost_is_told_its_heading_every_time() -> None:
    alone = Alone()
    alone.tell(Presence("mate", LOWEST_TIER))
    for _ in range(10):
        (fix,) = alone.sees(turned(), after_ns=100 * MS)
        assert fix.heading_rad is not None


def test_without_a_covariance_every_heading_is_told() -> None:
    alone = Alone(variant="weighted")
    alone.tell(Presence("mate", POOR))
    fixes = [fix for _ in range(10) for fix in alone.sees(turned())]
    assert len(fixes) == 10
    assert all(fix.heading_rad is not None for fix in fixes)


# When and how much ------------------------------------------------------------------------------


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


# When it says what it believes --------------------------------------------------------------------


def stamps_s(beliefs: list[Belief]) -> list[float]:
    return [b.stamp_ns / SECOND for b in beliefs]


def test_without_a_listener_no_belief_is_said_or_thought_of() -> None:
    alone = Alone()
    assert alone.later(3.0) == []
    assert alone.agent.counters.flows() == ()


def test_a_new_listener_is_told_at_once() -> None:
    alone = Alone()
    alone.later(1.0)
    alone.tell(BeliefSubscribers(present=True))
    assert stamps_s(alone.later(0.5)) == [1.1]
    alone.tell(BeliefSubscribers(present=False))
    assert alone.later(0.2) == []
    alone.tell(BeliefSubscribers(present=True))
    assert stamps_s(alone.later(0.5)) == [1.8]


@pytest.mark.parametrize("silence_s", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("speed_m_s", [0.0, 0.5])
def test_while_the_listeners_copy_holds_there_is_silence_up_to_its_longest(
    silence_s: float, speed_m_s: float
) -> None:
    alone = Alone(belief_silence_s=silence_s)
    alone.tell(BeliefSubscribers(present=True))
    alone.becomes(speed_m_s=speed_m_s)
    stamps = stamps_s(alone.later(9.2))
    assert stamps == pytest.approx([0.2 + n * silence_s for n in range(len(stamps))])
    assert len(stamps) == int(9.0 / silence_s) + 1
    tally = alone.tally("belief")
    assert (tally.messages, tally.messages + tally.silent) == (len(stamps), 46)


def test_a_robot_that_has_stopped_says_so() -> None:
    alone = Alone()
    alone.tell(BeliefSubscribers(present=True))
    alone.becomes(speed_m_s=0.5)
    assert stamps_s(alone.later(0.2)) == [0.2]
    alone.becomes(speed_m_s=0.0)
    assert stamps_s(alone.later(0.4)) == [0.4]


@pytest.mark.parametrize(("factor", "stamps"), [(1.2, [1.2]), (1.3, [0.4]), (1.0 / 1.3, [0.4])])
def test_a_robot_whose_sigma_has_changed_enough_says_so(factor: float, stamps: list[float]) -> None:
    """Half a sigma is a factor of 1.28."""
    alone = Alone(POOR)
    alone.tell(BeliefSubscribers(present=True))
    assert stamps_s(alone.later(0.3)) == [0.2]
    covariance = diagonal(SIGMA_M[POOR] * factor, 0.02)
    alone.becomes(estimate=alone.here.estimate._replace(covariance=covariance))
    assert stamps_s(alone.later(1.0)) == stamps


def test_beliefs_that_are_always_news_keep_their_rate() -> None:
    alone = Alone(belief_share=0.0, belief_rate_hz=2.0)
    alone.tell(BeliefSubscribers(present=True))
    assert stamps_s(alone.later(3.0)) == [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]


def test_a_belief_beyond_the_budget_is_counted_and_said_as_soon_as_it_may_be() -> None:
    alone = Alone(
        budget=BudgetSettings(messages_per_minute=6.0, urgent_share=0.0), belief_share=0.0
    )
    alone.tell(BeliefSubscribers(present=True))
    alone.later(9.0)
    tally = alone.tally("belief")
    assert tally.messages == 6 or tally.over_budget > 0
    assert tally.messages + tally.over_budget == 45
    alone.tell(BeliefSubscribers(present=True))
    assert stamps_s(alone.later(52.0))[0] <= 60.2


def test_no_beliefs_where_passive_help_is_switched_off_or_has_not_begun() -> None:
    for rules, then in (({"passive": False}, []), ({"after_s": 2.0}, [2.0])):
        alone = Alone(**rules)
        alone.tell(BeliefSubscribers(present=True))
        assert stamps_s(alone.later(2.5)) == then


# Whom it listens to -------------------------------------------------------------------------------


def looking(tier: int = POORER, **settings: Any) -> Alone:
    """A robot that knows of three teammates, one of them as bad as itself, and sees none."""
    alone = Alone(tier, **settings)
    alone.tell(Presence("mate", GOOD), Presence("other", tier), Presence("third", LOWEST_TIER))
    return alone


def test_only_a_better_teammate_in_sight_is_a_source() -> None:
    alone = looking()
    alone.later(0.1)
    assert alone.agent.sources == frozenset()
    alone.sees(*map(ahead, sorted(MATES)))
    alone.later(0.1)
    assert alone.agent.sources == {("mate", GOOD)}
    assert alone.agent.neighbours == MATES


def test_a_source_is_followed_to_its_tier_and_dropped_when_it_is_worse_or_gone() -> None:
    alone = looking()
    for tier, source in ((POOR, {("mate", POOR)}), (LOWEST_TIER, set()), (None, set())):
        alone.tell(Presence("mate", tier))
        alone.sees(ahead())
        alone.later(0.1)
        assert alone.agent.sources == source


def test_a_source_out_of_sight_is_dropped_after_a_second() -> None:
    alone = looking()
    alone.sees(ahead(), after_ns=0)
    alone.later(0.9)
    assert alone.agent.sources == {("mate", GOOD)}
    alone.later(0.1)
    assert alone.agent.sources == frozenset()


def test_a_better_teammate_that_tells_too_little_is_no_source() -> None:
    vague = SensorSettings(range_share=0.3, bearing_sigma_deg=20.0)
    for sensor, sources in ((vague, set()), (SensorSettings(), {("mate", GOOD)})):
        alone = looking(POOR, sensor=sensor)
        alone.sees(ahead(range_m=7.0))
        alone.later(0.1)
        assert alone.agent.sources == sources


def test_who_knows_its_heading_badly_listens_to_whom_it_needs_for_that() -> None:
    alone = Alone(GOOD)
    alone.tell(Presence("mate", GOOD - 1))
    chosen = []
    for heading_sigma in (0.005, 1.0):
        covariance = diagonal(SIGMA_M[GOOD], heading_sigma)
        alone.becomes(estimate=alone.here.estimate._replace(covariance=covariance))
        alone.sees(ahead(range_m=6.0))
        alone.later(0.1)
        chosen.append(alone.agent.sources)
    assert chosen == [frozenset(), {("mate", GOOD - 1)}]


def test_a_robot_without_passive_help_has_no_sources() -> None:
    alone = looking(passive=False)
    alone.sees(ahead())
    alone.later(0.1)
    assert alone.agent.sources == frozenset()
    assert alone.agent.neighbours == {"mate"}


def test_a_neighbour_is_forgotten_after_ten_seconds() -> None:
    alone = looking()
    alone.sees(ahead(), after_ns=0)
    alone.later(9.9)
    assert alone.agent.neighbours == {"mate"}
    alone.later(0.1)
    assert alone.agent.neighbours == frozenset()


# Lost ---------------------------------------------------------------------------------------------


def test_a_robot_that_is_lost_says_nothing_and_listens_to_all_who_are_better() -> None:
    vague = SensorSettings(range_share=0.3, bearing_sigma_deg=20.0)
    alone = looking(GOOD, sensor=vague, least_value=0.0)
    alone.tell(
        Presence("mate", LOWEST_TIER - 1), Presence("other", POOR), BeliefSubscribers(present=True)
    )
    assert len(alone.later(0.2)) == 1
    alone.becomes(lost=LOST)
    assert alone.sees(*map(ahead, sorted(MATES))) == []
    assert alone.later(2.0) == []
    assert alone.agent.tier == LOWEST_TIER
    assert alone.sees(*map(ahead, sorted(MATES))) == []
    alone.sees(*map(ahead, sorted(MATES)))
    assert alone.later(0.1) == []
    assert alone.agent.sources == {("mate", LOWEST_TIER - 1), ("other", POOR)}


def test_a_robot_that_has_found_itself_helps_again() -> None:
    alone = looking(GOOD)
    alone.becomes(lost=LOST)
    alone.tell(BeliefSubscribers(present=True))
    assert (alone.later(1.0), alone.sees(ahead("third"))) == ([], [])
    alone.becomes(lost="")
    assert len(alone.later(0.1)) == 1
    assert alone.agent.tier == GOOD
    assert robots(alone.sees(ahead("third"))) == ["third"]


def test_an_older_report_changes_nothing() -> None:
    alone = looking(GOOD)
    late = alone.here._replace(lost=LOST)
    assert alone.agent.handle(late, alone.now_ns) == ()
    assert alone.agent.tier == GOOD


def test_what_has_left_the_robot_is_counted_by_kind_and_teammate() -> None:
    alone = Alone()
    alone.tell(Presence("mate", POORER), Presence("other", POORER), BeliefSubscribers(present=True))
    (fix, _) = alone.sees(ahead("mate"), ahead("other"))
    (belief,) = alone.later(0.2)
    alone.agent.handle(HelpSent(replace(fix, stamp_ns=7 * SECOND), 8), alone.now_ns)
    assert alone.agent.counters.flows() == (
        Flow("belief", "", 1, 50, latest_ns=belief.stamp_ns),
        Flow("fix", fix.robot, 2, 50, latest_ns=7 * SECOND),
        Flow("fix", "other" if fix.robot == "mate" else "mate", 1, 42, latest_ns=fix.stamp_ns),
    )
