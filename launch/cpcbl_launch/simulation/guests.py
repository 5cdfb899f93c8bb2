"""Guests of a simulated team: who has a body on the field, and who comes and goes at set times."""

from collections.abc import Mapping
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_agents.node import GuestNode
from cpcbl_agents.robot import NEVER_NS
from cpcbl_team.config import RobotSettings, Team
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Join
from cpcbl_transport.robot_model import SimulatedRobotModel

REQUEST_LASTS_NS = 2_000_000_000  # who has not asked again for so long is gone
LONGEST_DELAY_S = 10.0  # what is sensed with a delay is kept so long


class GuestBodies:
    """What guests have asked for, by the team's rules. Times are the field's."""

    def __init__(self, team: Team) -> None:
        self._robots, self._rules = frozenset(team.robots), team.guests
        self._requests: dict[str, tuple[int, Join]] = {}

    def request(self, join: Join, now_ns: int) -> str:
        """Takes a guest's word; the reason if it is refused."""
        if join.model is None:
            self._requests.pop(join.robot, None)
            return ""
        reason = self._refusal(join.robot) or unsupported_delay(join.model)
        if not reason:
            self._requests[join.robot] = now_ns, join
        return reason

    def _refusal(self, name: str) -> str:
        if not self._rules.allowed:
            return "guests.allowed is false"
        if name in self._robots:
            return "a robot of the team has this name"
        full = len(self._requests) >= self._rules.most and name not in self._requests
        return f"there are {self._rules.most} guests, guests.most" if full else ""

    def present(self, now_ns: int) -> Mapping[str, Join]:
        """The guests that have a body now, with what each asked for last."""
        self._requests = {
            name: (asked_ns, join)
            for name, (asked_ns, join) in self._requests.items()
            if now_ns - asked_ns <= REQUEST_LASTS_NS
        }
        return {name: join for name, (_, join) in self._requests.items()}


def unsupported_delay(model: SimulatedRobotModel) -> str:
    """Why the field cannot give a guest this body; empty if it can."""
    for key in ("sensor", "odometry", "position_sensor"):
        device = getattr(model, key)
        if device is not None and abs(device.delay_s) > LONGEST_DELAY_S:
            return f"{key}.delay_s: {device.delay_s:g} s; at most {LONGEST_DELAY_S:g} s"
    return ""


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
        self._team = replace(team, robots={**team.robots, visitor.name: visitor.settings})
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
