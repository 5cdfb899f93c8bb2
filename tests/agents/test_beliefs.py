"""When a robot sends its belief, and whose beliefs it uses."""

import math
from typing import Any

import pytest
from msgspec.structs import astuple, replace
from support.buses import SECOND
from support.collaboration import GOOD, MATES, POOR, POORER, SIGMA_M, Alone, ahead, robots
from support.core import diagonal

from cpcbl_agents.agent import BeliefSubscribers, HelpSent, Presence
from cpcbl_team.config import (
    BudgetSettings,
    SensorSettings,
    Variant,
)
from cpcbl_team.inputs import Belief, HeadingBelief
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport.messages import Flow

LOST = "no evidence"


def stamps_s(beliefs: list[Belief]) -> list[float]:
    return [b.stamp_ns / SECOND for b in beliefs]


def test_without_a_subscriber_no_belief_is_sent_or_counted() -> None:
    alone = Alone()
    assert alone.later(3.0) == []
    assert alone.agent.counters.flows() == ()


def test_a_new_subscriber_gets_a_belief_at_once() -> None:
    alone = Alone()
    alone.later(1.0)
    assert stamps_s(alone.tell(BeliefSubscribers(present=True))) == [1.0]
    assert alone.later(0.5) == []
    assert alone.tell(BeliefSubscribers(present=False)) == []
    assert alone.later(0.2) == []
    assert stamps_s(alone.tell(BeliefSubscribers(present=True))) == [1.7]


def test_a_belief_that_nobody_heard_is_said_as_soon_as_somebody_subscribes() -> None:
    """At a change of tier the key of beliefs changes too, and nobody has subscribed to it yet. A
    robot whose tier changed with each of its poses was never heard, and a teammate took it to be
    where it no longer was."""
    alone = Alone()
    assert alone.tell(BeliefSubscribers(present=True)) == []
    alone.later(0.4)
    alone.heard = False
    poorer = alone.here.estimate._replace(covariance=diagonal(SIGMA_M[POOR], 0.02))
    alone.becomes(estimate=poorer)
    assert stamps_s(alone.later(0.2)) == [0.6]
    alone.heard = True
    assert stamps_s(alone.tell(BeliefSubscribers(present=True))) == [0.6]
    assert stamps_s(alone.tell(BeliefSubscribers(present=True))) == []  # five a second at most
    assert alone.tally("belief").messages == 2


