"""The log of a team that runs under faults: tracks, statuses, tokens and the ground truth.

All times are seconds of robot time since the run's epoch: those of stamps and those of arrivals.
"""

import threading
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from cpcbl_agents.clock import Clock
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Status, Track, Truths

TRUTH_EVERY_NS = 80_000_000
Value = TypeVar("Value")


class ReceivedTrack(NamedTuple):
    """A track, and when it arrived."""

    at_s: float
    track: Track


class ReceivedStatus(NamedTuple):
    """A status, and when it arrived."""

    at_s: float
    status: Status


class TokenEvent(NamedTuple):
    """A robot's liveliness token appeared or disappeared."""

    at_s: float
    robot: str
    tier: str
    incarnation: str
    alive: bool


class RunLog(NamedTuple):
    """What was received in a run."""

    epoch_ns: int
    tracks: Mapping[str, Sequence[ReceivedTrack]]
    statuses: Mapping[str, Sequence[ReceivedStatus]]
    tokens: Sequence[TokenEvent]
    truth: Mapping[str, Floats]
    """Rows of seconds, x, y, heading, by robot."""


class RunRecorder:
    """Records what it receives on one or several buses; a message that comes twice is kept once."""

    def __init__(self, clock: Clock, ahead_s: Mapping[str, float] = MappingProxyType({})) -> None:
        """`ahead_s`: how far each robot's clock is ahead; stamps of tracks are corrected."""
        self._clock, self._lock = clock, threading.Lock()
        self._ahead_ns = {name: int(s * 1e9) for name, s in ahead_s.items()}
        self._tracks: dict[str, list[ReceivedTrack]] = {}
        self._statuses: dict[str, list[ReceivedStatus]] = {}
        self._tokens: list[TokenEvent] = []
        self._rows: dict[str, list[tuple[float, float, float, float]]] = {}
        self._truth_ns = 0

    def listen(self, bus: Bus) -> None:
        """Subscribes to tracks, statuses, the ground truth and liveliness tokens."""
        for topic in (topics.TRACK, topics.STATUS, topics.TRUTH):
            bus.subscribe(topic.at(), self._arrived)
        bus.watch_liveliness(topics.ALIVE.at(), self._record_token)

    @property
    def now_s(self) -> float:
        return (self._clock.now_ns() - self._clock.epoch_ns) * 1e-9

    def _record_token(self, key: str, alive: bool) -> None:
        names = topics.ALIVE.names(key)
        if names is not None:
            token = TokenEvent(
                self.now_s, names["robot"], names["tier"], names["incarnation"], alive
            )
            with self._lock:
                self._tokens.append(token)

    def _arrived(self, key: str, payload: bytes) -> None:
        at_s, message = self.now_s, decode(key, payload)
        with self._lock:
            match message:
                case Track(robot=robot, stamp_ns=stamp_ns):
                    stamp_ns -= self._ahead_ns.get(robot, 0)
                    track = msgspec.structs.replace(message, stamp_ns=stamp_ns)
                    _add(self._tracks.setdefault(robot, []), ReceivedTrack(at_s, track))
                case Status(robot=robot):
                    _add(self._statuses.setdefault(robot, []), ReceivedStatus(at_s, message))
                case Truths() if self._is_next(message):
                    self._truth_ns = message.stamp_ns
                    stamp_s = (message.stamp_ns - self._clock.epoch_ns) * 1e-9
                    for t in message.robots:
                        row = (stamp_s, t.x_m, t.y_m, t.heading_rad)
                        self._rows.setdefault(t.robot, []).append(row)

    def _is_next(self, truths: Truths) -> bool:
        """Whether to keep it: a part is enough, and a forged one may have a stamp in the future."""
        ahead_ns = truths.stamp_ns - self._truth_ns
        return ahead_ns >= TRUTH_EVERY_NS and truths.stamp_ns <= self._clock.now_ns()

    def run_log(self) -> RunLog:
        """All that was received so far."""
        with self._lock:
            return RunLog(
                self._clock.epoch_ns,
                {name: tuple(heard) for name, heard in self._tracks.items()},
                {name: tuple(statuses) for name, statuses in self._statuses.items()},
                tuple(self._tokens),
                {name: np.array(rows) for name, rows in self._rows.items()},
            )


_Dated = TypeVar("_Dated", ReceivedTrack, ReceivedStatus)


def _add(kept: list[_Dated], new: _Dated) -> None:
    """Adds a message unless it is among the latest: two sites send each message twice."""
    if all(new[1] != old[1] for old in kept[-20:]):
        kept.append(new)
