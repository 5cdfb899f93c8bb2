"""Pairs of simulations that differ in one thing alone: with it recorded, and really without it.

Robots drive as they are commanded beforehand (open loop) or by their own estimates (closed loop).
Every source of errors has a random stream of its own, so both runs of a pair sense the same.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from heapq import heappop, heappush
from itertools import count
from pathlib import Path
from random import Random
from types import MappingProxyType
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_agents.flight_recorder import recorded
from cpcbl_agents.node import Node, NodeStart, Steppable
from cpcbl_agents.robot import NEVER_NS, build_robot
from cpcbl_agents.tape import NO_TAPE
from cpcbl_launch.lab.experiments.mixed_teams import mixed_team
from cpcbl_launch.lab.what_if.changes import Change, with_setting
from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import run_nodes, simulated_report
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, BusProxy, Publisher, PublisherProxy
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Drive, encode
from cpcbl_transport.topics import Qos
from support.simulated import SteppableProxy

Drives = Mapping[str, tuple[Drive, ...]]
HELP = ("fix/", "belief/")


class World(NamedTuple):
    """What both runs of a pair have in common."""

    team: Team
    seed: int
    duration_s: float
    drives: Drives = MappingProxyType({})
    """The commands of all robots; empty: they drive by their estimates."""
    most_delay_s: float = 0.0  # of a message between two robots, each drawn from 0 to this


def open_loop(world: World) -> World:
    """The same world, in which robots drive as they did of their own accord."""
    drives: dict[str, list[Drive]] = {}

    def on_drive(received: Received[Drive]) -> None:
        drives.setdefault(received.message.robot, []).append(received.message)

    simulate_world(world, watch=lambda bus: Subscriber(bus, Drive, on_drive))
    robots = {name: replace(r, waypoints_m=()) for name, r in world.team.robots.items()}
    team = replace(world.team, robots=robots)
    return world._replace(team=team, drives={name: tuple(d) for name, d in drives.items()})


def changed_world(world: World, change: Change) -> tuple[World, Team]:
    """The world as it really is after the change, and what stands on its field."""
    team, marks = world.team, dict(world.team.map.landmarks)
    for name in change.hide:
        marks[name] = replace(marks[name], gives="none")
    kept = {n: r for n, r in team.robots.items() if n not in change.without}
    truth = replace(team, robots=kept, map=replace(team.map, landmarks=marks))
    for text in change.settings:  # what robots believe: their errors stay what they were
        team = with_setting(team, text)
    believed = {n: r for n, r in team.robots.items() if n not in change.without}
    return world._replace(team=replace(team, robots=believed)), truth


def simulate_world(
    world: World,
    truth: Team | None = None,
    folder: Path | None = None,
    watch: Callable[[Bus], object] = lambda bus: None,
) -> Report:
    """The world once; `folder`: of the run, into which all robots record."""
    team, hub = world.team, MemoryHub()
    recorder, delays = Recorder(hub.session()), _Delays(world)
    watch(hub.session())
    field = SimulatedField(truth or team, world.seed, 0, is_paired=True)
    first = [FieldNode(field, hub.session()), _Commands(world.drives, hub.session()), delays]
    with ExitStack() as stack:
        nodes: list[Steppable] = []
        for name in team.robots:
            robot, start = build_robot(name, team, 0), NodeStart(0, "0")
            tape = NO_TAPE
            if folder is not None:
                tape = stack.enter_context(recorded(folder, robot, team, start))
            bus = _DelayingBus(hub.session(), delays)
            node = Node(robot, team, bus, start, tape=tape)
            nodes.append(_Timed(node, delays))
        if folder is not None:
            stack.enter_context(Recording(folder / "bus.mcap", team, hub.session()))
        run_nodes([*first, *nodes], 0, int(world.duration_s * 1e9))
    return simulated_report(recorder, team)


class _Commands(Steppable):
    """Commands that were given beforehand."""

    waiting = False

    def __init__(self, drives: Drives, bus: Bus) -> None:
        every = [drive for of_robot in drives.values() for drive in of_robot]
        self._drives = sorted(every, key=lambda drive: -drive.stamp_ns)
        self._publishers = {
            name: bus.publisher(topics.DRIVE.at(robot=name), topics.DRIVE.qos) for name in drives
        }

    @property
    def next_ns(self) -> int:
        return self._drives[-1].stamp_ns if self._drives else NEVER_NS

    def step(self, now_ns: int) -> None:
        while self.next_ns <= now_ns:
            drive = self._drives.pop()
            self._publishers[drive.robot].put(encode(drive))


class _Delays(Steppable):
    """Delivers each message between robots some time after it was sent."""

    waiting = False

    def __init__(self, world: World) -> None:
        self._random, self._most_ns = Random(world.seed), world.most_delay_s * 1e9
        self._held: list[tuple[int, int, Publisher, bytes]] = []
        self._numbers, self.now_ns = count(), 0

    @property
    def next_ns(self) -> int:
        return self._held[0][0] if self._held else NEVER_NS

    def step(self, now_ns: int) -> None:
        while self.next_ns <= now_ns:
            _, _, publisher, payload = heappop(self._held)
            publisher.put(payload)

    def put(self, publisher: Publisher, payload: bytes) -> None:
        if not self._most_ns:
            publisher.put(payload)
            return
        due_ns = self.now_ns + int(self._random.uniform(0.0, self._most_ns))
        heappush(self._held, (due_ns, next(self._numbers), publisher, payload))


class _DelayingPublisher(PublisherProxy):
    def __init__(self, publisher: Publisher, delays: _Delays) -> None:
        super().__init__(publisher)
        self._delays = delays

    def put(self, payload: bytes) -> None:
        self._delays.put(self._publisher, payload)


class _DelayingBus(BusProxy):
    def __init__(self, bus: Bus, delays: _Delays) -> None:
        super().__init__(bus)
        self._delays = delays

    def publisher(self, key: str, qos: Qos) -> Publisher:
        found = super().publisher(key, qos)
        return _DelayingPublisher(found, self._delays) if key.startswith(HELP) else found


class _Timed(SteppableProxy):
    """A node that tells the delays what time it is."""

    def __init__(self, node: Node, delays: _Delays) -> None:
        super().__init__(node)
        self._delays = delays

    def step(self, now_ns: int) -> None:
        self._delays.now_ns = now_ns
        super().step(now_ns)


# Forty pairs --------------------------------------------------------------------------------------

SIZE, SECONDS = 5, 60.0


def pair(
    number: int,
    is_open: bool,
    most_delay_s: float = 0.0,
    size: int = SIZE,
    duration_s: float = SECONDS,
) -> tuple[World, Change]:
    """A world of a mixed team, and what is changed in it: robots, landmarks, settings in turn."""
    team = mixed_team(size, number)
    helper, other = "r00", f"r0{1 + number % (size - 1)}"
    mark = f"m{number % len(team.map.landmarks)}"
    changes = (
        Change(without=(helper,)),
        Change(without=(other,)),
        Change(hide=(mark,)),
        Change(hide=tuple(team.map.landmarks)),
        Change(settings=("collaboration=none",)),
        Change(settings=("messages_per_minute=2",)),
        Change(settings=("variant=circular",)),
        Change(settings=(f"robots.{helper}.sensor.sees_robots=false",)),
    )
    world = World(team, number, duration_s, most_delay_s=most_delay_s)
    return (open_loop(world) if is_open else world), changes[number % len(changes)]
