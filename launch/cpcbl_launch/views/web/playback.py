"""Plays a recorded run into the feed of the page: as fast as one likes, from any time on.

All open pages show the same time. After a jump the messages of the minute before it are played at
once, so that trails and plots are there.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.reporting.recorded_file import Recorded, RecordedFile
from cpcbl_launch.views.web.feed import Feed
from cpcbl_team.inputs import Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Publisher
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import AnnotatedFrame, Status, Track, Truths, encode

CYCLE_S = 0.05
BEFORE_NS = 60_000_000_000  # what plots show
RECENT_NS = 6_000_000_000  # of which rates are known
STEP_NS = 450_000_000  # between two points of a plot
SLOWEST, FASTEST = 0.1, 100.0
SHOWN = (Track, Status, Truths, Sightings, AnnotatedFrame)


class Playing(NamedTuple):
    """What a page shows of the playback itself."""

    jumps: int  # after each one, what a page has drawn is of another time
    speed: float
    is_playing: bool
    problem: str = ""  # why it cannot be read on


class Playback:
    """The time of a recording, and the feed of what it holds until then."""

    def __init__(self, recording: RecordedFile) -> None:
        self._recording = recording
        span = recording.span(("track/", "status/"))
        if span is None:
            raise LogError(f"{recording.path}: holds no pose and no status of any robot")
        self.begin_ns, self._end_ns = span
        self.duration_s = (self._end_ns - self.begin_ns) * 1e-9
        self._at_ns, self._published_ns = self.begin_ns, self.begin_ns
        self._speed, self._is_playing, self._jumps = 1.0, True, 0
        self._jump_to_ns: int | None = self.begin_ns
        self._problem = ""
        self._changed = threading.Condition()
        self._hub = MemoryHub()
        self._publishers: dict[str, Publisher] = {}
        self._bus = self._hub.session()
        self.feed = Feed(recording.team.robots, self.now_s)

    def now_s(self) -> float:
        """Seconds since the begin of the recording, at the message that is being played."""
        return (self._published_ns - self.begin_ns) * 1e-9

    @property
    def playing(self) -> Playing | None:
        """None while it jumps."""
        with self._changed:
            if self._jump_to_ns is not None:
                return None
            return Playing(self._jumps, self._speed, self._is_playing, self._problem)

    def control(
        self, at_s: float | None = None, speed: float | None = None, play: bool | None = None
    ) -> None:
        """Jumps, plays faster or slower, pauses or goes on; at its end it begins again."""
        with self._changed:
            if speed is not None:
                self._speed = min(max(speed, SLOWEST), FASTEST)
            if at_s is not None:
                at_ns = self.begin_ns + round(at_s * 1e9)
                self._jump_to_ns = min(max(at_ns, self.begin_ns), self._end_ns)
            if play is not None:
                self._is_playing = play
                if play and at_s is None and self._at_ns >= self._end_ns:
                    self._jump_to_ns = self.begin_ns
            self._changed.notify()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Plays on a thread of its own, until the end."""
        stop = threading.Event()
        thread = threading.Thread(target=self._run, args=(stop,), name="playback", daemon=True)
        with self.feed.attach(self._hub.session()):
            thread.start()
            try:
                yield
            finally:
                stop.set()
                with self._changed:
                    self._changed.notify()
                thread.join()

    def _run(self, stop: threading.Event) -> None:
        messages: Iterator[Recorded] = iter(())
        waiting: Recorded | None = None
        before_s = time.monotonic()
        while not stop.is_set():
            with self._changed:
                self._changed.wait_for(lambda: self._jump_to_ns is not None, CYCLE_S)
                jump_to_ns = self._jump_to_ns
            now_s = time.monotonic()
            if jump_to_ns is not None:
                self.feed.clear()
                self._problem = ""
                messages, waiting = self._messages(jump_to_ns), None
                at_ns = jump_to_ns
            else:
                elapsed_ns = round((now_s - before_s) * 1e9 * self._speed)
                at_ns = min(self._at_ns + elapsed_ns * self._is_playing, self._end_ns)
            before_s = now_s
            try:
                waiting = self._play_until(at_ns, waiting, messages)
            except LogError as error:  # from here on it is damaged
                self._problem, waiting = str(error), None
            if jump_to_ns is not None:
                before_s = time.monotonic()
            self._arrive(at_ns, jump_to_ns)

    def _play_until(
        self, until_ns: int, waiting: Recorded | None, messages: Iterator[Recorded]
    ) -> Recorded | None:
        """Publishes what is due; returns the message that comes next."""
        while True:
            waiting = waiting or next(messages, None)
            if waiting is None or waiting.at_ns > until_ns:
                return waiting
            self._published_ns = waiting.at_ns
            self._publish(waiting)
            waiting = None

    def _arrive(self, at_ns: int, jumped_to_ns: int | None) -> None:
        with self._changed:
            self._at_ns = self._published_ns = at_ns
            if at_ns >= self._end_ns:
                self._is_playing = False
            if jumped_to_ns is not None:
                self._jumps += 1
                if self._jump_to_ns == jumped_to_ns:  # nobody wants to be elsewhere meanwhile
                    self._jump_to_ns = None

    def _messages(self, to_ns: int) -> Iterator[Recorded]:
        """From the minute before a time on: at first what trails and plots need, then all."""
        recent_ns = max(self.begin_ns, to_ns - RECENT_NS)
        if recent_ns > self.begin_ns:
            from_ns = max(self.begin_ns, to_ns - BEFORE_NS)
            yield from _thin(self._recording.messages(_is_in_plots, from_ns, recent_ns))
        yield from self._recording.messages(_is_shown, recent_ns, self._end_ns + 1)

    def _publish(self, recorded: Recorded) -> None:
        key, message = recorded.key, recorded.message
        if not isinstance(message, SHOWN):
            return
        if key not in self._publishers:
            self._publishers[key] = self._bus.publisher(key, topics.Qos.TELEMETRY)
        self._publishers[key].put(encode(message))


def _is_shown(key: str) -> bool:
    return key.endswith("/sightings") or _is_in_plots(key) or key.startswith(("status/", "look/"))


def _is_in_plots(key: str) -> bool:
    return key.startswith(("track/", topics.TRUTH.key))


def _thin(messages: Iterator[Recorded]) -> Iterator[Recorded]:
    """Without most poses, of which a plot shows a few a second."""
    latest_ns: dict[str, int] = {}
    for recorded in messages:
        if isinstance(recorded.message, Track):
            if recorded.at_ns - latest_ns.get(recorded.key, -STEP_NS) < STEP_NS:
                continue
            latest_ns[recorded.key] = recorded.at_ns
        yield recorded
