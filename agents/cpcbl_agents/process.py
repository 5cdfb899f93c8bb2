"""One robot as one process: the loop around a node, ended by SIGINT or SIGTERM."""

import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

import msgspec

from cpcbl_agents.clock import Clock
from cpcbl_agents.node import Node, Stepped
from cpcbl_agents.robot import Robot
from cpcbl_agents.sources import OwnCamera
from cpcbl_team.config import Team
from cpcbl_transport.bus import Bus
from cpcbl_transport.security import Identity, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import open_bus

log = logging.getLogger(__name__)

LONGEST_WAIT_S = 0.2
LATE_NS = 1_000_000_000


class Stop:
    """Set by SIGINT and SIGTERM, and when the process that started this one is gone."""

    def __init__(self, parent: int | None = None) -> None:
        self._event = threading.Event()
        self._parent = parent
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._event.set()

    def __call__(self) -> bool:
        orphaned = self._parent is not None and os.getppid() != self._parent
        return orphaned or self._event.is_set()


class Wake:
    """Wakes the one thread that waits, a fifth sooner than a `threading.Event`, as measured."""

    def __init__(self) -> None:
        self._asleep = threading.Lock()
        self._asleep.acquire()

    def set(self) -> None:
        """From any thread: the present wait, or the next one, ends at once."""
        with suppress(RuntimeError):  # it was set already
            self._asleep.release()

    def wait(self, seconds: float) -> None:
        self._asleep.acquire(timeout=seconds)


def run_robot(
    name: str,
    team: Team,
    connect: Sequence[str],
    clock: Clock,
    stop: Callable[[], bool],
    restarted: bool = False,
    through: Callable[[Bus], Bus] = lambda bus: bus,
) -> None:
    """Runs a robot until `stop()`. One that is restarted, or late, does not know where it is.

    `through` is what stands between the robot and its bus.

    Raises BusError when stopped before a router answered, LogError for an unreadable log,
    SecurityError without the keys of a secured team, ValueError for a camera that cannot be used.
    """
    wake = Wake()
    link = link_of(team, Identity(Role.ROBOT, name), connect)
    with (
        own_camera(name, team, clock, wake) as camera,
        open_bus(team.name, link.endpoints, stop, link.credentials) as bus,
    ):
        start_ns = clock.now_ns()
        late_s = (start_ns - clock.epoch_ns) * 1e-9 / clock.speed
        if restarted or start_ns > clock.epoch_ns + LATE_NS * max(1.0, clock.speed):
            log.warning("robot %s starts %.1f s after the team: it looks where it is", name, late_s)
            team = _not_knowing_its_start(name, team)
        incarnation = f"{os.getpid():x}"
        robot = Robot(name, team, start_ns, restarted, camera)
        node = Node(robot, team, through(bus), start_ns, incarnation, wake.set, clock.speed)
        run_node(node, wake, clock, stop)


@contextmanager
def own_camera(name: str, team: Team, clock: Clock, wake: Wake) -> Iterator[OwnCamera | None]:
    """The camera that a robot reads itself, until the end; None where nobody or a driver does.

    Raises ValueError for a camera that cannot be used, or without OpenCV.
    """
    robot = team.robots[name]
    if robot.sensing == "camera":
        import cpcbl_agents.vision  # noqa: F401  it says what is missing
    if robot.sensing != "camera" or not robot.camera.frames:
        yield None
        return
    from cpcbl_agents.sources.camera import opened

    camera = opened(name, robot.camera, robot.sensor.rate_hz, clock.now_ns, wake.set)
    try:
        yield camera
    finally:
        camera.close()


def run_node(node: Stepped, wake: Wake, clock: Clock, stop: Callable[[], bool]) -> None:
    """Steps a node until `stop()`: when something arrives, which sets `wake`, or is due."""
    node.step(clock.now_ns())
    while not stop():
        if not node.waiting:
            wake.wait(min(clock.seconds_until(node.next_ns), LONGEST_WAIT_S))
        node.step(clock.now_ns())


def _not_knowing_its_start(name: str, team: Team) -> Team:
    robot = msgspec.structs.replace(team.robots[name], start=None)
    return msgspec.structs.replace(team, robots={**team.robots, name: robot})
