"""Detections in a frame: sightings with their outlines, and rejected objects with a reason."""

from typing import NamedTuple

from cpcbl_agents.vision.camera import Floats
from cpcbl_team.inputs import Sighting


class Detection(NamedTuple):
    """A sighting, and its outline in the frame: (n, 2) pixels."""

    sighting: Sighting
    outline: Floats


class Ambiguity(NamedTuple):
    """An object that is not reported, with the reason; `names`: the objects that it could be."""

    reason: str
    names: tuple[str, ...]
    outline: Floats


class Detections(NamedTuple):
    """All detections and rejected objects of one frame."""

    found: tuple[Detection, ...] = ()
    ambiguities: tuple[Ambiguity, ...] = ()

    def __or__(self, other: "Detections") -> "Detections":
        return Detections(self.found + other.found, self.ambiguities + other.ambiguities)
