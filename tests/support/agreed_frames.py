"""Teams that agree on a frame from nothing, in memory: where each robot is, and in which frame."""

import math
import random
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from cpcbl_agents.node import Node, NodeStart, Steppable
from cpcbl_agents.robot import build_robot
from cpcbl_launch.reporting.frames import FrameOrigins
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import run_nodes
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Field, Start, Team
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport.bus import Bus, BusProxy, Publisher, PublisherProxy
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Track
from cpcbl_transport.topics import Qos
from support.simulated import SteppableProxy

STEP_NS = 100_000_000
HELP = ("belief/", "fix/", "landmark/")
INSIDE = 11.83  # the NEES of a position within 3 sigma
BusWrapper = Callable[[str, Bus], Bus]


class Sample(NamedTuple):
    """One robot at one time."""

    at_s: float
    robot: str
    frame: str
    lost: str
    error_m: float | None  # in its frame; None while it is lost, or its frame's origin unknown
    nees: float | None  # of two degrees of freedom


class ClockAhead(SteppableProxy):
    """A node whose clock is ahead of the field's."""

    def __init__(self, node: Steppable, ahead_ns: int) -> None:
        super().__init__(node)
        self._ahead_ns = ahead_ns

    @property
    def next_ns(self) -> int:
        return super().next_ns - self._ahead_ns

    def step(self, now_ns: int) -> None:
        super().step(now_ns + self._ahead_ns)


