"""What the page needs to know of a running team: of every robot the newest message of each kind.

Its callbacks run on threads of the bus. Sightings are subscribed to only while somebody watches,
and a camera's annotated frames only while somebody has that camera open.
"""

import bisect
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import NamedTuple

from cpcbl_launch.reporting.frames import FrameOrigins
from cpcbl_launch.views.traffic import Arrival, with_arrival
from cpcbl_team.frames import FIELD
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import (
    AnnotatedFrame,
    LandmarkEstimate,
    Status,
    Track,
    Truth,
    Truths,
)

MOST_UNNAMED = 100  # robots that the team file does not name; more are ignored
TRUTHS = 150  # the last 3 s of the simulated field's, at 50 Hz
ALL_SIGHTINGS = ""  # beside the names of robots whose camera is watched
UNSCORED = 20  # tracks of a robot that wait for their truth
HISTORY_S, HISTORY_STEP_S = 120.0, 0.5  # what a page that is opened later can still plot


class TrailPoint(NamedTuple):
    """A robot at one time, for trails and plots."""

    at_s: float
    x_m: float
    y_m: float
    sigma_m: float | None
    error_m: float | None


class LatestMessages(NamedTuple):
    """The newest that was received of one robot; times of arrival are real seconds."""

    track: Track | None = None
    track_s: float = 0.0
    sightings: Sightings | None = None
    sightings_s: float = 0.0
    arrivals: Sequence[Arrival] = ()  # of statuses, the latest last
    tokens: frozenset[str] = frozenset()
    token_lost_s: float | None = None  # when the last token disappeared; None while there is one
    latest_s: float = 0.0  # of any track or status
    pause_s: float = 0.0  # between the last ones of them
    error_m: float | None = None  # the distance to the truth at the stamp of a track
    places: tuple[LandmarkEstimate, ...] = ()
    places_frame: str = FIELD  # in which they are
    """Of the latest status. These and the track are in the field's frame, where theirs is known."""

    @property
    def status(self) -> Status | None:
        return self.arrivals[-1].status if self.arrivals else None

    @property
    def is_present(self) -> bool:
        """Whether anything was received of it."""
        return bool(self.latest_s or self.tokens or self.token_lost_s)


class TruthAt(NamedTuple):
    """The true poses of the simulated robots at one time."""

    stamp_ns: int
    robots: Mapping[str, Truth]


class Snapshot(NamedTuple):
    """The whole feed at one time."""

    robots: Mapping[str, LatestMessages] = MappingProxyType({})
    truths: Mapping[str, Truth] = MappingProxyType({})
    problem: str = ""  # of the connection; empty while there is one
    connected_s: float | None = None  # since when there is one


