"""A robot on a bus: what it refuses, what it sends and to whom."""

import math
from typing import Any, NamedTuple

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import (
    MS,
    SECOND,
    TeamOnBus,
    examples,
    matches,
    robot_at,
    saw,
    standing,
    team_of,
    with_robot,
    written,
)

from cpcbl_agents.composition import build_robot
from cpcbl_agents.node import INBOX, Node
from cpcbl_team.collaboration import LOWEST_TIER, tier_of
from cpcbl_team.config import BudgetSettings, LocalizerSettings, Team
from cpcbl_team.estimate import ZERO3, Estimate
from cpcbl_team.information_gain import sigma_limits_m
from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sighting, Sightings
from cpcbl_team.self_calibration import Learned
from cpcbl_team.state import CalibrationMemory
from cpcbl_team.timeline import HORIZON_NS
from cpcbl_transport import topics
from cpcbl_transport.bus import Publisher
from cpcbl_transport.compact import BELIEF_BYTES
from cpcbl_transport.link_size import sent_bytes
from cpcbl_transport.memory_bus import MemoryBus, MemoryHub
from cpcbl_transport.messages import (
    LARGEST_FRAME,
    LARGEST_PAYLOAD,
    VERSION,
    Frame,
    Message,
    Refusal,
    Track,
)

GOOD, POOR = 0.02, 0.3
COVARIANCE = (0.0004, 0.0, 0.0004, 0.0, 0.0, 0.0001)
NOW = 3 * SECOND
IN_ODOMETRY, IN_SIGHTINGS, IN_POSITION, IN_FRAME = (t.at(robot="me") for t in topics.INPUTS)
BELIEF_KEY = topics.BELIEF.at(tier=2, robot="mate")
FIX_KEY = topics.FIX.at(robot="me", tier=2, observer="mate")
BELIEF = Belief("mate", NOW, 2.0, 0.0, 0.0, COVARIANCE)
FIX = Fix("me", "mate", NOW, 0.1, 0.0, (0.01, 0.0, 0.01), (0.0004, 0.0, 0.0004))
POSITION = Position(NOW, 0.1, 0.0, (0.01, 0.0, 0.01))
MATE_SEEN = Sighting("mate", 2.0, 0.0)


def two_robots(me_sigma_m: float = POOR, mate_sigma_m: float = GOOD, **rules: Any) -> Team:
    """`me`, by default the worse one, sees `mate` two metres ahead."""
    return team_of(
        me=robot_at(sigma_m=me_sigma_m, **rules),
        mate=robot_at(2.0, 0.0, 180.0, sigma_m=mate_sigma_m, **rules),
    )


def only_me() -> TeamOnBus:
    """The robot `me` at NOW, which listens to its mate since it saw it; the test plays the mate."""
    stand = TeamOnBus(two_robots(), here=["me"])
    stand.announce("mate", 2)
    stand.stand_still(NOW / SECOND - 0.2)
    look(stand)
    stand.stand_still(0.2)
    return stand


def look(stand: TeamOnBus, *robots: str) -> None:
    """These robots, or all that are there, see each other."""
    for name, seen in (("me", "mate"), ("mate", "me")):
        if name in (robots or stand.robots):
            stand.sightings(name, saw(stand.now_ns, Sighting(seen, 2.0, 0.0)))
    stand.step()


def estimate(stand: TeamOnBus, robot: str = "me") -> Estimate:
    return stand.robots[robot].filter.timeline.state.estimate


def tier(stand: TeamOnBus, robot: str) -> int:
    return stand.robots[robot].collaboration.tier


# Bad payloads -----------------------------------------------------------------------------------


class Bad(NamedTuple):
    """A payload under a key, and the one reason why it must not be taken."""

    reason: str
    key: str
    payload: Message | bytes


def changed(message: Message, **fields: object) -> Message:
    return msgspec.structs.replace(message, **fields)


