"""The log of a team that runs under faults: tracks, statuses, tokens and the ground truth.

All times are seconds of robot time since the run's epoch: those of stamps and those of arrivals.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from cpcbl_agents.clock import Clock
from cpcbl_launch.reporting.metrics import (
    Floats,
)
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Status, Track, Truths

TRUTH_EVERY_NS = 80_000_000
Value = TypeVar("Value")


class Heard(NamedTuple):
    """A track, and when it came."""

    at_s: float
    track: Track


class Said(NamedTuple):
    """A status, and when it came."""

    at_s: float
    status: Status


class Token(NamedTuple):
    """A robot's token came or went."""

    at_s: float
    robot: str
    tier: str
    incarnation: str
    alive: bool


class Notes(NamedTuple):
    """What was heard in a run."""

    epoch_ns: int
    tracks: Mapping[str, Sequence[Heard]]
    statuses: Mapping[str, Sequence[Said]]
    tokens: Sequence[Token]
    truth: Mapping[str, Floats]
    """Rows of seconds, x, y, heading, by robot."""


class NoteTaker:
    """Listens on one bus or several; what comes twice is put down once."""

    def __init__(self, clock: Clock, ahead_s: Mapping[str, float] = MappingProxyType({})) -> None:
        """`ahead_s`: how far robots' clocks are ahead of this one; their tracks are put right."""
        self._clock, self._lock = clock, threading.Lock()
        self._ahead_ns = {name: int(s * 1e9) for name, s in ahead_s.items()}
        self._tracks: dict[str, list[Heard]] = {}
        self._statuses: dict[str, list[Said]] = {}
        self._tokens: list[Token] = []
        self._rows: dict[str, list[tuple[float, float, float, float]]] = {}
        self._truth_ns = 0

    def listen(self, bus: Bus) -> None:
        """To what robots and the field say for people, and to tokens."""
        for topic in (topics.TRACK, topics.STATUS, topics.TRUTH):
            bus.subscribe(topic.at(), self._arrived)
        bus.watch_liveliness(topics.ALIVE.at(), self._seen)

    @property
    def now_s(self) -> float:
        return (self._clock.now_ns() - self._clock.epoch_ns) * 1e-9

    def _seen(self, key: str, alive: bool) -> None:
        names = topics.ALIVE.names(key)
        if names is not None:
            token = Token(self.now_s, names["robot"], names["tier"], names["incarnation"], alive)
            with self._lock:
                self._tokens.append(token)

    def _arrived(self, key: str, payload: bytes) -> None:
        at_s, message = self.now_s, decode(key, payload)
        with self._lock:
            match message:
                case Track(robot=robot, stamp_ns=stamp_ns):
                    stamp_ns -= self._ahead_ns.get(robot, 0)
                    track = msgspec.structs.replace(message, stamp_ns=stamp_ns)
                    _add(self._tracks.setdefault(robot, []), Heard(at_s, track))
                case Status(robot=robot):
                    _add(self._statuses.setdefault(robot, []), Said(at_s, message))
                case Truths() if self._is_next(message):
                    self._truth_ns = message.stamp_ns
                    stamp_s = (message.stamp_ns - self._clock.epoch_ns) * 1e-9
                    for t in message.robots:
                        row = (stamp_s, t.x_m, t.y_m, t.heading_rad)
                        self._rows.setdefault(t.robot, []).append(row)

    def _is_next(self, truths: Truths) -> bool:
        """Of truths not so many are needed, and some may be forged."""
        ahead_ns = truths.stamp_ns - self._truth_ns
        return ahead_ns >= TRUTH_EVERY_NS and truths.stamp_ns <= self._clock.now_ns()

    def notes(self) -> Notes:
        """All so far."""
        with self._lock:
            return Notes(
                self._clock.epoch_ns,
                {name: tuple(heard) for name, heard in self._tracks.items()},
                {name: tuple(said) for name, said in self._statuses.items()},
                tuple(self._tokens),
                {name: np.array(rows) for name, rows in self._rows.items()},
            )

    def taken(self, take: Callable[[Notes], Value]) -> Value:
        """A figure of all so far."""
        return take(self.notes())


_Dated = TypeVar("_Dated", Heard, Said)


def _add(kept: list[_Dated], new: _Dated) -> None:
    """Two sites tell the same twice, one soon after the other."""
    if all(new[1] != old[1] for old in kept[-20:]):
        kept.append(new)
