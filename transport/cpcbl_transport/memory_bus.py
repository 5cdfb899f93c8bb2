"""The bus inside one process: deterministic, for simulations in one process and for tests."""

from collections.abc import Iterable
from functools import lru_cache
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
        self.subscribers: PatternIndex[_Listener[MessageCallback]] = PatternIndex()
        self.watchers: PatternIndex[_Listener[LivelinessCallback]] = PatternIndex()
        self.tokens: PatternIndex[_Token] = PatternIndex()

    def session(self) -> "MemoryBus":
        return MemoryBus(self)

    def notify_watchers(self, key: str, alive: bool) -> None:
        for watcher in self.watchers.find(patterns_of(key)):
            watcher.callback(key, alive)


class _Listener(Generic[CallbackT]):
    """A subscription, or who watches tokens: it lies in an index of the hub until it is closed."""

    def __init__(
        self,
        index: "PatternIndex[_Listener[CallbackT]]",
        session: object,
        keys: str,
        callback: CallbackT,
    ) -> None:
        self._index, self.session, self._keys, self.callback = index, session, keys, callback
        index.add([keys], self)

    def close(self) -> None:
        self._index.remove([self._keys], self)


class _Token:
    def __init__(self, hub: MemoryHub, key: str) -> None:
        self._hub, self.key = hub, key
        hub.tokens.add(patterns_of(key), self)
        hub.notify_watchers(key, True)

    def close(self) -> None:
        if self._hub.tokens.remove(patterns_of(self.key), self):
            self._hub.notify_watchers(self.key, False)


class _MemoryPublisher:
    def __init__(self, hub: MemoryHub, session: object, key: str) -> None:
        self._hub, self._session, self._key, self._open = hub, session, key, True
        self._patterns = patterns_of(key)

    @property
    def matching(self) -> bool:
        return self._open and bool(self._others())

    def put(self, payload: bytes) -> None:
        if self._open:
            for subscriber in self._others():
                subscriber.callback(self._key, payload)

    def _others(self) -> list[_Listener[MessageCallback]]:
        """The subscribers of other sessions."""
        found = self._hub.subscribers.find(self._patterns)
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
        for token in self._hub.tokens.find([keys]):
            on_change(token.key, True)
        return watcher

    def close(self) -> None:
        while self._declared:
            self._declared.pop().close()

    def _keep(self, handle: HandleT) -> HandleT:
        self._declared.append(handle)
        return handle


# Keys with wildcards ------------------------------------------------------------------------------


@lru_cache(maxsize=4096)
def patterns_of(key: str) -> tuple[str, ...]:
    """All patterns that include a key, the key itself too: 47 for a key of four chunks."""
    beginnings, patterns = [""], ["**"]
    for chunk in key.split("/"):
        beginnings = [f"{b}{part}/" for b in beginnings for part in (chunk, "*")]
        patterns += [f"{b}**" for b in beginnings]
    return (*patterns, *(b.removesuffix("/") for b in beginnings))


class PatternIndex(Generic[Thing]):
    """Each thing lies under one or more patterns and is found in the order in which it was added. A
    search costs as much as it looks up and finds, however much is stored."""

    def __init__(self) -> None:
        self._things: dict[str, dict[Thing, int]] = {}
        self._numbers = count()

    def add(self, patterns: Iterable[str], thing: Thing) -> None:
        number = next(self._numbers)
        for pattern in patterns:
            self._things.setdefault(pattern, {})[thing] = number

    def remove(self, patterns: Iterable[str], thing: Thing) -> bool:
        """Takes a thing back; whether it was there."""
        was_there = False
        for pattern in patterns:
            here = self._things.get(pattern, {})
            was_there |= here.pop(thing, None) is not None
            if not here:
                self._things.pop(pattern, None)
        return was_there

    def find(self, patterns: Iterable[str]) -> list[Thing]:
        """What lies under any of these patterns."""
        found: dict[Thing, int] = {}
        for pattern in patterns:
            if pattern in self._things:
                found.update(self._things[pattern])
        return sorted(found, key=found.__getitem__) if len(found) > 1 else list(found)