class World:
    """A simulated team in memory, whose robots come and go."""

    def __init__(
        self,
        team: Team,
        seed: int,
        wrap_bus: BusWrapper = lambda name, bus: bus,
        late_s: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self.team, self.hub, self.now_ns = team, MemoryHub(), 0
        self.field = SimulatedField(team, seed, 0)
        self._field_node = FieldNode(self.field, self.hub.session())
        self._wrap_bus, self._buses = wrap_bus, dict[str, Bus]()
        self.nodes: dict[str, Node] = {}
        self._steppable: dict[str, Steppable] = {}
        self.origins, self.samples = FrameOrigins(), list[Sample]()
        self._late_s = dict(late_s)
        for name in team.robots:
            if name not in self._late_s:
                self.start(name)

    def start(self, name: str) -> None:
        """Starts the process of a robot."""
        ahead_ns = self.field.clock_offset_ns(name)
        own_ns = self.now_ns + ahead_ns
        bus = self._buses[name] = self._wrap_bus(name, self.hub.session())
        start = NodeStart(own_ns, f"{own_ns:x}")
        node = Node(build_robot(name, self.team, own_ns), self.team, bus, start)
        self.nodes[name], self._steppable[name] = node, ClockAhead(node, ahead_ns)

    def add(self, name: str, make: Callable[[Bus], Steppable]) -> None:
        """Something else runs beside the robots, under this name."""
        self._steppable[name] = make(self.hub.session())

    def stop(self, name: str) -> None:
        """Its process ends."""
        del self.nodes[name], self._steppable[name]
        self._buses.pop(name).close()

    def run(self, seconds: float) -> "World":
        """So many seconds go by."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            for name in [n for n, at_s in self._late_s.items() if self.now_ns >= at_s * 1e9]:
                del self._late_s[name]
                self.start(name)
            nodes = [self._field_node, *self._steppable.values()]
            run_nodes(nodes, self.now_ns, self.now_ns + STEP_NS)
            self.now_ns += STEP_NS
            self.origins.note_truths(self.field.truth())
            self.samples += [self._sample(name) for name in self.nodes]
        return self

    def _sample(self, name: str) -> Sample:
        node = self.nodes[name]
        own_ns = self.now_ns + self.field.clock_offset_ns(name)
        state = node.robot.filter.timeline.latest(own_ns)
        frame = node.robot.filter.frame
        track = Track(
            name,
            self.now_ns,
            *state.reported.pose,
            state.reported.covariance,
            LOWEST_TIER,
            state.lost,
            frame,
        )
        self.origins.note_track(track)
        here, at_s = self.origins.in_field(track), self.now_ns * 1e-9
        if state.lost or here.frame or here.covariance is None:
            return Sample(at_s, name, frame, state.lost, None, None)
        true = self.field.robots[name].pose
        error = np.array([here.x_m - true.x, here.y_m - true.y])
        xx, xy, yy = here.covariance[:3]
        covariance = np.array([[xx, xy], [xy, yy]]) + 1e-8 * np.eye(2)
        nees = float(error @ np.linalg.solve(covariance, error))
        return Sample(at_s, name, frame, "", math.hypot(*error), nees)

    @property
    def frames(self) -> dict[str, str]:
        """The frame of each robot now."""
        return {name: node.robot.filter.frame for name, node in self.nodes.items()}

    def counts(self, name: str) -> Mapping[str, int]:
        """What a robot has counted."""
        node = self.nodes[name]
        return node.robot.counts + node.counts

    def one_frame_after_s(self, *names: str) -> float:
        """Since when these robots, or all, have been in one frame."""
        by_time: dict[float, set[str]] = {}
        for sample in self.samples:
            if not names or sample.robot in names:
                by_time.setdefault(sample.at_s, set()).add(sample.frame)
        return max((at_s for at_s, frames in by_time.items() if len(frames) > 1), default=0.0)

    def nees(self, from_s: float = 5.0) -> float:
        """The mean of all robots' positions."""
        return float(np.mean([s.nees for s in self._scored(from_s)]))

    def inside_share(self, from_s: float = 5.0) -> float:
        """The share of positions within 3 sigma."""
        return float(np.mean([(s.nees or 0.0) < INSIDE for s in self._scored(from_s)]))

    def rmse_m(self, from_s: float = 5.0) -> float:
        return math.sqrt(np.mean([(s.error_m or 0.0) ** 2 for s in self._scored(from_s)]))

    def _scored(self, from_s: float) -> Iterator[Sample]:
        return (s for s in self.samples if s.nees is not None and s.at_s >= from_s)


class LossyBus(BusProxy):
    """Loses this share of the help that is put on it."""

    def __init__(self, bus: Bus, share: float, seed: str) -> None:
        super().__init__(bus)
        self.share, self._dice = share, random.Random(seed)

    def publisher(self, key: str, qos: Qos) -> Publisher:
        publisher = super().publisher(key, qos)
        return _LossyPublisher(publisher, self) if key.startswith(HELP) else publisher

    def loses(self) -> bool:
        """Whether the next message is lost."""
        return self._dice.random() < self.share


class _LossyPublisher(PublisherProxy):
    def __init__(self, publisher: Publisher, bus: LossyBus) -> None:
        super().__init__(publisher)
        self._bus = bus

    def put(self, payload: bytes) -> None:
        if not self._bus.loses():
            super().put(payload)


def unmapped() -> Team:
    """The built-in team."""
    return load_team(builtin_path("unmapped"))


def bare() -> Team:
    """The same without any landmark: its robots see nothing but each other."""
    return replace(unmapped(), map=Field(frame="agreed"))


def two_halves() -> Team:
    """Two robots at each end of a row of landmarks, too far apart to see each other; they drive to
    its middle and back."""
    team = unmapped()
    mark, robot = team.map.unsurveyed["north"], team.robots["second"]
    places = [(5.0 * column - 1.5, y) for column in range(5) for y in (-1.5, 4.5)]
    marks = {f"l{n}": replace(mark, true_m=place) for n, place in enumerate(places)}
    ways = {
        "a1": ((0.0, 0.0), (8.0, 0.0), (8.0, 3.0), (0.0, 3.0), (0.0, 0.0)),
        "a2": ((1.0, 3.0), (0.0, 1.0), (7.0, 1.0), (7.0, 2.0), (0.0, 2.0)),
        "b1": ((18.0, 0.0), (10.0, 0.0), (10.0, 3.0), (18.0, 3.0), (18.0, 0.0)),
        "b2": ((17.0, 3.0), (18.0, 1.0), (11.0, 1.0), (11.0, 2.0), (18.0, 2.0)),
    }
    robots = {name: replace(robot, **_on(way)) for name, way in ways.items()}
    sensor = replace(robot.sensor, max_range_m=5.0)
    robots = {name: replace(r, sensor=sensor) for name, r in robots.items()}
    return replace(team, map=replace(team.map, unsurveyed=marks), robots=robots)


def _on(way: tuple[tuple[float, float], ...]) -> dict[str, object]:
    """The settings of a robot that drives from the first of these places to the others."""
    (x, y), (to_x, to_y) = way[:2]
    turn_deg = math.degrees(math.atan2(to_y - y, to_x - x))
    start = Start(x_m=x, y_m=y, heading_deg=turn_deg, known=False)
    return {"start": start, "waypoints_m": way[1:]}
