"""The bus inside one process: deterministic, for simulations in one process and for tests."""

from typing import TypeVar

from cpcbl_transport.bus import Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.key_tree import KeyTree
from cpcbl_transport.topics import Qos

HandleT = TypeVar("HandleT", bound=Handle)


class MemoryHub:
    """Connects the sessions of one process; delivers in the order of declaration."""

    def __init__(self) -> None:
        self.subscribers: KeyTree[_Subscriber] = KeyTree()
        self.watchers: KeyTree[_LivelinessWatcher] = KeyTree()
        self.tokens: KeyTree[_Token] = KeyTree()

    def session(self) -> "MemoryBus":
        return MemoryBus(self)

    def notify_watchers(self, key: str, alive: bool) -> None:
        for watcher in self.watchers.find(key):
            watcher.on_change(key, alive)


class _Subscriber:
    def __init__(
        self, hub: MemoryHub, session: object, keys: str, on_message: MessageCallback
    ) -> None:
        self._hub, self.session, self._keys, self.on_message = hub, session, keys, on_message
        hub.subscribers.add(keys, self)

    def close(self) -> None:
        self._hub.subscribers.remove(self._keys, self)


class _LivelinessWatcher:
    def __init__(self, hub: MemoryHub, keys: str, on_change: LivelinessCallback) -> None:
        self._hub, self._keys, self.on_change = hub, keys, on_change
        hub.watchers.add(keys, self)
        for token in hub.tokens.find(keys):
            on_change(token.key, True)

    def close(self) -> None:
        self._hub.watchers.remove(self._keys, self)


class _Token:
    def __init__(self, hub: MemoryHub, key: str) -> None:
        self._hub, self.key = hub, key
        hub.tokens.add(key, self)
        hub.notify_watchers(key, True)

    def close(self) -> None:
        if self._hub.tokens.remove(self.key, self):
            self._hub.notify_watchers(self.key, False)


class _MemoryPublisher:
    def __init__(self, hub: MemoryHub, session: object, key: str) -> None:
        self._hub, self._session, self._key, self._open = hub, session, key, True

    @property
    def matching(self) -> bool:
        return self._open and bool(self._others())

    def put(self, payload: bytes) -> None:
        if self._open:
            for subscriber in self._others():
                subscriber.on_message(self._key, payload)

    def _others(self) -> list[_Subscriber]:
        """The subscribers of other sessions."""
        found = self._hub.subscribers.find(self._key)
        return [s for s in found if s.session is not self._session]

    def close(self) -> None:
        self._open = False


class MemoryBus:
    """One session on a hub."""

    def __init__(self, hub: MemoryHub) -> None:
        self._hub = hub
        self._declared: list[Handle] = []

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return self._keep(_MemoryPublisher(self._hub, self, key))

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        return self._keep(_Subscriber(self._hub, self, keys, on_message))

    def declare_token(self, key: str) -> Handle:
        return self._keep(_Token(self._hub, key))

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        return self._keep(_LivelinessWatcher(self._hub, keys, on_change))

    def close(self) -> None:
        while self._declared:
            self._declared.pop().close()

    def __enter__(self) -> "MemoryBus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _keep(self, handle: HandleT) -> HandleT:
        self._declared.append(handle)
        return handle