@pytest.mark.parametrize("silence_s", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("speed_m_s", [0.0, 0.5])
def test_while_subscribers_can_predict_the_pose_no_belief_is_sent_up_to_the_longest_silence(
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


def test_a_robot_that_has_stopped_sends_its_belief() -> None:
    alone = Alone()
    alone.tell(BeliefSubscribers(present=True))
    alone.becomes(speed_m_s=0.5)
    assert stamps_s(alone.later(0.2)) == [0.2]
    alone.becomes(speed_m_s=0.0)
    assert stamps_s(alone.later(0.4)) == [0.4]


@pytest.mark.parametrize(("factor", "stamps"), [(1.2, [1.2]), (1.3, [0.4]), (1.0 / 1.3, [0.4])])
def test_a_robot_whose_sigma_has_changed_enough_sends_its_belief(
    factor: float, stamps: list[float]
) -> None:
    """Half a sigma is a factor of 1.28."""
    alone = Alone(POOR)
    alone.tell(BeliefSubscribers(present=True))
    assert stamps_s(alone.later(0.3)) == [0.2]
    covariance = diagonal(SIGMA_M[POOR] * factor, 0.02)
    alone.becomes(estimate=alone.here.estimate._replace(covariance=covariance))
    assert stamps_s(alone.later(1.0)) == stamps


def test_beliefs_that_always_change_keep_their_rate() -> None:
    alone = Alone(belief_share=0.0, belief_rate_hz=2.0)
    alone.tell(BeliefSubscribers(present=True))
    assert stamps_s(alone.later(3.0)) == [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]


def test_a_belief_beyond_the_budget_is_counted_and_sent_as_soon_as_the_budget_allows() -> None:
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


def test_under_a_budget_a_robot_says_that_it_has_driven_off() -> None:
    """Its teammates took it to stand where it had been, for 1.5 s; the interval of such a budget is
    half a minute."""
    alone = Alone(budget=BudgetSettings(bytes_per_s=4.0))
    alone.tell(BeliefSubscribers(present=True))
    alone.becomes(speed_m_s=0.0)
    assert stamps_s(alone.later(0.4)) == [0.2]
    alone.becomes(speed_m_s=0.5)
    assert stamps_s(alone.later(10.0)) == [0.6]


def test_a_belief_that_nobody_uses_any_more_is_not_urgent() -> None:
    alone = Alone(budget=BudgetSettings(bytes_per_s=4.0))
    alone.tell(BeliefSubscribers(present=True))
    assert stamps_s(alone.later(2.0)) == [0.2]
    alone.becomes(speed_m_s=0.5)
    assert stamps_s(alone.later(10.0)) == []


def test_no_beliefs_where_passive_help_is_switched_off_or_has_not_begun() -> None:
    for rules, then in (({"passive": False}, []), ({"after_s": 2.0}, [2.0])):
        alone = Alone(**rules)
        alone.tell(BeliefSubscribers(present=True))
        assert stamps_s(alone.later(2.5)) == then


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


def test_a_better_teammate_with_too_little_information_gain_is_no_source() -> None:
    vague = SensorSettings(range_share=0.3, bearing_sigma_deg=20.0)
    for sensor, sources in ((vague, set()), (SensorSettings(), {("mate", GOOD)})):
        alone = looking(POOR, sensor=sensor)
        alone.sees(ahead(range_m=7.0))
        alone.later(0.1)
        assert alone.agent.sources == sources


def test_a_robot_with_a_poor_heading_subscribes_to_teammates_that_improve_it() -> None:
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


def unsure_of_its_heading(tier: int = GOOD, **settings: Any) -> Alone:
    """A robot that stands and does not know its heading; it sees the teammate `mate`."""
    alone = Alone(tier, moves=False, **settings)
    covariance = diagonal(SIGMA_M[tier], math.radians(20.0))
    alone.becomes(estimate=alone.here.estimate._replace(covariance=covariance))
    alone.sees(ahead(range_m=6.0))
    return alone


@pytest.mark.parametrize(("tier", "is_source"), [(GOOD, True), (GOOD + 1, False)])
def test_a_standing_robot_takes_its_heading_from_equals_but_not_from_worse_ones(
    tier: int, is_source: bool
) -> None:
    alone = unsure_of_its_heading()
    alone.tell(Presence("mate", tier))
    alone.later(0.1)
    assert alone.agent.sources == ({("mate", tier)} if is_source else set())
    belief = Belief("mate", 0, 6.0, 0.0, 0.0, diagonal(0.02, 0.1))
    used = alone.agent.as_used(belief)
    assert isinstance(used, HeadingBelief) is is_source
    assert astuple(used) == astuple(belief)
    alone.tell(Presence("mate", LOWEST_TIER))
    alone.later(0.1)
    assert alone.agent.sources == set()
    late = alone.agent.as_used(belief)  # it was on the way meanwhile
    assert isinstance(late, HeadingBelief) is is_source


def test_the_belief_of_a_better_teammate_is_used_whole() -> None:
    alone = unsure_of_its_heading()
    alone.tell(Presence("mate", GOOD - 1))
    alone.later(0.1)
    assert alone.agent.sources == {("mate", GOOD - 1)}
    belief = Belief("mate", 0, 6.0, 0.0, 0.0, diagonal(0.02, 0.1))
    assert alone.agent.as_used(belief) is belief


@pytest.mark.parametrize(
    ("moves", "heading_sigma", "variant", "lost", "is_source"),
    [
        (False, 0.35, "joint", "", True),
        (True, 0.35, "joint", "", False),
        (False, 0.005, "joint", "", False),
        (False, 0.35, "weighted", "", False),
        (False, 0.35, "joint", LOST, False),
    ],
)
def test_only_a_robot_that_stands_and_hardly_knows_its_heading_listens_to_equals(
    moves: bool, heading_sigma: float, variant: Variant, lost: str, is_source: bool
) -> None:
    """The heading of a robot that drives becomes a position, and could come back as one."""
    alone = Alone(GOOD, moves=moves, variant=variant)
    covariance = diagonal(SIGMA_M[GOOD], heading_sigma)
    alone.becomes(estimate=alone.here.estimate._replace(covariance=covariance), lost=lost)
    alone.later(0.1)
    alone.tell(Presence("mate", alone.agent.tier))
    alone.sees(ahead(range_m=6.0))
    alone.later(0.1)
    assert bool(alone.agent.sources) is is_source


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


def test_a_lost_robot_sends_nothing_and_subscribes_to_all_better_teammates() -> None:
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
