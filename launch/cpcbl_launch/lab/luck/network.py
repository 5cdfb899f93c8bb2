"""A bad network between the sessions of a hub in memory, in virtual time.

A message is lost, delayed or doubled between its publisher's session and each of its subscriptions.
Dice belong to an event and to a pair of sessions, so an event that is taken away does not change
what the others do.
"""

import heapq
from collections.abc import Callable
from functools import partial
from itertools import count
from random import Random
from typing import TypeVar

from cpcbl_launch.lab.luck.history import Event, Kind
from cpcbl_transport.bus import (
    Bus,
    BusProxy,
    Handle,
    LivelinessCallback,
    MessageCallback,
    Publisher,
    PublisherProxy,
)
from cpcbl_transport.memory_bus import MemoryHub, patterns_of
from cpcbl_transport.topics import Qos

FIELD, WATCHER = "field", "watcher"  # their sessions have no bad luck
LEASE_S, RECONNECT_S = 2.0, 0.5  # as Zenoh: a silent session is gone after its lease
MOST_LATE_COPY_S = 4.0
HELP, INPUTS = ("fix/", "belief/", "landmark/"), "in/"
CUTS: tuple[Kind, ...] = ("cut", "mute", "deaf")
OnPut = Callable[[str, str, bytes], None]  # called with the session, the key and the payload
Thing = TypeVar("Thing")
OnDelivery = Callable[[str, bytes], None]