class Feed:
    """Receives what robots send, from the moment at which it is attached to a bus."""

    def __init__(
        self, robots: Collection[str], now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """`robots`: those of the team file, none where it is not at hand."""
        self.named, self.now_s = frozenset(robots), now_s
        self._lock, self._bus_lock = threading.Lock(), threading.Lock()
        self._bus: Bus | None = None
        self._robots = dict.fromkeys(robots, LatestMessages())
        self._history: dict[str, deque[TrailPoint]] = {}
        self._truths: deque[TruthAt] = deque(maxlen=TRUTHS)
        self._origins = FrameOrigins()
        self._unscored: dict[str, deque[Track]] = {}  # tracks that came before their truth
        self._problem = "not connected yet"
        self._connected_s: float | None = None
        self._while_watched: dict[str, Handle] = {}  # by robot, and one for all sightings
        self._camera_watchers = Counter[str]()
        self._frames: dict[str, AnnotatedFrame] = {}
        self._watchers = 0

    # From the threads of the server ---------------------------------------------------------------

    @contextmanager
    def attach(self, bus: Bus) -> Iterator[None]:
        """Subscribes, until the end; the bus must not be closed before."""
        with self._bus_lock:
            self._bus = bus
            lasting: list[Handle] = [
                Subscriber(bus, Track, self._on_track),
                Subscriber(bus, Status, self._on_status),
                Subscriber(bus, Truths, self._on_truths),
                bus.watch_liveliness(topics.ALIVE.at(), self._on_token),
            ]
        self.set_problem("")
        self._subscribe()
        try:
            yield
        finally:
            with self._bus_lock:
                self._bus = None
                for handle in (*lasting, *self._while_watched.values()):
                    handle.close()
                self._while_watched.clear()

    def set_problem(self, problem: str) -> None:
        """Why there is no connection at present; empty while there is one."""
        with self._lock:
            if not problem and self._connected_s is None:
                self._connected_s = self.now_s()
            elif problem:
                self._connected_s = None
            self._problem = problem

    def clear(self) -> None:
        """Forgets all that was received: a playback goes on at another time."""
        with self._lock:
            self._robots = dict.fromkeys(sorted(self.named), LatestMessages())
            for log in (self._history, self._truths, self._unscored, self._frames):
                log.clear()
            self._origins = FrameOrigins()
            self._connected_s = self.now_s()

    def watch(self, more: int) -> None:
        """So many more pages (or fewer) are open."""
        with self._lock:
            self._watchers += more
        self._subscribe()

    def watch_camera(self, robot: str, more: int) -> None:
        """So many more pages (or fewer) show the camera of this robot."""
        with self._lock:
            self._camera_watchers[robot] += more
        self._subscribe()

    def _subscribe(self) -> None:
        """Subscribes to what is watched, and to nothing else."""
        with self._bus_lock:
            if (bus := self._bus) is None:
                return
            with self._lock:
                wanted = {robot for robot, n in self._camera_watchers.items() if n > 0}
                if self._watchers > 0:
                    wanted.add(ALL_SIGHTINGS)
            for name in wanted - self._while_watched.keys():
                if name == ALL_SIGHTINGS:
                    handle: Handle = Subscriber(bus, Sightings, self._on_sightings)
                else:
                    handle = Subscriber(bus, AnnotatedFrame, self._on_frame, robot=name)
                self._while_watched[name] = handle
            for name in self._while_watched.keys() - wanted:
                self._while_watched.pop(name).close()
                with self._lock:
                    self._frames.pop(name, None)

    def snapshot(self) -> Snapshot:
        with self._lock:
            truths = self._truths[-1].robots if self._truths else {}
            return Snapshot(dict(self._robots), truths, self._problem, self._connected_s)

    def history(self) -> dict[str, tuple[TrailPoint, ...]]:
        """What plots and trails begin with."""
        with self._lock:
            return {name: tuple(samples) for name, samples in self._history.items()}

    def frame(self, robot: str) -> AnnotatedFrame | None:
        """The newest annotated frame of a camera that is watched."""
        with self._lock:
            return self._frames.get(robot)

    # From the threads of the bus ------------------------------------------------------------------

    def _latest_of(self, robot: str) -> LatestMessages | None:
        """What is known of a robot; None for one too many that the team file does not name."""
        latest = self._robots.get(robot)
        if latest is None and len(self._robots) - len(self.named) < MOST_UNNAMED:
            latest = LatestMessages()
        return latest

    def _on_track(self, received: Received[Track]) -> None:
        track, now_s = received.message, self.now_s()
        with self._lock:
            if (latest := self._latest_of(track.robot)) is None:
                return
            self._origins.note_track(track)
            track = self._origins.in_field(track)
            if latest.track is not None and latest.track.frame != track.frame:
                self._history.pop(track.robot, None)  # of another frame
            self._unscored.setdefault(track.robot, deque(maxlen=UNSCORED)).append(track)
            error_m = self._score(track.robot, latest.error_m)
            self._robots[track.robot] = with_arrival_time(latest, now_s)._replace(
                track=track, track_s=now_s, error_m=error_m
            )
            self._store_point(track, now_s, error_m)

    def _store_point(self, track: Track, now_s: float, error_m: float | None) -> None:
        most = int(HISTORY_S / HISTORY_STEP_S)
        samples = self._history.setdefault(track.robot, deque(maxlen=most))
        if not samples or now_s - samples[-1].at_s >= HISTORY_STEP_S:
            sigma_m = position_sigma_m(track)
            samples.append(TrailPoint(now_s, track.x_m, track.y_m, sigma_m, error_m))

    def _on_status(self, received: Received[Status]) -> None:
        status, now_s = received.message, self.now_s()
        with self._lock:
            if (latest := self._latest_of(status.robot)) is not None:
                arrivals = with_arrival(latest.arrivals, now_s, status)
                places, frame = self._origins.places_in_field(status.places, status.frame)
                self._robots[status.robot] = with_arrival_time(latest, now_s)._replace(
                    arrivals=arrivals, places=places, places_frame=frame
                )

    def _on_sightings(self, received: Received[Sightings]) -> None:
        names = topics.IN_SIGHTINGS.names(received.key) or {}
        self._store_sightings(names.get("robot", ""), received.message)

    def _on_frame(self, received: Received[AnnotatedFrame]) -> None:
        frame = received.message
        with self._lock:
            self._frames[frame.robot] = frame
        # A robot with a camera does not publish its sightings
        self._store_sightings(frame.robot, Sightings(frame.stamp_ns, frame.found))

    def _store_sightings(self, robot: str, sightings: Sightings) -> None:
        now_s = self.now_s()
        with self._lock:
            if robot in self._robots:
                latest = self._robots[robot]
                self._robots[robot] = latest._replace(sightings=sightings, sightings_s=now_s)

    def _on_truths(self, received: Received[Truths]) -> None:
        stamp_ns = received.message.stamp_ns
        truths = TruthAt(stamp_ns, {truth.robot: truth for truth in received.message.robots})
        with self._lock:
            self._origins.note_truths(received.message)
            if self._truths and stamp_ns <= self._truths[-1].stamp_ns:
                self._truths.clear()  # of another field
            self._truths.append(truths)
            for robot, tracks in self._unscored.items():
                if tracks and tracks[0].stamp_ns <= stamp_ns:
                    latest = self._robots[robot]
                    error_m = self._score(robot, latest.error_m)
                    self._robots[robot] = latest._replace(error_m=error_m)

    def _score(self, robot: str, error_m: float | None) -> float | None:
        """The error of the newest track for whose stamp the truth is known, else the one before."""
        tracks, until_ns = self._unscored[robot], -1
        if self._truths:
            until_ns = self._truths[-1].stamp_ns
        while tracks and tracks[0].stamp_ns <= until_ns:
            track = tracks.popleft()
            if track.frame:  # nobody knows where that is
                error_m = None
            elif (known := pose_at(self._truths, robot, track.stamp_ns)) is not None:
                error_m = _distance_m(known, track)
        return error_m

    def _on_token(self, key: str, alive: bool) -> None:
        names = topics.ALIVE.names(key) or {}
        robot, now_s = names.get("robot", ""), self.now_s()
        with self._lock:
            if (latest := self._latest_of(robot)) is None:
                return
            tokens = latest.tokens | {key} if alive else latest.tokens - {key}
            lost_s = None if tokens else now_s
            self._robots[robot] = latest._replace(tokens=tokens, token_lost_s=lost_s)


def with_arrival_time(latest: LatestMessages, now_s: float) -> LatestMessages:
    pause_s = now_s - latest.latest_s if latest.latest_s else 0.0
    pause_s = max(pause_s, 0.5 * latest.pause_s)  # a track and a status may come together
    return latest._replace(latest_s=now_s, pause_s=pause_s)


def _distance_m(truth: Truth, track: Track) -> float:
    return float(((truth.x_m - track.x_m) ** 2 + (truth.y_m - track.y_m) ** 2) ** 0.5)


def position_sigma_m(track: Track) -> float | None:
    """The position sigma of a track, the root of the mean variance; None without a covariance."""
    if track.covariance is None:
        return None
    return float(max(0.0, 0.5 * (track.covariance[0] + track.covariance[2])) ** 0.5)


def pose_at(truths: Sequence[TruthAt], robot: str, stamp_ns: int) -> Truth | None:
    """The true pose of a robot at this time, between two that are known; None outside of them."""
    later = bisect.bisect_left(truths, stamp_ns, key=lambda at: at.stamp_ns)
    if later == len(truths):
        return None
    until_ns, after = truths[later].stamp_ns, truths[later].robots.get(robot)
    if until_ns == stamp_ns or after is None:
        return after
    from_ns, before = truths[later - 1].stamp_ns, truths[later - 1].robots.get(robot)
    if later == 0 or before is None:
        return None
    share = (stamp_ns - from_ns) / (until_ns - from_ns)
    turn_rad = wrap_angle(after.heading_rad - before.heading_rad)
    return Truth(
        robot,
        before.x_m + share * (after.x_m - before.x_m),
        before.y_m + share * (after.y_m - before.y_m),
        before.heading_rad + share * turn_rad,
    )
