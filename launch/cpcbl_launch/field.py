"""The simulated field: true poses, what robots sense of it, what they bump into.

Robots send wheel commands (`field/drive/<robot>`); the field answers like a driver would, with
odometry and sightings under the robots' `in/` keys. Deterministic for a seed and the same commands.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from cpcbl_agents.clock import Clock
from cpcbl_agents.sensing import SensorInput
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry, Position, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.messages import Drive, Truth, Truths, decode, encode, refusal

COMMAND_LASTS_NS = 500_000_000


class Every:
    """Says when something is due that happens so many times a second."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = int(1e9 / rate_hz)
        self._due_ns: int | None = None

    def due(self, now_ns: int) -> bool:
        if self._due_ns is None:
            self._due_ns = now_ns
        if now_ns < self._due_ns:
            return False
        missed = (now_ns - self._due_ns) // self._period_ns
        self._due_ns += (missed + 1) * self._period_ns
        return True


class SimulatedRobot:
    """One robot of the field: its true pose and its imperfect senses."""

    def __init__(
        self, settings: RobotSettings, noise: float, seed: Sequence[int], start_ns: int
    ) -> None:
        assert settings.start is not None
        self.settings, self._noise = settings, noise
        self._random = np.random.default_rng(seed)
        start = settings.start
        self.pose = Pose2(
            start.x_m + self._normal(start.sigma_m),
            start.y_m + self._normal(start.sigma_m),
            wrap_angle(math.radians(start.heading_deg + self._normal(start.heading_sigma_deg))),
        )
        self.drive = Drive("", 0, 0.0, 0.0)
        self.bumps = 0
        self.touching: frozenset[str] = frozenset()
        self._reported, self._reported_ns = (0.0, 0.0), start_ns
        self._odometry_timer = Every(settings.odometry.rate_hz)
        self._frame_timer = Every(settings.sensor.rate_hz)
        sensor = settings.position_sensor
        self._position_timer = Every(sensor.rate_hz if sensor is not None else 1.0)

    def move(self, now_ns: int, seconds: float) -> None:
        """Drives on as commanded; the wheels report the command, the ground adds noise."""
        if not self.settings.odometry.moves:
            return
        commanded = now_ns - self.drive.stamp_ns <= COMMAND_LASTS_NS
        distance = self.drive.speed_m_s * seconds if commanded else 0.0
        turn = self.drive.turn_rate_rad_s * seconds if commanded else 0.0
        o = self.settings.odometry
        along = o.distance_sigma_m_per_sqrt_m * math.sqrt(abs(distance))
        around = math.sqrt(
            o.turn_sigma_rad_per_sqrt_rad**2 * abs(turn)
            + o.turn_sigma_rad_per_sqrt_m**2 * abs(distance)
        )
        self.pose = step(self.pose, distance + self._normal(along), turn + self._normal(around))
        self._reported = (self._reported[0] + distance, self._reported[1] + turn)

    def odometry(self, now_ns: int) -> Odometry | None:
        """The piece since the last one, when it is due; as reported, before any correction."""
        o = self.settings.odometry
        if not o.moves or not self._odometry_timer.due(now_ns):
            return None
        distance, turn = self._reported
        piece = Odometry(
            self._reported_ns, now_ns, distance / o.distance_scale, turn / o.turn_scale
        )
        self._reported, self._reported_ns = (0.0, 0.0), now_ns
        return piece

    def sightings(self, now_ns: int, objects: Iterable["Seen"]) -> Sightings | None:
        """What is in view, when a frame is due."""
        if not self._frame_timer.due(now_ns):
            return None
        return Sightings(now_ns, tuple(s for o in objects if (s := self._sighted(*o))))

    def position(self, now_ns: int) -> Position | None:
        """What the position sensor says, if there is one and it is due."""
        sensor = self.settings.position_sensor
        if sensor is None or not self._position_timer.due(now_ns):
            return None
        x, y = (v + self._normal(sensor.sigma_m) for v in self.pose[:2])
        return Position(now_ns, x, y, (sensor.sigma_m**2, 0.0, sensor.sigma_m**2))

    def _sighted(self, name: str, x: float, y: float, gives: str) -> Sighting | None:
        sensor = self.settings.sensor
        dx, dy = x - self.pose.x, y - self.pose.y
        range_m = math.hypot(dx, dy)
        bearing = wrap_angle(math.atan2(dy, dx) - self.pose.heading)
        seen = abs(bearing) <= math.radians(sensor.field_of_view_deg) / 2.0
        if gives == "none" or not seen or not 0.05 <= range_m <= sensor.max_range_m:
            return None
        range_m += self._normal(sensor.range_sigma_m(range_m))
        bearing = wrap_angle(bearing + self._normal(sensor.bearing_sigma_rad))
        return Sighting(
            name,
            max(range_m, 0.01) if gives in ("both", "range") else None,
            bearing if gives in ("both", "bearing") else None,
        )

    def _normal(self, sigma: float) -> float:
        return float(self._random.normal(0.0, sigma)) * self._noise if sigma else 0.0


