"""One contract for every bus: what holds in memory holds over Zenoh."""

import gc
import weakref
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import count
from typing import NamedTuple

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from support.buses import Subscription, examples, matches, wait_until
from support.routers import open_router

from cpcbl_launch.run.up import free_endpoint
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import BusError, open_bus

RELIABLE = Qos.INPUT


class Pair(NamedTuple):
    """Two sessions that can hear each other."""

    one: Bus
    other: Bus


@contextmanager
def in_memory() -> Iterator[Pair]:
    hub = MemoryHub()
    with hub.session() as one, hub.session() as other:
        yield Pair(one, other)


@contextmanager
def two_clients() -> Iterator[Pair]:
    endpoint = free_endpoint()
    with (
        open_router("tests", [endpoint]),
        open_bus("tests", [endpoint]) as one,
        open_bus("tests", [endpoint]) as other,
    ):
        yield Pair(one, other)


@contextmanager
def client_and_router() -> Iterator[Pair]:
    endpoint = free_endpoint()
    with open_router("tests", [endpoint]) as router, open_bus("tests", [endpoint]) as client:
        yield Pair(client, router)


@pytest.fixture(params=[in_memory, two_clients, client_and_router], ids=lambda f: f.__name__)
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    opened: Callable[[], AbstractContextManager[Pair]] = request.param
    with opened() as sessions:
        yield sessions


class Watched:
    """What a watcher was told, in order."""

    def __init__(self, bus: Bus, keys: str) -> None:
        self.events: list[tuple[str, bool]] = []
        self._handle = bus.watch_liveliness(
            keys, lambda key, alive: self.events.append((key, alive))
        )

    def close(self) -> None:
        self._handle.close()


MARKS = count()


def settle(pair: Pair) -> None:
    """Returns when `one` knows all that `other` has declared and taken back."""
    mark = f"mark/{next(MARKS)}"
    handle, publisher = Subscription(pair.other, mark), pair.one.publisher(mark, RELIABLE)
    wait_until(lambda: publisher.matching)
    publisher.close()
    handle.close()


def deliver(pair: Pair, key: str, payload: bytes = b"?") -> None:
    settle(pair)
    pair.one.publisher(key, RELIABLE).put(payload)


# Delivery ---------------------------------------------------------------------------------------

KEY = "belief/3/r1"
INCLUDING = (KEY, "belief/*/r1", "belief/3/*", "*/*/*", "belief/**", "**", f"{KEY}/**")
EXCLUDING = ("belief/4/r1", "belief/*", "fix/**", "belief/*/r2", "*", "belief/3/r1/*")


def test_a_message_reaches_the_subscriptions_that_include_its_key_and_no_other(pair: Pair) -> None:
    excluding = [Subscription(pair.other, keys) for keys in EXCLUDING]
    including = [Subscription(pair.other, keys) for keys in INCLUDING]
    deliver(pair, KEY, b"here")
    wait_until(lambda: all(ear.samples for ear in including))
    assert [ear.samples for ear in including] == [[(KEY, b"here")]] * len(INCLUDING)
    assert [ear.samples for ear in excluding] == [[]] * len(EXCLUDING)


def test_a_session_does_not_receive_its_own_messages(pair: Pair) -> None:
    own, others = Subscription(pair.one, "a/*"), Subscription(pair.other, "a/*")
    deliver(pair, "a/one", b"from one")
    deliver(Pair(pair.other, pair.one), "a/other", b"from other")
    wait_until(lambda: bool(own.samples and others.samples))
    assert own.payloads == [b"from other"]
    assert others.payloads == [b"from one"]


def test_payloads_arrive_unchanged_and_in_order(pair: Pair) -> None:
    ear = Subscription(pair.other, "a/*")
    sent = [b"", b"\x00", bytes(range(256)) * 234, *(n.to_bytes(2, "big") for n in range(1000))]
    publisher = pair.one.publisher("a/b", RELIABLE)
    wait_until(lambda: publisher.matching)
    for payload in sent:
        publisher.put(payload)
    wait_until(lambda: len(ear.samples) >= len(sent))
    assert ear.payloads == sent


# Matching and closing ---------------------------------------------------------------------------


def test_matching_is_whether_there_is_a_subscriber(pair: Pair) -> None:
    publisher = pair.one.publisher("a/b", RELIABLE)
    assert not publisher.matching
    ear = Subscription(pair.other, "a/*")
    wait_until(lambda: publisher.matching)
    ear.close()
    wait_until(lambda: not publisher.matching)


