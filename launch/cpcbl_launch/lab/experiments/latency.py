"""How long a sighting on one robot takes to change the belief of its teammate, over real Zenoh.

Four processes at one router: an observer and a robot that it sees, both in their own loop, and a
bare pair, one that puts as many bytes as a fix has, one that hears them. Sightings and bare puts
take turns. The observer does not move, so no frame waits for the odometry that covers it.

All times are of the machine's monotonic clock, noted in memory where a thing happens.
"""

import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import msgspec
import numpy as np
from rich.console import RenderableType

from cpcbl_agents.agent import FromBus, Tick
from cpcbl_agents.clock import Clock
from cpcbl_agents.node import Node
from cpcbl_agents.process import Loop, Stop
from cpcbl_agents.robot import Robot
from cpcbl_launch.reporting.tables import table
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import (
    CollaborationSettings,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)
from cpcbl_team.inputs import Fix, Odometry, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, Publisher, Receive
from cpcbl_transport.bus_proxy import PassingBus, PassingPublisher
from cpcbl_transport.compact import FIX_BYTES, decode_help
from cpcbl_transport.messages import Message, decode, encode
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import open_bus, open_router

PERIOD_NS = 103_000_000  # no multiple of the filter's 100 ms: every phase of it is met
UNMEASURED = 10  # sightings at the start, while code and caches get warm
SETTLE_NS = 1_000_000_000
PATIENCE_S = 20.0
SPEED_M_S, RADIUS_M = 0.5, 2.0
BARE_KEYS, BARE_KEY = "bare/teammate/2/*", "bare/teammate/2/observer"


class Quantiles(msgspec.Struct, frozen=True):
    """Of a latency, in microseconds."""

    p50_us: float
    p99_us: float


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """What the experiment writes."""

    experiment: str
    version: str
    sightings: int
    """That the driver put and that were measured."""
    changed: int
    """Of these: those that changed the teammate's belief."""
    bare_puts: int
    payload_bytes: int
    bare: Quantiles
    """A put on a declared publisher in one process -> the callback in another."""
    sighting_to_belief: Quantiles
    """The observer's process receives the sighting -> the teammate's filter has changed."""
    in_observer: Quantiles
    """Of this: until the observer puts the fix."""
    on_bus: Quantiles
    in_teammate: Quantiles
    """Of this: since the teammate's process has received the fix."""
    driver_to_belief: Quantiles
    """The driver's put of the sighting -> the teammate's filter has changed."""
    ratio_p50: float
    """Sighting to belief, as a multiple of a bare put."""
    ratio_p99: float
    cores: int
    load_average: float
    """Of the last minute, at the end: what else the machine did plays a part."""


# In the robots' processes -------------------------------------------------------------------------


class Noted(NamedTuple):
    """Something that passed, and when."""

    at_ns: int
    key: str
    payload: bytes


class _NotingPublisher(PassingPublisher):
    """A publisher that notes what is put."""

    def __init__(self, publisher: Publisher, key: str, said: list[Noted]) -> None:
        super().__init__(publisher)
        self._key, self._said = key, said

    def put(self, payload: bytes) -> None:
        self._said.append(Noted(time.monotonic_ns(), self._key, payload))
        super().put(payload)


class NotingBus(PassingBus):
    """A bus that notes what passes, and when."""

    def __init__(self, bus: Bus) -> None:
        super().__init__(bus)
        self.heard: list[Noted] = []
        self.said: list[Noted] = []

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return _NotingPublisher(super().publisher(key, qos), key, self.said)

    def subscribe(self, keys: str, receive: Receive) -> Handle:
        def arrived(key: str, payload: bytes) -> None:
            self.heard.append(Noted(time.monotonic_ns(), key, payload))
            receive(key, payload)

        return super().subscribe(keys, arrived)


