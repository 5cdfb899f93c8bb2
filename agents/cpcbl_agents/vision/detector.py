"""The detector of a robot with a camera: it turns frames into sightings.

It detects landmarks by their colour bands (`cylinders`), and teammates by their markers (`markers`)
or, farther away, by the bands of their masts.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import TypeVar

from cpcbl_agents.sources import Picture
from cpcbl_agents.vision.annotate import annotate
from cpcbl_agents.vision.camera import NO_PIXELS, Camera, Pixels
from cpcbl_agents.vision.cylinders import CylinderDetector
from cpcbl_agents.vision.detections import Detections
from cpcbl_agents.vision.frame_checks import FrameChecks
from cpcbl_agents.vision.markers import MarkerDetector
from cpcbl_agents.vision.pictures import decode_frame, encode_jpeg, pixel_fault
from cpcbl_team.config import Team
from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import AnnotatedFrame, Frame, UnclearObject

log = logging.getLogger(__name__)
T = TypeVar("T")


class CameraDetector:
    """The detector of one robot of a team."""

    restored_as = ("detector",)  # what it found is in a recording, so it is no part of a state

    def __init__(self, robot: str, team: Team) -> None:
        self.robot, self.camera = robot, Camera(team.robots[robot].camera)
        self._frame_s = 1.0 / team.robots[robot].sensor.rate_hz
        self._has_failed = False
        self._doubts: Counter[str] = Counter()
        self._checks = FrameChecks()
        self._cylinders = CylinderDetector(robot, team, self.camera)
        self._markers = MarkerDetector(robot, team, self.camera)

    @property
    def counts(self) -> Counter[str]:
        """What was rejected in frames, by reason, and what was not looked at."""
        return self._doubts + self._markers.counts + self._checks.counts

    @property
    def problems(self) -> tuple[str, ...]:
        """What the latest frames say about the camera, as sentences."""
        return (
            *self._checks.problems,
            *self._markers.fits.problems,
            *self._cylinders.doubts.problems,
        )

    def detect(self, frame: Frame | Picture) -> Sightings | str:
        """The sightings in a frame, or the reason why it cannot be used (`frame_...`)."""
        found = self._attempt(lambda: self._decode_and_detect(frame)[1])
        return found if isinstance(found, str) else Sightings(frame.stamp_ns, found.sightings)

    def detect_and_annotate(self, frame: Frame | Picture) -> tuple[Sightings | str, AnnotatedFrame]:
        """The same, and the annotated frame; it has no picture if the frame cannot be decoded."""
        found = self._attempt(lambda: self._annotated(frame))
        if not isinstance(found, str):
            return found
        unclear = (UnclearObject(found),)
        return found, AnnotatedFrame(self.robot, frame.stamp_ns, b"", (), unclear)

    def _annotated(self, frame: Frame | Picture) -> tuple[Sightings | str, AnnotatedFrame]:
        pixels, found = self._decode_and_detect(frame)
        if isinstance(found, str):
            image = encode_jpeg(pixels) if pixels.size else b""
            unclear: tuple[UnclearObject, ...] = (UnclearObject(found),)
            return found, AnnotatedFrame(self.robot, frame.stamp_ns, image, (), unclear)
        image, sightings = encode_jpeg(annotate(pixels, found)), found.sightings
        unclear = tuple(UnclearObject(one.reason, one.names) for one in found.ambiguities)
        annotated = AnnotatedFrame(self.robot, frame.stamp_ns, image, sightings, unclear)
        return Sightings(frame.stamp_ns, sightings), annotated

    def _decode_and_detect(self, frame: Frame | Picture) -> tuple[Pixels, Detections | str]:
        """The pixels, empty if the frame cannot be decoded, and its detections or the reason."""
        if isinstance(frame, Picture):
            pixels: Pixels | str = frame.pixels
        else:
            pixels = decode_frame(frame.image, self.camera.size_px)
        if isinstance(pixels, str):
            return NO_PIXELS, pixels
        is_repeated = self._checks.is_repeated(pixels)
        reason = pixel_fault(pixels, self.camera.size_px)
        if is_repeated:
            reason = reason or "frame_repeated"
        return pixels, reason or self._detections(pixels)

    def detections(self, pixels: Pixels) -> Detections | str:
        """All detections in a picture (height, width, 3), BGR, or why it cannot be used."""
        size_px = self.camera.size_px
        return self._attempt(lambda: pixel_fault(pixels, size_px) or self._detections(pixels))

    def _detections(self, pixels: Pixels) -> Detections | str:
        until_s = time.thread_time() + self._frame_s
        self._checks.note_exposure(pixels)
        near, far = self._markers.detections(pixels, until_s), self._cylinders.detections(pixels)
        # What markers detected or rejected, colours need not detect.
        known = {found.sighting.id for found in near.found}
        known.update(name for ambiguity in near.ambiguities for name in ambiguity.names)
        kept = tuple(found for found in far.found if found.sighting.id not in known)
        found = Detections(near.found + kept, near.ambiguities + far.ambiguities)
        self._doubts.update(one.reason for one in found.ambiguities)
        self._checks.note_uprightness(found)
        return "camera_upside_down" if self._checks.is_upside_down else found

    def _attempt(self, work: Callable[[], T]) -> T | str:
        """The result of `work`, or `frame_failed`: nobody can show every picture to a detector, and
        one frame must not end a robot."""
        try:
            return work()
        except Exception:
            if not self._has_failed:
                log.exception("the detector failed; such frames are counted as `frame_failed`")
            self._has_failed = True
            return "frame_failed"
