"""The sensing agent: it takes inputs of any source and corrects odometry and sightings."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING

import msgspec

from cpcbl_agents.agent import (
    AgentMessage,
    FrameChanged,
    FrameSubscribers,
    PoseEstimate,
    Tick,
)
from cpcbl_agents.detection_worker import (
    DetectedFrame,
    Detection,
    DetectionWorker,
    ImmediateDetection,
)
from cpcbl_agents.sources import OwnCamera, Picture, Source
from cpcbl_agents.waypoint_follower import WaypointFollower
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sightings
from cpcbl_team.sensors import corrected_odometry, corrected_sighting, without_duplicates
from cpcbl_transport.messages import Frame, SensorInput, input_name

if TYPE_CHECKING:  # it needs OpenCV
    from cpcbl_agents.tape import Tape
    from cpcbl_agents.vision.camera_correction import CameraCorrection
    from cpcbl_agents.vision.detector import CameraDetector

ANNOTATION_INTERVAL_NS = 500_000_000
UncorrectedInput = Odometry | Sightings | Position | InitialPose


class SensingAgent:
    """Polls the source and the camera, takes a driver's messages, corrects delays and scales, and
    drops sightings that the settings say the sensor cannot make.

    `source`: a log; None where inputs arrive on the bus. `map_names`: the names of landmarks and
    walls. Every other name is a robot's: a teammate's or a guest's.
    """

    def __init__(
        self,
        settings: LocalizationSettings,
        source: Source | None,
        map_names: frozenset[str],
        follower: WaypointFollower | None = None,
        detector: "CameraDetector | None" = None,
        camera: OwnCamera | None = None,
        correction: "CameraCorrection | None" = None,
    ) -> None:
        self._sensor, self._odometry = settings.sensor, settings.odometry
        self._sensor_delay_ns = int(settings.sensor.delay_s * 1e9)
        own = settings.position_sensor
        self._position_delay_ns = 0 if own is None else int(own.delay_s * 1e9)
        self._source, self._camera, self._map_names = source, camera, map_names
        self._sources = [s for s in (source, camera) if s is not None]
        self._follower, self._detector, self._has_subscribers = follower, detector, False
        self._correction = correction
        self._detection: Detection | None = None
        if detector is not None:
            self._detection = ImmediateDetection(detector)
        self._held: list[Odometry] = []  # that came while the detector had a frame
        self._annotated_ns = -ANNOTATION_INTERVAL_NS
        self._counts: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        """What could not be used, by reason."""

    @contextmanager
    def detect_on_thread(self, wake: Callable[[], None]) -> Iterator[None]:
        """Until this context ends, the detector works on a thread of its own. It calls `wake` for
        each of its results, which the next tick takes. Call this before a node wraps the
        detection."""
        if self._detector is None:
            yield
            return
        with closing(DetectionWorker(self._detector, wake)) as self._detection:
            yield

    def wrap(self, tape: "Tape") -> None:
        """Lets everything that is polled and detected from now on pass through this tape."""
        if self._source is not None:
            self._source = tape.wrap_source("source", self._source)
        if self._camera is not None:
            self._camera = tape.wrap_source("camera", self._camera)
        self._sources = [s for s in (self._source, self._camera) if s is not None]
        if self._detection is not None:
            self._detection = tape.wrap_detection(self._detection)

    @property
    def counts(self) -> Counter[str]:
        """What was sensed, and what could not be used, by reason."""
        parts = (self._camera, self._detection, self._correction)
        return sum((part.counts for part in parts if part is not None), self._counts)

    @property
    def has_detector(self) -> bool:
        return self._detection is not None

    @property
    def has_own_camera(self) -> bool:
        """Whether it reads a camera itself, beside what a driver sends."""
        return self._camera is not None

    @property
    def problems(self) -> tuple[str, ...]:
        """What may be wrong with the robot's camera, as sentences."""
        parts = (p for p in (self._detection, self._correction) if p is not None)
        return tuple(problem for part in parts for problem in part.problems)

    @property
    def next_ns(self) -> int | None:
        if not self._sources:
            return None
        return min((s.next_ns for s in self._sources if s.next_ns is not None), default=None)

    @property
    def is_finished(self) -> bool:
        return self._source is not None and self._source.is_finished

    def handle(self, message: AgentMessage, now_ns: int) -> Sequence[AgentMessage]:
        match message:
            case Tick():
                items = [item for source in self._sources for item in source.poll(now_ns)]
                outgoing = [out for item in items for out in self._process(item)]
                return [*outgoing, *self._collect()]
            case PoseEstimate():
                if self._correction is not None:
                    self._correction.set_estimate(message.estimate, message.lost)
                if self._follower is not None:
                    return self._follower.command(message)
            case Odometry() | Sightings() | Position() | InitialPose() | Frame():
                return self._process(message)
            case FrameChanged(_, new_from_old):
                if self._follower is not None:
                    self._follower.change_frame(new_from_old)
            case FrameSubscribers():
                self._has_subscribers = message.present
        return ()

    def _process(self, item: SensorInput | Picture) -> Sequence[AgentMessage]:
        if not isinstance(item, Frame | Picture):
            return [self._correct(item)]
        if self._detection is None:
            self._refuse("no_camera")
            return ()
        self._counts["frame"] += 1
        is_recent = 0 <= item.stamp_ns - self._annotated_ns < ANNOTATION_INTERVAL_NS
        annotates = self._has_subscribers and not is_recent
        if annotates:
            self._annotated_ns = item.stamp_ns
        if self._detection.submit(item, annotates):
            self._counts["frame_skipped"] += 1
        return self._collect()

    def _collect(self) -> list[AgentMessage]:
        """The messages that follow from the frames that the detector has finished."""
        if self._detection is None:
            return []
        return [out for found in self._detection.collect() for out in self._take(found)]

    def _take(self, found: DetectedFrame) -> Sequence[AgentMessage]:
        """The messages that follow from one frame that the detector has finished."""
        outgoing: list[AgentMessage] = [] if found.annotated is None else [found.annotated]
        self._release_odometry(found.stamp_ns)
        if isinstance(found.sightings, str):
            self._refuse(found.sightings)
            return outgoing
        frame = self._corrected_frame(found.sightings)
        if self._correction is None:
            return [*outgoing, frame]
        frame, change = self._correction.correct(frame)
        return [*outgoing, frame, *([] if change is None else [change])]

    def _add_odometry(self, piece: Odometry) -> None:
        """Passes a motion to the check of the camera, in the order in which motions and frames were
        measured."""
        if self._correction is None:
            return
        if self._detection is not None and self._detection.is_busy:
            self._held.append(piece)
            return
        self._release_odometry(piece.stamp_ns)
        self._correction.add_odometry(piece)

    def _release_odometry(self, until_ns: int) -> None:
        """Passes the held motions that were measured until then to the check of the camera."""
        while self._held and self._held[0].stamp_ns <= until_ns and self._correction is not None:
            self._correction.add_odometry(self._held.pop(0))

    def _correct(self, item: UncorrectedInput) -> UncorrectedInput:
        if isinstance(item, Sightings):
            return self._corrected_frame(item)
        self._counts[input_name(item)] += 1
        if isinstance(item, InitialPose):
            return item
        if isinstance(item, Odometry):
            piece = corrected_odometry(item, self._odometry)
            self._add_odometry(piece)
            return piece
        return msgspec.structs.replace(item, stamp_ns=item.stamp_ns - self._position_delay_ns)

    def _corrected_frame(self, item: Sightings) -> Sightings:
        self._counts["sightings"] += 1
        sightings = without_duplicates(item.sightings)
        if len(sightings) < len(item.sightings):
            self._refuse("seen_twice", len(item.sightings) - len(sightings))
        sensor, map_names, kept = self._sensor, self._map_names, []
        for sighting in sightings:
            is_robot = sighting.id not in map_names
            if sensor.sees_robots if is_robot else sensor.sees_landmarks:
                kept.append(corrected_sighting(sighting, sensor, is_robot))
        return Sightings(item.stamp_ns - self._sensor_delay_ns, tuple(kept))

    def _refuse(self, reason: str, number: int = 1) -> None:
        self._counts[reason] += number
        self.refused[reason] += number
