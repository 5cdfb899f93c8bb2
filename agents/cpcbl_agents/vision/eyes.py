"""A robot's eyes: a frame in, sightings out.

Landmarks by their colour bands (`cylinders`), teammates by their markers (`markers`) or, farther
away, by the bands of their masts.
"""

import cv2

from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.cylinders import Cylinders
from cpcbl_agents.vision.glimpses import Glimpses
from cpcbl_agents.vision.markers import Markers
from cpcbl_agents.vision.pictures import decoded, fault
from cpcbl_team.config import Team
from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import Frame

cv2.setNumThreads(1)  # a robot is one process of many on its machine


class CameraEyes:
    """The eyes of one robot of a team."""

    def __init__(self, robot: str, team: Team) -> None:
        self.camera = Camera(team.robots[robot].camera)
        self._cylinders = Cylinders(robot, team, self.camera)
        self._markers = Markers(robot, team, self.camera)

    def seen(self, frame: Frame) -> Sightings | str:
        """What is in a frame, at its stamp; or why the frame cannot be used (`frame_...`)."""
        pixels = decoded(frame.image)
        if isinstance(pixels, str):
            return pixels
        glimpses = self.glimpses(pixels)
        if isinstance(glimpses, str):
            return glimpses
        return Sightings(frame.stamp_ns, tuple(found.sighting for found in glimpses.found))

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