class NotingRobot(Robot):
    """A robot that notes when a fix has changed its belief."""

    def __init__(self, name: str, team: Team, start_ns: int) -> None:
        super().__init__(name, team, start_ns)
        self.changed_ns: dict[int, int] = {}
        """By the stamp of the fix."""

    def handle(self, message: Message | Tick | FromBus, now_ns: int) -> list[Message]:
        before = self.filter.timeline.state
        said = super().handle(message, now_ns)
        if isinstance(message, Fix):
            at_ns = time.monotonic_ns()
            if self.filter.timeline.state.estimate != before.estimate:
                self.changed_ns[message.stamp_ns] = at_ns
        return said


class Notes(NamedTuple):
    """What a robot's process hands back."""

    heard: list[Noted]
    said: list[Noted]
    changed_ns: dict[int, int]


def _robot(
    name: str, team: Team, endpoint: str, clock: Clock, parent: int, out: Connection
) -> None:
    """A robot's process: the project's own loop around a node, on a bus that notes."""
    stop, loop = Stop(parent), Loop(clock)
    with open_bus(team.name, [endpoint], stop) as session:
        bus, start_ns = NotingBus(session), clock.now_ns()
        robot = NotingRobot(name, team, start_ns)
        loop.run(Node(robot, team, bus, start_ns, "1", loop.arrived), stop)
    out.send(Notes(bus.heard, bus.said, robot.changed_ns))


def _bare_sender(team: str, endpoint: str, parent: int, schedule: Connection) -> None:
    """Puts at the times that it is told."""
    stop = Stop(parent)
    with open_bus(team, [endpoint], stop) as bus:
        publisher = bus.publisher(BARE_KEY, Qos.FRESH)
        bus.announce("ready/sender")
        while not stop() and not schedule.poll(0.1):
            pass
        for at_ns in schedule.recv() if schedule.poll() else ():
            if stop():
                break
            _sleep_until(at_ns)
            publisher.put(time.monotonic_ns().to_bytes(FIX_BYTES, "little"))


def _bare_receiver(team: str, endpoint: str, parent: int, out: Connection) -> None:
    """Notes how long each bare put took, in nanoseconds."""
    stop, took_ns = Stop(parent), list[int]()

    def arrived(key: str, payload: bytes) -> None:
        took_ns.append(time.monotonic_ns() - int.from_bytes(payload, "little"))

    with open_bus(team, [endpoint], stop) as bus:
        bus.subscribe(BARE_KEYS, arrived)
        bus.announce("ready/receiver")
        while not stop():
            time.sleep(0.05)
    out.send(took_ns)


# The driver ---------------------------------------------------------------------------------------


def pair() -> Team:
    """An observer that stands, and a teammate with poor wheels that drives round it."""
    eyes = SensorSettings(range_share=0.05, bearing_sigma_deg=3.0, field_of_view_deg=360.0)
    wheels = OdometrySettings(distance_sigma_m_per_sqrt_m=0.3, turn_sigma_rad_per_sqrt_rad=0.1)
    rules = CollaborationSettings(passive=False, least_value=0.0)  # each sighting becomes a fix
    return Team(
        name="latency",
        robots={
            "observer": RobotSettings(
                source="external",
                start=Start(x_m=0.0, y_m=0.0, sigma_m=0.02, heading_sigma_deg=0.5),
                sensor=eyes,
                odometry=OdometrySettings(moves=False),
                collaboration=rules,
            ),
            "teammate": RobotSettings(
                source="external",
                start=Start(x_m=RADIUS_M, y_m=0.0, heading_deg=90.0, sigma_m=0.3),
                odometry=wheels,
                collaboration=rules,
            ),
        },
    )


