"""The one small interface to a bus, and its deterministic twin in memory.

Keys are `/`-separated; in subscriptions `*` stands for one chunk and a last `**` for any rest.
Callbacks run on a thread of the bus (in memory: the publisher's). One that works for some
milliseconds holds up its own subscription alone: what comes for it meanwhile, up to 256, waits.
A session does not hear what it publishes itself.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from cpcbl_transport.key_tree import KeyTree
from cpcbl_transport.topics import Qos

Receive = Callable[[str, bytes], None]
Watch = Callable[[str, bool], None]
Kept = TypeVar("Kept", bound="Handle")


class Handle(Protocol):
    """Something declared on a bus."""

    def close(self) -> None:
        """Takes it back. Closing twice is allowed."""


class Publisher(Handle, Protocol):
    """Declared on one concrete key."""

    @property
    def matching(self) -> bool:
        """Whether anybody listens at present; ask before encoding."""

    def put(self, payload: bytes) -> None: ...


class Bus(AbstractContextManager["Bus"], Protocol):
    """A session of one process (or, in memory, of one robot). Closing it closes all it declared."""

    def publisher(self, key: str, qos: Qos) -> Publisher: ...

    def subscribe(self, keys: str, receive: Receive) -> Handle: ...

    def announce(self, key: str) -> Handle:
        """A liveliness token: `watch` hears when it comes and when it, or its session, goes."""

    def watch(self, keys: str, watch: Watch) -> Handle:
        """Calls `watch(key, alive)` for tokens that are there already and for every change."""

    def close(self) -> None: ...


class MemoryHub:
    """Connects the sessions of one process; delivers in the order of declaration."""

    def __init__(self) -> None:
        self.receivers: KeyTree[_Receiver] = KeyTree()
        self.watchers: KeyTree[_Watcher] = KeyTree()
        self.tokens: KeyTree[_Token] = KeyTree()

    def session(self) -> "MemoryBus":
        return MemoryBus(self)

    def tell(self, key: str, alive: bool) -> None:
        for watcher in self.watchers.find(key):
            watcher.watch(key, alive)


class _Receiver:
    def __init__(self, hub: MemoryHub, session: object, keys: str, receive: Receive) -> None:
        self._hub, self.session, self._keys, self.receive = hub, session, keys, receive
        hub.receivers.add(keys, self)

    def close(self) -> None:
        self._hub.receivers.remove(self._keys, self)


class _Watcher:
    def __init__(self, hub: MemoryHub, keys: str, watch: Watch) -> None:
        self._hub, self._keys, self.watch = hub, keys, watch
        hub.watchers.add(keys, self)
        for token in hub.tokens.find(keys):
            watch(token.key, True)

    def close(self) -> None:
        self._hub.watchers.remove(self._keys, self)


class _Token:
    def __init__(self, hub: MemoryHub, key: str) -> None:
        self._hub, self.key = hub, key
        hub.tokens.add(key, self)
        hub.tell(key, True)

    def close(self) -> None:
        if self._hub.tokens.remove(self.key, self):
            self._hub.tell(self.key, False)


class _MemoryPublisher:
    def __init__(self, hub: MemoryHub, session: object, key: str) -> None:
        self._hub, self._session, self._key, self._open = hub, session, key, True

    @property
    def matching(self) -> bool:
        return self._open and bool(self._others())

    def put(self, payload: bytes) -> None:
        if self._open:
            for receiver in self._others():
                receiver.receive(self._key, payload)

    def _others(self) -> list[_Receiver]:
        return [r for r in self._hub.receivers.find(self._key) if r.session is not self._session]

    def close(self) -> None:
        self._open = False


class MemoryBus:
    """One session on a hub."""

    def __init__(self, hub: MemoryHub) -> None:
        self._hub = hub
        self._declared: list[Handle] = []

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return self._keep(_MemoryPublisher(self._hub, self, key))

    def subscribe(self, keys: str, receive: Receive) -> Handle:
        return self._keep(_Receiver(self._hub, self, keys, receive))

    def announce(self, key: str) -> Handle:
        return self._keep(_Token(self._hub, key))

    def watch(self, keys: str, watch: Watch) -> Handle:
        return self._keep(_Watcher(self._hub, keys, watch))

    def close(self) -> None:
        while self._declared:
            self._declared.pop().close()

    def __enter__(self) -> "MemoryBus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _keep(self, handle: Kept) -> Kept:
        self._declared.append(handle)
        return handle
