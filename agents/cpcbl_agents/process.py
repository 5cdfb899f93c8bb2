"""One robot as one process: the loop around a node, ended by SIGINT, SIGTERM or SIGHUP."""

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from pathlib import Path

import msgspec

from cpcbl_agents.clock import Clock
from cpcbl_agents.earlier_processes import NEVER_RAN, EarlierRuns, OwnTokens, wait_until_alone
from cpcbl_agents.node import BoundedSteppable, Node, NodeCallbacks, NodeStart
from cpcbl_agents.robot import Robot, build_robot
from cpcbl_agents.robot_log import RobotLogger
from cpcbl_agents.sources import OwnCamera
from cpcbl_agents.stop import StopSignal as StopSignal  # with a robot, one needs it
from cpcbl_agents.tape import NO_TAPE, Tape
from cpcbl_agents.watchdog import with_watchdog
from cpcbl_team.config import Team
from cpcbl_team.errors import ClockError
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import Status
from cpcbl_transport.security import Identity, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import open_bus

log = logging.getLogger(__name__)

LONGEST_WAIT_S = 0.2
LATE_NS = 1_000_000_000
MAX_CLOCK_STEP_S = 0.25  # a clock that is set by more makes inputs late, or from the future
LONGEST_STEP_S = 0.05  # a step that lasts longer handles no more messages,
LEAST_STEP_S = 0.005  # nor one that lasts so long and delays what is due
BUSY_NS = 1_000_000  # after a step: what comes sooner may have queued behind it


class Loop:
    """Steps a node when something arrives or is due, one thread at a time.

    The bus's thread that delivers a message also handles it, if no other thread steps the node: to
    wake the robot's own thread would take 50 us. A message that arrives during a step, or so soon
    after one that it may have waited for its end, is left to the robot's own thread, so that the
    bus's thread is free to store the messages that follow.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._step_lock, self._sleep_lock = threading.Lock(), threading.Lock()
        self._step_lock.acquire()  # no thread may step the node before `run`
        self._sleep_lock.acquire()
        self._node: BoundedSteppable
        self._busy_ns = 0
        self._bug: BaseException | None = None

    def wake(self) -> None:
        """From any thread: the robot's own thread steps at once."""
        with suppress(RuntimeError):  # it is awake already
            self._sleep_lock.release()

    def on_arrival(self) -> None:
        """From a thread of the bus: something has arrived and is stored in the node."""
        if time.monotonic_ns() < self._busy_ns or not self._step_lock.acquire(blocking=False):
            self.wake()
            return
        try:
            self._step()
            if self._node.waiting:
                self.wake()
        except BaseException as bug:  # the bus would swallow it
            self._bug = bug
            self.wake()
        finally:
            self._busy_ns = time.monotonic_ns() + BUSY_NS
            self._step_lock.release()

    def run(self, node: BoundedSteppable, stop: Callable[[], bool]) -> None:
        """Runs until `stop()`. An exception of any thread's step is raised here."""
        self._node = node
        self._step_lock.release()
        try:
            while self._bug is None and not stop():
                with self._step_lock:
                    self._step()
                if not node.waiting:  # as after a step that could not handle all
                    self._sleep_lock.acquire(
                        timeout=min(self._clock.seconds_until(node.next_ns), LONGEST_WAIT_S)
                    )
        finally:
            self._step_lock.acquire()  # what still arrives is only stored
        if self._bug is not None:
            raise self._bug

    def _step(self) -> None:
        if self._bug is None:
            free_s = self._clock.seconds_until(self._node.next_ns)
            until_s = time.monotonic() + min(max(LEAST_STEP_S, free_s), LONGEST_STEP_S)
            self._node.step(self._clock.now_ns(), lambda handled: time.monotonic() < until_s)


