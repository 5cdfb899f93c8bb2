"""The processes of the latency benchmark: two robots that record times, a bare pair, a driver.

All times are of the machine's monotonic clock; a process keeps them in memory until it ends.
"""

import math
import time
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np

from cpcbl_agents.agent import BusEvent, Tick
from cpcbl_agents.clock import Clock
from cpcbl_agents.node import Node, NodeCallbacks, NodeStart
from cpcbl_agents.process import Loop
from cpcbl_agents.robot import Robot, build_sensing
from cpcbl_agents.stop import StopSignal
from cpcbl_team.config import (
    CollaborationSettings,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)
from cpcbl_team.frames import FIELD
from cpcbl_team.inputs import Fix, Odometry, Sighting, Sightings
from cpcbl_team.sensors import range_sigma_m
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, BusProxy, Handle, MessageCallback, Publisher, PublisherProxy
from cpcbl_transport.compact import FIX_BYTES
from cpcbl_transport.messages import Message, Outgoing, encode
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import open_bus

SPEED_M_S, RADIUS_M = 0.5, 2.0
BARE_KEYS, BARE_KEY = "bare/teammate/2/*", "bare/teammate/2/observer"


class Passed(NamedTuple):
    """A message, and the time at which it passed."""

    at_ns: int
    key: str
    payload: bytes


class _TimingPublisher(PublisherProxy):
    """A publisher that records each put."""

    def __init__(self, publisher: Publisher, key: str, sent: list[Passed]) -> None:
        super().__init__(publisher)
        self._key, self._sent = key, sent

    def put(self, payload: bytes) -> None:
        self._sent.append(Passed(time.monotonic_ns(), self._key, payload))
        super().put(payload)


class TimingBus(BusProxy):
    """A bus that records the messages that pass, and when."""

    def __init__(self, bus: Bus) -> None:
        super().__init__(bus)
        self.received: list[Passed] = []
        self.sent: list[Passed] = []

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return _TimingPublisher(super().publisher(key, qos), key, self.sent)

    def subscribe(self, keys: str, receive: MessageCallback) -> Handle:
        def arrived(key: str, payload: bytes) -> None:
            self.received.append(Passed(time.monotonic_ns(), key, payload))
            receive(key, payload)

        return super().subscribe(keys, arrived)


class TimingRobot(Robot):
    """A robot that records when a fix has changed its belief."""

    def __init__(self, name: str, team: Team, start_ns: int) -> None:
        super().__init__(name, team, start_ns, build_sensing(name, team))
        self.changed_ns: dict[int, int] = {}
        """When the belief changed, by the stamp of the fix."""

    def handle(
        self, message: Message | Tick | BusEvent, now_ns: int, frame: str = FIELD
    ) -> list[Outgoing]:
        before = self.filter.timeline.state
        outgoing = super().handle(message, now_ns, frame)
        if isinstance(message, Fix):
            after = self.filter.timeline.state  # which computes it
            at_ns = time.monotonic_ns()
            if after.estimate != before.estimate:
                self.changed_ns[message.stamp_ns] = at_ns
        return outgoing


class RobotTimes(NamedTuple):
    """What the process of a robot returns."""

    received: list[Passed]
    sent: list[Passed]
    changed_ns: dict[int, int]


def run_timed_robot(
    name: str, team: Team, endpoint: str, clock: Clock, parent: int, out: Connection
) -> None:
    """The process of a robot: the project's own loop around a node, on a bus that records times."""
    stop, loop = StopSignal(parent), Loop(clock)
    with open_bus(team.name, [endpoint], stop) as session:
        bus, start_ns = TimingBus(session), clock.now_ns()
        robot = TimingRobot(name, team, start_ns)
        loop.run(
            Node(robot, team, bus, NodeStart(start_ns, "1"), NodeCallbacks(loop.on_arrival)), stop
        )
    out.send(RobotTimes(bus.received, bus.sent, robot.changed_ns))


def bare_sender(team: str, endpoint: str, parent: int, schedule: Connection) -> None:
    """Puts at the times that it receives from its pipe."""
    stop = StopSignal(parent)
    with open_bus(team, [endpoint], stop) as bus:
        publisher = bus.publisher(BARE_KEY, Qos.FRESH)
        bus.declare_token("ready/sender")
        while not stop() and not schedule.poll(0.1):
            pass
        for at_ns in schedule.recv() if schedule.poll() else ():
            if stop():
                break
            sleep_until(at_ns)
            publisher.put(time.monotonic_ns().to_bytes(FIX_BYTES, "little"))


