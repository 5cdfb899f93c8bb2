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
        """When there will be something; None: not known or nothing any more."""

    @property
    def is_finished(self) -> bool:
        """Whether there will never be anything more: the end of a log."""

    def poll(self, now_ns: int) -> Sequence[Odometry | Sightings | Frame | Picture]:
        """Everything up to now that was not polled yet."""


class OwnCamera(Source, Protocol):
    """A source of frames beside another one that has the odometry."""

    @property
    def counts(self) -> Counter[str]:
        """What befell it, by reason."""

    def close(self) -> None:
        """Lets the camera go."""


class NoSource:
    """For robots whose inputs arrive on the bus: from their own driver or the simulated field."""

    next_ns: int | None = None
    is_finished = False

    def poll(self, now_ns: int) -> Sequence[Odometry | Sightings | Frame | Picture]:
        return ()
