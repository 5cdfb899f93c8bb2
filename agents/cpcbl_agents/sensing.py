"""The sensing agent: from any source to corrected odometry and sightings."""

import math
from collections import Counter
from collections.abc import Sequence

from cpcbl_agents.agent import Anything, Located, Tick
from cpcbl_agents.driving import Pilot
from cpcbl_agents.sources import Source
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Odometry, Position, Sighting, Sightings

LEAST_COSINE = 0.1  # a depth says nothing of what is seen across the optical axis
SensorInput = Odometry | Sightings | Position


class SensingAgent:
    """Polls the source, takes a driver's messages, corrects delays, blinds what is blind."""

    def __init__(
        self,
        settings: LocalizationSettings,
        source: Source,
        teammates: frozenset[str],
        pilot: Pilot | None = None,
    ) -> None:
        self._sensor, self._odometry = settings.sensor, settings.odometry
        self._odometry_delay_ns = int(settings.odometry.delay_s * 1e9)
        self._sensor_delay_ns = int(settings.sensor.delay_s * 1e9)
        sensor = settings.sensor
        biases = sensor.range_bias_m, sensor.robot_range_bias_m, sensor.bearing_bias_deg
        scaled = sensor.range_scale != 1.0 or sensor.bearing_scale != 1.0
        self._exact = not (any(biases) or scaled or sensor.range_is_depth)
        self._source, self._teammates, self._pilot = source, teammates, pilot
        self.counts: Counter[str] = Counter()

    @property
    def next_ns(self) -> int | None:
        return self._source.next_ns

    @property
    def over(self) -> bool:
        return self._source.over

    def handle(self, message: Anything, now_ns: int) -> Sequence[Anything]:
        match message:
            case Tick():
                return [self._corrected(item) for item in self._source.poll(now_ns)]
            case Odometry() | Sightings() | Position():
                return [self._corrected(message)]
            case Located() if self._pilot is not None and message.frame is None:
                return self._pilot.command(message)
        return ()

    def _corrected(self, item: SensorInput) -> SensorInput:
        self.counts[type(item).__name__.lower()] += 1
        if isinstance(item, Odometry):
            delay = self._odometry_delay_ns
            if not delay:
                return item
            return Odometry(
                item.from_ns + delay, item.stamp_ns + delay, item.distance_m, item.turn_rad
            )
        if isinstance(item, Position):
            return item
        kept = tuple(self._unbiased(s) for s in item.sightings if self._sees(s.id))
        return Sightings(item.stamp_ns - self._sensor_delay_ns, kept)

    def _unbiased(self, s: Sighting) -> Sighting:
        if self._exact:
            return s
        sensor, range_m, bearing = self._sensor, s.range_m, s.bearing_rad
        if bearing is not None and abs(bearing) > math.pi:
            return s  # a fault, to be counted as it is
        if range_m is not None:
            if sensor.range_is_depth and bearing is not None:
                off_axis = math.cos(bearing - math.radians(sensor.optical_axis_deg))
                range_m /= max(off_axis, LEAST_COSINE)
            teammate = s.id in self._teammates
            bias = sensor.robot_range_bias_m if teammate else sensor.range_bias_m
            range_m = sensor.range_scale * range_m - bias
        if bearing is not None:
            bias = math.radians(sensor.bearing_bias_deg)
            bearing = wrap_angle(sensor.bearing_scale * bearing - bias)
        return Sighting(s.id, range_m, bearing, s.range_sigma_m, s.bearing_sigma_rad)

    def _sees(self, name: str) -> bool:
        if name in self._teammates:
            return self._sensor.sees_robots
        return self._sensor.sees_landmarks
