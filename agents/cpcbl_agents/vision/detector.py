"""The detector of a robot with a camera: it turns frames into sightings.

It detects landmarks by their colour bands (`cylinders`), and teammates by their markers (`markers`)
or, farther away, by the bands of their masts.
"""

from cpcbl_agents.detector import Picture
from cpcbl_agents.vision.annotate import annotate
from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.cylinders import CylinderDetector
from cpcbl_agents.vision.detections import Detections
from cpcbl_agents.vision.markers import MarkerDetector
from cpcbl_agents.vision.pictures import decode_frame, encode_jpeg, pixel_fault
from cpcbl_team.config import Team
from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import AnnotatedFrame, Frame, UnclearObject


class CameraDetector:
    """The detector of one robot of a team."""

    def __init__(self, robot: str, team: Team) -> None:
        self.robot, self.camera = robot, Camera(team.robots[robot].camera)
        self._cylinders = CylinderDetector(robot, team, self.camera)
        self._markers = MarkerDetector(robot, team, self.camera)

    def detect(self, frame: Frame | Picture) -> Sightings | str:
        """The sightings in a frame, or the reason why it cannot be used (`frame_...`)."""
        pixels = self._decode(frame)
        detections = pixels if isinstance(pixels, str) else self.detections(pixels)
        if isinstance(detections, str):
            return detections
        return Sightings(frame.stamp_ns, tuple(found.sighting for found in detections.found))

    def detect_and_annotate(self, frame: Frame | Picture) -> tuple[Sightings | str, AnnotatedFrame]:
        """The same, and the annotated frame; it has no picture if the frame cannot be decoded."""
        pixels = self._decode(frame)
        if isinstance(pixels, str):
            return pixels, AnnotatedFrame(
                self.robot, frame.stamp_ns, b"", (), (UnclearObject(pixels),)
            )
        detections = self.detections(pixels)
        if isinstance(detections, str):
            image = encode_jpeg(pixels) if pixels.size else b""
            return detections, AnnotatedFrame(
                self.robot, frame.stamp_ns, image, (), (UnclearObject(detections),)
            )
        found = tuple(found.sighting for found in detections.found)
        unclear = tuple(
            UnclearObject(ambiguity.reason, ambiguity.names) for ambiguity in detections.ambiguities
        )
        image = encode_jpeg(annotate(pixels, detections))
        look = AnnotatedFrame(self.robot, frame.stamp_ns, image, found, unclear)
        return Sightings(frame.stamp_ns, found), look

    def _decode(self, frame: Frame | Picture) -> Pixels | str:
        if isinstance(frame, Picture):
            return frame.pixels
        return decode_frame(frame.image, self.camera.size_px)

    def detections(self, pixels: Pixels) -> Detections | str:
        """All detections in a picture (height, width, 3), BGR, or why it cannot be used."""
        reason = pixel_fault(pixels, self.camera.size_px)
        if reason:
            return reason
        return merge_detections(
            self._markers.detections(pixels), self._cylinders.detections(pixels)
        )


def merge_detections(near: Detections, far: Detections) -> Detections:
    """Both, without those by colours of objects that markers detected or rejected."""
    known = {found.sighting.id for found in near.found}
    known.update(name for ambiguity in near.ambiguities for name in ambiguity.names)
    kept = tuple(found for found in far.found if found.sighting.id not in known)
    return Detections(near.found + kept, near.ambiguities + far.ambiguities)