BAD = [
    Bad(Refusal.EMPTY, BELIEF_KEY, b""),
    Bad(Refusal.TOO_LARGE, BELIEF_KEY, bytes(LARGEST_PAYLOAD + 1)),
    Bad(Refusal.TOO_LARGE, IN_ODOMETRY, Frame(NOW, bytes(LARGEST_PAYLOAD))),
    Bad(Refusal.TOO_LARGE, IN_FRAME, Frame(NOW, bytes(LARGEST_FRAME))),
    Bad(Refusal.VERSION, BELIEF_KEY, bytes([VERSION + 1]) + written(BELIEF)[1:]),
    Bad(Refusal.VERSION, FIX_KEY, bytes([VERSION + 1]) + written(FIX)[1:]),
    Bad(Refusal.GARBAGE, BELIEF_KEY, written(BELIEF)[:-3]),
    Bad(Refusal.GARBAGE, IN_ODOMETRY, bytes([VERSION]) + b"\xc1" * 20),
    Bad(Refusal.GARBAGE, BELIEF_KEY, standing(NOW, NOW - SECOND)),
    Bad(Refusal.GARBAGE, BELIEF_KEY, FIX),
    Bad(Refusal.GARBAGE, FIX_KEY, BELIEF),
    Bad(Refusal.GARBAGE, IN_ODOMETRY, BELIEF),
    Bad(Refusal.WRONG_TYPE, IN_SIGHTINGS, Track("me", NOW, 0.0, 0.0, 0.0, None, 3)),
    Bad(Refusal.WRONG_TYPE, IN_ODOMETRY, saw(NOW, Sighting("oak", 3.5, 0.0))),
    Bad(Refusal.WRONG_TYPE, IN_SIGHTINGS, POSITION),
    Bad(Refusal.WRONG_TYPE, IN_SIGHTINGS, Frame(NOW, b"jpeg")),
    Bad(Refusal.WRONG_TYPE, IN_FRAME, saw(NOW, Sighting("oak", 3.5, 0.0))),
    Bad("no_camera", IN_FRAME, Frame(NOW, bytes(LARGEST_PAYLOAD))),
    Bad(Refusal.NOT_FINITE, IN_POSITION, changed(POSITION, y_m=math.nan)),
    Bad(Refusal.NOT_FINITE, IN_ODOMETRY, Odometry(NOW, NOW + 50 * MS, math.nan, 0.0)),
    Bad("not_finite", IN_SIGHTINGS, saw(NOW, Sighting("oak", math.nan, 0.0))),
    Bad(Refusal.IMPLAUSIBLE, FIX_KEY, changed(FIX, x_m=1e7)),
    Bad(Refusal.IMPLAUSIBLE, IN_ODOMETRY, Odometry(NOW, NOW + 50 * MS, -1e7, 0.0)),
    Bad(Refusal.IMPLAUSIBLE, BELIEF_KEY, changed(BELIEF, covariance=(1e7,) * 6)),
    Bad(Refusal.NOT_A_COVARIANCE, IN_POSITION, changed(POSITION, covariance=(-1.0, 0.0, 1.0))),
    Bad(Refusal.FUTURE, BELIEF_KEY, changed(BELIEF, stamp_ns=NOW + SECOND)),
    Bad(Refusal.FUTURE, FIX_KEY, changed(FIX, stamp_ns=NOW + SECOND)),
    Bad(Refusal.CLOCK, BELIEF_KEY, changed(BELIEF, stamp_ns=NOW + 300 * MS)),
    Bad(Refusal.CLOCK, FIX_KEY, changed(FIX, stamp_ns=NOW + 250 * MS)),
    Bad(Refusal.FUTURE, IN_SIGHTINGS, saw(NOW + SECOND)),
    Bad(Refusal.FUTURE, IN_FRAME, Frame(NOW + SECOND, b"jpeg")),
    Bad(Refusal.DURATION, IN_ODOMETRY, standing(NOW, NOW)),
    Bad(Refusal.UNKNOWN_ROBOT, topics.FIX.at(robot="me", tier=2, observer="ghost"), FIX),
    Bad(Refusal.OWN, topics.FIX.at(robot="me", tier=2, observer="me"), FIX),
    Bad("too_late", FIX_KEY, changed(FIX, stamp_ns=NOW - HORIZON_NS - SECOND)),
]


