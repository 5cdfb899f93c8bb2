"""The protocol of a detector of objects in frames, without OpenCV (`vision` implements it)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import AnnotatedFrame, Frame

if TYPE_CHECKING:  # a robot without a camera does not load numpy
    import numpy as np
    from numpy.typing import NDArray

NEEDS_OPENCV = "needs OpenCV: pip install 'cpcbl-team[camera]'"


class Picture(NamedTuple):
    """A frame that needs no decoding: pixels (height, width, 3), BGR, at the time of exposure."""

    stamp_ns: int
    pixels: NDArray[np.uint8]


class Detector(Protocol):
    """Detects landmarks and teammates in frames."""

    def detect(self, frame: Frame | Picture) -> Sightings | str:
        """The sightings in a frame, or the reason why it cannot be used (`frame_...`)."""

    def detect_and_annotate(self, frame: Frame | Picture) -> tuple[Sightings | str, AnnotatedFrame]:
        """The same, and the annotated frame."""
