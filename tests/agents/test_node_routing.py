"""What a robot on a bus publishes, under which tier, and to whom."""

import math
from typing import Any

import pytest
from support.buses import (
    MS,
    SECOND,
    TeamOnBus,
    matches,
    robot_at,
    saw,
    team_of,
    with_robot,
)
from support.nodes import (
    BELIEF_KEY,
    GOOD,
    POOR,
    estimate,
    exchange,
    helper,
    look,
    only_me,
    tier,
    two_robots,
)

from cpcbl_team.config import BudgetSettings, OdometrySettings, Start
from cpcbl_team.information_gain import sigma_limits_m
from cpcbl_team.inputs import Belief, Fix, Odometry, Sighting
from cpcbl_team.tiers import LOWEST_TIER, tier_of
from cpcbl_transport import topics
from cpcbl_transport.bus import Publisher
from cpcbl_transport.memory_bus import MemoryBus, MemoryHub
from cpcbl_transport.messages import (
    Message,
    Track,
)


def test_nothing_is_sent_uphill() -> None:
    stand = TeamOnBus(two_robots())
    exchange(stand)
    worse, better = stand.statuses().values()
    assert better.heard == worse.sent == ()
    assert {flow.topic for flow in better.sent} == {"belief", "fix"}
    assert worse.messages_received == better.messages_sent > 2


def test_robots_of_the_same_tier_send_each_other_nothing() -> None:
    stand = TeamOnBus(two_robots(GOOD, GOOD))
    exchange(stand)
    assert [(s.sent, s.heard) for s in stand.statuses().values()] == [((), ())] * 2


def test_a_standing_robot_gets_its_heading_and_nothing_else_from_an_equal() -> None:
    """Its mate drives, and gets nothing. Alone the robot's heading stays 0.3 rad off."""
    start = Start(x_m=0.0, y_m=0.0, heading_deg=0.0, sigma_m=GOOD, heading_sigma_deg=20.0)
    ends = []
    for moves in (True, False):
        odometry = OdometrySettings(moves=moves)
        team = with_robot(two_robots(GOOD, GOOD), "me", start=start, odometry=odometry)
        stand = TeamOnBus(team)
        for _ in range(10):
            stand.stand_still(0.2)
            stand.sightings("me", saw(stand.now_ns, Sighting("mate", 2.5, -0.3)))
            look(stand, "mate")
        ends.append(estimate(stand))
        statuses = stand.statuses()
        assert statuses["mate"].heard == ()
        assert {f.topic for f in statuses["me"].heard} == (set() if moves else {"belief"})
    alone, helped = ends
    assert alone.pose == (0.0, 0.0, 0.0)
    assert helped.pose == pytest.approx((0.0, 0.0, 0.3), abs=0.01)
    assert helped.pose[:2] == alone.pose[:2]
    assert helped.covariance.position() == alone.covariance.position()
    assert helped.heading_sigma_rad < math.radians(3.0)


def test_both_ways_sends_uphill_too() -> None:
    stand = TeamOnBus(two_robots(direction="both-ways", least_value=0.0, least_use=0.0))
    exchange(stand)
    for status in stand.statuses().values():
        assert {flow.topic for flow in status.heard if flow.messages} == {"belief", "fix"}


def test_a_budget_is_not_spent_without_a_subscriber() -> None:
    stand = helper(budget=BudgetSettings(messages_per_minute=60.0, urgent_share=0.0))
    exchange(stand)
    ear = stand.ear(topics.FIX.at(robot="mate"))
    exchange(stand)
    (spending,) = stand.status("me").spending
    assert 0 < len(ear.messages) == spending.most


def test_a_robot_subscribes_only_to_teammates_in_sight() -> None:
    stand = TeamOnBus(two_robots())
    stand.stand_still(2.0)
    assert [s.heard for s in stand.statuses().values()] == [(), ()]
    exchange(stand, 1.0)
    heard = stand.status("me").messages_received
    assert heard > 0
    stand.stand_still(2.0)
    assert stand.status("me").messages_received == heard


