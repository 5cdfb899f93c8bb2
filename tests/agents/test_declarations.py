"""What one robot declares on the bus, and what it makes of the tokens of others."""

from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import Subscription, TeamOnBus, examples, robot_at, saw, standing, team_of

from cpcbl_agents.agent import Presence
from cpcbl_agents.declarations import LivelinessTokens
from cpcbl_agents.node import Node, NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_team.inputs import Fix, Odometry, Sighting
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport import topics
from cpcbl_transport.bus import Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.memory_bus import MemoryBus, MemoryHub

MS = 1_000_000

# Tokens -------------------------------------------------------------------------------------------


def alive(tier: object, robot: str = "mate", incarnation: object = 1) -> str:
    return topics.ALIVE.at(tier=tier, robot=robot, incarnation=incarnation)


def test_a_teammate_is_there_until_its_token_goes() -> None:
    tokens = LivelinessTokens()
    assert tokens.update(alive(7), True) == Presence("mate", 7)
    assert tokens.update(alive(7), False) == Presence("mate", None)


def test_nothing_is_kept_of_those_that_are_gone() -> None:
    tokens, empty = LivelinessTokens(), vars(LivelinessTokens())
    for name in ("guest1", "guest2"):
        own = {"robot": name, "incarnation": 1}
        for key in (topics.ALIVE.at(tier=7, **own), topics.FRAME.at(frame="field", **own)):
            tokens.update(key, True)
            assert vars(tokens) != empty
            tokens.update(key, False)
    assert vars(tokens) == empty


def test_of_two_tokens_the_newest_counts() -> None:
    """At a change of tier the new one comes before the old one goes."""
    tokens = LivelinessTokens()
    assert tokens.update(alive(7), True) == Presence("mate", 7)
    assert tokens.update(alive(3), True) == Presence("mate", 3)
    assert tokens.update(alive(7), False) == Presence("mate", 3)
    assert tokens.update(alive(3), False) == Presence("mate", None)


def test_when_the_newest_token_goes_the_one_before_counts() -> None:
    tokens = LivelinessTokens()
    for tier in (7, 3, 5):
        tokens.update(alive(tier), True)
    assert tokens.update(alive(5), False) == Presence("mate", 3)


def test_a_token_that_is_declared_again_is_the_newest() -> None:
    tokens = LivelinessTokens()
    for tier in (7, 3):
        tokens.update(alive(tier), True)
    assert tokens.update(alive(7), True) == Presence("mate", 7)


def test_a_process_that_is_started_again_has_a_token_of_its_own() -> None:
    tokens = LivelinessTokens()
    tokens.update(alive(7, incarnation="a"), True)
    assert tokens.update(alive(7, incarnation="b"), True) == Presence("mate", 7)
    assert tokens.update(alive(7, incarnation="a"), False) == Presence("mate", 7)


def test_the_tokens_of_teammates_do_not_mix() -> None:
    tokens = LivelinessTokens()
    tokens.update(alive(7), True)
    assert tokens.update(alive(3, "other"), True) == Presence("other", 3)
    assert tokens.update(alive(3, "other"), False) == Presence("other", None)
    assert tokens.update(alive(7), True) == Presence("mate", 7)


def test_a_token_that_disappears_without_having_appeared_changes_nothing() -> None:
    tokens = LivelinessTokens()
    assert tokens.update(alive(7), False) == Presence("mate", None)
    tokens.update(alive(3), True)
    assert tokens.update(alive(7), False) == Presence("mate", 3)


def test_what_is_forgotten_plays_no_part_any_more() -> None:
    tokens = LivelinessTokens()
    tokens.update(alive(7), True)
    tokens.forget("mate")
    tokens.forget("stranger")
    tokens.update(alive(3), True)
    assert tokens.update(alive(3), False) == Presence("mate", None)


