"""The simulated field: true poses, what robots sense of it, what they bump into.

Robots send wheel commands (`field/drive/<robot>`); the field answers like a driver would, with
odometry and sightings, or a camera's frames, under the robots' `in/` keys. Deterministic for a seed
and the same commands.
Guests have a body on it for as long as they ask for it (`field/join/<robot>`).
"""

import logging
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from msgspec.structs import replace

from cpcbl_agents.clock import Clock
from cpcbl_agents.sensing import SensorInput
from cpcbl_launch.simulation.bodies import Bodies
from cpcbl_launch.simulation.grid import Grid
from cpcbl_team.config import (
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    SimulationEvent,
    Team,
)
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry, Position, Sighting, Sightings
from cpcbl_team.motion import motion_noise
from cpcbl_team.sensors import LEAST_COSINE, corrected_odometry, crawled_s
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, Publisher
from cpcbl_transport.messages import (
    Body,
    Drive,
    Frame,
    Join,
    Refusal,
    Truth,
    Truths,
    encode,
    refusal,
)
from cpcbl_transport.reading import read

if TYPE_CHECKING:
    from cpcbl_launch.simulation.cameras import Cameras

log = logging.getLogger(__name__)

COMMAND_LASTS_NS = 500_000_000
PICTURES_LATE_NS = 150_000_000  # a field that is further behind catches up without making pictures
INBOX = 10_000
MOST_REFUSED = 100  # guests whose refusal is logged
_GUEST_SEED = 2**31  # no robot of a team file has this number
NOWHERE: Mapping[str, Bus] = MappingProxyType({})


class Every:
    """Says when something is due that happens so many times a second, from a time on or at once."""

    def __init__(self, rate_hz: float, from_ns: int | None = None) -> None:
        self._period_ns = int(1e9 / rate_hz)
        self._due_ns = from_ns

    def due(self, now_ns: int) -> bool:
        if self._due_ns is None:
            self._due_ns = now_ns
        if now_ns < self._due_ns:
            return False
        missed = (now_ns - self._due_ns) // self._period_ns
        self._due_ns += (missed + 1) * self._period_ns
        return True


class Seen(NamedTuple):
    """Something on the field, at the place that is seen of it."""

    name: str
    x: float
    y: float
    gives: str
    teammate: bool = False


class Delayed:
    """Steps of a motion that happen `steps` (whole and a fraction) after they were commanded."""

    def __init__(self, steps: float) -> None:
        whole = math.floor(steps)
        self._share = steps - whole
        self._steps: deque[tuple[float, float]] = deque([(0.0, 0.0)] * (whole + 2), whole + 2)

    def next(self, commanded: tuple[float, float]) -> tuple[float, float]:
        """What happens in this step, of which `commanded` is the command."""
        self._steps.append(commanded)
        before, now = self._steps[0], self._steps[1]
        if not self._share:
            return now
        late, soon = self._share, 1.0 - self._share
        return late * before[0] + soon * now[0], late * before[1] + soon * now[1]


def really_driven(distance: float, turn: float, seconds: float, o: OdometrySettings) -> float:
    """How far wheels go that are told to go this far: no slower than their least speed."""
    if not o.least_speed_m_s:
        return distance
    reported = Odometry(0, round(seconds * 1e9), *misreported(distance, turn, o))
    return corrected_odometry(reported, o).distance_m


def misreported(distance: float, turn: float, o: OdometrySettings) -> tuple[float, float]:
    """What wheels report of a motion that they were told: `corrected_odometry` makes of it what
    is `really_driven`, and without a least speed the motion itself."""
    reported_turn = (turn - o.turn_bias_rad_per_m * distance) / o.turn_scale
    lost = o.distance_loss_m_per_rad * abs(reported_turn) if distance else 0.0
    way = (abs(distance) + lost) / o.distance_scale
    return math.copysign(way, distance), reported_turn


def misread(
    range_m: float, bearing: float, sensor: SensorSettings, teammate: bool
) -> tuple[float, float]:
    """What a camera reads of a true range and bearing: the inverse of `corrected_sighting`."""
    reading = (bearing + math.radians(sensor.bearing_bias_deg)) / sensor.bearing_scale
    bias_m = sensor.robot_range_bias_m if teammate else sensor.range_bias_m
    reading_m = (range_m + bias_m) / sensor.range_scale
    if sensor.range_is_depth:
        off_axis = math.cos(reading - math.radians(sensor.optical_axis_deg))
        reading_m *= max(off_axis, LEAST_COSINE)
    return reading_m, wrap_angle(reading)


