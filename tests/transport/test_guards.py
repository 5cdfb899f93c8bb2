"""What a router lets in from one robot: the rules, and a real flood beside a healthy robot."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest
import zenoh
from msgspec.structs import replace
from support.buses import Subscription, robot_at, team_of, wait_until
from support.routers import open_router

from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import GuardSettings, Team, TransportSettings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import LARGEST_FRAME, LARGEST_PAYLOAD
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import open_bus
from cpcbl_transport.zenoh_config import guard_rules

FIX = topics.FIX.at(robot="victim", tier=7, observer="faulty")
TOO_SELDOM_HZ, ANY_RATE_HZ = 0.01, 1e9


def guarded(**guards: Any) -> Team:
    team = team_of(victim=robot_at(), healthy=robot_at(), faulty=robot_at())
    return replace(team, transport=TransportSettings(guards=GuardSettings(**guards)))


# The rules --------------------------------------------------------------------------------------


def rates(rules: dict[str, Any]) -> dict[str, float]:
    return {rule["key_expr"]: rule["freq"] for rule in rules["downsampling"][0]["rules"]}


def limits(rules: dict[str, Any]) -> dict[str, int]:
    return {key: one["size_limit"] for one in rules["low_pass_filter"] for key in one["key_exprs"]}


def test_every_target_and_beliefs_have_a_rate_and_every_key_a_size() -> None:
    rates_hz: dict[str, Any] = {"fix_rate_hz": 30.0, "belief_rate_hz": 20.0, "frame_rate_hz": 60.0}
    team = guarded(**rates_hz, largest_help_bytes=99, largest_bytes=999, largest_frame_bytes=99_999)
    rules = guard_rules(team)
    assert rates(rules) == {
        "cpcbl/tests/fix/victim/*/*": 30.0,
        "cpcbl/tests/fix/healthy/*/*": 30.0,
        "cpcbl/tests/fix/faulty/*/*": 30.0,
        "cpcbl/tests/belief/*/*": 20.0,
        "cpcbl/tests/landmark/*/*/*": 20.0,
        "cpcbl/tests/in/victim/frame": 60.0,
        "cpcbl/tests/in/healthy/frame": 60.0,
        "cpcbl/tests/in/faulty/frame": 60.0,
    }
    assert limits(rules) == {
        "cpcbl/tests/fix/*/*/*": 99,
        "cpcbl/tests/belief/*/*": 99,
        "cpcbl/tests/landmark/*/*/*": 99,
        "cpcbl/tests/status/*": 999,
        "cpcbl/tests/track/*": 999,
        "cpcbl/tests/pose/*": 999,
        "cpcbl/tests/in/*/odometry": 999,
        "cpcbl/tests/in/*/sightings": 999,
        "cpcbl/tests/in/*/position": 999,
        "cpcbl/tests/in/*/initial_pose": 999,
        "cpcbl/tests/in/*/frame": 99_999,
        "cpcbl/tests/look/*": 99_999,
        "cpcbl/tests/field/drive/*": 999,
        "cpcbl/tests/field/join/*": 999,
        "cpcbl/tests/field/truth": 999,
        "cpcbl/tests/**": 99_999,
    }


def test_guards_can_be_off() -> None:
    assert guard_rules(guarded(enabled=False)) == {}


@pytest.mark.parametrize(("speed", "factor"), [(0.5, 1.0), (1.0, 1.0), (10.0, 10.0)])
def test_a_run_that_is_faster_than_real_time_may_send_more_often(
    speed: float, factor: float
) -> None:
    slow = rates(guard_rules(guarded()))
    assert rates(guard_rules(guarded(), speed)) == {k: factor * hz for k, hz in slow.items()}


def test_rules_of_rate_do_not_overlap() -> None:
    keys = [zenoh.KeyExpr(key) for key in rates(guard_rules(guarded()))]
    assert not [(a, b) for a in keys for b in keys if a is not b and a.intersects(b)]


def test_by_default_what_robots_would_take_is_let_in() -> None:
    for topic in topics.TOPICS:
        if topic.carries not in (None, *topics.COLLABORATION):
            assert limits(guard_rules(guarded()))[f"cpcbl/tests/{topic.at()}"] == topic.largest


# Over a real router -----------------------------------------------------------------------------


class Sessions(NamedTuple):
    """Three robots' sessions, and what the victim hears."""

    faulty: Bus
    healthy: Bus
    fixes: Subscription
    beliefs: Subscription
    inputs: Subscription


@contextmanager
def three_robots(team: Team) -> Iterator[Sessions]:
    endpoint = free_endpoint()
    with (
        open_router(team.name, [endpoint], guards=guard_rules(team)),
        open_bus(team.name, [endpoint]) as faulty,
        open_bus(team.name, [endpoint]) as healthy,
        open_bus(team.name, [endpoint]) as victim,
    ):
        ears = [
            Subscription(victim, keys) for keys in ("fix/victim/7/*", "belief/7/*", "in/victim/*")
        ]
        yield Sessions(faulty, healthy, *ears)


def put(bus: Bus, key: str, *payloads: bytes, qos: Qos = Qos.INPUT) -> None:
    publisher = bus.publisher(key, qos)
    wait_until(lambda: publisher.matching)
    for payload in payloads:
        publisher.put(payload)


def last_of(bus: Bus, ear: Subscription, robot: str = "victim") -> None:
    """Returns when what this session put before has been delivered, or dropped."""
    before = ear.payloads.count(b"last")
    put(bus, topics.IN_POSITION.at(robot=robot), b"last")
    wait_until(lambda: ear.payloads.count(b"last") > before)


