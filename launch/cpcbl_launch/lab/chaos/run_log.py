"""The log of a team that runs under faults, and the figures that are computed from it.

All times are seconds of robot time since the run's epoch: those of stamps and those of arrivals.
"""

import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cpcbl_agents.clock import Clock
from cpcbl_launch.lab.chaos.consistency import Consistency, consistency
from cpcbl_launch.lab.chaos.machine import IDLE, MachineLog
from cpcbl_launch.reporting import metrics
from cpcbl_launch.reporting.metrics import Floats, Samples
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Status, Track, Trust, Truths

FOUND_M = 0.3
TRUTH_EVERY_NS = 80_000_000
TRACKS_HZ = 10.0
EVER_S = (-np.inf, np.inf)


class ReceivedTrack(NamedTuple):
    """A track, when it arrived, and its stamp."""

    at_s: float
    stamp_s: float
    track: Track


class TokenEvent(NamedTuple):
    """A robot's liveliness token appeared or disappeared."""

    at_s: float
    robot: str
    tier: str
    incarnation: str
    alive: bool


class RunLog(NamedTuple):
    """What was received in a run. A figure `..._after_s` is a time after `from_s`, or None if what
    it measures did not happen."""

    epoch_ns: int
    tracks: Mapping[str, Sequence[ReceivedTrack]]
    statuses: Mapping[str, Sequence[tuple[float, Status]]]  # each with the time at which it arrived
    tokens: Sequence[TokenEvent]
    truth: Mapping[str, Floats]  # rows of seconds, x, y, heading, by robot
    machine: MachineLog = IDLE
    left_out: Mapping[str, Sequence[tuple[float, float]]] = MappingProxyType({})
    """By robot, the times (from, until) whose tracks are not judged, and not here."""

    # Tokens -------------------------------------------------------------------------------------

    def token_gone_after_s(self, robot: str, from_s: float) -> float | None:
        """The last token of a robot disappeared."""
        alive: set[tuple[str, str]] = set()
        for token in self.tokens:
            if token.robot != robot:
                continue
            key = token.tier, token.incarnation
            (alive.add if token.alive else alive.discard)(key)
            if token.at_s >= from_s and not alive:
                return token.at_s - from_s
        return None

    def token_back_after_s(self, robot: str, from_s: float, not_of: str = "") -> float | None:
        """A token of the robot appeared, declared by another process than `not_of`."""
        mine = (t for t in self.tokens if t.robot == robot and t.alive and t.incarnation != not_of)
        return _first((t.at_s for t in mine), from_s)

    def latest_incarnation(self, robot: str) -> str:
        """The process that declared the robot's last token; empty if there was none."""
        mine = [t.incarnation for t in self.tokens if t.robot == robot and t.alive]
        return mine[-1] if mine else ""

    # Tracks -------------------------------------------------------------------------------------

    def first_track_after_s(self, robot: str, from_s: float) -> float | None:
        """The first track with a later stamp arrived."""
        return _first((t.at_s for t in self.tracks.get(robot, ()) if t.stamp_s >= from_s), from_s)

    def longest_track_gap_s(self, robot: str, from_s: float, until_s: float) -> float:
        """The longest time within [from_s, until_s] in which no track of the robot arrived."""
        arrivals = [t.at_s for t in self.tracks.get(robot, ()) if from_s < t.at_s < until_s]
        return max(b - a for a, b in pairwise([from_s, *arrivals, until_s]))

    def track_delay_s(self, robot: str, from_s: float, until_s: float) -> float | None:
        """The 99th percentile of the delay of a robot's tracks: arrival minus stamp."""
        arrived = (t for t in self.tracks.get(robot, ()) if from_s <= t.at_s < until_s)
        delays = [t.at_s - t.stamp_s for t in arrived]
        return float(np.quantile(delays, 0.99)) if delays else None

    def late_track_count(self, robot: str, from_s: float, late_s: float) -> int:
        """How many tracks arrived after `from_s`, each more than `late_s` after its stamp."""
        arrived = (t for t in self.tracks.get(robot, ()) if t.at_s >= from_s)
        return sum(t.at_s - t.stamp_s > late_s for t in arrived)

    # Positions ----------------------------------------------------------------------------------

    def localized_after_s(
        self, robot: str, from_s: float, within_m: float = FOUND_M
    ) -> float | None:
        """The robot was within `within_m` of the truth and not lost, from then on for 1 s."""
        stamps_s, samples = self._samples(robot, from_s, np.inf)
        lost = {t.stamp_s for t in self.tracks.get(robot, ()) if t.track.lost}
        since_s: float | None = None
        errors_m = metrics.position_errors(samples)
        for stamp_s, error_m in zip(stamps_s.tolist(), errors_m, strict=True):
            if error_m <= within_m and stamp_s not in lost:
                since_s = stamp_s if since_s is None else since_s
                if stamp_s - since_s >= 1.0:
                    return since_s - from_s
            else:
                since_s = None
        return None

    def position_rmse_m(self, robot: str, from_s: float, until_s: float = np.inf) -> float | None:
        """Root mean square of the position error over the tracks stamped in [from_s, until_s)."""
        return metrics.score(self._samples(robot, from_s, until_s)[1]).position_rmse_m

    def largest_position_error_m(self, robot: str, from_s: float, until_s: float) -> float | None:
        """The largest position error of the tracks stamped in [from_s, until_s)."""
        return metrics.score(self._samples(robot, from_s, until_s)[1]).position_max_m

    def errors(self, robot: str) -> Iterator[tuple[float, float, float]]:
        """(stamp s, position error m, its NEES) of each track."""
        stamps_s, samples = self._samples(robot, *EVER_S)
        nees = metrics.position_nees(samples)
        if nees is not None:
            columns = stamps_s, metrics.position_errors(samples), nees
            yield from zip(*(column.tolist() for column in columns), strict=True)

    def consistency(self, robot: str, from_s: float, until_s: float) -> Consistency | None:
        """How well the robot's stated uncertainty fits its errors in [from_s, until_s)."""
        window = self._samples(robot, from_s, until_s)[1]
        return consistency(robot, window, self._samples(robot, *EVER_S)[1], TRACKS_HZ)

    def first_position_jump(self, robot: str) -> tuple[float, float] | None:
        """(time, metres) of the first jump of a robot's true position by at least 1 m."""
        rows = self.truth.get(robot)
        if rows is None:
            return None
        steps = np.hypot(*np.diff(rows[:, 1:3], axis=0).T)
        jumps = np.flatnonzero(steps >= 1.0)
        return (float(rows[jumps[0] + 1, 0]), float(steps[jumps[0]])) if len(jumps) else None

    def _samples(self, robot: str, from_s: float, until_s: float) -> tuple[Floats, Samples]:
        """(stamps s, estimates beside truths) of the tracks stamped in [from_s, until_s)."""
        received = self.tracks.get(robot, ()) if robot in self.truth else ()
        chosen = [t for t in received if from_s <= t.stamp_s < until_s and t.track.covariance]
        if not chosen:
            return np.empty(0), Samples(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 6)))
        stamps_s = np.array([t.stamp_s for t in chosen])
        estimate = np.array([(t.track.x_m, t.track.y_m, t.track.heading_rad) for t in chosen])
        covariance = np.array([t.track.covariance for t in chosen])
        truth, known = metrics.interpolated_truth(stamps_s, self.truth[robot])
        return stamps_s[known], Samples(estimate[known], truth[known], covariance[known])

    # Statuses -----------------------------------------------------------------------------------

    def reported_lost_after_s(self, robot: str, from_s: float) -> float | None:
        """The robot first reported that it is lost: in a track, or in a count of its status if it
        was localized again before its next track."""
        times_s, known = [t.stamp_s for t in self.tracks.get(robot, ()) if t.track.lost], 0
        for at_s, status in self.statuses.get(robot, ()):
            count = status.counts.get("lost", 0)
            times_s += [at_s] if count > known else []
            known = count
        return _first(sorted(times_s), from_s)

    def first_help_after_s(self, robot: str, helpers: Sequence[str], from_s: float) -> float | None:
        """The robot first reported later help of these, up to a second after it received it."""
        from_ns = self.epoch_ns + int(from_s * 1e9)
        helped = (
            at_s
            for at_s, status in self.statuses.get(robot, ())
            if any(f.peer in helpers and f.latest_ns >= from_ns for f in status.heard)
        )
        return _first(helped, from_s)

    def counts_between(self, robot: str, from_s: float, until_s: float = np.inf) -> Counter[str]:
        """The robot's counts between its statuses of [from_s, until_s], over all its processes."""
        before: dict[str, Counter[str]] = {}
        after: dict[str, Counter[str]] = {}
        for at_s, status in self.statuses.get(robot, ()):
            if at_s <= until_s:
                (before if at_s <= from_s else after)[status.incarnation] = _counts(status)
        changes = (counts - before.get(process, Counter()) for process, counts in after.items())
        return sum(changes, Counter())

    def latest_counts(self, robot: str) -> Counter[str]:
        """The counts of the robot's latest process, by its latest status."""
        received = self.statuses.get(robot)
        return _counts(received[-1][1]) if received else Counter()

    def distrust_reported_at_s(
        self, robot: str, peer: str, window_s: tuple[float, float] = EVER_S, reason: str = ""
    ) -> float | None:
        """When, within the window, a robot first reported that it distrusts a teammate, for this
        reason (default: for any)."""
        for at_s, status in self.statuses.get(robot, ()):
            reasons = {t.reason for t in status.trust if t.peer == peer} - {""}
            if window_s[0] <= at_s < window_s[1] and (reason in reasons if reason else reasons):
                return at_s
        return None

    def distrusted_peers(self, robot: str) -> dict[str, str]:
        """The teammates that a robot distrusts by its latest status, and why."""
        return {trust.peer: trust.reason for trust in self.latest_trust(robot) if trust.reason}

    def latest_trust(self, robot: str) -> Sequence[Trust]:
        """What a robot makes of its teammates by its latest status."""
        received = self.statuses.get(robot)
        return received[-1][1].trust if received else ()