class Network:
    """All sessions of one simulation, its time, and what is due in it."""

    def __init__(self, seed: int, on_put: OnPut) -> None:
        self.hub, self.now_ns, self.sender = MemoryHub(), 0, ""
        self.on_put, self._seed = on_put, seed
        self.owners: dict[str, str] = {}  # of tokens
        self.declared: dict[str, dict[str, list[str]]] = {}  # by session: keys by what they are for
        self._queue: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers, self._active = count(), list[Event]()
        self._dice: dict[tuple[int, str, str], Random] = {}
        self._cut_ns: dict[tuple[str, str], int] = {}
        self._watches: list[_Watch] = []

    def session(self, name: str, on_delivery: OnDelivery = lambda key, payload: None) -> Bus:
        """A session; `on_delivery` is called for each message that a subscription receives."""
        self.declared[name] = {"subscriptions": [], "publishers": [], "tokens": []}
        return _Session(self, name, on_delivery)

    # Time and bad luck --------------------------------------------------------------------------

    @property
    def next_ns(self) -> int | None:
        return self._queue[0][0] if self._queue else None

    def at(self, due_ns: int, action: Callable[[], None]) -> None:
        """Does something at a time."""
        heapq.heappush(self._queue, (due_ns, next(self._numbers), action))

    def run_until(self, now_ns: int) -> None:
        """Does all that is due."""
        while self._queue and self._queue[0][0] <= now_ns:
            self.now_ns, _, action = heapq.heappop(self._queue)
            action()
        self.now_ns = now_ns

    def begin(self, event: Event) -> None:
        self._active.append(event)
        self._update_cuts()

    def end(self, event: Event) -> None:
        self._active.remove(event)
        self._update_cuts()
        self.at(self.now_ns + int(RECONNECT_S * 1e9), self._synchronize)

    @property
    def has_cuts(self) -> bool:
        return bool(self._cut_ns)

    def dice(self, event: Event, sender: str = "", receiver: str = "") -> Random:
        """The dice of an event, for messages between two sessions."""
        name = event.number, sender, receiver
        if name not in self._dice:
            self._dice[name] = Random(f"{self._seed} {name}")
        return self._dice[name]

    def _update_cuts(self) -> None:
        """Notes which links have just been cut, and lets their leases expire."""
        before, self._cut_ns = self._cut_ns, {}
        for event in self._active:
            for link in _cut_links(event):
                self._cut_ns[link] = before.get(link, self.now_ns)
        if self._cut_ns.keys() - before.keys():
            self.at(self.now_ns + int(LEASE_S * 1e9), self._synchronize)

    def sees(self, viewer: str, owner: str) -> bool | None:
        """Whether a session sees what another one declares; None: it sees what it saw before."""
        if not self._cut_ns or viewer == owner or WATCHER in (viewer, owner):
            return True
        links = (owner, ""), ("", viewer)
        since_ns = [self._cut_ns[link] for link in links if link in self._cut_ns]
        if not since_ns or FIELD in (viewer, owner):
            return True
        return None if self.now_ns - min(since_ns) < int(LEASE_S * 1e9) else False

    # Messages -----------------------------------------------------------------------------------

    def carry(self, receiver: str, key: str, payload: bytes, arrive: MessageCallback) -> None:
        """Carries a message of the present sender; each copy arrives at its time."""
        if not self._active:
            arrive(key, payload)
            return
        for delay_ns in self._delays_ns(self.sender, receiver, key):
            if delay_ns:
                self.at(self.now_ns + delay_ns, partial(arrive, key, payload))
            else:
                arrive(key, payload)

    def _delays_ns(self, sender: str, receiver: str, key: str) -> list[int]:
        """The delay of each copy that arrives."""
        if receiver == WATCHER:
            return [0]
        if sender == FIELD and key.startswith(INPUTS):
            return self._input_delays_ns(receiver)
        if not key.startswith(HELP):
            return [0]
        delays = [0]
        for event in self._active:
            if not _concerns(event, sender, receiver):
                continue
            dice = self.dice(event, sender, receiver)
            if event.kind in CUTS or (event.kind == "loss" and dice.random() < event.strength):
                return []
            if event.kind == "copies" and dice.random() < event.strength:
                delays.append(int(dice.uniform(0.0, MOST_LATE_COPY_S) * 1e9))
            if event.kind == "delay":
                delays = [d + int(dice.uniform(0.0, event.strength) * 1e9) for d in delays]
        return delays

    def _input_delays_ns(self, robot: str) -> list[int]:
        """The delays of an input, on the way from the robot's driver to the robot."""
        delay_ns = 0
        for event in self._active:
            if event.robot != robot or event.kind not in ("late-inputs", "lost-inputs"):
                continue
            dice = self.dice(event)
            if event.kind == "lost-inputs" and dice.random() < event.strength:
                return []
            if event.kind == "late-inputs":
                delay_ns += int(dice.uniform(0.0, event.strength) * 1e9)
        return [delay_ns]

    # Tokens -------------------------------------------------------------------------------------

    def watch(self, watch: "_Watch") -> Handle:
        self._watches.append(watch)
        return _Taken(lambda: _remove(self._watches, watch))

    def _synchronize(self) -> None:
        for watch in list(self._watches):
            watch.synchronize()


def _concerns(event: Event, sender: str, receiver: str) -> bool:
    """Whether an event may change messages of this sender to this receiver."""
    out, back = event.robot == sender, event.robot == receiver
    return {"mute": out, "deaf": back}.get(event.kind, out or back)


def _cut_links(event: Event) -> list[tuple[str, str]]:
    """The links (sender, receiver) on which an event hides tokens; empty: any other session."""
    out, back = (event.robot, ""), ("", event.robot)
    links = {"cut": [out, back], "mute": [out], "hidden-tokens": [out], "deaf": [back]}
    return links.get(event.kind, [])


def _remove(things: list[Thing], thing: Thing) -> None:
    if thing in things:
        things.remove(thing)


class _Taken(Handle):
    def __init__(self, undeclare: Callable[[], object]) -> None:
        self._undeclare: Callable[[], object] | None = undeclare

    def close(self) -> None:
        undeclare, self._undeclare = self._undeclare, None
        if undeclare is not None:
            undeclare()


