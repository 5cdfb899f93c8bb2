"""What stands between a robot's node and the world: nothing, a recorder, or a recording.

All that a node learns of the world passes here, and all that it puts on the bus. A node is
deterministic besides, so one that gets the same from its tape does the same, bit for bit.
"""

from collections.abc import Callable, Collection
from typing import TypeVar

from cpcbl_agents.arrivals import Arrivals
from cpcbl_agents.detection_worker import Detection
from cpcbl_agents.sources import OwnCamera, Source
from cpcbl_transport.bus import Bus

SourceT = TypeVar("SourceT", Source, OwnCamera)


class Tape:
    """The tape of a node; as it stands here it passes everything on.

    A recorder notes what passes; a replay answers in place of the world, and compares what comes.
    """

    def start(self, node: object, now_ns: int) -> None:
        """This node begins with its first step, in which it is made."""
        self.begin(now_ns)

    def begin(self, now_ns: int, leaves: bool = False) -> None:
        """A step of the node begins. `leaves`: the last one, of a guest that leaves."""

    def end(self) -> None:
        """The step is over."""

    @property
    def problems(self) -> tuple[str, ...]:
        """What is wrong with the recording, as sentences."""
        return ()

    def wrap_bus(self, bus: Bus) -> Bus:
        return bus

    def arrivals(
        self, robot: str, incarnation: str, team: Collection[str], on_arrival: Callable[[], None]
    ) -> Arrivals:
        return Arrivals(robot, incarnation, team, on_arrival)

    def wrap_source(self, name: str, source: SourceT) -> SourceT:
        return source

    def wrap_detection(self, detection: Detection) -> Detection:
        return detection


NO_TAPE = Tape()