class SimulatedRobot:
    """One robot of the field: its true pose and its imperfect senses."""

    def __init__(
        self,
        settings: RobotSettings,
        noise: float,
        seed: Sequence[int],
        start_ns: int,
        step_ns: int,
        frames_from_ns: int | None = None,
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
        self._motion = Delayed(settings.odometry.delay_s * 1e9 / step_ns)
        self._frames: deque[Sightings | Frame] = deque()
        self._positions: deque[Position] = deque()
        self._errors: dict[tuple[str, str], tuple[int, float]] = {}
        self._odometry_timer = Every(settings.odometry.rate_hz)
        self._frame_timer = Every(settings.sensor.rate_hz, frames_from_ns)
        sensor = settings.position_sensor
        self._position_timer = Every(sensor.rate_hz if sensor is not None else 1.0)

    def move(self, now_ns: int, seconds: float) -> None:
        """The wheels report what is commanded; the ground does it later and adds noise."""
        if not self.settings.odometry.moves:
            return
        commanded = now_ns - self.drive.stamp_ns <= COMMAND_LASTS_NS
        distance = self.drive.speed_m_s * seconds if commanded else 0.0
        turn = self.drive.turn_rate_rad_s * seconds if commanded else 0.0
        self._reported = (self._reported[0] + distance, self._reported[1] + turn)
        o = self.settings.odometry
        distance, turn = self._motion.next((really_driven(distance, turn, seconds, o), turn))
        crawled = crawled_s(distance, seconds, o)
        in_its_direction = motion_noise(-0.5 * turn, distance, turn, o, crawled)
        along, around = math.sqrt(in_its_direction.xx), math.sqrt(in_its_direction.hh)
        self.pose = step(self.pose, distance + self._normal(along), turn + self._normal(around))

    def odometry(self, now_ns: int) -> Odometry | None:
        """The piece since the last one, when it is due; as reported, before any correction."""
        o = self.settings.odometry
        if not o.moves or not self._odometry_timer.due(now_ns):
            return None
        distance, turn = self._reported
        piece = Odometry(self._reported_ns, now_ns, *misreported(distance, turn, o))
        self._reported, self._reported_ns = (0.0, 0.0), now_ns
        return piece

    def frames(
        self, now_ns: int, exposed: Callable[[int], Sightings | Frame | None]
    ) -> list[Sightings | Frame]:
        """The frames that are out by now. One is `exposed` when it is due and stamped `delay_s`
        later; the camera hands it over at its stamp, or at once where the stamp is earlier.
        """
        if self._frame_timer.due(now_ns):
            frame = exposed(now_ns + int(self.settings.sensor.delay_s * 1e9))
            if frame is not None:
                self._frames.append(frame)
        return _out(self._frames, now_ns)

    def sightings(self, now_ns: int, stamp_ns: int, objects: Iterable[Seen]) -> Sightings:
        """What it sees of these objects now."""
        return Sightings(stamp_ns, tuple(s for o in objects if (s := self._sighted(o, now_ns))))

    def positions(self, now_ns: int) -> list[Position]:
        """What the position sensor has said by now, if there is one: `delay_s` after it measured,
        with the stamp of that time."""
        sensor = self.settings.position_sensor
        if sensor is None:
            return []
        if self._position_timer.due(now_ns):
            x, y = (v + self._normal(sensor.sigma_m) for v in self.pose[:2])
            variance, stamp_ns = sensor.sigma_m**2, now_ns + int(sensor.delay_s * 1e9)
            self._positions.append(Position(stamp_ns, x, y, (variance, 0.0, variance)))
        return _out(self._positions, now_ns)

    def _sighted(self, seen: Seen, now_ns: int) -> Sighting | None:
        sensor = self.settings.sensor
        dx, dy = seen.x - self.pose.x, seen.y - self.pose.y
        range_m = math.hypot(dx, dy)
        if seen.gives == "none" or not 0.05 <= range_m <= sensor.max_range_m:
            return None
        bearing = wrap_angle(math.atan2(dy, dx) - self.pose.heading)
        if abs(bearing) > math.radians(sensor.field_of_view_deg) / 2.0:
            return None
        range_m += self._error(seen.name, "range", sensor.range_sigma_m(range_m), now_ns)
        bearing += self._error(seen.name, "bearing", sensor.bearing_sigma_rad, now_ns)
        reading_m, reading = misread(range_m, bearing, sensor, seen.teammate)
        return Sighting(
            seen.name,
            max(reading_m, 0.01) if seen.gives in ("both", "range") else None,
            reading if seen.gives in ("both", "bearing") else None,
        )

    def _error(self, name: str, kind: str, sigma: float, now_ns: int) -> float:
        """The error of a reading: white, or like the last one of the same object (Gauss-Markov)."""
        if not self.settings.sensor.correlation_s:
            return self._normal(sigma)
        last = self._errors.get((name, kind))
        if last is None:
            unit = self._normal(1.0)
        else:
            alike = math.exp((last[0] - now_ns) * 1e-9 / self.settings.sensor.correlation_s)
            unit = alike * last[1] + self._normal(math.sqrt(1.0 - alike * alike))
        self._errors[name, kind] = now_ns, unit
        return sigma * unit

    def _normal(self, sigma: float) -> float:
        return float(self._random.normal(0.0, sigma)) * self._noise if sigma else 0.0


Stamped = TypeVar("Stamped", bound=Sightings | Frame | Position)


def _out(waiting: deque[Stamped], now_ns: int) -> list[Stamped]:
    """What is stamped with a time that has come."""
    out = []
    while waiting and waiting[0].stamp_ns <= now_ns:
        out.append(waiting.popleft())
    return out


class SimulatedField:
    """All robots of a team on one field, in fixed steps of time."""

    def __init__(self, team: Team, seed: int, start_ns: int) -> None:
        self.team, self._seed = team, seed
        self._step_ns = int(1e9 / team.simulation.step_rate_hz)
        self.now_ns = start_ns
        self.robots = {
            name: SimulatedRobot(
                settings,
                team.simulation.noise,
                (seed, i),
                start_ns,
                self._step_ns,
                _in_turn(team, name, start_ns + self._step_ns),
            )
            for i, (name, settings) in enumerate(team.robots.items())
            if settings.source == "simulated"
        }
        self._cameras = _cameras(team, seed)
        self.not_taken = 0
        """Frames that were due in steps without pictures."""
        self._marks = [Seen(n, m.x_m, m.y_m, m.gives) for n, m in team.map.landmarks.items()]
        self._marks_to_touch = Grid(team.simulation.bump_radius_m, self._marks)
        self._start_ns = start_ns
        self._events = deque(sorted(team.simulation.events, key=lambda event: event.at_s))
        self._hidden_until_ns = start_ns
        self._look()

    def _look(self) -> None:
        """How far anybody sees, and what there is to see so far around."""
        ranges_m = [robot.settings.sensor.max_range_m for robot in self.robots.values()]
        self._reach_m = max(ranges_m, default=0.0)
        self._marks_to_see = Grid(self._reach_m, self._marks)

    def join(self, name: str, body: Body) -> None:
        """A guest has a body from now on. Its noise is its own: the others' stays what it was."""
        settings = RobotSettings(
            start=body.start,
            sensor=body.sensor,
            odometry=body.odometry,
            position_sensor=body.position_sensor,
        )
        seed, noise = (self._seed, _GUEST_SEED, *name.encode()), self.team.simulation.noise
        self.robots[name] = SimulatedRobot(settings, noise, seed, self.now_ns, self._step_ns)
        self._look()

    def leave(self, name: str) -> None:
        del self.robots[name]
        self._look()

    @property
    def next_ns(self) -> int:
        return self.now_ns + self._step_ns

    def ahead_ns(self, robot: str) -> int:
        """How far a robot's clock is ahead of the field's."""
        return int(self.team.simulation.clocks_ahead_s.get(robot, 0.0) * 1e9)

    def command(self, drive: Drive) -> None:
        """A robot's wheels from now on; commands for unknown robots are ignored."""
        if drive.robot in self.robots:
            self.robots[drive.robot].drive = drive

    def advance(self, pictures: bool = True) -> list[tuple[str, SensorInput]]:
        """One step; what each robot senses at its end, with or without its camera."""
        self.now_ns += self._step_ns
        while self._events and self._passed_s >= self._events[0].at_s:
            self._befall(self._events.popleft())
        for robot in self.robots.values():
            robot.move(self.now_ns, self._step_ns * 1e-9)
            self._bump(robot)
        mates = Grid(
            self._reach_m,
            (Seen(n, r.pose.x, r.pose.y, "both", teammate=True) for n, r in self.robots.items()),
        )
        sensed: list[tuple[str, SensorInput]] = []
        for name, robot in self.robots.items():
            piece = robot.odometry(self.now_ns)
            frames = robot.frames(self.now_ns, partial(self._exposed, name, mates, pictures))
            items = (piece, *frames, *robot.positions(self.now_ns))
            sensed += [(name, item) for item in items if item is not None]
        return sensed

    def truth(self) -> Truths:
        robots = tuple(Truth(n, *r.pose, r.bumps) for n, r in self.robots.items())
        return Truths(self.now_ns, robots)

    @property
    def _passed_s(self) -> float:
        return (self.now_ns - self._start_ns) * 1e-9

    def _befall(self, event: SimulationEvent) -> None:
        hidden_ns = self._start_ns + int((event.at_s + event.hide_landmarks_s) * 1e9)
        self._hidden_until_ns = max(self._hidden_until_ns, hidden_ns)
        if event.to is not None and event.kidnap in self.robots:
            x, y, heading_deg = event.to
            self.robots[event.kidnap].pose = Pose2(x, y, wrap_angle(math.radians(heading_deg)))

    def _exposed(
        self, name: str, mates: Grid[Seen], pictures: bool, stamp_ns: int
    ) -> Sightings | Frame | None:
        """What a robot sees now: a picture, if it has a camera."""
        robot = self.robots[name]
        if robot.settings.sensing == "camera" and self._cameras is not None:
            if not pictures:
                self.not_taken += 1
                return None
            poses = {other: r.pose for other, r in self.robots.items()}
            return self._cameras.frame(name, stamp_ns, poses, self._landmarks_hidden)
        return robot.sightings(self.now_ns, stamp_ns, self._visible(name, robot.pose, mates))

    @property
    def _landmarks_hidden(self) -> bool:
        return self.now_ns < self._hidden_until_ns

    def _visible(self, viewer: str, pose: Pose2, mates: Grid[Seen]) -> Iterable[Seen]:
        if not self._landmarks_hidden:
            yield from self._marks_to_see.near(pose.x, pose.y)
            yield from self._walls(pose)
        yield from (mate for mate in mates.near(pose.x, pose.y) if mate.name != viewer)

    def _walls(self, pose: Pose2) -> Iterable[Seen]:
        for name, wall in self.team.map.walls.items():
            (ax, ay), (bx, by) = wall.from_m, wall.to_m
            length = math.hypot(bx - ax, by - ay)
            ux, uy = (bx - ax) / length, (by - ay) / length
            along = ux * (pose.x - ax) + uy * (pose.y - ay)
            if 0.0 <= along <= length:
                yield Seen(name, ax + along * ux, ay + along * uy, wall.gives)

    def _bump(self, robot: SimulatedRobot) -> None:
        radius = self.team.simulation.bump_radius_m
        touching = frozenset(
            mark.name
            for mark in self._marks_to_touch.near(robot.pose.x, robot.pose.y)
            if math.hypot(mark.x - robot.pose.x, mark.y - robot.pose.y) < radius
        )
        robot.bumps += len(touching - robot.touching)
        robot.touching = touching


def _cameras(team: Team, seed: int) -> "Cameras | None":
    """Of the team's simulated robots; OpenCV is loaded for nobody else."""
    if not team.renders:
        return None
    from cpcbl_launch.simulation.cameras import Cameras

    return Cameras(team, seed)


def _in_turn(team: Team, name: str, from_ns: int) -> int | None:
    """When a camera's first frame is due: one after the other, as cameras do not wait for each
    other and pictures take time."""
    robots = team.cameras
    if name not in robots:
        return None
    period_ns = 1e9 / team.robots[name].sensor.rate_hz
    return from_ns + int(period_ns * robots.index(name) / len(robots))


class FieldNode:
    """The field on a bus. Robots of other `sites` (robot -> bus) are told on the bus of theirs, so
    that the world goes on for them while their site is cut off.
    """

    def __init__(self, field: SimulatedField, bus: Bus, sites: Mapping[str, Bus] = NOWHERE) -> None:
        self._field, self._bus, self._sites = field, bus, sites
        self._bodies = Bodies(field.team)
        self._guests: dict[str, str] = {}  # with the incarnation that asked
        self._refused: set[str] = set()
        self._said: deque[tuple[str, bytes]] = deque(maxlen=INBOX)
        self.counts: Counter[str] = Counter()
        """What was taken (`drive`, `join`), and what was refused, by reason."""
        self._truth = bus.publisher(topics.TRUTH.at(), topics.TRUTH.qos)
        self._publishers: dict[tuple[str, type], Publisher] = {}
        self._driven: dict[str, Handle] = {}
        for name in field.robots:
            self._declare(name)
        bus.subscribe(topics.JOIN.at(), self._arrived)

    def _declare(self, name: str) -> None:
        bus = self._sites.get(name, self._bus)
        for topic in topics.INPUTS:
            assert topic.carries is not None
            publisher = bus.publisher(topic.at(robot=name), topic.qos)
            self._publishers[name, topic.carries] = publisher
        self._driven[name] = bus.subscribe(topics.DRIVE.at(robot=name), self._arrived)

    def _arrived(self, key: str, payload: bytes) -> None:
        if len(self._said) == INBOX:
            self.counts["inbox_overflow"] += 1
        self._said.append((key, payload))

    @property
    def next_ns(self) -> int:
        return self._field.next_ns

    @property
    def pictures_not_taken(self) -> int:
        return self._field.not_taken

    @property
    def waiting(self) -> bool:
        return False  # commands take effect with the next step

    def step(self, now_ns: int) -> None:
        """Advances the field to `now_ns` and tells the robots what they sense."""
        while self._said:
            reason = self._taken(*self._said.popleft(), now_ns)
            if reason is not None:
                self.counts[reason] += 1
        self._let_in_and_out(now_ns)
        while self._field.next_ns <= now_ns:
            in_time = now_ns - self._field.next_ns <= PICTURES_LATE_NS
            for name, sensed in self._field.advance(in_time):
                stamped = later(sensed, self._field.ahead_ns(name))
                self._publishers[name, type(sensed)].put(encode(stamped))
            if self._truth.matching:
                self._truth.put(encode(self._field.truth()))

    def _taken(self, key: str, payload: bytes, now_ns: int) -> Refusal | None:
        """Does what a robot says, by the field's clock; or why not."""
        said = read(key, payload)
        if isinstance(said, Refusal):
            return said
        assert isinstance(said, Drive | Join)
        if isinstance(said, Drive):
            if said.robot not in self._field.robots:
                return Refusal.UNKNOWN_ROBOT
            said = later(said, -self._field.ahead_ns(said.robot))
        reason = refusal(said, now_ns)
        if reason is not None:
            return reason
        self.counts[type(said).__name__.lower()] += 1
        if isinstance(said, Drive):
            self._field.command(said)
        else:
            self._asked(said, now_ns)
        return None

    def _asked(self, join: Join, now_ns: int) -> None:
        reason = self._bodies.ask(join, now_ns)
        if reason and len(self._refused) < MOST_REFUSED and join.robot not in self._refused:
            self._refused.add(join.robot)
            log.warning("guest %s gets no body: %s", join.robot, reason)

    def _let_in_and_out(self, now_ns: int) -> None:
        """Guests that ask for a body get it, those that leave or are silent lose it."""
        present = self._bodies.present(now_ns)
        for name, incarnation in list(self._guests.items()):
            if name not in present or present[name].incarnation != incarnation:
                self._let_out(name)
        for name, join in present.items():
            if name not in self._guests and join.body is not None:
                self._guests[name] = join.incarnation
                self._field.join(name, join.body)
                self._declare(name)
                log.info("guest %s joined the field", name)

    def _let_out(self, name: str) -> None:
        del self._guests[name]
        self._field.leave(name)
        for topic in topics.INPUTS:
            assert topic.carries is not None
            self._publishers.pop((name, topic.carries)).close()
        self._driven.pop(name).close()
        log.info("guest %s left the field", name)


Moved = TypeVar("Moved", bound=SensorInput | Drive)


def later(message: Moved, ns: int) -> Moved:
    """The message by a clock that is so far ahead."""
    if not ns:
        return message
    if isinstance(message, Odometry):
        return replace(message, from_ns=message.from_ns + ns, stamp_ns=message.stamp_ns + ns)
    return replace(message, stamp_ns=message.stamp_ns + ns)


def robots_at(sites: Iterable[str], team: Team) -> dict[str, list[str]]:
    """Endpoint -> robots, of `tcp/10.0.0.2:7447=r3,r4`. Raises ValueError."""
    found = {}
    for text in sites:
        endpoint, _, names = text.partition("=")
        found[endpoint] = [name.strip() for name in names.split(",")]
        for name in found[endpoint]:
            if name not in team.robots:
                known = ", ".join(team.robots)
                raise ValueError(f"--site {text}: no robot {name!r}; there are {known}")
    return found


def run_field(
    team: Team,
    seed: int,
    bus: Bus,
    clock: Clock,
    stop: Callable[[], bool],
    sites: Mapping[str, Bus] = NOWHERE,
) -> None:
    """The field as a process: steps in robot time until `stop()`."""
    node = FieldNode(SimulatedField(team, seed, clock.now_ns()), bus, sites)
    while not stop():
        node.step(clock.now_ns())
        time.sleep(min(clock.seconds_until(node.next_ns), 0.2))
    counts = ", ".join(f"{reason} {n}" for reason, n in sorted(node.counts.items()))
    log.info("commands, by what became of them: %s", counts or "none")
    if node.pictures_not_taken:
        log.warning("frames not taken, as the field was late: %d", node.pictures_not_taken)