def test_every_reason_to_refuse_a_payload_has_a_case() -> None:
    of_others = {Refusal.NOT_ITS_OWN}  # inputs name no robot; whoever listens to a team meets it
    assert set(Refusal) - of_others == {b.reason for b in BAD if isinstance(b.reason, Refusal)}


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: f"{bad.reason} on {bad.key}")
def test_a_bad_payload_is_counted_and_changes_nothing_else(bad: Bad) -> None:
    with_it, without = only_me(), only_me()
    with_it.put(bad.key, bad.payload)
    if isinstance(bad.payload, Sightings) and bad.reason == "not_finite":  # a frame is a frame
        without.put(bad.key, saw(bad.payload.stamp_ns))
    for stand in (with_it, without):
        stand.put(FIX_KEY, FIX)
        stand.stand_still(0.2)
        look(stand)
        stand.stand_still(0.3)
    assert estimate(with_it) == estimate(without)
    assert estimate(with_it) != estimate(only_me())
    counts = [stand.status("me").counts for stand in (with_it, without)]
    assert counts[0] == {**counts[1], bad.reason: 1}


@pytest.mark.parametrize(
    ("key", "message", "also"),
    [
        (FIX_KEY, FIX, []),
        (BELIEF_KEY, BELIEF, []),
        (IN_ODOMETRY, Odometry(NOW, NOW + 100 * MS, 0.1, 0.0), ["odometry"]),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", 4.0, 0.0)), ["sightings"]),
        (IN_POSITION, POSITION, ["position"]),
    ],
    ids=lambda part: type(part).__name__,
)
def test_a_duplicate_is_counted_and_changes_nothing_else(
    key: str, message: Message, also: list[str]
) -> None:
    once, twice = only_me(), only_me()
    for stand, repeats in ((once, 1), (twice, 2)):
        for _ in range(repeats):
            stand.put(key, message)
        stand.step()
    assert estimate(twice) == estimate(once)
    counts = once.robots["me"].counts
    more = {kind: counts[kind] + 1 for kind in also}
    assert twice.robots["me"].counts == {**counts, "duplicate": 1, **more}


def test_a_duplicate_frame_does_not_repeat_its_fixes() -> None:
    stand = helper(least_value=0.0)
    exchange(stand, 1.0)
    ear = stand.ear(topics.FIX.at(robot="mate"))
    stand.stand_still(0.1)
    for _ in range(2):
        look(stand)
    assert len(ear.messages) == 1


FINITE = st.floats(allow_nan=False, allow_infinity=False)
HUGE, TINY = 1e200, 1e-200


@pytest.mark.parametrize(
    ("key", "message"),
    [
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", HUGE))),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", HUGE, 0.0))),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", 4.0, 0.0, TINY, TINY))),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", 4.0, 0.0, HUGE, HUGE))),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", TINY, 0.0))),
        (IN_ODOMETRY, Odometry(NOW, NOW + 50 * MS, HUGE, 0.0)),
        (IN_ODOMETRY, Odometry(NOW, NOW + 50 * MS, 0.1, HUGE)),
        (FIX_KEY, changed(FIX, x_m=HUGE)),
        (FIX_KEY, changed(FIX, sensor_covariance=(0.0,) * 3, observer_covariance=(0.0,) * 3)),
        (FIX_KEY, changed(FIX, sensor_covariance=(HUGE, 0.0, HUGE))),
        (IN_POSITION, changed(POSITION, x_m=HUGE)),
        (IN_POSITION, changed(POSITION, covariance=(0.0, 0.0, 0.0))),
        (IN_POSITION, changed(POSITION, covariance=(HUGE, 0.0, HUGE))),
        (BELIEF_KEY, changed(BELIEF, x_m=HUGE)),
        (BELIEF_KEY, changed(BELIEF, speed_m_s=HUGE)),
        (BELIEF_KEY, changed(BELIEF, heading_rad=1.7e308, turn_rate_rad_s=1.7e308)),
        (BELIEF_KEY, changed(BELIEF, covariance=(HUGE, 0.0, HUGE, 0.0, 0.0, HUGE))),
        (BELIEF_KEY, changed(BELIEF, speed_m_s=1.0, covariance=(0.01, 0, 0.01, -1.0, 0, 0.01))),
    ],
    ids=[
        "range",
        "range with bearing",
        "tiny sigmas",
        "huge sigmas",
        "tiny range",
        "distance",
        "turn",
        "fix far away",
        "fix without a covariance",
        "fix of no worth",
        "position far away",
        "position without a covariance",
        "position of no worth",
        "belief far away",
        "belief at a huge speed",
        "belief turning",
        "belief of no worth",
        "belief with an impossible covariance",
    ],
)
def test_an_extreme_number_stops_no_robot(key: str, message: Message) -> None:
    stand = only_me()
    stand.put(key, message)
    stand.now_ns += 50 * MS
    stand.sightings("me", saw(stand.now_ns, MATE_SEEN, Sighting("oak", 4.0, 0.0)))
    stand.step()
    stand.stand_still(0.5)
    pose, covariance, _ = estimate(stand)
    assert all(math.isfinite(n) for n in (*pose, *covariance))
    assert min(covariance.xx, covariance.yy, covariance.hh) >= 0.0


