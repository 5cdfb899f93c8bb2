"""What is on the wire: the TCP relay of the fault scenarios, here with a count of what passes.

Zenoh's stream is batches, each after its length in two bytes (little endian). A batch is one
transport message, or a frame: header, sequence number, extensions, then network messages. Read
here is as much of it as tells what a batch is for (zenoh-protocol: transport/mod.rs, frame.rs,
network/mod.rs). Network messages of different kinds do not share a batch: declarations go with a
priority that no topic has. Links are not compressed.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum
from typing import NamedTuple

from cpcbl_launch.lab.chaos import links


class Kind(StrEnum):
    """What a batch is for."""

    KEEP_ALIVE = "keep-alive"
    DECLARATION = "declaration"  # subscriptions, tokens, keys, interests
    DATA = "data"  # puts, whole or in fragments
    OTHER = "other"  # init, open, close, routing


class Batch(NamedTuple):
    """One batch on a link, at the time (monotonic) at which the relay passed it on."""

    at_s: float
    kind: Kind
    content: bytes

    @property
    def size(self) -> int:
        """Bytes of the stream, with the two of the length."""
        return LENGTH_SIZE + len(self.content)


LENGTH_SIZE = 2
_ID, _MORE = 0x1F, 0x80  # of a header: what it is; whether extensions follow
_FRAME = 0x05
_TRANSPORT = {0x04: Kind.KEEP_ALIVE, 0x06: Kind.DATA}  # keep-alive, fragment
_NETWORK = {0x1D: Kind.DATA, 0x1E: Kind.DECLARATION, 0x19: Kind.DECLARATION}  # push, declare, ...


def kind_of(batch: bytes) -> Kind:
    """What a batch is for, by its first message."""
    if batch[0] & _ID != _FRAME:
        return _TRANSPORT.get(batch[0] & _ID, Kind.OTHER)
    at = _after_number(batch, 1)
    more = batch[0] & _MORE
    while more:
        more, body, at = batch[at] & _MORE, batch[at] >> 5 & 0b11, at + 1
        if body == 0b01:
            at = _after_number(batch, at)
        elif body == 0b10:
            at = _after_number(batch, at) + _number(batch, at)
    return _NETWORK.get(batch[at] & _ID, Kind.OTHER)


def _after_number(batch: bytes, at: int) -> int:
    """Where a number of variable length ends: seven bits a byte, the eighth says more."""
    while batch[at] & _MORE:
        at += 1
    return at + 1


def _number(batch: bytes, at: int) -> int:
    end = _after_number(batch, at)
    return sum((byte & 0x7F) << 7 * i for i, byte in enumerate(batch[at:end]))


def total(batches: Iterable[Batch], *kinds: Kind) -> int:
    """Bytes of the batches of some kinds; of all without any."""
    return sum(b.size for b in batches if not kinds or b.kind in kinds)


def most_in_window(batches: Sequence[Batch], window_s: float, *kinds: Kind) -> int:
    """Most bytes of some kinds (of all without any) in any window; two batches that are as far
    apart as it is long do not share it."""
    chosen = [b for b in batches if not kinds or b.kind in kinds]
    most = inside = first = 0
    for batch in chosen:
        inside += batch.size
        while batch.at_s - chosen[first].at_s >= window_s:
            inside -= chosen[first].size
            first += 1
        most = max(most, inside)
    return most


class Relay(links.Relay):
    """Between one client and the router at `endpoint`; what passed is in `up` and `down`.

    A batch is put down before it is passed on: who has received something finds it here.
    """

    def __init__(self, router: str) -> None:
        super().__init__(router)
        self.up: list[Batch] = []
        self.down: list[Batch] = []

    def observer(self, upward: bool) -> Callable[[bytes], None]:
        seen, rest = (self.up if upward else self.down), b""

        def observe(data: bytes) -> None:
            nonlocal rest
            rest = put_down(rest + data, seen)

        return observe


def put_down(stream: bytes, seen: list[Batch]) -> bytes:
    """Appends the whole batches of a stream; returns what is left of it."""
    now_s, at = time.monotonic(), 0
    while len(stream) >= at + LENGTH_SIZE:
        start = at + LENGTH_SIZE
        end = start + int.from_bytes(stream[at:start], "little")
        if len(stream) < end:
            break
        content = stream[start:end]
        seen.append(Batch(now_s, kind_of(content), content))
        at = end
    return stream[at:]
