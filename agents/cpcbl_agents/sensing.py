"""The sensing agent: from any source to corrected odometry and sightings."""

from collections import Counter
from collections.abc import Sequence

import msgspec

from cpcbl_agents.agent import Anything, Located, Tick
from cpcbl_agents.driving import Pilot
from cpcbl_agents.eyes import Eyes
from cpcbl_agents.sources import Source
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.inputs import Odometry, Position, Sightings
from cpcbl_team.sensors import corrected_odometry, corrected_sighting
from cpcbl_transport.messages import Frame

SensorInput = Odometry | Sightings | Position | Frame


class SensingAgent:
    """Polls the source, takes a driver's messages, corrects delays, blinds what is blind.

    `marks`: what the map names. Whatever else is seen is a robot: a teammate, perhaps a guest.
    """

    def __init__(
        self,
        settings: LocalizationSettings,
        source: Source,
        marks: frozenset[str],
        pilot: Pilot | None = None,
        eyes: Eyes | None = None,
    ) -> None:
        self._sensor, self._odometry = settings.sensor, settings.odometry
        self._sensor_delay_ns = int(settings.sensor.delay_s * 1e9)
        own = settings.position_sensor
        self._position_delay_ns = 0 if own is None else int(own.delay_s * 1e9)
        self._source, self._marks, self._pilot, self._eyes = source, marks, pilot, eyes
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
                return [out for item in self._source.poll(now_ns) for out in self._sensed(item)]
            case Odometry() | Sightings() | Position() | Frame():
                return self._sensed(message)
            case Located() if self._pilot is not None and message.frame is None:
                return self._pilot.command(message)
        return ()

    def _sensed(self, item: SensorInput) -> Sequence[Anything]:
        if not isinstance(item, Frame):
            return [self._corrected(item)]
        if self._eyes is None:
            self.counts["no_camera"] += 1
            return ()
        self.counts["frame"] += 1
        seen = self._eyes.seen(item)
        if isinstance(seen, str):
            self.counts[seen] += 1
            return ()
        return [self._corrected(seen)]

    def _corrected(self, item: Odometry | Sightings | Position) -> Odometry | Sightings | Position:
        self.counts[type(item).__name__.lower()] += 1
        if isinstance(item, Odometry):
            return corrected_odometry(item, self._odometry)
        if isinstance(item, Position):
            return msgspec.structs.replace(item, stamp_ns=item.stamp_ns - self._position_delay_ns)
        kept = tuple(
            corrected_sighting(s, self._sensor, s.id not in self._marks)
            for s in item.sightings
            if self._sees(s.id)
        )
        return Sightings(item.stamp_ns - self._sensor_delay_ns, kept)

    def _sees(self, name: str) -> bool:
        return self._sensor.sees_landmarks if name in self._marks else self._sensor.sees_robots
