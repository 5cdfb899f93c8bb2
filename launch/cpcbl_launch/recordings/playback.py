"""The tape that plays a recording: it gives a node what it took, and compares what comes out.

The node runs as it did: nothing of it is replaced but what stands between it and the world.
"""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import Any, TypeVar, cast

from msgspec.structs import asdict, replace

from cpcbl_agents.arrivals import Arrivals
from cpcbl_agents.detection_worker import DetectedFrame, Detection
from cpcbl_agents.flight_recorder.entries import (
    Answered,
    AnyEntry,
    Declared,
    Detected,
    FrameTaken,
    MessageTaken,
    Outgoing,
    Polled,
    Put,
    Step,
    TokenTaken,
    Undeclared,
)
from cpcbl_agents.flight_recorder.images import CARRIES_IMAGES, without_image
from cpcbl_agents.flight_recorder.states import StateError, decode_state, encode_state
from cpcbl_agents.node import NO_CALLBACKS
from cpcbl_agents.sources import OwnCamera
from cpcbl_agents.tape import SourceT, Tape
from cpcbl_launch.recordings.differences import DifferenceError
from cpcbl_team.inputs import MarkerSighting, Sightings
from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.messages import LARGEST_FRAME, AnnotatedFrame, decode_tagged
from cpcbl_transport.topics import Qos

OnPut = Callable[[str, bytes], None]
EntryT = TypeVar("EntryT")


def ignore(key: str, payload: bytes) -> None:
    """Does nothing with what a node puts on the bus."""


class Playback(Tape):
    """Plays one step after the other: `load` each before the node makes it. `on_put` is called with
    each message that the node puts on the bus.

    Raises DifferenceError where the node does something else than it did.
    """

    restored_as = ("tape",)

    def __init__(self, on_put: OnPut = ignore) -> None:
        self._on_put = on_put
        self._step, self._next = Step(0, ()), 0
        self._answers: dict[str, Any] = {}
        self.input: AnyEntry | None = None  # the one that was taken last in this step
        self._handled = 0
        self.waiting_tokens = self.waiting_messages = 0
        self.messages = 0
        """How many the node put on the bus so far, each as it did."""

    def load(self, step: Step) -> None:
        """The step that comes next."""
        self._step, self._next, self.input = step, 0, None
        self.waiting_tokens = sum(isinstance(e, TokenTaken) for e in step.entries)
        taken = sum(isinstance(e, MessageTaken) for e in step.entries)
        self.waiting_messages = taken if step.waiting < 0 else step.waiting
        self._handled = self.waiting_tokens + taken

    def may_go_on(self, handled: int) -> bool:
        """Whether the node handled more in this step."""
        return handled < self._handled

    def end(self) -> None:
        if self._upcoming is not None or not self._step.is_whole:
            raise DifferenceError(self.input, self._upcoming, None)

    @property
    def _upcoming(self) -> AnyEntry | None:
        """The entry that comes next; None at the end of the step."""
        return self._step.entries[self._next] if self._next < len(self._step.entries) else None

    def find(self, kind: type[EntryT], name: str = "") -> EntryT | None:
        """The next entry, taken, if it is of this kind, and of the source of this name."""
        entry = self._upcoming
        if not isinstance(entry, kind) or (isinstance(entry, Polled) and entry.source != name):
            return None
        self._next += 1
        self.input = cast(AnyEntry, entry)
        return entry

    def take(self, kind: type[EntryT]) -> EntryT:
        """The same where there must be one."""
        entry = self.find(kind)
        if entry is None:  # the node did something else before
            raise DifferenceError(self.input, self._upcoming, None)
        return entry

    def answer(self, question: str) -> Any:
        """What was answered to this question; None if that was nothing."""
        entry = self._upcoming
        if isinstance(entry, Answered) and entry.question == question:
            self._next += 1
            self._answers[question] = entry.answer
        return self._answers.get(question)

    def state(self, node: object) -> bytes:
        """The state of the node that plays this, and with it what goes on to be answered."""
        return encode_state([node, self._answers])

    def restored(self, state: bytes) -> Any:
        """The node of this state, which plays this from now on. Raises StateError."""
        try:
            node, self._answers = decode_state(state, self._restore)
        except ValueError as error:
            raise StateError("no state of a node") from error
        return node

    def _restore(self, name: str, *parts: Any) -> Any:
        """What belongs to the world of a node: here all of it is played."""
        match name, *parts:
            case ["tape"]:
                return self
            case ["bus"]:
                return PlayedBus(self)
            case ["arrivals"]:
                return _PlayedArrivals(self, "", "", (), lambda: None)
            case ["handle", str(what), str(key)]:
                return _PlayedHandle(what, key, self)
            case ["publisher", str(key)]:
                return _PlayedPublisher(key, self)
            case ["source", str(source), int() | None as next_ns, bool(is_finished)]:
                return PlayedSource(source, self, next_ns, is_finished)
            case ["detection"]:
                return _PlayedDetection(self)
            case ["detector"]:
                return None
            case ["callbacks"]:
                return NO_CALLBACKS
        raise StateError(f"needs {name!r:.40}")

    def forget(self, question: str) -> None:
        self._answers.pop(question, None)

    def compare(self, entry: Outgoing) -> None:
        """The node does this; it must have done it."""
        old = self._upcoming
        if old != entry:
            raise DifferenceError(self.input, old, entry)
        self._next += 1

    def put(self, key: str, payload: bytes) -> None:
        """The node puts this on the bus."""
        entry = Put(key, payload)
        if key.startswith(CARRIES_IMAGES) and entry != self._upcoming:
            entry = Put(key, without_image(key, payload))  # as it was noted
        self.compare(entry)
        self.messages += 1
        self._on_put(key, payload)

    def wrap_bus(self, bus: Bus) -> Bus:
        return PlayedBus(self)

    def arrivals(
        self, robot: str, incarnation: str, team: Collection[str], on_arrival: Callable[[], None]
    ) -> Arrivals:
        return _PlayedArrivals(self, robot, incarnation, team, on_arrival)

    def wrap_source(self, name: str, source: SourceT) -> SourceT:
        played = PlayedSource(name, self)
        played.poll(0)  # what comes next in it, from the start
        return cast(SourceT, played)

    def wrap_detection(self, detection: Detection) -> Detection:
        return _PlayedDetection(self)


