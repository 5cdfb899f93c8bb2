"""A robot of the simulated field: its true pose and its imperfect senses."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from cpcbl_team.config import OdometrySettings, RobotSettings, SensorSettings
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry, Position, Sighting, Sightings
from cpcbl_team.motion import motion_noise
from cpcbl_team.sensors import LEAST_COSINE, corrected_odometry, range_sigma_m, time_at_min_speed_s
from cpcbl_transport.messages import Drive, Frame

COMMAND_LASTS_NS = 500_000_000


class Timer:
    """Says when something is due that happens so many times a second, from a time on or at once."""

    def __init__(self, rate_hz: float, from_ns: int | None = None) -> None:
        self._period_ns = int(1e9 / rate_hz)
        self._due_ns = from_ns

    def is_due(self, now_ns: int) -> bool:
        if self._due_ns is None:
            self._due_ns = now_ns
        if now_ns < self._due_ns:
            return False
        missed = (now_ns - self._due_ns) // self._period_ns
        self._due_ns += (missed + 1) * self._period_ns
        return True


class VisibleObject(NamedTuple):
    """Something on the field, at the point that a sensor measures."""

    name: str
    x: float
    y: float
    gives: str
    teammate: bool = False


class DelayedMotion:
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


def actual_distance(distance: float, turn: float, seconds: float, o: OdometrySettings) -> float:
    """The distance that the wheels drive when this one is commanded: they have a least speed."""
    if not o.least_speed_m_s:
        return distance
    reported = Odometry(0, round(seconds * 1e9), *reported_odometry(distance, turn, o))
    return corrected_odometry(reported, o).distance_m


def reported_odometry(distance: float, turn: float, o: OdometrySettings) -> tuple[float, float]:
    """The reading of the wheels for a commanded motion: `corrected_odometry` makes of it what
    is `really_driven`, and without a least speed the motion itself."""
    reported_turn = (turn - o.turn_bias_rad_per_m * distance) / o.turn_scale
    lost = o.distance_loss_m_per_rad * abs(reported_turn) if distance else 0.0
    way = (abs(distance) + lost) / o.distance_scale
    return math.copysign(way, distance), reported_turn


def sensor_reading(
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


class Noise:
    """The random errors of one robot: from one stream, or from one for each source of errors.

    With a stream for each, an object that is hidden, or a robot that is away, changes no error of
    anything else: two such runs can be compared sample by sample.
    """

    def __init__(self, factor: float, seed: Sequence[int], is_split: bool) -> None:
        self._factor, self._seed, self._is_split = factor, seed, is_split
        self._streams: dict[str, np.random.Generator] = {}

    def normal(self, sigma: float, source: str) -> float:
        """An error of this source, with this standard deviation times the factor."""
        if not sigma:
            return 0.0
        name = source if self._is_split else ""
        if name not in self._streams:
            self._streams[name] = np.random.default_rng((*self._seed, *name.encode()))
        # What `normal(0.0, sigma)` gives, without the check of its arguments
        return self._streams[name].standard_normal() * sigma * self._factor


class SimulatedRobot:
    """One robot of the field: its true pose and its imperfect senses."""

    def __init__(
        self,
        settings: RobotSettings,
        noise: Noise,
        start_ns: int,
        step_ns: int,
        frames_from_ns: int | None = None,
    ) -> None:
        assert settings.start is not None
        self.settings, self._noise = settings, noise
        start = settings.start
        self.pose = Pose2(
            start.x_m + noise.normal(start.sigma_m, "start"),
            start.y_m + noise.normal(start.sigma_m, "start"),
            wrap_angle(
                math.radians(start.heading_deg + noise.normal(start.heading_sigma_deg, "start"))
            ),
        )
        self.drive = Drive("", 0, 0.0, 0.0)
        self.bumps = 0
        self.touching: frozenset[str] = frozenset()
        self._reported, self._reported_ns = (0.0, 0.0), start_ns
        self._motion = DelayedMotion(settings.odometry.delay_s * 1e9 / step_ns)
        self._frames: deque[Sightings | Frame] = deque()
        self._positions: deque[Position] = deque()
        self._errors: dict[tuple[str, str], tuple[int, float]] = {}
        self._odometry_timer = Timer(settings.odometry.rate_hz)
        self._frame_timer = Timer(settings.sensor.rate_hz, frames_from_ns)
        sensor = settings.position_sensor
        self._position_timer = Timer(sensor.rate_hz if sensor is not None else 1.0)

    def move(self, now_ns: int, seconds: float) -> None:
        """The wheels report what is commanded; the ground does it later and adds noise."""
        if not self.settings.odometry.moves:
            return
        commanded = now_ns - self.drive.stamp_ns <= COMMAND_LASTS_NS
        distance = self.drive.speed_m_s * seconds if commanded else 0.0
        turn = self.drive.turn_rate_rad_s * seconds if commanded else 0.0
        self._reported = (self._reported[0] + distance, self._reported[1] + turn)
        o = self.settings.odometry
        distance, turn = self._motion.next((actual_distance(distance, turn, seconds, o), turn))
        crawled = time_at_min_speed_s(distance, seconds, o)
        in_its_direction = motion_noise(-0.5 * turn, distance, turn, o, crawled)
        along, around = math.sqrt(in_its_direction.xx), math.sqrt(in_its_direction.hh)
        normal = self._noise.normal
        distance, turn = distance + normal(along, "motion"), turn + normal(around, "motion")
        self.pose = step(self.pose, distance, turn)

    def odometry(self, now_ns: int) -> Odometry | None:
        """The piece since the last one, when it is due; as reported, before any correction."""
        o = self.settings.odometry
        if not o.moves or not self._odometry_timer.is_due(now_ns):
            return None
        distance, turn = self._reported
        piece = Odometry(self._reported_ns, now_ns, *reported_odometry(distance, turn, o))
        self._reported, self._reported_ns = (0.0, 0.0), now_ns
        return piece

    def frames(
        self, now_ns: int, take_frame: Callable[[int], Sightings | Frame | None]
    ) -> list[Sightings | Frame]:
        """The frames that are out by now. One is `exposed` when it is due and stamped `delay_s`
        later; the camera hands it over at its stamp, or at once where the stamp is earlier.
        """
        if self._frame_timer.is_due(now_ns):
            frame = take_frame(now_ns + int(self.settings.sensor.delay_s * 1e9))
            if frame is not None:
                self._frames.append(frame)
        return _pop_due(self._frames, now_ns)

    def sightings(self, now_ns: int, stamp_ns: int, objects: Iterable[VisibleObject]) -> Sightings:
        """What it sees of these objects now."""
        return Sightings(stamp_ns, tuple(s for o in objects if (s := self._sighting(o, now_ns))))

    def positions(self, now_ns: int) -> list[Position]:
        """What the position sensor has said by now, if there is one: `delay_s` after it measured,
        with the stamp of that time."""
        sensor = self.settings.position_sensor
        if sensor is None:
            return []
        if self._position_timer.is_due(now_ns):
            x, y = (v + self._noise.normal(sensor.sigma_m, "position") for v in self.pose[:2])
            variance, stamp_ns = sensor.sigma_m**2, now_ns + int(sensor.delay_s * 1e9)
            self._positions.append(Position(stamp_ns, x, y, (variance, 0.0, variance)))
        return _pop_due(self._positions, now_ns)

    def _sighting(self, visible: VisibleObject, now_ns: int) -> Sighting | None:
        sensor = self.settings.sensor
        dx, dy = visible.x - self.pose.x, visible.y - self.pose.y
        range_m = math.hypot(dx, dy)
        if visible.gives == "none" or not 0.05 <= range_m <= sensor.max_range_m:
            return None
        bearing = wrap_angle(math.atan2(dy, dx) - self.pose.heading)
        if abs(bearing) > math.radians(sensor.field_of_view_deg) / 2.0:
            return None
        range_m += self._reading_error(
            visible.name, "range", range_sigma_m(sensor, range_m), now_ns
        )
        bearing += self._reading_error(visible.name, "bearing", sensor.bearing_sigma_rad, now_ns)
        reading_m, reading = sensor_reading(range_m, bearing, sensor, visible.teammate)
        return Sighting(
            visible.name,
            max(reading_m, 0.01) if visible.gives in ("both", "range") else None,
            reading if visible.gives in ("both", "bearing") else None,
        )

    def _reading_error(self, name: str, kind: str, sigma: float, now_ns: int) -> float:
        """The error of a reading: white, or like the last one of the same object (Gauss-Markov)."""
        source = f"{name} {kind}"
        if not self.settings.sensor.correlation_s:
            return self._noise.normal(sigma, source)
        last = self._errors.get((name, kind))
        if last is None:
            unit = self._noise.normal(1.0, source)
        else:
            alike = math.exp((last[0] - now_ns) * 1e-9 / self.settings.sensor.correlation_s)
            new = self._noise.normal(math.sqrt(1.0 - alike * alike), source)
            unit = alike * last[1] + new
        self._errors[name, kind] = now_ns, unit
        return sigma * unit


Stamped = TypeVar("Stamped", bound=Sightings | Frame | Position)


def _pop_due(waiting: deque[Stamped], now_ns: int) -> list[Stamped]:
    """What is stamped with a time that has come."""
    out = []
    while waiting and waiting[0].stamp_ns <= now_ns:
        out.append(waiting.popleft())
    return out