@pytest.mark.parametrize(
    ("rules", "kinds"),
    [
        ({"passive": False}, {Fix}),
        ({"active": False}, {Belief}),
        ({"passive": False, "active": False}, set()),
        ({"after_s": 100.0}, set()),
        ({}, {Belief, Fix}),
    ],
    ids=["active", "passive", "none", "not yet", "both"],
)
def test_help_is_of_the_kinds_that_are_chosen(
    rules: dict[str, Any], kinds: set[type[Message]]
) -> None:
    stand = helper(**rules)
    beliefs, fixes = stand.ear("belief/**"), stand.ear("fix/**")
    exchange(stand)
    assert {type(m) for m in beliefs.messages + fixes.messages} == kinds


def test_help_begins_after_the_chosen_time() -> None:
    stand = TeamOnBus(two_robots(GOOD, POOR, after_s=2.0), here=["me"])
    ear = stand.ear("belief/**")
    exchange(stand, 4.0)
    stamps = [m.stamp_ns for m in ear.messages if isinstance(m, Belief)]
    assert min(stamps) == 2 * SECOND


@pytest.mark.parametrize("known", [True, False], ids=["knows where it is", "lost"])
def test_a_lost_robot_sends_teammates_nothing(known: bool) -> None:
    stand = TeamOnBus(
        team_of(me=robot_at(sigma_m=GOOD, known=known), mate=robot_at(2.0)), here=["me"]
    )
    stand.announce("mate", LOWEST_TIER)
    help_, track = stand.ear("*/*/me"), stand.ear(topics.TRACK.at(robot="me"))
    fixes = stand.ear("fix/**")
    exchange(stand)
    assert bool(help_.messages) is known
    assert bool(fixes.messages) is known
    latest = track.messages[-1]
    assert isinstance(latest, Track)
    assert bool(latest.lost) is not known
    assert (latest.tier == LOWEST_TIER) is not known


def tiers_listened_to(stand: TeamOnBus) -> list[int]:
    """The tiers whose fixes `me` subscribes to."""
    keys = [topics.FIX.at(robot="me", tier=t, observer="mate") for t in range(LOWEST_TIER + 1)]
    return [t for t, key in enumerate(keys) if listens(stand, key)]


def listens(stand: TeamOnBus, key: str) -> bool:
    return stand.bus.publisher(key, topics.Qos.FRESH).matching


def drive(stand: TeamOnBus, way_m: float, robot: str = "me") -> None:
    """One robot drives straight ahead within 100 ms, the others stand."""
    before, stand.now_ns = stand.now_ns, stand.now_ns + 100 * MS
    for name in stand.robots:
        way = way_m if name == robot else 0.0
        stand.odometry(name, Odometry(before, stand.now_ns, way, 0.0))
    stand.step()


