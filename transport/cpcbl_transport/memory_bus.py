"""The bus inside one process: deterministic, for simulations in one process and for tests."""

from collections.abc import Iterator
from itertools import count
from typing import Generic, TypeVar

from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.topics import Qos

HandleT = TypeVar("HandleT", bound=Handle)
CallbackT = TypeVar("CallbackT")
Thing = TypeVar("Thing")


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


# Keys with wildcards ------------------------------------------------------------------------------


class _Branch(Generic[Thing]):
    """What lies under the chunks so far, with its number, and the chunks that may follow."""

    __slots__ = ("here", "next")

    def __init__(self) -> None:
        self.here: dict[Thing, int] = {}
        self.next: dict[str, _Branch[Thing]] = {}


class KeyTree(Generic[Thing]):
    """Each thing lies under one key or pattern and is found in the order in which it was added. It
    is a tree of chunks: a search costs as much as it finds, however much is stored."""

    def __init__(self) -> None:
        self._root: _Branch[Thing] = _Branch()
        self._numbers = count()

    def add(self, keys: str, thing: Thing) -> None:
        branch = self._root
        for chunk in keys.split("/"):
            branch = branch.next.setdefault(chunk, _Branch())
        branch.here[thing] = next(self._numbers)

    def remove(self, keys: str, thing: Thing) -> bool:
        """Takes a thing back; whether it was there. Branches that bear nothing more go too."""
        way, branch = [], self._root
        for chunk in keys.split("/"):
            way.append((branch, chunk))
            if chunk not in branch.next:
                return False
            branch = branch.next[chunk]
        if branch.here.pop(thing, None) is None:
            return False
        for before, chunk in reversed(way):
            if branch.here or branch.next:
                break
            del before.next[chunk]
            branch = before
        return True

    def find(self, keys: str) -> list[Thing]:
        """For a key, what lies under it and under the patterns that include it; for a pattern,
        what lies under the keys that it includes."""
        found: dict[Thing, int] = {}
        for branch in self._branches(keys.split("/")):
            found.update(branch.here)
        return sorted(found, key=found.__getitem__) if len(found) > 1 else list(found)

    def _branches(self, chunks: list[str]) -> Iterator[_Branch[Thing]]:
        level = [self._root]
        for chunk in chunks:
            if chunk == "**":
                for branch in level:
                    yield from _with_all_beyond(branch)
                return
            following: list[_Branch[Thing]] = []
            for branch in level:
                if "**" in branch.next:
                    yield branch.next["**"]
                if chunk == "*":
                    following += branch.next.values()
                    continue
                for name in (chunk, "*"):
                    if name in branch.next:
                        following.append(branch.next[name])
            level = following
        for branch in level:
            yield branch
            if "**" in branch.next:
                yield branch.next["**"]


def _with_all_beyond(branch: _Branch[Thing]) -> Iterator[_Branch[Thing]]:
    yield branch
    for further in branch.next.values():
        yield from _with_all_beyond(further)