def test_the_publishers_own_session_and_other_keys_do_not_match(pair: Pair) -> None:
    Subscription(pair.one, "a/b")
    Subscription(pair.other, "a/c")
    asked, witness = pair.one.publisher("a/b", RELIABLE), pair.one.publisher("a/c", RELIABLE)
    wait_until(lambda: witness.matching)
    assert not asked.matching


def test_a_closed_subscription_receives_nothing_more(pair: Pair) -> None:
    closed, witness = Subscription(pair.other, "a/*"), Subscription(pair.other, "a/b")
    closed.close()
    deliver(pair, "a/b")
    wait_until(lambda: bool(witness.samples))
    assert closed.samples == []


def test_a_closed_publisher_publishes_nothing_more(pair: Pair) -> None:
    ear = Subscription(pair.other, "a/b")
    publisher = pair.one.publisher("a/b", RELIABLE)
    wait_until(lambda: publisher.matching)
    publisher.close()
    publisher.put(b"too late")
    assert not publisher.matching
    deliver(pair, "a/b", b"last")
    wait_until(lambda: bool(ear.samples))
    assert ear.payloads == [b"last"]


def test_a_closed_session_publishes_nothing_more(pair: Pair) -> None:
    ear = Subscription(pair.other, "a/b")
    publisher = pair.one.publisher("a/b", RELIABLE)
    wait_until(lambda: publisher.matching)
    pair.one.close()
    publisher.put(b"too late")
    assert not publisher.matching
    assert ear.samples == []


def test_subscriptions_outlive_their_handles(pair: Pair) -> None:
    heard: list[bytes] = []
    pair.other.subscribe("a/b", lambda key, payload: heard.append(payload))
    gc.collect()
    deliver(pair, "a/b")
    wait_until(lambda: bool(heard))


def test_what_is_closed_is_forgotten(pair: Pair) -> None:
    """A robot subscribes anew at each change of a tier, for as long as it runs."""
    declared = [
        pair.one.publisher("a", RELIABLE),
        pair.one.subscribe("a", lambda key, payload: None),
        pair.one.declare_token("a"),
        pair.one.watch_liveliness("a", lambda key, alive: None),
    ]
    kept = [weakref.ref(handle) for handle in declared]
    for handle in declared:
        handle.close()
    del handle, declared
    gc.collect()
    assert [ref() for ref in kept] == [None] * 4


def test_closing_a_session_ends_its_subscriptions(pair: Pair) -> None:
    Subscription(pair.other, "a/b")
    publisher = pair.one.publisher("a/b", RELIABLE)
    wait_until(lambda: publisher.matching)
    pair.other.close()
    wait_until(lambda: not publisher.matching)


def test_everything_can_be_closed_twice_and_after_its_session(pair: Pair) -> None:
    def declared() -> list[Callable[[], None]]:
        bus = pair.one
        return [
            bus.publisher("a/b", RELIABLE).close,
            bus.subscribe("a/b", lambda key, payload: None).close,
            bus.declare_token("alive/r1").close,
            bus.watch_liveliness("alive/*", lambda key, alive: None).close,
        ]

    for close in (early := declared()):
        close()
    late = declared()
    pair.one.close()
    for close in [*early, *late, pair.one.close]:
        close()
    publisher = pair.other.publisher("a/b", RELIABLE)
    tokens = Watched(pair.other, "alive/*")
    wait_until(lambda: not publisher.matching)
    mark = pair.other.declare_token("alive/r2")
    wait_until(lambda: ("alive/r2", True) in tokens.events)
    mark.close()
    # Its withdrawal may still be on its way when the watcher comes; what counts is the end.
    wait_until(lambda: not dict(tokens.events).get("alive/r1"))


# Liveliness -------------------------------------------------------------------------------------


@pytest.mark.parametrize("watcher_first", [True, False], ids=["watched before", "watched after"])
def test_a_token_is_seen_to_come_and_to_go(pair: Pair, watcher_first: bool) -> None:
    before = Watched(pair.other, "alive/*") if watcher_first else None
    token = pair.one.declare_token("alive/r1")
    watched = before or Watched(pair.other, "alive/*")
    wait_until(lambda: watched.events == [("alive/r1", True)])
    token.close()
    wait_until(lambda: watched.events == [("alive/r1", True), ("alive/r1", False)])


def test_a_token_goes_with_its_session(pair: Pair) -> None:
    watched = Watched(pair.other, "alive/**")
    token = pair.one.declare_token("alive/3/r1/7")
    wait_until(lambda: bool(watched.events))
    pair.one.close()
    wait_until(lambda: watched.events[1:] == [("alive/3/r1/7", False)])
    token.close()