def bare_receiver(team: str, endpoint: str, parent: int, out: Connection) -> None:
    """Records how long each bare put took, in nanoseconds."""
    stop, took_ns = StopSignal(parent), list[int]()

    def arrived(key: str, payload: bytes) -> None:
        took_ns.append(time.monotonic_ns() - int.from_bytes(payload, "little"))

    with open_bus(team, [endpoint], stop) as bus:
        bus.subscribe(BARE_KEYS, arrived)
        bus.declare_token("ready/receiver")
        while not stop():
            time.sleep(0.05)
    out.send(took_ns)


def sleep_until(at_ns: int) -> None:
    time.sleep(max(0.0, (at_ns - time.monotonic_ns()) * 1e-9))


def latency_team() -> Team:
    """An observer that stands still, and a teammate with poor odometry that drives around it."""
    sensor = SensorSettings(range_share=0.05, bearing_sigma_deg=3.0, field_of_view_deg=360.0)
    odometry = OdometrySettings(distance_sigma_m_per_sqrt_m=0.3, turn_sigma_rad_per_sqrt_rad=0.1)
    help_rules = CollaborationSettings(
        passive=False, least_value=0.0
    )  # each sighting becomes a fix
    return Team(
        name="latency",
        robots={
            "observer": RobotSettings(
                source="external",
                start=Start(x_m=0.0, y_m=0.0, sigma_m=0.02, heading_sigma_deg=0.5),
                sensor=sensor,
                odometry=OdometrySettings(moves=False),
                collaboration=help_rules,
            ),
            "teammate": RobotSettings(
                source="external",
                start=Start(x_m=RADIUS_M, y_m=0.0, heading_deg=90.0, sigma_m=0.3),
                odometry=odometry,
                collaboration=help_rules,
            ),
        },
    )


class Driver:
    """Puts the observer's sightings and the teammate's odometry, with the noise that they state."""

    def __init__(self, bus: Bus, team: Team, clock: Clock) -> None:
        self._team, self._clock = team, clock
        self._random = np.random.default_rng(1)
        self._way_m = 0.0
        self._odometry_ns = clock.now_ns()
        odometry, sightings = topics.IN_ODOMETRY, topics.IN_SIGHTINGS
        self._odometry = bus.publisher(odometry.at(robot="teammate"), odometry.qos)
        self._sightings = bus.publisher(sightings.at(robot="observer"), sightings.qos)
        self.put_ns: dict[int, int] = {}
        """When each sighting was put, by its stamp."""

    def put_odometry(self) -> None:
        """Puts the teammate's odometry since the last call."""
        from_ns, self._odometry_ns = self._odometry_ns, self._clock.now_ns()
        way_m = SPEED_M_S * (self._odometry_ns - from_ns) * 1e-9
        self._way_m += way_m
        turn = way_m / RADIUS_M
        noise = self._team.robots["teammate"].odometry
        distance_m = way_m + noise.distance_sigma_m_per_sqrt_m * math.sqrt(way_m) * self._normal()
        turn_rad = turn + noise.turn_sigma_rad_per_sqrt_rad * math.sqrt(turn) * self._normal()
        self._odometry.put(encode(Odometry(from_ns, self._odometry_ns, distance_m, turn_rad)))

    def put_sighting(self) -> None:
        """Puts the observer's sighting of the teammate now."""
        stamp_ns = self._clock.now_ns() // 1000 * 1000  # fixes carry whole microseconds
        since_s = (stamp_ns - self._odometry_ns) * 1e-9
        bearing = (self._way_m + SPEED_M_S * since_s) / RADIUS_M
        sensor = self._team.robots["observer"].sensor
        seen = Sighting(
            "teammate",
            RADIUS_M + range_sigma_m(sensor, RADIUS_M) * self._normal(),
            math.remainder(bearing + sensor.bearing_sigma_rad * self._normal(), math.tau),
        )
        payload = encode(Sightings(stamp_ns, (seen,)))
        self.put_ns[stamp_ns] = time.monotonic_ns()
        self._sightings.put(payload)

    def _normal(self) -> float:
        return float(self._random.normal())


class ChildProcess:
    """A process with a pipe to it; a context manager that leaves none behind."""

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        context = get_context("spawn")
        self.pipe, self._its_end = context.Pipe()
        self._process = context.Process(target=target, args=(*arguments, self._its_end))

    def __enter__(self) -> "ChildProcess":
        self._process.start()
        self._its_end.close()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        self.pipe.close()

    def end(self) -> Any:
        """Ends the process and returns its result. Raises EOFError if it died before."""
        self._process.terminate()
        result = self.pipe.recv()
        self._process.join()
        return result
