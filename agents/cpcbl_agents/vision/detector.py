"""A robot's eyes: a frame in, sightings out.

Landmarks by their colour bands (`cylinders`), teammates by their markers (`markers`) or, farther
away, by the bands of their masts.
"""

from cpcbl_agents.detector import Picture
from cpcbl_agents.vision.annotate import annotated
from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.cylinders import Cylinders
from cpcbl_agents.vision.detections import Glimpses
from cpcbl_agents.vision.markers import Markers
from cpcbl_agents.vision.pictures import encoded, fault, received
from cpcbl_team.config import Team
from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import AnnotatedFrame, Frame, UnclearObject


class CameraEyes:
    """The eyes of one robot of a team."""

    def __init__(self, robot: str, team: Team) -> None:
        self.robot, self.camera = robot, Camera(team.robots[robot].camera)
        self._cylinders = Cylinders(robot, team, self.camera)
        self._markers = Markers(robot, team, self.camera)

    def seen(self, frame: Frame | Picture) -> Sightings | str:
        """What is in a frame, at its stamp; or why the frame cannot be used (`frame_...`)."""
        pixels = self._pixels(frame)
        glimpses = pixels if isinstance(pixels, str) else self.glimpses(pixels)
        if isinstance(glimpses, str):
            return glimpses
        return Sightings(frame.stamp_ns, tuple(found.sighting for found in glimpses.found))

    def shown(self, frame: Frame | Picture) -> tuple[Sightings | str, AnnotatedFrame]:
        """The same, and the frame with all that drawn into it; without picture if there is none."""
        pixels = self._pixels(frame)
        if isinstance(pixels, str):
            return pixels, AnnotatedFrame(
                self.robot, frame.stamp_ns, b"", (), (UnclearObject(pixels),)
            )
        glimpses = self.glimpses(pixels)
        if isinstance(glimpses, str):
            image = encoded(pixels) if pixels.size else b""
            return glimpses, AnnotatedFrame(
                self.robot, frame.stamp_ns, image, (), (UnclearObject(glimpses),)
            )
        found = tuple(found.sighting for found in glimpses.found)
        unclear = tuple(UnclearObject(doubt.reason, doubt.names) for doubt in glimpses.doubts)
        image = encoded(annotated(pixels, glimpses))
        look = AnnotatedFrame(self.robot, frame.stamp_ns, image, found, unclear)
        return Sightings(frame.stamp_ns, found), look

    def _pixels(self, frame: Frame | Picture) -> Pixels | str:
        if isinstance(frame, Picture):
            return frame.pixels
        return received(frame.image, self.camera.size_px)

    def glimpses(self, pixels: Pixels) -> Glimpses | str:
        """Everything in a picture (height, width, 3), BGR; or why it cannot be used."""
        reason = fault(pixels, self.camera.size_px)
        if reason:
            return reason
        return together(self._markers.glimpses(pixels), self._cylinders.glimpses(pixels))


def together(near: Glimpses, far: Glimpses) -> Glimpses:
    """Both, but what markers told, or doubted, is not told again by colours."""
    known = {found.sighting.id for found in near.found}
    known.update(name for doubt in near.doubts for name in doubt.names)
    kept = tuple(found for found in far.found if found.sighting.id not in known)
    return Glimpses(near.found + kept, near.doubts + far.doubts)
