"""Where inputs come from: a driver on the bus, the simulated field, a camera, a real log."""

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from cpcbl_agents.detector import Picture
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_transport.messages import Frame


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