class Recalling(MemoryHub):
    """Its sessions remember what publishers they were asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.publishers: list[tuple[str, Publisher]] = []

    def session(self) -> MemoryBus:
        return RecallingBus(self)

    def open_keys(self, keys: str) -> set[str]:
        """The keys with a publisher that is still open (and heard)."""
        return {key for key, p in self.publishers if matches(keys, key) and p.matching}


class RecallingBus(MemoryBus):
    def __init__(self, hub: Recalling) -> None:
        super().__init__(hub)
        self._recalling = hub

    def publisher(self, key: str, qos: topics.Qos) -> Publisher:
        publisher = super().publisher(key, qos)
        self._recalling.publishers.append((key, publisher))
        return publisher


def test_after_a_change_of_tier_the_new_keys_are_in_force() -> None:
    hub = Recalling()
    stand = TeamOnBus(two_robots(GOOD, POOR), here=["me"], hub=hub)
    tokens: list[tuple[str, bool]] = []
    stand.bus.watch_liveliness("alive/**", lambda key, alive: tokens.append((key, alive)))
    ear = stand.ear("belief/**")
    stand.stand_still(1.0)
    before = tier_of(GOOD, math.sqrt(2.0))
    assert tiers_listened_to(stand) == list(range(before))
    assert tokens == [(topics.ALIVE.at(tier=before, robot="me", incarnation="1"), True)]
    assert set(ear.keys) == {topics.BELIEF.at(tier=before, robot="me")}

    drive(stand, 4.0)
    after = tier(stand, "me")
    assert after > before
    assert tiers_listened_to(stand) == list(range(after))
    assert tokens[1:] == [
        (topics.ALIVE.at(tier=after, robot="me", incarnation="1"), True),
        (topics.ALIVE.at(tier=before, robot="me", incarnation="1"), False),
    ]
    ear.samples.clear()
    stand.stand_still(1.0)
    assert set(ear.keys) == {topics.BELIEF.at(tier=after, robot="me")}
    assert hub.open_keys(topics.BELIEF.at(robot="me")) == set(ear.keys)


def test_a_belief_is_published_under_the_tier_of_its_own_sigma() -> None:
    """A robot that gets worse says so to none who listened to what it was before, and one that
    gets better tells all who listen to the better tier at once."""
    stand = helper()
    ear, rules = stand.ear("belief/**"), stand.team.robots["me"].collaboration
    stand.stand_still(1.1)
    drive(stand, 2.0)
    stand.stand_still(1.0)
    for _ in range(5):
        stand.stand_still(0.1)
        stand.sightings("me", saw(stand.now_ns, Sighting("oak", 2.0, 0.0)))
    stand.stand_still(1.0)
    said: dict[int, list[Belief]] = {}
    for key, belief in zip(ear.keys, ear.messages, strict=True):
        assert isinstance(belief, Belief)
        (_, tier, _) = key.split("/")
        sigma = math.sqrt((belief.covariance[0] + belief.covariance[2]) / 2.0)
        least, most = sigma_limits_m(int(tier), rules)
        assert least * 0.99 < sigma < most * 1.01
        said.setdefault(int(tier), []).append(belief)
    assert len(said) > 2


def test_a_robot_that_has_become_better_no_longer_subscribes_to_its_equals() -> None:
    stand = TeamOnBus(two_robots(POOR, GOOD), here=["me"])
    stand.stand_still(1.0)
    before = tier(stand, "me")
    for _ in range(5):
        stand.stand_still(0.1)
        stand.sightings("me", saw(stand.now_ns, Sighting("oak", 4.0, 0.0)))
        stand.sightings("me", saw(stand.now_ns + 1, Sighting("elm", 4.0, math.pi / 2.0)))
    stand.stand_still(0.2)
    assert tier(stand, "me") < before
    assert tiers_listened_to(stand) == list(range(tier(stand, "me")))


def test_the_belief_of_a_teammate_is_followed_to_its_next_tier() -> None:
    stand = only_me()
    second, third = (topics.BELIEF.at(tier=t, robot="mate") for t in (2, 3))
    assert listens(stand, second)
    token = stand.announce("mate", 3)
    stand.stand_still(0.1)
    assert (listens(stand, second), listens(stand, third)) == (False, True)
    token.close()
    stand.stand_still(0.1)
    assert (listens(stand, second), listens(stand, third)) == (True, False)


def test_a_robot_does_not_subscribe_to_a_teammate_that_is_gone() -> None:
    stand = TeamOnBus(two_robots(), here=["me"])
    token = stand.announce("mate", 2)
    exchange(stand, 1.0)
    assert listens(stand, BELIEF_KEY)
    token.close()
    look(stand)
    stand.stand_still(0.1)
    assert not listens(stand, BELIEF_KEY)


def test_robots_that_swap_tiers_swap_the_direction_of_help() -> None:
    stand = TeamOnBus(two_robots())
    exchange(stand)
    before = stand.statuses()
    assert before["me"].messages_received > 0
    assert before["mate"].heard == ()
    for way_m in (50.0, -50.0):  # there and back
        drive(stand, way_m, "mate")
    assert tier(stand, "mate") > tier(stand, "me")
    exchange(stand)
    after = stand.statuses()
    assert after["me"].messages_received == before["me"].messages_received
    assert after["mate"].messages_received > 0