class _PlayedArrivals(Arrivals):
    """What the node took."""

    restored_as = ("arrivals",)

    def __init__(
        self,
        playback: Playback,
        robot: str,
        incarnation: str,
        team: Collection[str],
        on_arrival: Callable[[], None],
    ) -> None:
        super().__init__(robot, incarnation, team, on_arrival)
        self._playback = playback

    @property
    def waiting_tokens(self) -> int:
        return self._playback.waiting_tokens

    @property
    def waiting_messages(self) -> int:
        return self._playback.waiting_messages

    @property
    def counts(self) -> Counter[str]:
        return Counter(self._playback.answer("arrivals"))

    @property
    def has_namesake(self) -> bool:
        return bool(self._playback.answer("namesake"))

    def take_token(self) -> tuple[str, bool]:
        token = self._playback.take(TokenTaken)
        return token.key, token.is_alive

    def take_message(self) -> tuple[str, bytes]:
        message = self._playback.take(MessageTaken)
        return message.key, message.payload

    def take_frame(self) -> tuple[str, bytes] | None:
        frame = self._playback.find(FrameTaken)
        return None if frame is None else (frame.key, frame.payload)

    def pop_overflow(self) -> tuple[int, Counter[str]]:
        waiting, dropped = self._playback.answer("overflow")
        return waiting, Counter(dropped)


