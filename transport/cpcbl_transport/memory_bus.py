"""The bus inside one process: deterministic, for simulations in one process and for tests."""

from collections.abc import Callable, Collection, Set
from functools import lru_cache, partial
from itertools import count
from typing import Generic, NamedTuple, TypeVar

from cpcbl_transport.bus import (
    Bus,
    Declared,
    Handle,
    LivelinessCallback,
    MessageCallback,
    Publisher,
)
from cpcbl_transport.topics import Qos

Thing = TypeVar("Thing")
MOST_CHANGES = 32  # that an index remembers


class _Subscriber(NamedTuple):
    session: object
    on_message: MessageCallback


class MemoryHub:
    """Connects the sessions of one process; delivers in the order of declaration."""

    def __init__(self) -> None:
        self.subscribers: PatternIndex[_Subscriber] = PatternIndex()
        self.watchers: PatternIndex[LivelinessCallback] = PatternIndex()
        self.tokens: PatternIndex[str] = PatternIndex()

    def session(self) -> "MemoryBus":
        return MemoryBus(self)

    def notify_watchers(self, key: str, alive: bool) -> None:
        for on_change in self.watchers.find(patterns_of(key)):
            on_change(key, alive)


class _MemoryPublisher(Declared):
    def __init__(self, hub: MemoryHub, session: "MemoryBus", key: str) -> None:
        super().__init__(session.declared, lambda: None)
        self._hub, self._session, self._key = hub, session, key
        self._patterns = patterns_of(key)
        self._found: list[_Subscriber] = []
        self._changes = 0  # of the subscribers, that are in what was found

    @property
    def matching(self) -> bool:
        return self.open and bool(self._others())

    def put(self, payload: bytes) -> None:
        if self.open:
            for subscriber in self._others():
                subscriber.on_message(self._key, payload)

    def _others(self) -> list[_Subscriber]:
        """The subscribers of other sessions."""
        subscribers = self._hub.subscribers
        if self._changes != subscribers.changes:
            if subscribers.may_have_changed(self._patterns, self._changes):
                found = subscribers.find(self._patterns)
                self._found = [s for s in found if s.session is not self._session]
            self._changes = subscribers.changes
        return self._found


class MemoryBus(Bus):
    """One session on a hub."""

    def __init__(self, hub: MemoryHub) -> None:
        self._hub = hub
        self.declared: dict[Declared, None] = {}  # in this order

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return _MemoryPublisher(self._hub, self, key)

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        return Declared(
            self.declared, self._hub.subscribers.add([keys], _Subscriber(self, on_message))
        )

    def declare_token(self, key: str) -> Handle:
        remove = self._hub.tokens.add(patterns_of(key), key)
        self._hub.notify_watchers(key, True)

        def close() -> None:
            if remove():
                self._hub.notify_watchers(key, False)

        return Declared(self.declared, close)

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        watcher = Declared(self.declared, self._hub.watchers.add([keys], on_change))
        for key in self._hub.tokens.find({keys}):
            on_change(key, True)
        return watcher

    def close(self) -> None:
        for handle in reversed(list(self.declared)):
            handle.close()


# Keys with wildcards ------------------------------------------------------------------------------


@lru_cache(maxsize=4096)
def patterns_of(key: str) -> frozenset[str]:
    """All patterns that include a key, the key itself too: 47 for a key of four chunks."""
    beginnings, patterns = [""], ["**"]
    for chunk in key.split("/"):
        beginnings = [f"{b}{part}/" for b in beginnings for part in (chunk, "*")]
        patterns += [f"{b}**" for b in beginnings]
    return frozenset([*patterns, *(b.removesuffix("/") for b in beginnings)])


class PatternIndex(Generic[Thing]):
    """Each thing lies under one or more patterns and is found in the order in which it was added. A
    search costs as much as it looks up and finds, however much is stored."""

    def __init__(self) -> None:
        self._things: dict[str, dict[int, Thing]] = {}
        self._numbers = count()
        self.changes = 0
        """How often something was added under a pattern or taken back."""
        self._changed: list[str] = []  # the latest of these patterns

    def add(self, patterns: Collection[str], thing: Thing) -> Callable[[], bool]:
        """Adds a thing. What it returns takes it back, and says whether it was there."""
        number = next(self._numbers)
        self._note_change(patterns)
        for pattern in patterns:
            self._things.setdefault(pattern, {})[number] = thing
        return partial(self._remove, patterns, number)

    def _remove(self, patterns: Collection[str], number: int) -> bool:
        was_there = False
        self._note_change(patterns)
        for pattern in patterns:
            here = self._things.get(pattern, {})
            was_there |= here.pop(number, None) is not None
            if not here:
                self._things.pop(pattern, None)
        return was_there

    def _note_change(self, patterns: Collection[str]) -> None:
        self.changes += len(patterns)
        self._changed = [*self._changed, *patterns][-MOST_CHANGES:]

    def may_have_changed(self, patterns: Set[str], since: int) -> bool:
        """Whether one of these patterns may be among the changes after the first `since`."""
        number = self.changes - since
        return number > MOST_CHANGES or not patterns.isdisjoint(self._changed[-number:])

    def find(self, patterns: Set[str]) -> list[Thing]:
        """What lies under any of these patterns."""
        found: dict[int, Thing] = {}
        for pattern in patterns & self._things.keys():
            found.update(self._things[pattern])
        return [found[number] for number in sorted(found)]
