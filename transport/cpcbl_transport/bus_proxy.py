"""A bus that passes everything on: for those that change or note what passes."""

from typing import Self

from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.topics import Qos


class BusProxy:
    """Stands before a bus and does what it does."""

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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class PublisherProxy:
    """Stands before a publisher and does what it does."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher

    @property
    def matching(self) -> bool:
        return self._publisher.matching

    def put(self, payload: bytes) -> None:
        self._publisher.put(payload)

    def close(self) -> None:
        self._publisher.close()