def run_robot(
    name: str,
    team: Team,
    connect: Sequence[str],
    clock: Clock,
    stop: Callable[[], bool],
    restarted: bool | None = None,
    wrap_bus: Callable[[Bus], Bus] = lambda bus: bus,
    record: Path | None = None,
) -> None:
    """Runs a robot until `stop()`. One that is started again does not know where it is, once it has
    moved. `restarted` says whether that is so; None: the router knows.

    `wrap_bus` may put something between the robot and its bus; `record` is the folder that it
    records into. Raises BusError when stopped before
    a router answered, LogError for an unreadable log, SecurityError without the keys of a secured
    team, InputError for a camera that cannot be used or when another process is this robot,
    DependencyError without OpenCV, ClockError when this machine's clock was set.
    """
    loop = Loop(clock)
    link = link_of(team, Identity(Role.ROBOT, name), connect)
    with (
        own_camera(name, team, clock, loop.wake) as camera,
        open_bus(team.name, link.endpoints, stop, link.credentials) as bus,
    ):
        before = wait_until_alone(bus.tokens, name, stop)
        if restarted is not None:
            before = EarlierRuns(restarted, before.ran or restarted)
        robot = make_robot(name, team, clock, before, camera)
        start = NodeStart(clock.now_ns(), new_incarnation(), clock.speed)
        logger, tokens = RobotLogger(name), OwnTokens(bus, name, start.incarnation, before)

        def on_status(status: Status) -> None:
            logger.log_status(status)
            if node.has_moved:
                tokens.declare_moved()

        callbacks = NodeCallbacks(loop.on_arrival, on_status)
        with (
            robot.sensing.detect_on_thread(loop.wake),
            tape_for(robot, team, start, record) as tape,
        ):
            node = Node(robot, team, wrap_bus(bus), start, callbacks, tape)
            logger.log_connected(team, link.endpoints)
            loop.run(node, with_watchdog(stop_on_clock_step(name, team, clock, stop)))


def make_robot(
    name: str,
    team: Team,
    clock: Clock,
    before: EarlierRuns = NEVER_RAN,
    camera: OwnCamera | None = None,
) -> Robot:
    """The robot as it starts now. It keeps its start unless it has moved since, or is late in its
    log; one that ran before does not know what it spent."""
    start_ns = clock.now_ns()
    late_s = (start_ns - clock.epoch_ns) * 1e-9 / clock.speed
    logged, start = team.robots[name].source == "mrclam", team.robots[name].start
    knows_start = start is not None and start.known
    late = logged and start_ns > clock.epoch_ns + LATE_NS * max(1.0, clock.speed)
    if late:
        log.warning("%s: begins %.1f s late in its log: it has to find its pose", name, late_s)
    elif before.moved and knows_start:
        log.warning(
            "%s: has moved since the team started: it has to find its pose; --no-restarted: it"
            " stands at its start again",
            name,
        )
    if knows_start and (late or before.moved):
        robot = msgspec.structs.replace(team.robots[name], start=None)
        team = msgspec.structs.replace(team, robots={**team.robots, name: robot})
    return build_robot(name, team, start_ns, late or before.moved or before.ran, camera)


def tape_for(
    robot: Robot, team: Team, start: NodeStart, record: Path | None, is_guest: bool = False
) -> AbstractContextManager[Tape]:
    """What the robot's node records with: into this folder, or that of the team file. Raises
    InputError for a folder that cannot be written to."""
    folder = record or team.recording.folder
    if not folder:
        return nullcontext(NO_TAPE)
    from cpcbl_agents.flight_recorder import recorded  # no other robot needs it

    return recorded(Path(folder), robot, team, start, is_guest)


def new_incarnation() -> str:
    """Distinguishes this process from earlier ones: in containers, process ids repeat."""
    return os.urandom(4).hex()


def stop_on_clock_step(
    name: str, team: Team, clock: Clock, stop: Callable[[], bool]
) -> Callable[[], bool]:
    """`stop`, which raises ClockError when the machine's time was set under a robot with real
    inputs: their stamps are of another time from then on."""
    if team.robots[name].source != "external":
        return stop

    def stop_or_raise() -> bool:
        if abs(by_s := clock.clock_step_s()) > MAX_CLOCK_STEP_S:
            raise ClockError(
                f"robot {name}: this machine's clock was set by {by_s:+.2f} s, or it slept: start"
                " the robot again"
            )
        return stop()

    return stop_or_raise


def own_camera(
    name: str, team: Team, clock: Clock, wake: Callable[[], None]
) -> AbstractContextManager[OwnCamera | None]:
    """The camera that a robot reads itself, until the end; None where nobody or a driver does.
    Raises InputError for a camera that cannot be used, DependencyError without OpenCV."""
    robot = team.robots[name]
    if robot.sensing == "camera":
        import cpcbl_agents.vision  # noqa: F401  it says what is missing
    if robot.sensing != "camera" or not robot.camera.frames:
        return nullcontext()
    from cpcbl_agents.sources.camera import open_camera

    return closing(open_camera(name, robot.camera, robot.sensor.rate_hz, clock.now_ns, wake))
