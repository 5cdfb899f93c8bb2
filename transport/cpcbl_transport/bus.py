"""The one small interface to a bus. Over Zenoh it is `zenoh_bus`, inside one process `memory_bus`.

Keys are `/`-separated; in subscriptions `*` stands for one chunk and a last `**` for any rest.
Callbacks run on a thread of the bus (in memory: the publisher's). A callback that works for some
milliseconds delays its own subscription alone; up to 256 messages wait for it meanwhile.
A session does not receive what it publishes itself.
"""

from collections.abc import Callable
from typing import Protocol, Self

from cpcbl_transport.topics import Qos

MessageCallback = Callable[[str, bytes], None]  # called with the key and the payload of a message
LivelinessCallback = Callable[[str, bool], None]
"""Called with the key of a token, and whether the token is there."""


class Handle(Protocol):
    """Something declared on a bus."""

    def close(self) -> None:
        """Takes the declaration back. Closing twice is allowed."""


class Declared(Handle):
    """Something declared. Its session keeps it in `kept` until it is closed, as an unused one would
    end."""

    def __init__(self, kept: "dict[Declared, None]", undeclare: Callable[[], object]) -> None:
        self._kept, self._undeclare = kept, undeclare
        kept[self] = None

    @property
    def open(self) -> bool:
        return self in self._kept

    def close(self) -> None:
        if self.open:
            self._kept.pop(self, None)
            self._undeclare()


class Publisher(Handle, Protocol):
    """Declared on one concrete key."""

    @property
    def matching(self) -> bool:
        """Whether there is a subscriber at present; ask before encoding."""

    def put(self, payload: bytes) -> None: ...


class Bus(Protocol):
    """A session of one process (or, in memory, of one robot). Closing it closes all it declared."""

    def publisher(self, key: str, qos: Qos) -> Publisher: ...

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle: ...

    def declare_token(self, key: str) -> Handle:
        """Declares a liveliness token, which ends when it is closed or its session ends."""

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        """Calls `on_change` for tokens that are there already and for every change."""

    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class PublisherProxy(Publisher):
    """Stands before a publisher and passes everything on, for those that change what passes."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher

    @property
    def matching(self) -> bool:
        return self._publisher.matching

    def put(self, payload: bytes) -> None:
        self._publisher.put(payload)

    def close(self) -> None:
        self._publisher.close()


class BusProxy(Bus):
    """Stands before a bus and passes everything on, for those that change or note what passes."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return self._bus.publisher(key, qos)

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        return self._bus.subscribe(keys, on_message)

    def declare_token(self, key: str) -> Handle:
        return self._bus.declare_token(key)

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        return self._bus.watch_liveliness(keys, on_change)

    def close(self) -> None:
        self._bus.close()
