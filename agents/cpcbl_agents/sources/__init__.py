"""Where inputs come from: a driver on the bus, the simulated field, a camera, a real log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_transport.messages import Frame

if TYPE_CHECKING:  # a robot without a camera does not load numpy
    import numpy as np
    from numpy.typing import NDArray


class Picture(NamedTuple):
    """A frame that needs no decoding: pixels (height, width, 3), BGR, at the time of exposure."""

    stamp_ns: int
    pixels: NDArray[np.uint8]


class Source(Protocol):
    """Yields a robot's inputs as time passes."""

    @property
    def next_ns(self) -> int | None:
        """When the next input comes; None if that is not known or nothing comes any more."""

    @property
    def is_finished(self) -> bool:
        """Whether nothing will come any more, as at the end of a log."""

    def poll(self, now_ns: int) -> Sequence[Odometry | Sightings | Frame | Picture]:
        """Everything up to now that was not polled yet."""


class OwnCamera(Source, Protocol):
    """A source of frames beside another one that has the odometry."""

    @property
    def counts(self) -> Counter[str]:
        """Its events so far, by name."""

    def close(self) -> None:
        """Releases the camera."""
