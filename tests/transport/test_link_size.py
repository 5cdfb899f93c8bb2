"""Bytes on a TCP link, counted by a relay between a real session and its router."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import Subscription, examples, wait_until
from support.routers import open_router
from support.wire_tap import Batch, Kind, Relay, kind_of, most_in_window, put_down, total

from cpcbl_launch.run.up import free_endpoint
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.compact import (
    BELIEF_BYTES,
    FIX_BYTES,
    HEADED_FIX_BYTES,
    received_bytes,
    sent_bytes,
)
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import open_bus

LONG_NAME = "observer-one"


class Links(NamedTuple):
    """Two clients of one router, each behind a relay."""

    sender: Bus
    receiver: Bus
    sent: Relay
    received: Relay


@contextmanager
def two_clients() -> Iterator[Links]:
    endpoint = free_endpoint()
    with (
        open_router("tests", [endpoint]),
        Relay(endpoint) as sent,
        Relay(endpoint) as received,
        open_bus("tests", [sent.endpoint]) as sender,
        open_bus("tests", [received.endpoint]) as receiver,
    ):
        yield Links(sender, receiver, sent, received)


@pytest.fixture
def links() -> Iterator[Links]:
    with two_clients() as opened:
        yield opened


def data(batches: list[Batch]) -> list[Batch]:
    return [batch for batch in batches if batch.kind is Kind.DATA]


def carry(links: Links, key: str, keys: str, payload: bytes, qos: Qos = Qos.FRESH) -> None:
    """One put, from its publisher to a subscription."""
    ear, publisher = Subscription(links.receiver, keys), links.sender.publisher(key, qos)
    wait_until(lambda: publisher.matching)
    publisher.put(payload)
    wait_until(lambda: ear.payloads == [payload])
    publisher.close()
    ear.close()


# The relay --------------------------------------------------------------------------------------


def test_a_put_passes_each_link_once_with_its_bytes(links: Links) -> None:
    payload = bytes(range(40))
    carry(links, "a/b", "a/b", payload)
    for batches in (data(links.sent.up), data(links.received.down)):
        assert [batch.content[-40:] for batch in batches] == [payload]
        assert 42 < batches[0].size <= 60
    assert data(links.sent.down) == data(links.received.up) == []


def test_many_puts_in_shared_batches_are_all_there(links: Links) -> None:
    sent = [f"<{n:038}>".encode() for n in range(1000)]
    ear, publisher = Subscription(links.receiver, "a/b"), links.sender.publisher("a/b", Qos.INPUT)
    wait_until(lambda: publisher.matching)
    for payload in sent:
        publisher.put(payload)
    wait_until(lambda: len(ear.payloads) == len(sent))
    for batches in (data(links.sent.up), data(links.received.down)):
        stream = b"".join(batch.content for batch in batches)
        assert [payload for payload in sent if stream.count(payload) != 1] == []


def test_a_put_that_is_sent_in_fragments_is_data(links: Links) -> None:
    carry(links, "a/b", "a/b", bytes(200_000), Qos.INPUT)
    for batches in (data(links.sent.up), data(links.received.down)):
        assert len(batches) > 1
        assert 200_000 < total(batches) < 200_500


def test_opening_declaring_and_keeping_alive_are_distinguished(links: Links) -> None:
    relay = links.sent
    assert {b.kind for b in relay.up + relay.down} <= {Kind.OTHER, Kind.KEEP_ALIVE}
    assert total(relay.up, Kind.OTHER) > 50
    links.sender.subscribe("c/d", lambda key, payload: None)
    wait_until(lambda: total(relay.up, Kind.DECLARATION) > len("c/d"))
    wait_until(lambda: min(total(b, Kind.KEEP_ALIVE) for b in (relay.up, relay.down)) > 0)
    assert all(b.size == 3 for b in relay.up + relay.down if b.kind is Kind.KEEP_ALIVE)
    assert data(relay.up) == data(relay.down) == []


def test_the_bytes_of_all_kinds_are_those_of_the_stream(links: Links) -> None:
    carry(links, "a/b", "a/*", b"here")
    seen = list(links.sent.up)
    stream = b"".join(len(b.content).to_bytes(2, "little") + b.content for b in seen)
    assert total(seen) == len(stream) == sum(total(seen, kind) for kind in Kind)


def test_a_relay_leaves_no_thread_behind() -> None:
    before = set(threading.enumerate())
    with two_clients() as links:
        carry(links, "a/b", "a/b", b"here")
        relays = {t for t in threading.enumerate() if t not in before}
        assert relays
    wait_until(lambda: not any(thread.is_alive() for thread in relays))  # nobody joins an ear's


BATCH = st.binary(max_size=6).map(lambda rest: bytes([0x05, 0x01, 0x1D]) + rest)


@examples(100)
@given(st.lists(BATCH, max_size=6), st.lists(st.integers(1, 9)))
def test_a_stream_in_any_pieces_gives_the_same_batches(
    batches: list[bytes], pieces: list[int]
) -> None:
    stream = b"".join(len(b).to_bytes(2, "little") + b for b in batches)
    seen: list[Batch] = []
    rest = b""
    for piece in [*pieces, len(stream)]:
        rest, stream = put_down(rest + stream[:piece], seen), stream[piece:]
    assert [b.content for b in seen] == batches
    assert rest == b""


@pytest.mark.parametrize(
    ("batch", "kind"),
    [
        ("04", Kind.KEEP_ALIVE),
        ("a1 09", Kind.OTHER),  # init
        ("26 05", Kind.DATA),  # fragment
        ("05 ff01 5d 01", Kind.DATA),
        ("a5 05 31 06 5d 01", Kind.DATA),  # one extension, a number
        ("a5 05 b1 06 42 02 ffff 9e 01", Kind.DECLARATION),  # two, the second of two bytes
        ("85 05 10 19 01", Kind.DECLARATION),  # an extension without a body; interest
        ("25 05 1f", Kind.OTHER),  # routing
    ],
)
def test_worked_examples_of_batches(batch: str, kind: Kind) -> None:
    assert kind_of(bytes.fromhex(batch)) is kind


TIMED = st.lists(st.tuples(st.integers(0, 50), st.integers(0, 9)), max_size=20)


@examples(100)
@given(TIMED, st.integers(1, 20))
def test_the_fullest_window_is_found(timed: list[tuple[int, int]], window: int) -> None:
    batches = [Batch(float(t), Kind.DATA, bytes(n)) for t, n in sorted(timed)]
    windows = [[b for b in batches if t <= b.at_s < t + window] for t in range(51)]
    assert most_in_window(batches, window, Kind.DATA) == max(map(total, windows))
    assert most_in_window(batches, window, Kind.KEEP_ALIVE) == 0


# What a message costs ---------------------------------------------------------------------------


@pytest.mark.parametrize("observer", ["r1", LONG_NAME])
@pytest.mark.parametrize("size", [FIX_BYTES, HEADED_FIX_BYTES, BELIEF_BYTES])
def test_what_a_fix_and_a_belief_cost(links: Links, size: int, observer: str) -> None:
    ways = [
        (topics.FIX.at(robot="r3", tier=7, observer=observer), topics.FIX.at(robot="r3", tier=7)),
        (topics.BELIEF.at(tier=7, robot=observer), topics.BELIEF.at(tier=7)),
    ]
    for key, keys in ways:
        carry(links, key, keys, bytes(size))
    as_text = 2 + len(observer)
    for sent, received in zip(data(links.sent.up), data(links.received.down), strict=True):
        assert sent.size - size in (8, 9)  # a low sequence number is a byte less
        assert received.size - size in (8 + as_text, 9 + as_text)
        assert sent.size <= min(60, sent_bytes(size))
        assert received.size <= received_bytes(size, observer)
        if observer == "r1":
            assert received.size <= 60


def test_a_whole_key_in_a_subscription_saves_the_senders_name(links: Links) -> None:
    key = topics.BELIEF.at(tier=7, robot=LONG_NAME)
    carry(links, key, key, bytes(40))
    assert [b.size for b in data(links.received.down)] in ([48], [49])


def test_messages_between_robots_cost_less_than_those_of_any_other_topic(links: Links) -> None:
    sizes = {}
    for qos in Qos:
        before = len(data(links.sent.up))
        carry(links, f"a/{qos.name}", f"a/{qos.name}", bytes(40), qos)
        sizes[qos] = data(links.sent.up)[before].size
    cheapest = sizes.pop(Qos.FRESH)
    assert all(size >= cheapest + 3 for size in sizes.values())


@pytest.mark.parametrize("size", [0, 127, 128, 16_383, 16_384])
def test_no_message_costs_more_than_the_bound(links: Links, size: int) -> None:
    key = topics.BELIEF.at(tier=7, robot=LONG_NAME)
    for number in range(200):  # keys with numbers of two bytes
        links.sender.publisher(f"other/{number}", Qos.FRESH)
        links.receiver.subscribe(f"another/{number}/*", lambda key, payload: None)
    carry(links, key, topics.BELIEF.at(tier=7), bytes(size))
    (sent,), (received,) = data(links.sent.up), data(links.received.down)
    assert sent_bytes(size) - 1 <= sent.size <= sent_bytes(size)
    assert received_bytes(size, LONG_NAME) - 1 <= received.size <= received_bytes(size, LONG_NAME)