class _Driver:
    """Puts the observer's sightings and the teammate's odometry, with the noise that is assumed."""

    def __init__(self, bus: Bus, team: Team, clock: Clock) -> None:
        self._team, self._clock = team, clock
        self._random = np.random.default_rng(1)
        self._way_m = 0.0
        self._odometry_ns = clock.now_ns()
        odometry, sightings = topics.IN_ODOMETRY, topics.IN_SIGHTINGS
        self._odometry = bus.publisher(odometry.at(robot="teammate"), odometry.qos)
        self._sightings = bus.publisher(sightings.at(robot="observer"), sightings.qos)
        self.put_ns: dict[int, int] = {}
        """When sightings were put, by their stamps."""

    def drive(self) -> None:
        """What the teammate's wheels say since the last time."""
        from_ns, self._odometry_ns = self._odometry_ns, self._clock.now_ns()
        way_m = SPEED_M_S * (self._odometry_ns - from_ns) * 1e-9
        self._way_m += way_m
        turn = way_m / RADIUS_M
        noise = self._team.robots["teammate"].odometry
        said_m = way_m + noise.distance_sigma_m_per_sqrt_m * math.sqrt(way_m) * self._normal()
        turned = turn + noise.turn_sigma_rad_per_sqrt_rad * math.sqrt(turn) * self._normal()
        self._odometry.put(encode(Odometry(from_ns, self._odometry_ns, said_m, turned)))

    def see(self) -> None:
        """What the observer sees of the teammate now."""
        stamp_ns = self._clock.now_ns() // 1000 * 1000  # fixes say whole microseconds
        since_s = (stamp_ns - self._odometry_ns) * 1e-9
        bearing = (self._way_m + SPEED_M_S * since_s) / RADIUS_M
        sensor = self._team.robots["observer"].sensor
        seen = Sighting(
            "teammate",
            RADIUS_M + sensor.range_sigma_m(RADIUS_M) * self._normal(),
            math.remainder(bearing + sensor.bearing_sigma_rad * self._normal(), math.tau),
        )
        payload = encode(Sightings(stamp_ns, (seen,)))
        self.put_ns[stamp_ns] = time.monotonic_ns()
        self._sightings.put(payload)

    def _normal(self) -> float:
        return float(self._random.normal())


class _Child:
    """A process with a pipe to it; a context manager that leaves none behind."""

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        context = get_context("spawn")
        self.pipe, self._its_end = context.Pipe()
        self._process = context.Process(target=target, args=(*arguments, self._its_end))

    def __enter__(self) -> "_Child":
        self._process.start()
        self._its_end.close()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        self.pipe.close()

    def ended(self) -> Any:
        """Ends it; what it hands back. Raises EOFError when it has died."""
        self._process.terminate()
        said = self.pipe.recv()
        self._process.join()
        return said


