"""What is on the wire: a TCP relay that a client dials instead of its router, and that counts.

Zenoh's stream is batches, each after its length in two bytes (little endian). A batch is one
transport message, or a frame: header, sequence number, extensions, then network messages. Read
here is as much of it as tells what a batch is for (zenoh-protocol: transport/mod.rs, frame.rs,
network/mod.rs). Network messages of different kinds do not share a batch: declarations go with a
priority that no topic has. Links are not compressed.
"""

import socket
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from enum import StrEnum
from typing import NamedTuple


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


class Relay:
    """Between one client and the router at `endpoint`; what passed is in `up` and `down`.

    A batch is put down before it is passed on: who has received something finds it here.
    """

    def __init__(self, endpoint: str) -> None:
        host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
        self._router = (host, int(port))
        self.up: list[Batch] = []
        self.down: list[Batch] = []
        self._open: list[socket.socket] = []
        self._threads: list[threading.Thread] = []

    @property
    def endpoint(self) -> str:
        """Where the client is to dial."""
        return f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"

    def __enter__(self) -> "Relay":
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._start(self._accept)
        return self

    def __exit__(self, *_: object) -> None:
        for end in (self._listener, *self._open):
            with suppress(OSError):  # its other side may be gone
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for end in (self._listener, *self._open):
            end.close()

    def _start(self, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        with suppress(OSError):  # the listener is shut down at the end
            while True:
                client, _ = self._listener.accept()
                router = socket.create_connection(self._router)
                self._open += (client, router)
                for end in (client, router):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._start(self._pass_on, client, router, self.up)
                self._start(self._pass_on, router, client, self.down)

    def _pass_on(self, source: socket.socket, sink: socket.socket, seen: list[Batch]) -> None:
        rest = b""
        with suppress(OSError):  # either side may leave at any time
            while data := source.recv(65_536):
                rest = put_down(rest + data, seen)
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


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
