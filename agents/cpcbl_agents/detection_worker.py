"""A detector on a thread of its own: a frame that takes long delays no step of the robot.

Only the process that runs a robot uses one. In a simulation the detector works in the robot's step,
so that the same inputs give the same bits.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

from cpcbl_agents.sources import Picture
from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import AnnotatedFrame, Frame

if TYPE_CHECKING:  # it needs OpenCV
    from cpcbl_agents.vision.detector import CameraDetector

PATIENCE_S = 1.8  # for the thread at the end


class DetectedFrame(NamedTuple):
    """What a detector made of a frame: sightings, or why it cannot be used."""

    stamp_ns: int
    sightings: Sightings | str
    annotated: AnnotatedFrame | None = None


def detect(detector: "CameraDetector", frame: Frame | Picture, annotates: bool) -> DetectedFrame:
    """The sightings in a frame, and the annotated frame if it `annotates`."""
    if annotates:
        return DetectedFrame(frame.stamp_ns, *detector.detect_and_annotate(frame))
    return DetectedFrame(frame.stamp_ns, detector.detect(frame))


class Detection(Protocol):
    """Detects in the frames that it is given; the results come now or later."""

    @property
    def counts(self) -> Counter[str]:
        """The detector's events so far, by name."""

    @property
    def problems(self) -> tuple[str, ...]:
        """What the detector doubts, as sentences."""

    @property
    def is_busy(self) -> bool:
        """Whether there is a frame whose result was not collected yet."""

    def submit(self, frame: Frame | Picture, annotates: bool) -> bool:
        """One more frame; whether it takes the place of one that waits, which is skipped."""

    def collect(self) -> Sequence[DetectedFrame]:
        """The results since the last call."""


class ImmediateDetection(Detection):
    """Detects on the thread that gives it a frame, in the same step of the robot."""

    def __init__(self, detector: "CameraDetector") -> None:
        self._detector = detector
        self._results: list[DetectedFrame] = []

    @property
    def counts(self) -> Counter[str]:
        return self._detector.counts

    @property
    def problems(self) -> tuple[str, ...]:
        return self._detector.problems

    @property
    def is_busy(self) -> bool:
        return bool(self._results)

    def submit(self, frame: Frame | Picture, annotates: bool) -> bool:
        self._results.append(detect(self._detector, frame, annotates))
        return False

    def collect(self) -> Sequence[DetectedFrame]:
        results, self._results = self._results, []
        return results


class DetectionWorker(Detection):
    """Detects in one frame at a time while the newest of the others waits. `wake` is called, on the
    worker's thread, for each result."""

    def __init__(self, detector: "CameraDetector", wake: Callable[[], None]) -> None:
        self._detector, self._wake = detector, wake
        # After the latest result: the thread replaces these two and changes none
        self._counts, self._problems = detector.counts, detector.problems
        self._waiting: deque[tuple[Frame | Picture, bool]] = deque()
        self._results: deque[DetectedFrame] = deque()
        self._unfinished = 0  # frames whose results were not collected
        self._failure: Exception | None = None
        self._changed, self._is_closed = threading.Condition(), False
        self._thread = threading.Thread(target=self._run, name="detector", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> Counter[str]:
        return self._counts

    @property
    def problems(self) -> tuple[str, ...]:
        return self._problems

    @property
    def is_busy(self) -> bool:
        return self._unfinished > 0

    def submit(self, frame: Frame | Picture, annotates: bool) -> bool:
        with self._changed:
            skips = bool(self._waiting)
            self._waiting.clear()
            self._waiting.append((frame, annotates))
            self._changed.notify()
        self._unfinished += not skips
        return skips

    def collect(self) -> list[DetectedFrame]:
        """The results since the last call. Raises what the detector raised on the thread: it takes
        bad frames, so that is an error of this program, which must not leave the robot blind."""
        if self._failure is not None:
            raise self._failure
        with self._changed:
            results = list(self._results)
            self._results.clear()
        self._unfinished -= len(results)
        return results

    def close(self) -> None:
        """Ends the thread, after the frame at which it works."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join(PATIENCE_S)

    # On the thread ------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._is_closed)
                if self._is_closed:
                    return
                frame, annotates = self._waiting.popleft()
            try:
                result = detect(self._detector, frame, annotates)
            except Exception as error:
                self._failure = error
                self._wake()
                return
            self._counts, self._problems = self._detector.counts, self._detector.problems
            with self._changed:
                self._results.append(result)
            self._wake()
