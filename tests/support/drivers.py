"""A robot on the bus in memory, its driver, and the world that the driver measures."""

import math
import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from cpcbl_agents.node import Node, NodeCallbacks, NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_team.config import Field, Landmark, PositionSensor, Team
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Publisher
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Frame, SensorInput, Status, encode
from support.buses import SECOND, robot_at

EPOCH = 1_750_000_000 * SECOND
TICK_NS = SECOND // 100
Sent = SensorInput | bytes
Change = Callable[[SensorInput, int], Sequence[Sent]]
Drive = Callable[[float], tuple[float, float]]  # speed and turn rate by the time (s)
TOPICS = {
    Odometry: topics.IN_ODOMETRY,
    Sightings: topics.IN_SIGHTINGS,
    Position: topics.IN_POSITION,
    InitialPose: topics.IN_INITIAL_POSE,
    Frame: topics.IN_FRAME,
}
PLACES = {"door": (5.0, 1.0), "desk": (4.0, -4.0), "lamp": (-4.0, 3.0), "sink": (-2.0, -5.0)}


def as_it_is(message: SensorInput, now_ns: int) -> Sequence[Sent]:
    return [message]


class World(NamedTuple):
    """What a robot does and sees. Rates of 0: it has no such sensor."""

    drive: Drive
    places: Mapping[str, tuple[float, float]] = PLACES
    start: Pose2 = Pose2(0.0, 0.0, 0.0)
    odometry_hz: float = 10.0
    sightings_hz: float = 10.0
    position_hz: float = 0.0
    latency_s: float = 0.005
    jitter_s: float = 0.0
    range_share: float = 0.03
    bearing_deg: float = 2.0
    slip: float = 0.03  # of distances and turns
    outliers: float = 0.0  # the share of sightings that are far off
    view_deg: float = 360.0
    empty_frames: bool = True  # whether frames are sent in which nothing is seen
    drift: float = 0.0  # of the driver's clock
    settings: Mapping[str, Any] = {}
    seed: int = 1


