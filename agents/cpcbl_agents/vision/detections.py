"""What is found in a frame: sightings with their outlines, and what is not clear, with a reason."""

from typing import NamedTuple

from cpcbl_agents.vision.camera import Floats
from cpcbl_team.inputs import Sighting


class Found(NamedTuple):
    """A sighting, and its outline in the frame: (n, 2) pixels."""

    sighting: Sighting
    outline: Floats


class Doubt(NamedTuple):
    """Something that is not reported, and why; `names`: what it could be."""

    reason: str
    names: tuple[str, ...]
    outline: Floats


class Glimpses(NamedTuple):
    """All that one frame shows."""

    found: tuple[Found, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    def __or__(self, other: "Glimpses") -> "Glimpses":
        return Glimpses(self.found + other.found, self.doubts + other.doubts)
