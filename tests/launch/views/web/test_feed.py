"""What is kept of a team on the bus in memory, and what is subscribed to meanwhile."""

from collections.abc import Iterator
from typing import NamedTuple

import pytest
from support.buses import MS, SECOND
from support.traffic import status

from cpcbl_launch.views.web import feed as feeds
from cpcbl_launch.views.web.feed import Feed, TruthAt, pose_at
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import AnnotatedFrame, Tagged, Track, Truth, Truths, encode
from cpcbl_transport.topics import Topic


class Stand(NamedTuple):
    """A feed, and a session of the robots."""

    feed: Feed
    robots: Bus

    def put(self, topic: Topic, robot: str, message: Tagged) -> None:
        self.robots.publisher(topic.at(robot=robot), topic.qos).put(encode(message))

    def is_wanted(self, topic: Topic, robot: str) -> bool:
        return self.robots.publisher(topic.at(robot=robot), topic.qos).matching

    def error_m(self, robot: str) -> float | None:
        return self.feed.snapshot().robots[robot].error_m


@pytest.fixture
def stand() -> Iterator[Stand]:
    hub, now_s = MemoryHub(), iter(range(1, 10_000))
    feed = Feed(["r1", "r2"], lambda: float(next(now_s)))
    with feed.attach(hub.session()):
        yield Stand(feed, hub.session())


def track(stamp_ns: int, x_m: float, robot: str = "r1") -> Track:
    return Track(robot, stamp_ns, x_m, 0.0, 0.0, None, 3)


def truths(stamp_ns: int, x_m: float) -> Truths:
    return Truths(stamp_ns, (Truth("r1", x_m, 0.0, 0.0),))


def test_sightings_and_cameras_are_subscribed_to_only_while_somebody_watches(stand: Stand) -> None:
    assert stand.is_wanted(topics.TRACK, "r1")

    def wanted() -> list[bool]:
        return [stand.is_wanted(topic, "r1") for topic in (topics.IN_SIGHTINGS, topics.LOOK)]

    assert wanted() == [False, False]
    stand.feed.watch(1)
    stand.feed.watch(1)
    stand.feed.watch_camera("r1", 1)
    assert wanted() == [True, True]
    assert not stand.is_wanted(topics.LOOK, "r2")
    stand.put(topics.LOOK, "r1", AnnotatedFrame("r1", 5, b"jpeg", (Sighting("door", 1.0),)))
    found = stand.feed.frame("r1")
    assert found is not None
    assert found.image == b"jpeg"
    seen = stand.feed.snapshot().robots["r1"].sightings
    assert seen is not None
    assert seen.sightings[0].id == "door"
    stand.feed.watch_camera("r1", -1)
    assert stand.feed.frame("r1") is None
    stand.feed.watch(-1)
    assert wanted() == [True, False]
    stand.feed.watch(-1)
    assert wanted() == [False, False]


def test_never_subscribes_to_what_robots_would_send_because_of_it(stand: Stand) -> None:
    stand.feed.watch(1)
    assert not stand.robots.publisher("belief/3/r1", topics.BELIEF.qos).matching
    assert not stand.robots.publisher("fix/r1/3/r2", topics.FIX.qos).matching


@pytest.mark.parametrize("is_truth_first", [True, False])
def test_the_error_compares_equal_stamps(stand: Stand, is_truth_first: bool) -> None:
    """The robot drives 1 m/s: the newest truth is elsewhere than the robot was."""
    stand.put(topics.TRUTH, "", truths(1 * SECOND, 1.0))
    if not is_truth_first:
        stand.put(topics.TRACK, "r1", track(1 * SECOND + 500 * MS, 1.6))
        assert stand.error_m("r1") is None
    stand.put(topics.TRUTH, "", truths(2 * SECOND, 2.0))
    stand.put(topics.TRUTH, "", truths(3 * SECOND, 3.0))
    if is_truth_first:
        stand.put(topics.TRACK, "r1", track(1 * SECOND + 500 * MS, 1.6))
    assert stand.error_m("r1") == pytest.approx(0.1)
    assert stand.error_m("r2") is None


