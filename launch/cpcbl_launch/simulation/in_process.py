"""A team in one process over the bus in memory: deterministic, as fast as the machine is."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from cpcbl_agents.node import Node, NodeStart, Steppable
from cpcbl_agents.robot import Robot, build_robot
from cpcbl_agents.tape import NO_TAPE, Tape
from cpcbl_launch.reporting.recorder import Recorder, Report, variants_of
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_team.config import Team
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub

Progress = Callable[[float], None]
BusWrapper = Callable[[Bus], Bus]
TapeFor = Callable[[Robot, Team, NodeStart], Tape]


def no_tape(robot: Robot, team: Team, start: NodeStart) -> Tape:
    """Records nothing."""
    return NO_TAPE


def simulate(
    team: Team,
    seed: int,
    duration_s: float,
    truth: Team | None = None,
    watch: Callable[[Bus], object] = lambda bus: None,
    over: Callable[[], bool] = lambda: False,
    progress: Progress | None = None,
    bus_wrappers: Mapping[str, BusWrapper] = MappingProxyType({}),
    tape_for: TapeFor = no_tape,
) -> tuple[Report, Recorder]:
    """A simulated team, field and robots in one process.

    `truth` is the team as it really is, where that is not what its robots believe. `watch` may
    subscribe to the run, and `over` end it before its time; `bus_wrappers` put something between a
    robot and its bus, and `tape_for` says what a robot's node records with.
    """
    hub, end_ns = MemoryHub(), int(duration_s * 1e9)
    recorder = Recorder(hub.session())
    watch(hub.session())
    field = FieldNode(SimulatedField(truth or team, seed, 0), hub.session())
    robots = robot_nodes(team, hub, 0, bus_wrappers, tape_for)
    run_nodes([field, *robots], 0, end_ns, progress, over)
    return simulated_report(recorder, team), recorder


def simulated_report(recorder: Recorder, team: Team) -> Report:
    """The figures of a simulated team, from its start on."""
    return recorder.report(variants_of(team), recorder.simulated_truth())


def robot_nodes(
    team: Team,
    hub: MemoryHub,
    start_ns: int,
    bus_wrappers: Mapping[str, BusWrapper] = MappingProxyType({}),
    tape_for: TapeFor = no_tape,
) -> list[Steppable]:
    """A node for each robot, each with a session of its own."""
    start = NodeStart(start_ns, "0")

    def session(name: str) -> Bus:
        bus = hub.session()
        return bus_wrappers[name](bus) if name in bus_wrappers else bus

    def node(name: str) -> Node:
        robot = build_robot(name, team, start_ns)
        tape = tape_for(robot, team, start)
        return Node(robot, team, session(name), start, tape=tape)

    return [node(name) for name in team.robots]


def run_nodes(
    nodes: Sequence[Steppable],
    start_ns: int,
    end_ns: int,
    progress: Progress | None = None,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Steps nodes in the order of their times; what one says the others hear at once."""
    now_ns, shown = start_ns, 0.0
    while now_ns < end_ns and not over():
        now_ns = max(now_ns, min(end_ns, *(node.next_ns for node in nodes)))
        for node in nodes:
            if node.next_ns <= now_ns or node.waiting:
                node.step(now_ns)
        while any(node.waiting for node in nodes):
            for node in nodes:
                if node.waiting:
                    node.step(now_ns)
        done = (now_ns - start_ns) / (end_ns - start_ns)
        if progress is not None and done >= shown + 0.01:
            shown = done
            progress(min(done, 1.0))
