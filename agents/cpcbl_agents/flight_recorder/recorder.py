"""The tape that notes what passes between a node and the world. It declares nothing on the bus."""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import Any, TypeVar

from cpcbl_agents.arrivals import Arrivals
from cpcbl_agents.detection_worker import DetectedFrame, Detection
from cpcbl_agents.flight_recorder.entries import (
    Answered,
    AnyEntry,
    Declared,
    Detected,
    FrameTaken,
    MessageTaken,
    Polled,
    Put,
    Step,
    TokenTaken,
    Undeclared,
)
from cpcbl_agents.flight_recorder.images import CARRIES_IMAGES, without_image
from cpcbl_agents.flight_recorder.segments import SegmentWriter
from cpcbl_agents.flight_recorder.states import StateError, encode_state
from cpcbl_agents.sources import OwnCamera, Picture, Source
from cpcbl_agents.tape import SourceT, Tape
from cpcbl_team.inputs import MarkerSighting
from cpcbl_transport import topics
from cpcbl_transport.bus import (
    Bus,
    BusProxy,
    Handle,
    LivelinessCallback,
    MessageCallback,
    Publisher,
    PublisherProxy,
)
from cpcbl_transport.messages import LARGEST_FRAME, Frame, encode
from cpcbl_transport.topics import Qos

log = logging.getLogger(__name__)

AnswerT = TypeVar("AnswerT")
ENTRY_BYTES = 100  # that an entry takes in memory beside its payload


class FlightRecorder(Tape):
    """Notes the steps of one node, and hands each over to be written when it is over."""

    restored_as = ("tape",)

    def __init__(self, writer: SegmentWriter, keeps_images: bool = False) -> None:
        self._writer, self._keeps_images = writer, keeps_images
        self._node: object = None
        self._answers: dict[str, Any] = {}
        self._entries: list[AnyEntry] = []
        self._now_ns, self._waiting, self._size = 0, -1, 0
        self._is_within_step = self._leaves = False

    def start(self, node: object, now_ns: int) -> None:
        self._node = node
        self.begin(now_ns)

    def begin(self, now_ns: int, leaves: bool = False) -> None:
        self._now_ns, self._leaves, self._is_within_step = now_ns, leaves, True

    def end(self) -> None:
        self._hand_over(is_whole=True)

    def _hand_over(self, is_whole: bool) -> None:
        step = Step(self._now_ns, tuple(self._entries), self._waiting, self._leaves, is_whole)
        self._writer.add(step, self._size + ENTRY_BYTES * (1 + len(self._entries)))
        self._entries.clear()
        self._waiting, self._size, self._is_within_step = -1, 0, False
        if self._writer.wants_state:
            self._writer.add_state(self._state())

    def _state(self) -> bytes:
        """With it the next file can be replayed without the ones before it."""
        try:
            return encode_state([self._node, self._answers])
        except StateError:  # the core is compiled: its files are replayed from the first one on
            return b""
        except Exception:  # an error of this program, which must not end the robot
            log.exception("%s: its state is not recorded", self)
            return b""

    def close(self) -> None:
        """Writes what is left; also the step that an exception ended."""
        if self._is_within_step:
            self._hand_over(is_whole=False)
        self._writer.close()

    @property
    def problems(self) -> tuple[str, ...]:
        return (self._writer.problem,) if self._writer.problem else ()

    def note(self, entry: AnyEntry, size: int = 0) -> None:
        """Something passed; `size`: the bytes of its payload."""
        self._entries.append(entry)
        self._size += size

    def note_waiting(self, messages: int) -> None:
        """So many messages waited at the begin of this step, which does not take all of them."""
        self._waiting = messages

    def answer(self, question: str, answer: AnswerT) -> AnswerT:
        """Passes an answer on to the node; notes it if it is another one than the last time. What
        others than the node ask, between its steps, is not noted."""
        if self._is_within_step and self._answers.get(question) != answer:
            self._answers[question] = answer
            self._entries.append(Answered(question, answer))
        return answer

    def forget(self, question: str) -> None:
        """The question is not asked again, or as if for the first time."""
        self._answers.pop(question, None)

    def without_image(self, key: str, payload: bytes) -> bytes:
        """A payload as it is noted: images only if they are kept."""
        if self._keeps_images or not key.startswith(CARRIES_IMAGES):
            return payload
        return without_image(key, payload)

    def wrap_bus(self, bus: Bus) -> Bus:
        return _RecordedBus(bus, self)

    def arrivals(
        self, robot: str, incarnation: str, team: Collection[str], on_arrival: Callable[[], None]
    ) -> Arrivals:
        return _RecordedArrivals(self, robot, incarnation, team, on_arrival)

    def wrap_source(self, name: str, source: SourceT) -> SourceT:
        return _RecordedSource(name, source, self)

    def wrap_detection(self, detection: Detection) -> Detection:
        return _RecordedDetection(detection, self)