STRANGE_TIERS = ["", "x", "-1", "16", "99", "1.0", "+3", " 3", "1e1", "³", "٣", "9" * 5000]
STRANGE = [
    *(alive(tier) for tier in STRANGE_TIERS),
    "alive/3/mate",
    "alive/3/mate/1/2",
    "alive",
    "",
    "belief/3/mate",
    "dead/3/mate/1",
]


@pytest.mark.parametrize("key", STRANGE, ids=lambda key: key[:20] or "empty")
@pytest.mark.parametrize("there", [True, False])
def test_a_key_that_is_no_robots_token_gives_none(key: str, there: bool) -> None:
    tokens = LivelinessTokens()
    tokens.update(alive(7), True)
    assert tokens.update(key, there) is None
    assert tokens.update(alive(7), True) == Presence("mate", 7)


@examples(100)
@given(st.text(alphabet="alive/0123456789mate-*x", max_size=30), st.booleans())
def test_no_key_raises(key: str, there: bool) -> None:
    presence = LivelinessTokens().update(key, there)
    assert isinstance(presence, Presence | None)
    assert presence is None or presence.tier is None or 0 <= presence.tier <= LOWEST_TIER


CHANGES = st.lists(
    st.tuples(st.sampled_from(["mate", "other"]), st.integers(0, 4), st.booleans()), max_size=40
)


@examples(100)
@given(CHANGES)
def test_the_newest_of_what_is_there_counts(changes: list[tuple[str, int, bool]]) -> None:
    tokens, there = LivelinessTokens(), list[tuple[str, int]]()
    for robot, tier, comes in changes:
        if (robot, tier) in there:
            there.remove((robot, tier))
        if comes:
            there.append((robot, tier))
        newest = [t for name, t in there if name == robot]
        assert tokens.update(alive(tier, robot), comes) == Presence(
            robot, newest[-1] if newest else None
        )


def test_invalid_tokens_are_counted_and_change_nothing() -> None:
    """A foreign session declares them under the name of a teammate that is in sight."""
    results = []
    for strange in ([], ["alive/x/mate/1", "alive/99/mate/1", "alive/-1/mate/7"]):
        stand = TeamOnBus(TEAM, here=["me"])
        stand.announce("mate", 2)
        for key in strange:
            stand.bus.declare_token(key)
        for _ in range(5):
            stand.stand_still(0.2)
            stand.sightings("me", saw(stand.now_ns, Sighting("mate", 2.0, 0.0)))
            stand.step()
        results.append((stand.robots["me"].collaboration.sources, stand.status("me").counts))
    (sources, counts), (same, strange_counts) = results
    assert sources == same == {("mate", 2)}
    assert strange_counts == {**counts, "bad_token": 3}


# Declaring ----------------------------------------------------------------------------------------

TEAM = team_of(me=robot_at(sigma_m=0.3), mate=robot_at(2.0), other=robot_at(0.0, 2.0))


class Event(NamedTuple):
    """Something was declared on a bus, or taken back."""

    what: str
    key: str
    declared: bool


class Recording(MemoryBus):
    """A session that writes down what is declared on it and taken back, in order."""

    def __init__(self, hub: MemoryHub) -> None:
        super().__init__(hub)
        self.events: list[Event] = []

    def publisher(self, key: str, qos: topics.Qos) -> Publisher:
        noted: Publisher = self._noted("publish", key, super().publisher(key, qos))
        return noted

    def subscribe(self, keys: str, receive: MessageCallback) -> Handle:
        noted: Handle = self._noted("subscribe", keys, super().subscribe(keys, receive))
        return noted

    def declare_token(self, key: str) -> Handle:
        noted: Handle = self._noted("declare_token", key, super().declare_token(key))
        return noted

    def watch_liveliness(self, keys: str, watch: LivelinessCallback) -> Handle:
        noted: Handle = self._noted("watch_liveliness", keys, super().watch_liveliness(keys, watch))
        return noted

    def _noted(self, what: str, key: str, handle: Any) -> Any:
        self.events.append(Event(what, key, declared=True))
        return _Noted(handle, lambda: self.events.append(Event(what, key, declared=False)))

    def open(self, what: str) -> list[str]:
        """What is declared now; what was declared twice is in it twice."""
        keys = []
        for event in self.events:
            if event.what == what:
                keys.append(event.key) if event.declared else keys.remove(event.key)
        return sorted(keys)


