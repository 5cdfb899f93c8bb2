"""Simulated teams that are recorded, or have guests that come and go at set times."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_agents.node import GuestNode, NodeStart, Steppable
from cpcbl_agents.process import tape_for
from cpcbl_agents.robot import NEVER_NS, Robot, build_robot
from cpcbl_agents.tape import Tape
from cpcbl_launch.recordings.read import BUS
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
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub


class SteppableProxy(Steppable):
    """Stands before a node and passes everything on, for those that measure or note its steps."""

    def __init__(self, node: Steppable) -> None:
        self._node = node

    @property
    def next_ns(self) -> int:
        return self._node.next_ns

    @property
    def waiting(self) -> bool:
        return self._node.waiting

    def step(self, now_ns: int) -> None:
        self._node.step(now_ns)


class ScheduledGuest(NamedTuple):
    """A guest, and when it is there (seconds of robot time)."""

    name: str
    settings: RobotSettings
    from_s: float
    until_s: float


class ScheduledGuestNode:
    """A visitor's node, with a session of its own from its coming to its going. `record`: the
    folder that it records into."""

    def __init__(
        self, visitor: ScheduledGuest, team: Team, hub: MemoryHub, record: Path | None = None
    ) -> None:
        self._name, self._hub, self._record = visitor.name, hub, record
        self._recording = ExitStack()
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
            start = NodeStart(now_ns, "1")
            tape = tape_for(robot, self._team, start, self._record, is_guest=True)
            entered = self._recording.enter_context(tape)
            self._visit = GuestNode(robot, self._team, self._bus, start, tape=entered)
        if self._visit is None:
            return
        if now_ns < self._until_ns:
            self._visit.step(now_ns)
            return
        self._visit.leave(now_ns)
        self._visit = None
        self._recording.close()
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


def record_run(
    folder: Path,
    team: Team,
    seed: int,
    duration_s: float,
    guests: Sequence[ScheduledGuest] = (),
    with_bus: bool = False,
) -> None:
    """Records a simulated team and its guests, as `simulate --record FOLDER` does; with what the
    bus carried, as `up` does. Robots publish for a recorder and for one who looks at their poses
    and frames."""
    hub = MemoryHub()
    Recorder(hub.session())
    for topic in (topics.POSE, topics.LOOK):
        hub.session().subscribe(topic.at(), lambda key, payload: None)
    visits = [ScheduledGuestNode(guest, team, hub, folder) for guest in guests]
    field = FieldNode(SimulatedField(team, seed, 0), hub.session())
    with ExitStack() as stack:

        def record(robot: Robot, team: Team, start: NodeStart) -> Tape:
            return stack.enter_context(tape_for(robot, team, start, folder))

        if with_bus:
            folder.mkdir(exist_ok=True)
            stack.enter_context(Recording(folder / BUS, team, hub.session()))
        robots = robot_nodes(team, hub, 0, tape_for=record)
        run_nodes([field, *robots, *visits], 0, int(duration_s * 1e9))


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