def maximum(values: Iterable[float | None]) -> float | None:
    """The largest of the figures; None if one is missing or there are none."""
    known = list(values)
    return max((v for v in known if v is not None), default=None) if None not in known else None


def worst(of: Callable[..., float | None], robots: Iterable[str], *times_s: float) -> float | None:
    """The largest of these robots' figures; None if one is missing or there are none."""
    return maximum(of(name, *times_s) for name in robots)


def _first(times_s: Iterable[float], from_s: float) -> float | None:
    return next((at_s - from_s for at_s in times_s if at_s >= from_s), None)


def _counts(status: Status) -> Counter[str]:
    return Counter(status.counts) + Counter(messages_received=status.messages_received)


# Recording ----------------------------------------------------------------------------------------


class RunRecorder:
    """Records what it receives on a bus."""

    def __init__(self, clock: Clock, ahead_s: Mapping[str, float] = MappingProxyType({})) -> None:
        """`ahead_s`: how far each robot's clock is ahead; stamps of tracks are corrected."""
        self._clock, self._ahead_s, self._lock = clock, ahead_s, threading.Lock()
        self._tracks = defaultdict[str, list[ReceivedTrack]](list)
        self._statuses = defaultdict[str, list[tuple[float, Status]]](list)
        self._tokens: list[TokenEvent] = []
        self._rows = defaultdict[str, list[tuple[float, float, float, float]]](list)
        self._truth_ns = 0

    def listen(self, bus: Bus) -> None:
        """Subscribes to tracks, statuses, the ground truth and liveliness tokens."""
        for topic in (topics.TRACK, topics.STATUS, topics.TRUTH):
            bus.subscribe(topic.at(), self._on_message)
        bus.watch_liveliness(topics.ALIVE.at(), self._record_token)

    @property
    def now_s(self) -> float:
        return self._robot_time_s(self._clock.now_ns())

    @property
    def zero_s(self) -> float:
        """The machine's monotonic clock when robot time began."""
        return self._clock.from_ns * 1e-9

    def _robot_time_s(self, stamp_ns: int) -> float:
        return (stamp_ns - self._clock.epoch_ns) * 1e-9

    def _record_token(self, key: str, alive: bool) -> None:
        if names := topics.ALIVE.names(key):
            with self._lock:
                self._tokens.append(TokenEvent(self.now_s, alive=alive, **names))

    def _on_message(self, key: str, payload: bytes) -> None:
        at_s, message = self.now_s, decode(key, payload)
        with self._lock:
            match message:
                case Track(robot=robot):
                    ahead_ns = int(self._ahead_s.get(robot, 0.0) * 1e9)
                    stamp_s = self._robot_time_s(message.stamp_ns - ahead_ns)
                    self._tracks[robot].append(ReceivedTrack(at_s, stamp_s, message))
                case Status(robot=robot):
                    self._statuses[robot].append((at_s, message))
                case Truths() if self._is_next(message):
                    self._truth_ns = message.stamp_ns
                    stamp_s = self._robot_time_s(message.stamp_ns)
                    for t in message.robots:
                        self._rows[t.robot].append((stamp_s, t.x_m, t.y_m, t.heading_rad))

    def _is_next(self, truths: Truths) -> bool:
        """Whether to keep it: a part is enough, and a forged one may have a stamp in the future."""
        ahead_ns = truths.stamp_ns - self._truth_ns
        return ahead_ns >= TRUTH_EVERY_NS and truths.stamp_ns <= self._clock.now_ns()

    def run_log(self) -> RunLog:
        """All that was received so far."""
        with self._lock:
            return RunLog(
                self._clock.epoch_ns,
                {name: tuple(received) for name, received in self._tracks.items()},
                {name: tuple(received) for name, received in self._statuses.items()},
                tuple(self._tokens),
                {name: np.array(rows) for name, rows in self._rows.items()},
            )