VARIANCE = st.floats(0.0, allow_infinity=False)
NONE = st.just(0.0)
AT_NOW, FROM_MATE = st.just(NOW), st.just("mate")
PLANE = st.tuples(VARIANCE, NONE, VARIANCE)


@examples(150)
@given(
    st.one_of(
        st.tuples(
            st.just(IN_ODOMETRY),
            st.builds(Odometry, AT_NOW, st.just(NOW + 50 * MS), FINITE, FINITE),
        ),
        st.tuples(
            st.just(IN_SIGHTINGS),
            st.builds(
                lambda *seen: saw(NOW, Sighting(*seen)),
                st.sampled_from(["oak", "mate"]),
                *[FINITE | st.none()] * 4,
            ),
        ),
        st.tuples(st.just(IN_POSITION), st.builds(Position, AT_NOW, FINITE, FINITE, PLANE)),
        st.tuples(
            st.just(FIX_KEY),
            st.builds(Fix, st.just("me"), FROM_MATE, AT_NOW, FINITE, FINITE, PLANE, PLANE),
        ),
        st.tuples(
            st.just(BELIEF_KEY),
            st.builds(
                Belief,
                FROM_MATE,
                AT_NOW,
                *[FINITE] * 3,
                st.tuples(VARIANCE, NONE, VARIANCE, NONE, NONE, VARIANCE),
                FINITE,
                FINITE,
            ),
        ),
    )
)
def test_no_finite_numbers_raise(keyed: tuple[str, Message]) -> None:
    stand = TeamOnBus(two_robots(), here=["me"])
    stand.now_ns = NOW
    stand.odometry("me", standing(NOW))
    stand.step()
    stand.put(*keyed)
    stand.now_ns += 100 * MS
    stand.sightings("me", saw(stand.now_ns, MATE_SEEN, Sighting("oak", 4.0, 0.0)))
    stand.step()
    assert stand.nodes["me"].next_ns > NOW


def test_of_frames_only_the_latest_is_kept() -> None:
    stand = only_me()
    for n in range(5):
        stand.put(IN_FRAME, Frame(NOW - n, b"jpeg"))
        stand.put(IN_FRAME, b"garbage")
    stand.put(IN_FRAME, Frame(NOW, b"jpeg"))
    stand.step()
    assert stand.nodes["me"].counts["frame_skipped"] == 10
    assert Refusal.VERSION not in stand.nodes["me"].counts
    assert stand.robots["me"].counts["no_camera"] == 1


def test_a_full_inbox_drops_the_oldest_and_counts_it() -> None:
    stand = only_me()
    for _ in range(INBOX + 3):
        stand.put(FIX_KEY, b"")
    stand.step()
    assert +stand.nodes["me"].counts == {"inbox_overflow": 3, Refusal.EMPTY: INBOX}