class _Noted:
    """Anything declared; notes that it is closed."""

    def __init__(self, handle: Any, on_close: Any) -> None:
        self._handle, self._on_close = handle, on_close

    def __getattr__(self, name: str) -> Any:
        return getattr(self._handle, name)

    def close(self) -> None:
        self._on_close()
        self._handle.close()


class Wired(TeamOnBus):
    """The robot `me` on a bus that records; the test plays its mates."""

    def __init__(self) -> None:
        super().__init__(TEAM, here=[])
        self.recording = Recording(self.hub)
        self.robots["me"] = build_robot("me", TEAM, 0)
        self.nodes["me"] = Node(self.robots["me"], TEAM, self.recording, NodeStart(0, "1"))
        self.stand_still(0.5)

    @property
    def tier(self) -> int:
        return self.robots["me"].collaboration.tier

    def sees(self, *names: str) -> None:
        self.sightings("me", saw(self.now_ns, *(Sighting(name, 2.0, 0.0) for name in names)))
        self.step()

    def gets_worse(self) -> list[Event]:
        """It drives; what that changes on the bus."""
        before, self.now_ns = self.now_ns, self.now_ns + 100 * MS
        so_far = len(self.recording.events)
        self.odometry("me", Odometry(before, self.now_ns, 9.0, 0.0))
        self.step()
        return self.recording.events[so_far:]


def fixes_from(tiers: range) -> list[str]:
    return [topics.FIX.at(robot="me", tier=t) for t in tiers]


def test_a_robot_alone_declares_its_name_its_inputs_and_better_tiers() -> None:
    wired = Wired()
    inputs = [topic.at(robot="me") for topic in topics.INPUTS]
    assert wired.recording.open("subscribe") == sorted(inputs + fixes_from(range(wired.tier)))
    assert wired.recording.open("declare_token") == [alive(wired.tier, "me")]
    assert wired.recording.open("watch_liveliness") == [topics.ALIVE.at(robot="me")]


def test_only_teammates_in_sight_are_watched_and_only_for_a_while() -> None:
    wired = Wired()
    own = topics.ALIVE.at(robot="me")
    wired.sees("mate")
    wired.stand_still(0.1)
    assert wired.recording.open("watch_liveliness") == sorted([own, topics.ALIVE.at(robot="mate")])
    wired.stand_still(10.0)
    assert wired.recording.open("watch_liveliness") == [own]


def test_of_a_teammate_that_is_forgotten_no_token_remains() -> None:
    """It went while nobody watched it."""
    wired = Wired()
    token = wired.announce("mate", 2)
    wired.sees("mate")
    wired.stand_still(11.0)
    token.close()
    for again in (False, True):
        wired.sees("mate")
        if again:
            wired.announce("mate", 3).close()
        wired.stand_still(0.2)
        assert wired.robots["me"].collaboration.neighbours == {"mate"}
        assert wired.robots["me"].collaboration.sources == frozenset()


def test_exactly_the_beliefs_of_sources_are_subscribed_to() -> None:
    wired = Wired()
    wired.announce("mate", 2)
    wired.announce("other", LOWEST_TIER)
    wired.sees("mate", "other")
    wired.stand_still(0.2)
    heard = [key for key in wired.recording.open("subscribe") if key.startswith("belief/")]
    assert heard == [topics.BELIEF.at(tier=2, robot="mate")]