class _Watch:
    """The tokens that one session watches, as it sees them."""

    def __init__(
        self, network: Network, viewer: str, keys: str, on_change: LivelinessCallback
    ) -> None:
        self._network, self._viewer, self._keys = network, viewer, keys
        self._on_change, self._seen = on_change, dict[str, str]()

    def synchronize(self) -> None:
        """Reports the tokens that have appeared, then those that have disappeared."""
        network, seen = self._network, self._seen
        here = {key: network.owners[key] for key in network.hub.tokens.find({self._keys})}
        sees = {
            owner: network.sees(self._viewer, owner) for owner in {*here.values(), *seen.values()}
        }
        new = [key for key, owner in here.items() if key not in seen and sees[owner]]
        gone = [
            key
            for key, owner in seen.items()
            if sees[owner] is False or (sees[owner] and key not in here)
        ]
        seen.update((key, here[key]) for key in new)
        for key in gone:
            del seen[key]
        for key in new:
            self._on_change(key, True)
        for key in gone:
            self._on_change(key, False)


class _Publisher(PublisherProxy):
    def __init__(self, publisher: Publisher, session: "_Session", key: str) -> None:
        super().__init__(publisher)
        self._session, self._key = session, key
        self._listed = session.listed("publishers", key)

    @property
    def matching(self) -> bool:
        if not self._publisher.matching:
            return False
        return not self._session.network.has_cuts or self._session.reaches_any(self._key)

    def put(self, payload: bytes) -> None:
        network, own = self._session.network, self._session.name
        network.on_put(own, self._key, payload)
        before, network.sender = network.sender, own
        self._publisher.put(payload)
        network.sender = before

    def close(self) -> None:
        self._listed.close()
        super().close()


class _Session(BusProxy):
    """One session: of a robot's process, the field, a guest or a hostile member."""

    def __init__(self, network: Network, name: str, on_delivery: OnDelivery) -> None:
        super().__init__(network.hub.session())
        self.network, self.name, self._on_delivery = network, name, on_delivery
        self._watched: list[Handle] = []

    def listed(self, what: str, key: str) -> Handle:
        """Lists a declaration until the handle is closed."""
        keys = self.network.declared[self.name][what]
        keys.append(key)
        return _Taken(lambda: _remove(keys, key))

    def reaches_any(self, key: str) -> bool:
        """Whether a subscriber is on this side of the cuts."""
        network, patterns = self.network, patterns_of(key)
        return any(
            network.sees(self.name, other) is not False
            for other, declared in network.declared.items()
            if other != self.name and any(k in patterns for k in declared["subscriptions"])
        )

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return _Publisher(super().publisher(key, qos), self, key)

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        network, is_open = self.network, [True]

        def arrive(key: str, payload: bytes) -> None:
            if is_open:  # a subscription that was taken back meanwhile receives nothing
                self._on_delivery(key, payload)
                on_message(key, payload)

        def on_put(key: str, payload: bytes) -> None:
            network.carry(self.name, key, payload, arrive)

        handle, listed = super().subscribe(keys, on_put), self.listed("subscriptions", keys)

        def close() -> None:
            is_open.clear()
            listed.close()
            handle.close()

        self._watched.append(taken := _Taken(close))
        return taken

    def declare_token(self, key: str) -> Handle:
        self.network.owners[key] = self.name
        handle, listed = super().declare_token(key), self.listed("tokens", key)

        def close() -> None:
            listed.close()
            handle.close()

        return _Taken(close)

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        watch = _Watch(self.network, self.name, keys, on_change)
        inner = super().watch_liveliness(keys, lambda key, alive: watch.synchronize())
        outer = self.network.watch(watch)
        watch.synchronize()

        def close() -> None:
            inner.close()
            outer.close()

        self._watched.append(taken := _Taken(close))
        return taken

    def close(self) -> None:
        while self._watched:
            self._watched.pop().close()
        super().close()
        for keys in self.network.declared[self.name].values():
            keys.clear()