def test_a_token_and_a_watcher_outlive_their_handles(pair: Pair) -> None:
    events: list[tuple[str, bool]] = []
    pair.other.watch_liveliness("alive/*", lambda key, alive: events.append((key, alive)))
    pair.one.declare_token("alive/r1")
    gc.collect()
    witness = pair.one.declare_token("alive/r2")
    wait_until(lambda: ("alive/r2", True) in events)
    witness.close()
    wait_until(lambda: ("alive/r2", False) in events)
    assert [alive for key, alive in events if key == "alive/r1"] == [True]


def test_a_watcher_is_notified_of_its_own_keys_only_and_until_it_is_closed(pair: Pair) -> None:
    other_keys, closed = Watched(pair.other, "alive/r2"), Watched(pair.other, "alive/*")
    witness = Watched(pair.other, "alive/*")
    closed.close()
    token = pair.one.declare_token("alive/r1")
    wait_until(lambda: bool(witness.events))
    token.close()
    assert other_keys.events == []
    assert closed.events == []


# Zenoh ------------------------------------------------------------------------------------------


def test_two_teams_on_one_router_receive_nothing_from_each_other() -> None:
    endpoint = free_endpoint()
    with (
        open_router("red", [endpoint]),
        open_bus("red", [endpoint]) as red,
        open_bus("blue", [endpoint]) as blue,
        open_bus("blue", [endpoint]) as blue_too,
    ):
        ear, alive = Subscription(red, "**"), Watched(red, "**")
        witness, alive_too = Subscription(blue_too, "**"), Watched(blue_too, "**")
        token = blue.declare_token("alive/r1")
        deliver(Pair(blue, blue_too), "a/b")
        wait_until(lambda: bool(witness.samples and alive_too.events))
        token.close()
        assert ear.samples == []
        assert alive.events == []


@pytest.mark.parametrize("tries", [0, 1])
def test_opening_gives_up_when_stopped_and_no_router_is_there(tries: int) -> None:
    endpoint, answers = free_endpoint(), iter([False] * tries + [True])
    with pytest.raises(BusError, match=endpoint):
        open_bus("tests", [endpoint], give_up=lambda: next(answers))


def test_a_client_waits_for_its_router() -> None:
    endpoint = free_endpoint()
    opened: list[AbstractContextManager[Bus]] = []

    def router_comes_late() -> bool:
        if not opened:
            opened.append(open_router("tests", [endpoint]))
        return False

    with open_bus("tests", [endpoint], give_up=router_comes_late) as client, opened[0] as router:
        ear = Subscription(router, "a/b")
        deliver(Pair(client, router), "a/b")
        wait_until(lambda: bool(ear.samples))


def test_a_router_cannot_listen_where_another_does() -> None:
    endpoint = free_endpoint()
    with open_router("tests", [endpoint]), pytest.raises(BusError, match=endpoint):
        open_router("tests", [endpoint])


# Key expressions --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "key", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/c", False),
        ("a/b", "a", False),
        ("a/b", "a/b/c", False),
        ("a/*", "a/b", True),
        ("a/*", "a", False),
        ("a/*", "a/b/c", False),
        ("*/b", "a/b", True),
        ("*", "a", True),
        ("*", "a/b", False),
        ("**", "a/b/c", True),
        ("a/**", "a", True),
        ("a/**", "a/b/c", True),
        ("a/**", "b/a", False),
        ("a/b/**", "a", False),
        ("a/*/**", "a", False),
        ("a/*/**", "a/b", True),
    ],
)
def test_worked_examples_of_key_expressions(keys: str, key: str, expected: bool) -> None:
    assert matches(keys, key) is expected


CHUNK = st.text("abc_-.1", min_size=1, max_size=3)
PATTERN = st.builds(
    lambda chunks, rest: "/".join(chunks + rest),
    st.lists(CHUNK | st.just("*"), min_size=1, max_size=4),
    st.sampled_from([[], ["**"]]),
)


@st.composite
def patterns_and_keys(draw: st.DrawFn) -> tuple[str, str]:
    """A pattern and a key that is made from it."""
    pattern = draw(PATTERN)
    chunks = pattern.split("/")
    rest = draw(st.lists(CHUNK, max_size=3)) if chunks[-1] == "**" else []
    key = [draw(CHUNK) if c == "*" else c for c in chunks if c != "**"] + rest
    return pattern, "/".join(key)


@examples(100)
@given(patterns_and_keys())
def test_a_key_that_is_made_from_a_pattern_matches_it(made: tuple[str, str]) -> None:
    assert matches(*made)


@examples(100)
@given(PATTERN, st.lists(CHUNK, min_size=1, max_size=4).map("/".join))
def test_the_bus_in_memory_reads_keys_as_zenoh_does(pattern: str, key: str) -> None:
    assert matches(pattern, key) is zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(key))
