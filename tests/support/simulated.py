"""Simulated teams that are recorded, or have guests that come and go at set times."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_agents.node import GuestNode, NodeStart, Steppable
from cpcbl_agents.robot import NEVER_NS, build_robot
from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import (
    BusWrapper,
    robot_nodes,
    run_nodes,
    simulated_report,
)
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
            robot = build_robot(self._name, self._team, now_ns)
            self._visit = GuestNode(robot, self._team, self._bus, NodeStart(now_ns, "1"))
        if self._visit is None:
            return
        if now_ns < self._until_ns:
            self._visit.step(now_ns)
            return
        self._visit.leave(now_ns)
        self._visit = None
        self._bus.close()


def simulate_with_guests(
    team: Team, seed: int, duration_s: float, guests: Sequence[ScheduledGuest]
) -> Recorder:
    """What a recorder received of a simulated team and of its guests."""
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    visits = [ScheduledGuestNode(guest, team, hub) for guest in guests]
    run_simulated(team, seed, duration_s, hub, visits)
    return recorder


def simulate_recorded(
    team: Team, seed: int, duration_s: float, path: Path
) -> tuple[Report, Recorder]:
    """A simulated team that is recorded into a file."""
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    with Recording(path, team, hub.session()):
        run_simulated(team, seed, duration_s, hub)
    return simulated_report(recorder, team), recorder


def run_simulated(
    team: Team,
    seed: int,
    duration_s: float,
    hub: MemoryHub,
    others: Sequence[Steppable] = (),
    bus_wrappers: Mapping[str, BusWrapper] = MappingProxyType({}),
) -> None:
    """Runs the field, the robots and others on a hub."""
    field = FieldNode(SimulatedField(team, seed, 0), hub.session())
    robots = robot_nodes(team, hub, 0, bus_wrappers)
    run_nodes([field, *robots, *others], 0, int(duration_s * 1e9))