class PlayedBus(Bus):
    """Compares what the node declares and puts."""

    restored_as = ("bus",)

    def __init__(self, playback: Playback) -> None:
        self._playback = playback

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return _PlayedPublisher(key, self._playback)

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        return self._declare("subscription", keys)

    def declare_token(self, key: str) -> Handle:
        return self._declare("token", key)

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        return self._declare("watch", keys)

    def _declare(self, what: str, key: str) -> Handle:
        self._playback.compare(Declared(what, key))
        return _PlayedHandle(what, key, self._playback)

    def close(self) -> None:
        """There is nothing to close."""


class _PlayedHandle(Handle):
    def __init__(self, what: str, key: str, playback: Playback) -> None:
        self._undeclared, self._playback = Undeclared(what, key), playback
        self.restored_as = ("handle", what, key)

    def close(self) -> None:
        self._playback.compare(self._undeclared)


class _PlayedPublisher(Publisher):
    def __init__(self, key: str, playback: Playback) -> None:
        self._key, self._playback = key, playback
        self.restored_as = ("publisher", key)

    @property
    def matching(self) -> bool:
        return bool(self._playback.answer(self._key))

    def put(self, payload: bytes) -> None:
        self._playback.put(self._key, payload)

    def close(self) -> None:
        self._playback.forget(self._key)


class PlayedSource(OwnCamera):
    """What the robot's own log or camera had."""

    next_ns: int | None = None
    is_finished: bool = False

    def __init__(
        self,
        name: str,
        playback: Playback,
        next_ns: int | None = None,
        is_finished: bool = False,
    ) -> None:
        self._name, self._playback = name, playback
        self.next_ns, self.is_finished = next_ns, is_finished

    @property
    def restored_as(self) -> tuple[str, str, int | None, bool]:
        return "source", self._name, self.next_ns, self.is_finished

    @property
    def counts(self) -> Counter[str]:
        return Counter(self._playback.answer(f"{self._name} counts"))

    def poll(self, now_ns: int) -> Sequence[Any]:
        polled = self._playback.find(Polled, self._name)
        if polled is None:
            return ()
        self.next_ns, self.is_finished = polled.next_ns, polled.is_finished
        return [decode_tagged(payload, LARGEST_FRAME) for payload in polled.payloads]

    def close(self) -> None:
        """There is nothing to close."""


class _PlayedDetection(Detection):
    """What was found in the frames, whether or not their images were kept."""

    restored_as = ("detection",)

    def __init__(self, playback: Playback) -> None:
        self._playback = playback

    @property
    def counts(self) -> Counter[str]:
        return Counter(self._playback.answer("detector counts"))

    @property
    def problems(self) -> tuple[str, ...]:
        return tuple(self._playback.answer("detector problems"))

    @property
    def is_busy(self) -> bool:
        return bool(self._playback.answer("detector is busy"))

    def submit(self, frame: Any, annotates: bool) -> bool:
        return bool(self._playback.answer("frame skipped"))

    def collect(self) -> Sequence[DetectedFrame]:
        results = []
        while (found := self._playback.find(Detected)) is not None:
            sightings = _sightings_of(found) if found.sightings else found.reason
            shown = None
            if found.annotated is not None:
                shown = decode_tagged(found.annotated, LARGEST_FRAME)
            if not isinstance(sightings, str) and isinstance(shown, AnnotatedFrame):
                shown = replace(shown, found=sightings.sightings)
            assert shown is None or isinstance(shown, AnnotatedFrame)
            results.append(DetectedFrame(found.stamp_ns, sightings, shown))
        return results


def _sightings_of(found: Detected) -> Sightings:
    """The sightings in a frame as the detector made them."""
    frame = decode_tagged(found.sightings)
    assert isinstance(frame, Sightings)
    per_centre = found.per_centre or (0.0,) * len(found.per_focal)
    sightings = (
        sighting
        if k is None
        else MarkerSighting(**asdict(sighting), heading_per_focal=k, heading_per_centre=c)
        for sighting, k, c in zip(frame.sightings, found.per_focal, per_centre, strict=True)
    )
    return Sightings(frame.stamp_ns, tuple(sightings))