def measured(sightings: int, done: Callable[[], None]) -> Latency:
    """The latencies of so many sightings; `done` is called after each.

    Raises TimeoutError when the processes do not get ready.
    """
    team, endpoint, parent = pair(), free_endpoint(), os.getpid()
    clock = Clock(time.time_ns(), time.monotonic_ns(), 1.0)
    common = team.name, endpoint, parent
    with (
        open_router(team.name, [endpoint]),
        open_bus(team.name, [endpoint]) as bus,
        _Child(_robot, "observer", team, endpoint, clock, parent) as observer,
        _Child(_robot, "teammate", team, endpoint, clock, parent) as teammate,
        _Child(_bare_sender, *common) as sender,
        _Child(_bare_receiver, *common) as receiver,
    ):
        _wait_for(
            bus, ("alive/*/observer/*", "alive/*/teammate/*", "ready/sender", "ready/receiver")
        )
        driver = _Driver(bus, team, clock)
        first_ns = time.monotonic_ns() + SETTLE_NS
        turns = [first_ns + n * PERIOD_NS for n in range(UNMEASURED + sightings)]
        sender.pipe.send([at_ns + PERIOD_NS // 2 for at_ns in turns])
        for at_ns in turns:
            _sleep_until(at_ns - PERIOD_NS // 4)
            driver.drive()
            _sleep_until(at_ns)
            driver.see()
            _sleep_until(at_ns + PERIOD_NS // 4)
            driver.drive()
            done()
        _sleep_until(turns[-1] + PERIOD_NS)
        stamps = list(driver.put_ns)[UNMEASURED:]
        ways = _ways(stamps, driver.put_ns, observer.ended(), teammate.ended())
        return _latency(len(stamps), ways, receiver.ended()[UNMEASURED:])


def _wait_for(bus: Bus, tokens: Sequence[str]) -> None:
    """Until all are announced."""
    events = []
    for keys in tokens:
        event = threading.Event()
        bus.watch(keys, lambda key, alive, event=event: event.set())  # type: ignore[misc]
        events.append(event)
    until = time.monotonic() + PATIENCE_S
    for keys, event in zip(tokens, events, strict=True):
        if not event.wait(until - time.monotonic()):
            raise TimeoutError(f"{keys} did not come within {PATIENCE_S:.0f} s")


def _sleep_until(at_ns: int) -> None:
    time.sleep(max(0.0, (at_ns - time.monotonic_ns()) * 1e-9))


class Way(NamedTuple):
    """The way of one sighting: when it was where."""

    put_ns: int
    received_ns: int
    fix_put_ns: int
    fix_received_ns: int
    changed_ns: int


def _ways(
    stamps: Sequence[int], put_ns: Mapping[int, int], observer: Notes, teammate: Notes
) -> list[Way]:
    """Those sightings that changed the teammate's belief."""
    received, fixes = _by_stamp(observer.heard), _by_stamp(observer.said)
    heard, changed = _by_stamp(teammate.heard), teammate.changed_ns
    return [
        Way(put_ns[s], received[s], fixes[s], heard[s], changed[s]) for s in stamps if s in changed
    ]


def _by_stamp(notes: Sequence[Noted]) -> dict[int, int]:
    """When the sightings and the fixes among these passed first."""
    passed: dict[int, int] = {}
    for at_ns, key, payload in notes:
        fix = key.startswith("fix/")
        message = decode_help(key, payload) if fix else decode(payload)
        if isinstance(message, Sightings | Fix):
            passed.setdefault(message.stamp_ns, at_ns)
    return passed


def _latency(sightings: int, ways: Sequence[Way], bare_ns: Sequence[int]) -> Latency:
    """Raises RuntimeError where nothing came through."""
    if not ways or not bare_ns:
        raise RuntimeError("no sighting changed a belief, or no bare put was heard")
    at = np.array(ways)
    bare, whole = _quantiles(bare_ns), _quantiles(at[:, 4] - at[:, 1])
    return Latency(
        experiment="latency",
        version=version("cpcbl-team"),
        sightings=sightings,
        changed=len(ways),
        bare_puts=len(bare_ns),
        payload_bytes=FIX_BYTES,
        bare=bare,
        sighting_to_belief=whole,
        in_observer=_quantiles(at[:, 2] - at[:, 1]),
        on_bus=_quantiles(at[:, 3] - at[:, 2]),
        in_teammate=_quantiles(at[:, 4] - at[:, 3]),
        driver_to_belief=_quantiles(at[:, 4] - at[:, 0]),
        ratio_p50=whole.p50_us / bare.p50_us,
        ratio_p99=whole.p99_us / bare.p99_us,
        cores=os.cpu_count() or 1,
        load_average=os.getloadavg()[0],
    )


def _quantiles(nanoseconds: Any) -> Quantiles:
    p50, p99 = np.percentile(nanoseconds, [50.0, 99.0]) * 1e-3
    return Quantiles(float(p50), float(p99))


def tables(result: Latency) -> Iterable[RenderableType]:
    """What a person sees."""
    shown = table(
        f"Latency, {result.changed} of {result.sightings} sightings",
        ("from -> to",),
        ("p50 us", "p99 us", "p50 x", "p99 x"),
    )
    for said, q in (
        (f"bare put -> callback, {result.payload_bytes} B", result.bare),
        ("sighting received -> teammate's belief changed", result.sighting_to_belief),
        ("  sighting received -> fix put", result.in_observer),
        ("  fix put -> received", result.on_bus),
        ("  fix received -> belief changed", result.in_teammate),
        ("driver's put -> teammate's belief changed", result.driver_to_belief),
    ):
        ratios = q.p50_us / result.bare.p50_us, q.p99_us / result.bare.p99_us
        shown.add_row(said, f"{q.p50_us:.0f}", f"{q.p99_us:.0f}", *(f"{r:.2f}" for r in ratios))
    yield shown
    yield f"{result.cores} cores, load average {result.load_average:.1f}"