class DrivenRobot:
    """Robot `r1`, which its driver drives through a world."""

    def __init__(self, world: World) -> None:
        base = robot_at(world.start.x, world.start.y, math.degrees(world.start.heading))
        own = {"position_sensor": PositionSensor()} if world.position_hz else {}
        robot = msgspec.structs.replace(base, **own, **world.settings)
        marks = {name: Landmark(x_m=x, y_m=y) for name, (x, y) in world.places.items()}
        self.team = Team(name="lab", robots={"r1": robot, "r2": base}, map=Field(landmarks=marks))
        self.world, self.random = world, random.Random(world.seed)
        self.hub = hub = MemoryHub()
        out = hub.session()
        self._publishers: dict[type, Publisher] = {
            kind: out.publisher(topic.at(robot="r1"), topic.qos) for kind, topic in TOPICS.items()
        }
        self.statuses: list[Status] = []
        self.node = Node(
            build_robot("r1", self.team, EPOCH),
            self.team,
            hub.session(),
            NodeStart(EPOCH, "1"),
            NodeCallbacks(on_status=self.statuses.append),
        )
        self.now_ns, self.pose = EPOCH, world.start
        self._since = self._position_ns = self._sightings_ns = EPOCH
        self._distance_m = self._turn_rad = 0.0
        self._waiting: list[tuple[int, int, type, bytes]] = []
        self._sent, self._last = 0, dict[type, int]()

    def run(self, seconds: float, change: Change = as_it_is) -> None:
        """Drives for so long."""
        until_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < until_ns:
            self._tick(change)

    def put(self, message: SensorInput) -> None:
        """Gives the robot another input, at once."""
        self._publishers[type(message)].put(encode(message))

    def _tick(self, change: Change) -> None:
        self.now_ns += TICK_NS
        speed, rate = self.world.drive((self.now_ns - EPOCH) * 1e-9)
        seconds = TICK_NS * 1e-9
        self.pose = step(self.pose, speed * seconds, rate * seconds)
        self._distance_m += speed * seconds
        self._turn_rad += rate * seconds
        w = self.world
        if (self.now_ns - self._since) * 1e-9 * w.odometry_hz > 1.0 - 1e-6 and w.odometry_hz:
            self._send(self._odometry(), change)
        if (self.now_ns - self._sightings_ns) * 1e-9 * w.sightings_hz > 1.0 - 1e-6:
            self._sightings_ns = self.now_ns
            frame = Sightings(self._stamp(self.now_ns), tuple(self._seen()))
            if frame.sightings or w.empty_frames:
                self._send(frame, change)
        if (self.now_ns - self._position_ns) * 1e-9 * w.position_hz > 1.0 - 1e-6:
            self._position_ns = self.now_ns
            x, y = (c + self.random.gauss(0.0, 0.02) for c in self.pose[:2])
            self._send(Position(self._stamp(self.now_ns), x, y, (0.0004, 0.0, 0.0004)), change)
        while self._waiting and self._waiting[0][0] <= self.now_ns:
            _, _, kind, payload = self._waiting.pop(0)
            self._publishers[kind].put(payload)
        if self.node.waiting or self.node.next_ns <= self.now_ns:  # as the loop of a process does
            self.node.step(self.now_ns)

    def _stamp(self, stamp_ns: int) -> int:
        return stamp_ns + round((stamp_ns - EPOCH) * self.world.drift)

    def _noisy(self, value: float, share: float) -> float:
        return value * (1.0 + self.random.gauss(0.0, share)) if value else 0.0

    def _odometry(self) -> Odometry:
        share = self.world.slip
        moved = self._noisy(self._distance_m, share), self._noisy(self._turn_rad, share)
        piece = Odometry(self._stamp(self._since), self._stamp(self.now_ns), *moved)
        self._since, self._distance_m, self._turn_rad = self.now_ns, 0.0, 0.0
        return piece

    def _seen(self) -> list[Sighting]:
        seen, w = [], self.world
        for name, (x, y) in w.places.items():
            dx, dy = x - self.pose.x, y - self.pose.y
            bearing = wrap_angle(math.atan2(dy, dx) - self.pose.heading)
            if abs(bearing) > math.radians(0.5 * w.view_deg) or math.hypot(dx, dy) > 8.0:
                continue
            bearing = wrap_angle(bearing + self.random.gauss(0.0, math.radians(w.bearing_deg)))
            range_m = self._noisy(math.hypot(dx, dy), w.range_share)
            if self.random.random() < w.outliers:
                bearing, range_m = self.random.uniform(-3.1, 3.1), self.random.uniform(0.3, 8.0)
            seen.append(Sighting(name, range_m, bearing))
        return seen

    def _send(self, message: SensorInput, change: Change) -> None:
        late_s = self.world.latency_s + self.random.uniform(0.0, self.world.jitter_s)
        for sent in change(message, self.now_ns):
            payload = sent if isinstance(sent, bytes) else encode(sent)
            self._sent += 1
            arrives_ns = max(self.now_ns + round(late_s * SECOND), self._last.get(type(message), 0))
            self._last[type(message)] = arrives_ns  # a connection keeps the order
            self._waiting.append((arrives_ns, self._sent, type(message), payload))
        self._waiting.sort(key=lambda item: item[:2])

    @property
    def is_consistent(self) -> bool:
        """Whether the true position is inside 3 sigma of the estimate."""
        estimate = self.node.robot.filter.timeline.state.estimate
        dx, dy = self.pose.x - estimate.pose.x, self.pose.y - estimate.pose.y
        c = estimate.covariance
        det = c.xx * c.yy - c.xy * c.xy
        return (c.yy * dx * dx - 2.0 * c.xy * dx * dy + c.xx * dy * dy) / det < 11.83

    @property
    def problems(self) -> tuple[str, ...]:
        return self.statuses[-1].problems