Seen = tuple[str, float, float, str]  # name, the place that is seen, what it gives


class SimulatedField:
    """All robots of a team on one field, in fixed steps of time."""

    def __init__(self, team: Team, seed: int, start_ns: int) -> None:
        self._team = team
        self._step_ns = int(1e9 / team.simulation.step_rate_hz)
        self.now_ns = start_ns
        self.robots = {
            name: SimulatedRobot(settings, team.simulation.noise, (seed, i), start_ns)
            for i, (name, settings) in enumerate(team.robots.items())
            if settings.source == "simulated"
        }

    @property
    def next_ns(self) -> int:
        return self.now_ns + self._step_ns

    def command(self, drive: Drive) -> None:
        """A robot's wheels from now on; commands for unknown robots are ignored."""
        if drive.robot in self.robots:
            self.robots[drive.robot].drive = drive

    def advance(self) -> list[tuple[str, SensorInput]]:
        """One step; what each robot senses at its end."""
        self.now_ns += self._step_ns
        for robot in self.robots.values():
            robot.move(self.now_ns, self._step_ns * 1e-9)
            self._bump(robot)
        sensed: list[tuple[str, SensorInput]] = []
        for name, robot in self.robots.items():
            piece = robot.odometry(self.now_ns)
            frame = robot.sightings(self.now_ns, self._visible(name, robot.pose))
            position = robot.position(self.now_ns)
            sensed += [(name, item) for item in (piece, frame, position) if item is not None]
        return sensed

    def truth(self) -> Truths:
        robots = tuple(Truth(n, *r.pose, r.bumps) for n, r in self.robots.items())
        return Truths(self.now_ns, robots)

    def _visible(self, viewer: str, pose: Pose2) -> Iterable[Seen]:
        for name, mark in self._team.map.landmarks.items():
            yield name, mark.x_m, mark.y_m, mark.gives
        for name, wall in self._team.map.walls.items():
            (ax, ay), (bx, by) = wall.from_m, wall.to_m
            length = math.hypot(bx - ax, by - ay)
            ux, uy = (bx - ax) / length, (by - ay) / length
            along = ux * (pose.x - ax) + uy * (pose.y - ay)
            if 0.0 <= along <= length:
                yield name, ax + along * ux, ay + along * uy, wall.gives
        for name, other in self.robots.items():
            if name != viewer:
                yield name, other.pose.x, other.pose.y, "both"

    def _bump(self, robot: SimulatedRobot) -> None:
        radius = self._team.simulation.bump_radius_m
        touching = frozenset(
            name
            for name, mark in self._team.map.landmarks.items()
            if math.hypot(mark.x_m - robot.pose.x, mark.y_m - robot.pose.y) < radius
        )
        robot.bumps += len(touching - robot.touching)
        robot.touching = touching


class FieldNode:
    """The field on a bus."""

    def __init__(self, field: SimulatedField, bus: Bus) -> None:
        self._field = field
        self._drives: deque[bytes] = deque(maxlen=10_000)
        self._truth = bus.publisher(topics.TRUTH.at(), topics.TRUTH.qos)
        self._publishers: dict[tuple[str, type], Publisher] = {}
        for name in field.robots:
            for topic in topics.INPUTS:
                assert topic.carries is not None
                publisher = bus.publisher(topic.at(robot=name), topic.qos)
                self._publishers[name, topic.carries] = publisher
        bus.subscribe(topics.DRIVE.at(), lambda key, payload: self._drives.append(payload))

    @property
    def next_ns(self) -> int:
        return self._field.next_ns

    @property
    def waiting(self) -> bool:
        return False  # commands take effect with the next step

    def step(self, now_ns: int) -> None:
        """Advances the field to `now_ns` and tells the robots what they sense."""
        while self._drives:
            drive = decode(self._drives.popleft())
            if isinstance(drive, Drive) and refusal(drive, now_ns) is None:
                self._field.command(drive)
        while self._field.next_ns <= now_ns:
            for name, sensed in self._field.advance():
                self._publishers[name, type(sensed)].put(encode(sensed))
            if self._truth.matching:
                self._truth.put(encode(self._field.truth()))


def run_field(team: Team, seed: int, bus: Bus, clock: Clock, stop: Callable[[], bool]) -> None:
    """The field as a process: steps in robot time until `stop()`."""
    node = FieldNode(SimulatedField(team, seed, clock.now_ns()), bus)
    while not stop():
        node.step(clock.now_ns())
        time.sleep(min(clock.seconds_until(node.next_ns), 0.2))
