"""What makes sightings of a camera's frames: the protocol, without OpenCV (`vision` has that)."""

from typing import Protocol

from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import Frame


class Eyes(Protocol):
    """Sees landmarks and teammates in frames."""

    def seen(self, frame: Frame) -> Sightings | str:
        """What is in a frame, at its stamp; or why the frame cannot be used (`frame_...`)."""