def test_the_beliefs_of_a_source_that_changes_its_tier_always_arrive() -> None:
    wired = Wired()
    before, after = (topics.BELIEF.at(tier=t, robot="mate") for t in (2, 3))
    wired.announce("mate", 2)
    wired.sees("mate")
    wired.stand_still(0.2)
    wired.announce("mate", 3)
    wired.stand_still(0.2)
    events = [e for e in wired.recording.events if e.key in (before, after)]
    assert events == [
        Event("subscribe", before, declared=True),
        Event("subscribe", after, declared=True),
        Event("subscribe", before, declared=False),
    ]


def test_at_a_change_of_tier_the_new_is_declared_before_the_old_is_taken_back() -> None:
    wired = Wired()
    ear = Subscription(wired.bus, "belief/**")
    wired.stand_still(0.5)
    old = wired.tier
    events = wired.gets_worse()
    new = wired.tier
    assert new > old
    assert ear.samples
    for what, declared, taken_back in (
        ("declare_token", alive(new, "me"), alive(old, "me")),
        ("subscribe", fixes_from(range(old, new))[0], topics.BELIEF.at(tier=old, robot="me")),
    ):
        first = events.index(Event(what, declared, declared=True))
        kind = "declare_token" if what == "declare_token" else "publish"
        assert first < events.index(Event(kind, taken_back, declared=False))
    assert wired.recording.open("declare_token") == [alive(new, "me")]
    wired.stand_still(0.2)
    published = [k for k in wired.recording.open("publish") if k.startswith(("belief/", "fix/"))]
    assert published == [topics.BELIEF.at(tier=new, robot="me")]


def test_a_robot_that_gets_better_takes_its_old_subscriptions_back_last() -> None:
    wired = Wired()
    wired.gets_worse()
    worse, so_far = wired.tier, len(wired.recording.events)
    for _ in range(5):
        wired.stand_still(0.1)
        x, y, _ = wired.robots["me"].filter.timeline.state.estimate.pose
        sure = (0.0004, 0.0, 0.0004)
        fix = Fix("me", "mate", wired.now_ns, x, y, sure, sure)
        wired.put(topics.FIX.at(robot="me", tier=0, observer="mate"), fix)
    wired.stand_still(0.2)
    assert wired.tier < worse
    assert wired.recording.open("declare_token") == [alive(wired.tier, "me")]
    heard = [k for k in wired.recording.open("subscribe") if k.startswith("fix/")]
    assert heard == sorted(fixes_from(range(wired.tier)))
    token_gone = Event("declare_token", alive(worse, "me"), declared=False)
    events = wired.recording.events[so_far:]
    announced = [e for e in events if e.what == "declare_token"]
    assert [e.declared for e in announced] == [True, False] * (len(announced) // 2)
    assert token_gone in events


def test_nothing_is_declared_twice_or_again_without_need() -> None:
    wired = Wired()
    wired.announce("mate", 2)
    for _ in range(20):
        wired.sees("mate")
        wired.stand_still(0.2)
    for what in ("declare_token", "subscribe", "watch_liveliness", "publish"):
        keys = wired.recording.open(what)
        assert len(keys) == len(set(keys))
        events = [e for e in wired.recording.events if e.what == what]
        assert len([e for e in events if e.declared]) == len({e.key for e in events})


def test_a_robot_of_which_nothing_is_known_declares_no_tier() -> None:
    hub = MemoryHub()
    recording = Recording(hub)
    node = Node(build_robot("me", TEAM, 0), TEAM, recording, NodeStart(0, "1"))
    node.step(0)
    assert recording.open("declare_token") == []
    TeamOnBus(TEAM, here=[], hub=hub).odometry("me", standing(100 * MS))
    node.step(100 * MS)
    assert len(recording.open("declare_token")) == 1


def test_a_robot_without_active_help_subscribes_to_no_fixes() -> None:
    """Else teammates would send it what it does not use."""
    for active in (True, False):
        rules = {"active": active}
        stand = TeamOnBus(team_of(me=robot_at(sigma_m=0.3, **rules), mate=robot_at(2.0)))
        stand.stand_still(0.5)
        assert bool(stand.nodes["me"]._declarations._subscriptions) is active
