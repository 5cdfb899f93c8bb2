"""What robots without a camera know of frames: no OpenCV and no numpy (`vision` detects)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # a robot without a camera does not load numpy
    import numpy as np
    from numpy.typing import NDArray

NEEDS_OPENCV = "needs OpenCV: pip install 'cpcbl-team[camera]'"


class Picture(NamedTuple):
    """A frame that needs no decoding: pixels (height, width, 3), BGR, at the time of exposure."""

    stamp_ns: int
    pixels: NDArray[np.uint8]
