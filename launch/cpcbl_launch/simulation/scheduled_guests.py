"""Guests of a simulated team in one process: they come and go at set times."""

from typing import NamedTuple

import msgspec

from cpcbl_agents.guest_node import GuestNode
from cpcbl_agents.robot import NEVER_NS
from cpcbl_team.config import RobotSettings, Team
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub


class ScheduledGuest(NamedTuple):
    """A guest, and when it is there (seconds of robot time)."""

    name: str
    settings: RobotSettings
    from_s: float
    until_s: float


class ScheduledGuestNode:
    """A visitor's node, with a session of its own from its coming to its going."""

    def __init__(self, visitor: ScheduledGuest, team: Team, hub: MemoryHub) -> None:
        self._name, self._hub = visitor.name, hub
        self._team = with_guest(team, visitor.name, visitor.settings)
        self._from_ns, self._until_ns = (round(s * 1e9) for s in visitor[2:])
        self._visit: GuestNode | None = None
        self._bus: Bus | None = None

    @property
    def next_ns(self) -> int:
        if self._visit is not None:
            return min(self._visit.next_ns, self._until_ns)
        return self._from_ns if self._bus is None else NEVER_NS

    @property
    def waiting(self) -> bool:
        return self._visit is not None and self._visit.waiting

    def step(self, now_ns: int) -> None:
        if self._bus is None:
            self._bus = self._hub.session()
            self._visit = GuestNode(self._name, self._team, self._bus, now_ns, "1")
        if self._visit is None:
            return
        if now_ns < self._until_ns:
            self._visit.step(now_ns)
            return
        self._visit.leave(now_ns)
        self._visit = None
        self._bus.close()


def with_guest(team: Team, name: str, settings: RobotSettings) -> Team:
    """The team as a guest sees it: itself beside the robots of the file."""
    return msgspec.structs.replace(team, robots={**team.robots, name: settings})
