"""The bus inside one process: deterministic, for simulations in one process and for tests."""

from typing import Generic, TypeVar

from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.key_tree import KeyTree
from cpcbl_transport.topics import Qos

HandleT = TypeVar("HandleT", bound=Handle)
CallbackT = TypeVar("CallbackT")


class MemoryHub:
    """Connects the sessions of one process; delivers in the order of declaration."""

    def __init__(self) -> None:
        self.subscribers: KeyTree[_Listener[MessageCallback]] = KeyTree()
        self.watchers: KeyTree[_Listener[LivelinessCallback]] = KeyTree()
        self.tokens: KeyTree[_Token] = KeyTree()

    def session(self) -> "MemoryBus":
        return MemoryBus(self)

    def notify_watchers(self, key: str, alive: bool) -> None:
        for watcher in self.watchers.find(key):
            watcher.callback(key, alive)


class _Listener(Generic[CallbackT]):
    """A subscription, or who watches tokens: it lies in a tree of the hub until it is closed."""

    def __init__(
        self,
        tree: "KeyTree[_Listener[CallbackT]]",
        session: object,
        keys: str,
        callback: CallbackT,
    ) -> None:
        self._tree, self.session, self._keys, self.callback = tree, session, keys, callback
        tree.add(keys, self)

    def close(self) -> None:
        self._tree.remove(self._keys, self)


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
                subscriber.callback(self._key, payload)

    def _others(self) -> list[_Listener[MessageCallback]]:
        """The subscribers of other sessions."""
        found = self._hub.subscribers.find(self._key)
        return [s for s in found if s.session is not self._session]

    def close(self) -> None:
        self._open = False


class MemoryBus(Bus):
    """One session on a hub."""

    def __init__(self, hub: MemoryHub) -> None:
        self._hub = hub
        self._declared: list[Handle] = []

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return self._keep(_MemoryPublisher(self._hub, self, key))

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        return self._keep(_Listener(self._hub.subscribers, self, keys, on_message))

    def declare_token(self, key: str) -> Handle:
        return self._keep(_Token(self._hub, key))

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        watcher = self._keep(_Listener(self._hub.watchers, self, keys, on_change))
        for token in self._hub.tokens.find(keys):
            on_change(token.key, True)
        return watcher

    def close(self) -> None:
        while self._declared:
            self._declared.pop().close()

    def _keep(self, handle: HandleT) -> HandleT:
        self._declared.append(handle)
        return handle
