"""The sensing agent: from any source to corrected odometry and sightings."""

from collections import Counter
from collections.abc import Sequence

import msgspec

from cpcbl_agents.agent import AgentMessage, FrameSubscribers, Located, Tick
from cpcbl_agents.detector import Eyes, Picture
from cpcbl_agents.sources import OwnCamera, Source
from cpcbl_agents.waypoint_follower import WaypointFollower
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.inputs import Odometry, Position, Sightings
from cpcbl_team.sensors import corrected_odometry, corrected_sighting, once_each
from cpcbl_transport.messages import Frame

LOOK_NS = 500_000_000

SensorInput = Odometry | Sightings | Position | Frame


class SensingAgent:
    """Polls the source and the camera, takes a driver's messages, corrects delays, blinds what is
    blind.

    `marks`: what the map names. Whatever else is seen is a robot: a teammate, perhaps a guest.
    """

    def __init__(
        self,
        settings: LocalizationSettings,
        source: Source,
        marks: frozenset[str],
        pilot: WaypointFollower | None = None,
        eyes: Eyes | None = None,
        camera: OwnCamera | None = None,
    ) -> None:
        self._sensor, self._odometry = settings.sensor, settings.odometry
        self._sensor_delay_ns = int(settings.sensor.delay_s * 1e9)
        own = settings.position_sensor
        self._position_delay_ns = 0 if own is None else int(own.delay_s * 1e9)
        self._source, self._marks, self._pilot, self._eyes = source, marks, pilot, eyes
        self._camera, self._looked, self._look_ns = camera, False, -LOOK_NS
        self._counts: Counter[str] = Counter()

    @property
    def counts(self) -> Counter[str]:
        """What was sensed, and what could not be used, by reason."""
        return self._counts + (Counter() if self._camera is None else self._camera.counts)

    @property
    def has_detector(self) -> bool:
        return self._eyes is not None

    @property
    def next_ns(self) -> int | None:
        sources = (self._source,) if self._camera is None else (self._source, self._camera)
        return min((s.next_ns for s in sources if s.next_ns is not None), default=None)

    @property
    def is_finished(self) -> bool:
        return self._source.is_finished

    def handle(self, message: AgentMessage, now_ns: int) -> Sequence[AgentMessage]:
        match message:
            case Tick():
                items = list(self._source.poll(now_ns))
                items += () if self._camera is None else self._camera.poll(now_ns)
                return [out for item in items for out in self._sensed(item)]
            case Odometry() | Sightings() | Position() | Frame():
                return self._sensed(message)
            case FrameSubscribers():
                self._looked = message.present
            case Located() if self._pilot is not None and message.frame is None:
                return self._pilot.command(message)
        return ()

    def _sensed(self, item: SensorInput | Picture) -> Sequence[AgentMessage]:
        if not isinstance(item, Frame | Picture):
            return [self._corrected(item)]
        if self._eyes is None:
            self._counts["no_camera"] += 1
            return ()
        self._counts["frame"] += 1
        said: list[AgentMessage] = []
        if self._looked and not 0 <= item.stamp_ns - self._look_ns < LOOK_NS:
            self._look_ns = item.stamp_ns
            seen, look = self._eyes.shown(item)
            said.append(look)
        else:
            seen = self._eyes.seen(item)
        if isinstance(seen, str):
            self._counts[seen] += 1
            return said
        return [*said, self._corrected(seen)]

    def _corrected(self, item: Odometry | Sightings | Position) -> Odometry | Sightings | Position:
        self._counts[type(item).__name__.lower()] += 1
        if isinstance(item, Odometry):
            return corrected_odometry(item, self._odometry)
        if isinstance(item, Position):
            return msgspec.structs.replace(item, stamp_ns=item.stamp_ns - self._position_delay_ns)
        sightings = once_each(item.sightings)
        if len(sightings) < len(item.sightings):
            self._counts["seen_twice"] += len(item.sightings) - len(sightings)
        kept = tuple(
            corrected_sighting(s, self._sensor, s.id not in self._marks)
            for s in sightings
            if self._sees(s.id)
        )
        return Sightings(item.stamp_ns - self._sensor_delay_ns, kept)

    def _sees(self, name: str) -> bool:
        return self._sensor.sees_landmarks if name in self._marks else self._sensor.sees_robots