def by(observer: str, ear: Subscription) -> list[bytes]:
    return [payload for key, payload in ear.samples if key.endswith("/" + observer)]


class Flood:
    """Puts on a fix key as fast as it can, on a thread of its own; every 500th is 1 MB."""

    def __init__(self, bus: Bus) -> None:
        self.count = 0
        self._publisher = bus.publisher(FIX, Qos.FRESH)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._stop.is_set():
            self._publisher.put(bytes(1_000_000 if self.count % 500 == 499 else 34))
            self.count += 1

    def __enter__(self) -> "Flood":
        wait_until(lambda: self._publisher.matching)
        self.from_s = time.monotonic()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def test_a_flood_is_limited_and_all_messages_of_the_healthy_robot_arrive() -> None:
    rate_hz = 50.0
    healthy_fix = topics.FIX.at(robot="victim", tier=7, observer="healthy")
    sent = [n.to_bytes(34, "big") for n in range(40)]
    with three_robots(guarded(fix_rate_hz=rate_hz)) as robots:
        publisher = robots.healthy.publisher(healthy_fix, Qos.FRESH)
        wait_until(lambda: publisher.matching)
        with Flood(robots.faulty) as flood:
            wait_until(lambda: flood.count > 1000)
            for n, payload in enumerate(sent):
                publisher.put(payload)
                wait_until(lambda n=n: len(by("healthy", robots.fixes)) > n)  # type: ignore[misc]
                time.sleep(1.2 / rate_hz)
        last_of(robots.faulty, robots.inputs)
        seconds = time.monotonic() - flood.from_s
    flooded = by("faulty", robots.fixes)
    assert by("healthy", robots.fixes) == sent
    assert 0 < len(flooded) <= seconds * rate_hz + 1
    assert {len(payload) for payload in flooded} == {34}
    assert flood.count > 10 * len(flooded)


def test_without_guards_the_same_flood_comes_through() -> None:
    with three_robots(guarded(enabled=False)) as robots, Flood(robots.faulty):
        wait_until(lambda: len(robots.fixes.samples) > 1000)
        wait_until(lambda: bytes(1_000_000) in robots.fixes.payloads)


def test_what_is_sent_at_once_has_a_rate_for_each_target_and_each_robot() -> None:
    rare = guarded(fix_rate_hz=TOO_SELDOM_HZ, belief_rate_hz=TOO_SELDOM_HZ)
    with three_robots(rare) as robots:
        others = Subscription(robots.healthy, "fix/healthy/7/*")
        for observer, bus in (("faulty", robots.faulty), ("healthy", robots.healthy)):
            put(bus, topics.FIX.at(robot="victim", tier=7, observer=observer), b"1", b"2")
            put(bus, topics.FIX.at(robot="victim", tier=7, observer=observer), b"3")
            put(bus, topics.BELIEF.at(tier=7, robot=observer), b"4", b"5")
        put(robots.faulty, "fix/healthy/7/faulty", b"6", b"7")
        for bus in (robots.faulty, robots.healthy):
            last_of(bus, robots.inputs)
        wait_until(lambda: bool(others.samples))
        for ear in (robots.fixes, robots.beliefs):
            wait_until(lambda ear=ear: len(ear.samples) >= 2)  # type: ignore[misc]
    for observer in ("faulty", "healthy"):
        assert by(observer, robots.fixes) == [b"1"]
        assert by(observer, robots.beliefs) == [b"4"]
    assert others.payloads == [b"6"]


def test_what_is_too_large_is_not_let_in() -> None:
    belief = topics.BELIEF.at(tier=7, robot="faulty")
    odometry = topics.IN_ODOMETRY.at(robot="victim")
    frame = topics.IN_FRAME.at(robot="victim")
    small, largest, largest_frame = bytes(256), bytes(LARGEST_PAYLOAD), bytes(LARGEST_FRAME)
    with three_robots(guarded(belief_rate_hz=ANY_RATE_HZ, frame_rate_hz=ANY_RATE_HZ)) as robots:
        put(robots.faulty, belief, bytes(1_000_000), bytes(257), small)
        put(robots.faulty, odometry, bytes(1_000_000), bytes(LARGEST_PAYLOAD + 1), largest)
        put(robots.faulty, frame, bytes(LARGEST_FRAME + 1), largest_frame)
        # the router drops what would wait behind megabytes for a victim that is busy
        wait_until(lambda: largest_frame in robots.inputs.payloads)
        last_of(robots.faulty, robots.inputs)
        wait_until(lambda: bool(robots.beliefs.samples))
    assert robots.beliefs.payloads == [small]
    assert robots.inputs.payloads == [largest, largest_frame, b"last"]


def test_images_have_a_rate_for_each_robot() -> None:
    images = [topics.IN_FRAME.at(robot=name) for name in ("victim", "healthy")]
    with three_robots(guarded(frame_rate_hz=TOO_SELDOM_HZ)) as robots:
        other = Subscription(robots.healthy, "in/healthy/*")
        for key in images:
            put(robots.faulty, key, b"1", b"2")
        last_of(robots.faulty, robots.inputs)
        last_of(robots.faulty, other, "healthy")
    assert robots.inputs.payloads == other.payloads == [b"1", b"last"]


def test_other_inputs_are_let_in_as_they_come() -> None:
    sent = [n.to_bytes(20, "big") for n in range(2000)]
    with three_robots(guarded()) as robots:
        put(robots.faulty, topics.IN_ODOMETRY.at(robot="victim"), *sent)
        last_of(robots.faulty, robots.inputs)
    assert robots.inputs.payloads == [*sent, b"last"]
