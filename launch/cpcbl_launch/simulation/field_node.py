"""The simulated field on a bus, and as a process.

Robots send wheel commands (`field/drive/<robot>`); the field answers like a driver would, with
odometry and sightings, or a camera's frames, under the robots' `in/` keys. Guests have a body on it
for as long as they ask for it (`field/join/<robot>`).
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import TypeVar

from msgspec.structs import replace

from cpcbl_agents.clock import Clock
from cpcbl_agents.input_diagnosis.message_causes import MOST_SPEED_M_S, MOST_TURN_RATE_RAD_S
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.guests import GuestBodies
from cpcbl_launch.team.endpoints import endpoint_problem
from cpcbl_launch.team.requirements import require_robots
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Odometry
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, Publisher
from cpcbl_transport.decoding import decode_by_key
from cpcbl_transport.messages import Drive, Join, Refusal, SensorInput, encode, refusal

log = logging.getLogger(__name__)

PICTURES_LATE_NS = 150_000_000  # a field that is further behind catches up without making pictures
INBOX = 10_000
MOST_REFUSED = 100  # guests whose refusal is logged
NO_SITES: Mapping[str, Bus] = MappingProxyType({})


class FieldNode:
    """The field on a bus.

    Robots of other `sites` (robot -> bus) receive their inputs on the bus of their site, so that
    the simulation continues for them while their site is cut off.
    """

    def __init__(
        self, field: SimulatedField, bus: Bus, sites: Mapping[str, Bus] = NO_SITES
    ) -> None:
        self._field, self._bus, self._sites = field, bus, sites
        self._guest_bodies = GuestBodies(field.team)
        self._guests: dict[str, str] = {}  # with the incarnation that asked
        self._refused: set[str] = set()
        self._inbox: deque[tuple[str, bytes]] = deque(maxlen=INBOX)
        self.counts: Counter[str] = Counter()
        """Accepted messages (`drive`, `join`), and refused ones by reason."""
        self._truth = bus.publisher(topics.TRUTH.at(), topics.TRUTH.qos)
        self._publishers: dict[str, dict[type[object] | None, Publisher]] = {}
        self._drive_subscriptions: dict[str, Handle] = {}
        for name in field.robots:
            self._declare(name)
        bus.subscribe(topics.JOIN.at(), self._receive)

    def _declare(self, name: str) -> None:
        bus = self._sites.get(name, self._bus)
        self._publishers[name] = {
            topic.carries: bus.publisher(topic.at(robot=name), topic.qos) for topic in topics.INPUTS
        }
        self._drive_subscriptions[name] = bus.subscribe(topics.DRIVE.at(robot=name), self._receive)

    def _receive(self, key: str, payload: bytes) -> None:
        if len(self._inbox) == INBOX:
            self.counts["inbox_overflow"] += 1
        self._inbox.append((key, payload))

    @property
    def next_ns(self) -> int:
        return self._field.next_ns

    @property
    def skipped_frames(self) -> int:
        return self._field.skipped_frames

    @property
    def waiting(self) -> bool:
        return False  # commands take effect with the next step

    def step(self, now_ns: int) -> None:
        """Advances the field to `now_ns` and publishes what the robots sense.

        What arrives meanwhile is for the next step: under a flood there is always more.
        """
        for _ in range(len(self._inbox)):
            reason = self._handle(*self._inbox.popleft(), now_ns)
            if reason is not None:
                self.counts[reason] += 1
        self._update_guests(now_ns)
        while self._field.next_ns <= now_ns:
            in_time = now_ns - self._field.next_ns <= PICTURES_LATE_NS
            for name, sensed in self._field.advance(in_time):
                stamped = with_clock_offset(sensed, self._field.clock_offset_ns(name))
                self._publishers[name][type(sensed)].put(encode(stamped))
            if self._truth.matching:
                self._truth.put(encode(self._field.truth()))

    def _handle(self, key: str, payload: bytes, now_ns: int) -> Refusal | None:
        """Handles a message by the clock of the field; returns the reason if it is refused."""
        message = decode_by_key(key, payload)
        if isinstance(message, Refusal):
            return message
        assert isinstance(message, Drive | Join)
        if isinstance(message, Drive):
            if message.robot not in self._field.robots:
                return Refusal.UNKNOWN_ROBOT
            message = with_clock_offset(message, -self._field.clock_offset_ns(message.robot))
        if reason := refusal(message, now_ns):
            return reason
        if isinstance(message, Drive) and (
            abs(message.speed_m_s) > MOST_SPEED_M_S
            or abs(message.turn_rate_rad_s) > MOST_TURN_RATE_RAD_S
        ):
            return Refusal.IMPLAUSIBLE  # no wheels do that, and whatever stands there is hit
        self.counts[type(message).__name__.lower()] += 1
        if isinstance(message, Drive):
            self._field.command(message)
        elif (why := self._guest_bodies.request(message, now_ns)) and (
            len(self._refused) < MOST_REFUSED and message.robot not in self._refused
        ):
            self._refused.add(message.robot)
            log.warning("guest %s gets no body: %s", message.robot, why)
        return None

    def _update_guests(self, now_ns: int) -> None:
        """Guests that ask for a body get it, those that leave or are silent lose it."""
        present = self._guest_bodies.present(now_ns)
        for name, incarnation in list(self._guests.items()):
            if name not in present or present[name].incarnation != incarnation:
                del self._guests[name]
                self._field.remove_guest(name)
                for publisher in self._publishers.pop(name).values():
                    publisher.close()
                self._drive_subscriptions.pop(name).close()
                log.info("guest %s left the field", name)
        for name, join in present.items():
            if name not in self._guests and join.model is not None:
                self._guests[name] = join.incarnation
                self._field.add_guest(name, join.model)
                self._declare(name)
                log.info("guest %s joined the field", name)


Stamped = TypeVar("Stamped", bound=SensorInput | Drive)


def with_clock_offset(message: Stamped, ns: int) -> Stamped:
    """The message by a clock that is so far ahead."""
    if not ns:
        return message
    if isinstance(message, Odometry):
        return replace(message, from_ns=message.from_ns + ns, stamp_ns=message.stamp_ns + ns)
    return replace(message, stamp_ns=message.stamp_ns + ns)


def parse_sites(sites: Iterable[str], team: Team) -> dict[str, list[str]]:
    """Endpoint -> robots, of `tcp/10.0.0.2:7447=r3,r4`. Raises InputError."""
    found = {}
    for text in sites:
        endpoint, _, names = text.partition("=")
        if reason := endpoint_problem(endpoint):
            raise InputError(f"--site {text}: {reason}")
        found[endpoint] = [name.strip() for name in names.split(",")]
        require_robots(f"--site {text}", found[endpoint], team)
    return found


def run_field(
    team: Team,
    seed: int,
    bus: Bus,
    clock: Clock,
    stop: Callable[[], bool],
    sites: Mapping[str, Bus] = NO_SITES,
) -> None:
    """The field as a process: steps in robot time until `stop()`."""
    node = FieldNode(SimulatedField(team, seed, clock.now_ns()), bus, sites)
    while not stop():
        node.step(clock.now_ns())
        time.sleep(min(clock.seconds_until(node.next_ns), 0.2))
    counts = ", ".join(f"{reason} {n}" for reason, n in sorted(node.counts.items()))
    log.info("commands, by what became of them: %s", counts or "none")
    if node.skipped_frames:
        log.warning("frames skipped because the field was late: %d", node.skipped_frames)