def test_a_truth_that_is_always_late_is_compared_too(stand: Stand) -> None:
    for n in range(1, 10):
        stand.put(topics.TRACK, "r1", track(n * SECOND, n + 0.2))
        if n > 3:
            stand.put(topics.TRUTH, "", truths((n - 3) * SECOND, n - 3.0))
    assert stand.error_m("r1") == pytest.approx(0.2)


def test_a_true_pose_between_two_turns_the_short_way() -> None:
    known = [TruthAt(0, {"r": Truth("r", 0.0, 0.0, 3.0)}), TruthAt(10, {"r": Truth("r", 1, 0, -3)})]
    half = pose_at(known, "r", 5)
    assert half is not None
    assert (half.x_m, abs(half.heading_rad)) == pytest.approx((0.5, 3.1416), abs=1e-3)
    assert pose_at(known, "r", 11) is None
    assert pose_at(known, "other", 5) is None
    assert pose_at(known[1:], "r", 5) is None


def test_tokens_say_which_process_is_there(stand: Stand) -> None:
    old = stand.robots.declare_token(topics.ALIVE.at(tier=3, robot="r1", incarnation="a"))
    new = stand.robots.declare_token(topics.ALIVE.at(tier=2, robot="r1", incarnation="a"))
    old.close()
    assert stand.feed.snapshot().robots["r1"].token_lost_s is None
    new.close()
    assert stand.feed.snapshot().robots["r1"].token_lost_s is not None


def test_a_flood_of_names_is_bounded_and_the_teams_own_are_not_touched(stand: Stand) -> None:
    for n in range(feeds.MOST_UNNAMED + 50):
        stand.put(topics.STATUS, f"x{n}", status(f"x{n}", 1.0, 3))
    stand.put(topics.STATUS, "r2", status("r2", 1.0, 3))
    now = stand.feed.snapshot().robots
    assert len(now) == feeds.MOST_UNNAMED + 2
    assert now["r2"].status is not None


def test_the_history_has_two_samples_a_second_and_an_end() -> None:
    hub, now_s = MemoryHub(), [0.0]
    feed, robots = Feed(["r1"], lambda: now_s[0]), hub.session()
    with feed.attach(hub.session()):
        for n in range(5000):
            now_s[0] = 0.1 * n
            robots.publisher("track/r1", topics.TRACK.qos).put(encode(track(n * 100 * MS, 0.1 * n)))
    samples = feed.history()["r1"]
    assert len(samples) == feeds.HISTORY_S / feeds.HISTORY_STEP_S
    assert samples[-1].at_s - samples[-2].at_s == pytest.approx(0.5)


def test_garbage_and_foreign_names_change_nothing(stand: Stand) -> None:
    before = stand.feed.snapshot()
    for key in ("track/r1", "status/r1", "field/truth", "in/r1/sightings"):
        stand.robots.publisher(key, topics.TRACK.qos).put(b"garbage")
    stand.put(topics.TRACK, "r2", track(SECOND, 1.0, "r1"))
    stand.put(topics.IN_SIGHTINGS, "stranger", Sightings(1, ()))
    assert stand.feed.snapshot() == before


def test_a_feed_that_is_detached_subscribes_to_nothing() -> None:
    hub = MemoryHub()
    feed, robots = Feed(["r1"]), hub.session()
    feed.watch(1)  # before there is a bus
    publisher = robots.publisher("in/r1/sightings", topics.IN_SIGHTINGS.qos)
    with feed.attach(hub.session()):
        assert publisher.matching
    assert not publisher.matching
    feed.watch_camera("r1", 1)
    assert not robots.publisher("look/r1", topics.LOOK.qos).matching
