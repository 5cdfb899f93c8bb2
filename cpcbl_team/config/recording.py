"""Where and how robots record what they take and send."""

from typing import Annotated

import msgspec

from cpcbl_team.config.table import Table


class RecordingSettings(Table, frozen=True, kw_only=True):
    """The flight recorder of each robot (docs/recordings.md)."""

    folder: str = ""
    """The folder to record into, relative to the team file; empty: only with `--record`."""
    segment_bytes: Annotated[int, msgspec.Meta(ge=4096)] = 67_108_864
    """A file that is larger is followed by a new one, and so is one that is older."""
    segment_s: Annotated[float, msgspec.Meta(ge=1.0)] = 3600.0
    keep_bytes: Annotated[int, msgspec.Meta(ge=0)] = 0
    """The oldest files of a robot are deleted where all take more than this; 0: never."""
    images: bool = False
    """Whether the images that come on the bus are kept too."""