class StoppedRecorder(Tape):
    """The tape of a robot that cannot be recorded; its status says why."""

    def __init__(self, problem: str) -> None:
        self._problem = problem

    @property
    def problems(self) -> tuple[str, ...]:
        return (self._problem,)


class _RecordedArrivals(Arrivals):
    """Notes what is taken, when it is taken."""

    restored_as = ("arrivals",)

    def __init__(
        self,
        recorder: FlightRecorder,
        robot: str,
        incarnation: str,
        team: Collection[str],
        on_arrival: Callable[[], None],
    ) -> None:
        super().__init__(robot, incarnation, team, on_arrival)
        self._recorder = recorder

    @property
    def counts(self) -> Counter[str]:
        return Counter(self._recorder.answer("arrivals", dict(super().counts)))

    @property
    def has_namesake(self) -> bool:
        return self._recorder.answer("namesake", super().has_namesake)

    def take_token(self) -> tuple[str, bool]:
        token = super().take_token()
        self._recorder.note(TokenTaken(*token))
        return token

    def take_message(self) -> tuple[str, bytes]:
        message = super().take_message()
        self._recorder.note(MessageTaken(*message), len(message[1]))
        return message

    def take_frame(self) -> tuple[str, bytes] | None:
        frame = super().take_frame()
        if frame is None:
            return None
        payload = self._recorder.without_image(*frame)[: LARGEST_FRAME + 1]
        self._recorder.note(FrameTaken(frame[0], payload), len(payload))
        return frame

    def note_taken(self, taken: int, waiting: int) -> None:
        super().note_taken(taken, waiting)
        if taken < waiting:
            self._recorder.note_waiting(waiting)

    def pop_overflow(self) -> tuple[int, Counter[str]]:
        waiting, dropped = super().pop_overflow()
        self._recorder.answer("overflow", [waiting, dict(dropped)])
        return waiting, dropped


class _RecordedBus(BusProxy):
    """Notes what is declared and put, and the answers of publishers."""

    restored_as = ("bus",)

    def __init__(self, bus: Bus, recorder: FlightRecorder) -> None:
        super().__init__(bus)
        self._recorder = recorder

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return _RecordedPublisher(self._bus.publisher(key, qos), key, self._recorder)

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        self._recorder.note(Declared("subscription", keys))
        handle = self._bus.subscribe(keys, on_message)
        return _RecordedHandle(handle, Undeclared("subscription", keys), self._recorder)

    def declare_token(self, key: str) -> Handle:
        self._recorder.note(Declared("token", key))
        return _RecordedHandle(
            self._bus.declare_token(key), Undeclared("token", key), self._recorder
        )

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        self._recorder.note(Declared("watch", keys))
        handle = self._bus.watch_liveliness(keys, on_change)
        return _RecordedHandle(handle, Undeclared("watch", keys), self._recorder)


class _RecordedHandle(Handle):
    def __init__(self, handle: Handle, undeclared: Undeclared, recorder: FlightRecorder) -> None:
        self._handle, self._undeclared, self._recorder = handle, undeclared, recorder
        self.restored_as = ("handle", undeclared.what, undeclared.key)

    def close(self) -> None:
        self._recorder.note(self._undeclared)
        self._handle.close()


