"""What makes sightings of a camera's frames: the protocol, without OpenCV (`vision` has that)."""

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


class Eyes(Protocol):
    """Sees landmarks and teammates in frames."""

    def seen(self, frame: Frame | Picture) -> Sightings | str:
        """What is in a frame, at its stamp; or why the frame cannot be used (`frame_...`)."""

    def shown(self, frame: Frame | Picture) -> tuple[Sightings | str, AnnotatedFrame]:
        """The same, and the frame with all that drawn into it."""