def test_news_of_teammates_that_do_not_fit_are_counted() -> None:
    stand = only_me()
    for _ in range(INBOX // 2 + 2):  # each comes and goes
        stand.announce("mate", 2).close()
    stand.step()
    assert +stand.nodes["me"].counts == {"news_overflow": 4}


def test_a_step_ends_although_more_and_more_arrives(monkeypatch: pytest.MonkeyPatch) -> None:
    stand, answered = only_me(), 0
    robot = stand.robots["me"]
    handle = robot.handle

    def answered_at_once(message: Any, now_ns: int) -> list[Message]:
        nonlocal answered
        if isinstance(message, Position) and answered < 100:
            answered += 1
            stand.put(IN_POSITION, POSITION)
        return handle(message, now_ns)

    monkeypatch.setattr(robot, "handle", answered_at_once)
    stand.put(IN_POSITION, POSITION)
    for steps in (1, 2):
        stand.nodes["me"].step(stand.now_ns)
        assert answered == steps


def test_what_threads_of_the_bus_count_is_read_while_they_count() -> None:
    """No entry is added under the reader, and what never happened is not reported."""
    stand = only_me()
    counts = stand.nodes["me"].counts
    entries = set(counts)
    for _ in range(INBOX + 1):
        stand.put(IN_FRAME, b"")
        stand.put(IN_POSITION, b"")
        stand.announce("mate", 2).close()
    stand.bus.declare_token(topics.ALIVE.at(tier=0, robot="me", incarnation="2"))
    assert set(counts) == entries
    assert min(+counts[name] for name in entries) > 0
    assert 0 not in only_me().status("me").counts.values()


# Status -----------------------------------------------------------------------------------------


def test_status_comes_once_a_second() -> None:
    stand = TeamOnBus(two_robots(), here=["me"])
    ear = stand.ear(topics.STATUS.at(robot="me"))
    stand.stand_still(5.0)
    stamps = [getattr(m, "stamp_ns", None) for m in ear.messages]
    assert stamps == [n * SECOND for n in (1, 2, 3, 4, 5)]


def test_status_tells_quality_and_traffic() -> None:
    stand = TeamOnBus(two_robots(active=False))
    exchange(stand)
    mine, mates = stand.statuses().values()
    assert mine.tier == tier(stand, "me") > mates.tier == tier(stand, "mate")
    assert mine.position_sigma_m == estimate(stand).position_sigma_m
    assert mine.lost == ""
    assert mates.messages_sent == mine.messages_received > 1
    assert mates.bytes_sent == mine.bytes_received
    assert mine.bytes_received == sent_bytes(BELIEF_BYTES) * mine.messages_received
    (said,), (heard,) = mates.sent, mine.heard
    assert (said.topic, said.peer, heard.topic, heard.peer) == ("belief", "", "belief", "mate")
    assert (said.messages, said.bytes) == (mates.messages_sent, mates.bytes_sent)
    assert said.latest_ns == heard.latest_ns
    assert said.silent > 0


# Who hears whom ---------------------------------------------------------------------------------


def exchange(stand: TeamOnBus, seconds: float = 2.0) -> None:
    """Both robots stand and see each other at 5 Hz."""
    for _ in range(round(5 * seconds)):
        stand.stand_still(0.2)
        look(stand)


def helper(**rules: Any) -> TeamOnBus:
    """The robot `me`, which is good; the test plays its mate, which is poor."""
    stand = TeamOnBus(two_robots(GOOD, POOR, **rules), here=["me"])
    stand.announce("mate", tier_of(POOR, math.sqrt(2.0)))
    return stand


def test_nothing_is_sent_uphill() -> None:
    stand = TeamOnBus(two_robots())
    exchange(stand)
    worse, better = stand.statuses().values()
    assert better.heard == worse.sent == ()
    assert {flow.topic for flow in better.sent} == {"belief", "fix"}
    assert worse.messages_received == better.messages_sent > 2


def test_robots_of_the_same_tier_tell_each_other_nothing() -> None:
    stand = TeamOnBus(two_robots(GOOD, GOOD))
    exchange(stand)
    assert [(s.sent, s.heard) for s in stand.statuses().values()] == [((), ())] * 2


def test_both_ways_sends_uphill_too() -> None:
    stand = TeamOnBus(two_robots(direction="both-ways", least_value=0.0, least_use=0.0))
    exchange(stand)
    for status in stand.statuses().values():
        assert {flow.topic for flow in status.heard if flow.messages} == {"belief", "fix"}


def test_a_budget_is_not_spent_on_what_nobody_hears() -> None:
    stand = helper(budget=BudgetSettings(messages_per_minute=1.0, urgent_share=0.0))
    exchange(stand)
    ear = stand.ear(topics.FIX.at(robot="mate"))
    exchange(stand)
    assert len(ear.messages) == 1
    (spending,) = stand.status("me").spending
    assert (spending.most, spending.allowed) == (1.0, 1.0)


def test_only_teammates_in_sight_are_listened_to() -> None:
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
def test_a_lost_robot_tells_teammates_nothing(known: bool) -> None:
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


# Change of tier ---------------------------------------------------------------------------------


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


def test_a_belief_is_said_under_the_tier_of_its_own_sigma() -> None:
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


def test_a_robot_that_has_become_better_no_longer_listens_to_its_equals() -> None:
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


def test_a_robot_listens_no_more_to_a_teammate_that_is_gone() -> None:
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


# What was told may come back ---------------------------------------------------------------------


def test_nothing_is_shared_while_nobody_listens() -> None:
    stand = helper()
    stand.ear(topics.TRACK.at(robot="me"))
    exchange(stand)
    assert estimate(stand).shared == ZERO3


@pytest.mark.parametrize("topic", [topics.BELIEF, topics.FIX], ids=lambda t: t.key)
def test_all_is_shared_once_help_was_really_sent(topic: topics.Topic) -> None:
    stand = helper(least_value=0.0)
    exchange(stand)
    assert estimate(stand).shared == ZERO3
    ear = stand.ear(topic.at())
    exchange(stand)
    assert ear.messages
    assert estimate(stand).shared == estimate(stand).covariance


def test_a_listener_shares_only_what_it_has_used() -> None:
    stand = TeamOnBus(two_robots(passive=True, active=False))
    stand.stand_still(0.5)
    stand.sightings("me", saw(stand.now_ns, Sighting("mate", 40.0, 0.0)))  # the gate rejects it
    stand.stand_still(0.5)
    assert stand.status("me").messages_received > 0
    assert estimate(stand, "me").shared == ZERO3
    exchange(stand)
    assert estimate(stand, "me").shared != ZERO3


# The same name twice ----------------------------------------------------------------------------


def test_a_second_robot_of_the_same_name_is_counted() -> None:
    stand = only_me()
    assert "same_name_twice" not in stand.status("me").counts
    team = stand.team
    twin = Node(build_robot("me", team, 0), team, stand.hub.session(), 0, incarnation="2")
    stand.odometry("me", standing(stand.now_ns))
    twin.step(stand.now_ns)
    assert stand.status("me").counts["same_name_twice"] == 1
    assert twin.counts["same_name_twice"] == 1


def test_arrivals_wake_the_robots_own_loop() -> None:
    woken: list[bool] = []
    stand = TeamOnBus(two_robots(), here=[])
    node = Node(
        build_robot("me", stand.team, 0),
        stand.team,
        stand.hub.session(),
        0,
        "1",
        on_arrival=lambda: woken.append(node.waiting),
    )
    stand.odometry("me", standing(100 * MS))
    assert woken == [True]
    node.step(100 * MS)
    assert not node.waiting


def test_the_status_of_a_robot_that_learns_says_what() -> None:
    learning = LocalizerSettings(self_calibration=True)
    stand = TeamOnBus(with_robot(two_robots(), "me", localizer=learning))
    for robot in stand.robots.values():
        timeline = robot.filter.timeline
        calibration = CalibrationMemory(Learned(0.98, 0.96, 0.01))
        memory = timeline.state.memory._replace(calibration=calibration)
        timeline.state = timeline.state._replace(memory=memory)
    assert stand.status("me").learned == (0.98, 0.96, 0.01)
    assert stand.status("mate").learned is None