class _RecordedPublisher(PublisherProxy):
    def __init__(self, publisher: Publisher, key: str, recorder: FlightRecorder) -> None:
        super().__init__(publisher)
        self._key, self._recorder = key, recorder
        self._answer: bool | None = None
        self.restored_as = ("publisher", key)

    @property
    def matching(self) -> bool:
        answer = self._publisher.matching
        if answer is not self._answer:  # the question that is asked most often
            self._answer = self._recorder.answer(self._key, answer)
        return answer

    def put(self, payload: bytes) -> None:
        payload_noted = self._recorder.without_image(self._key, payload)
        self._recorder.note(Put(self._key, payload_noted), len(payload_noted))
        self._publisher.put(payload)

    def close(self) -> None:
        self._recorder.forget(self._key)
        self._publisher.close()


class _RecordedSource(OwnCamera):
    """Notes what a log or a camera had, each time that it had something."""

    def __init__(self, name: str, source: Source, recorder: FlightRecorder) -> None:
        self._name, self._source, self._recorder = name, source, recorder
        self._was: tuple[int | None, bool] | None = None
        self._note(())

    def _note(self, items: Sequence[Any]) -> None:
        now = self._source.next_ns, self._source.is_finished
        if items or now != self._was:
            self._was = now
            payloads = tuple(self._encoded(item) for item in items)
            size = sum(len(payload) for payload in payloads)
            self._recorder.note(Polled(self._name, payloads, *now), size)

    def _encoded(self, item: Any) -> bytes:
        if isinstance(item, Picture):  # pixels: an image of them would not be theirs to the bit
            item = Frame(item.stamp_ns, b"")
        payload = encode(item)
        if isinstance(item, Frame):
            payload = self._recorder.without_image(topics.IN_FRAME.at(robot="own"), payload)
        return payload

    @property
    def restored_as(self) -> tuple[str, str, int | None, bool]:
        return "source", self._name, self.next_ns, self.is_finished

    @property
    def next_ns(self) -> int | None:
        return self._source.next_ns

    @property
    def is_finished(self) -> bool:
        return self._source.is_finished

    @property
    def counts(self) -> Counter[str]:
        counts: Counter[str] = self._source.counts  # type: ignore[attr-defined]
        return Counter(self._recorder.answer(f"{self._name} counts", dict(counts)))

    def poll(self, now_ns: int) -> Sequence[Any]:
        items = self._source.poll(now_ns)
        self._note(items)
        return items

    def close(self) -> None:
        self._source.close()  # type: ignore[attr-defined]


class _RecordedDetection(Detection):
    """Notes what was found in frames, when the node takes it."""

    restored_as = ("detection",)

    def __init__(self, detection: Detection, recorder: FlightRecorder) -> None:
        self._detection, self._recorder = detection, recorder

    @property
    def counts(self) -> Counter[str]:
        return Counter(self._recorder.answer("detector counts", dict(self._detection.counts)))

    @property
    def problems(self) -> tuple[str, ...]:
        return tuple(self._recorder.answer("detector problems", list(self._detection.problems)))

    @property
    def is_busy(self) -> bool:
        return self._recorder.answer("detector is busy", self._detection.is_busy)

    def submit(self, frame: Any, annotates: bool) -> bool:
        return self._recorder.answer("frame skipped", self._detection.submit(frame, annotates))

    def collect(self) -> Sequence[DetectedFrame]:
        results = self._detection.collect()
        for stamp_ns, sightings, annotated in results:
            found, reason = b"", ""
            per_focal, per_centre = tuple[float | None, ...](), tuple[float, ...]()
            if isinstance(sightings, str):
                reason = sightings
            else:
                found = encode(sightings)
                per_focal = tuple(
                    s.heading_per_focal if isinstance(s, MarkerSighting) else None
                    for s in sightings.sightings
                )
                per_centre = tuple(
                    s.heading_per_centre if isinstance(s, MarkerSighting) else 0.0
                    for s in sightings.sightings
                )
            shown = None
            if annotated is not None:
                key = topics.LOOK.at(robot=annotated.robot)
                shown = self._recorder.without_image(key, encode(annotated))
            size = len(found) + len(shown or b"")
            entry = Detected(stamp_ns, found, reason, per_focal, shown, per_centre)
            self._recorder.note(entry, size)
        return results
