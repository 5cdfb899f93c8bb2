"""`cpcbl-team up`: router, field and a process per robot; a live table; a report at the end."""

import logging
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from cpcbl_agents.clock import Clock
from cpcbl_agents.earlier_processes import repeat_tokens
from cpcbl_agents.flight_recorder import recorded
from cpcbl_agents.node import NodeStart
from cpcbl_agents.robot import Robot
from cpcbl_agents.tape import NO_TAPE, Tape
from cpcbl_launch.recordings.read import BUS
from cpcbl_launch.reporting.files import write_or_reason
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.phases import Span, guest_reports, phase_report
from cpcbl_launch.reporting.recorder import Recorder, Report, variants_of
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.run.admission import admission_control
from cpcbl_launch.run.logged_team import is_calibrated_on
from cpcbl_launch.run.processes import (
    Processes,
    Supervisor,
    process_table,
    tasks,
)
from cpcbl_launch.run.router import team_router
from cpcbl_launch.simulation.in_process import Progress, simulate
from cpcbl_launch.team.file import save_resolved
from cpcbl_launch.team.requirements import require_duration
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport.bus import Bus
from cpcbl_transport.security import Identity, link_of
from cpcbl_transport.topics import Role, namespace
from cpcbl_transport.zenoh_bus import open_bus, open_router

log = logging.getLogger(__name__)

LEAD_S = 2.0
LEAD_S_A_PROCESS = 0.3
LEAD_S_A_CAMERA = 1.0  # OpenCV is loaded, the lens laid out
REFRESH_S = 0.25
SIMULATED_S = 30.0  # by default
LEAST_S = 1.0
JOIN_S = 10.0  # so long a router that runs is looked for

Stop = Callable[[], bool]
Watch = Callable[[Bus], AbstractContextManager[object]]  # entered before any process starts
Show = Callable[[Recorder, Processes, float], None]  # of a run to a person, and its seconds so far


class Run(NamedTuple):
    """What is to be run."""

    team: Team
    duration_s: float | None
    speed: float = 1.0
    seed: int = 1
    here: Collection[str] | None = None  # the robots to start on this machine; None: all
    truth: Mapping[str, Floats] = MappingProxyType({})
    left_out: Mapping[str, str] = MappingProxyType({})
    epoch_ns: int | None = None  # robot time at the start; None: now
    folder: Path | None = None  # where processes write their logs; None: a temporary folder
    picture: Path | None = None  # the picture of the run to write (PNG or SVG)
    record: Path | None = None  # the recording to write: a file (MCAP), or the folder of a run
    connect: tuple[str, ...] = ()  # a router that runs; none: the run starts one

    @property
    def record_folder(self) -> Path | None:
        """The folder that robots record into, if they do."""
        is_folder = self.record is not None and self.record.suffix != BUS.suffix
        return self.record if is_folder else None


class Launcher(Protocol):
    """Starts what a run needs, and ends it."""

    @property
    def lead_s(self) -> float:
        """Real seconds that all processes take to be ready."""

    def router(self) -> AbstractContextManager[Bus]:
        """The team's router, and a session on it."""

    def processes(self, clock: Clock) -> AbstractContextManager[Processes]:
        """The robots and the field; robot time is the clock's."""


class OnThisMachine:
    """The router in this process, everybody else in a process of its own."""

    def __init__(self, run: Run, folder: Path, stop: Stop) -> None:
        self._run, self._folder, self._stop = run, folder, stop
        self._here = run.team.robots if run.here is None else run.here
        cameras = sum(name in self._here for name in run.team.cameras)
        self.lead_s = LEAD_S + LEAD_S_A_PROCESS * len(self._here) + LEAD_S_A_CAMERA * cameras

    def router(self) -> AbstractContextManager[Bus]:
        team, listen = self._run.team, self._run.team.transport.listen
        if self._run.connect:
            return self._join_router()
        require_keys(team, listen, self._here)
        return self._opened(team_router(team, listen, (), self._run.speed))

    @contextmanager
    def _opened(self, config: Mapping[str, Any]) -> Iterator[Bus]:
        team, speed = self._run.team, self._run.speed
        with (
            open_router(config, namespace(team.name)) as bus,
            admission_control(bus, team.transport.guards, team.transport.listen, speed),
        ):
            repeat_tokens(bus)
            yield bus

    def _join_router(self) -> AbstractContextManager[Bus]:
        run, until_s = self._run, time.monotonic() + JOIN_S
        require_keys(run.team, run.connect, self._here)
        link = link_of(run.team, Identity(Role.OPERATOR), run.connect)
        return open_bus(
            run.team.name,
            link.endpoints,
            lambda: self._stop() or time.monotonic() > until_s,
            link.credentials,
        )

    def processes(self, clock: Clock) -> AbstractContextManager[Processes]:
        team, path = self._run.team, self._folder / "team.json"
        save_resolved(team, path)
        endpoint = router_endpoint(self._run)
        record = self._run.record_folder
        where = str(record.absolute()) if record else ""
        table = process_table(team, path, endpoint, clock, self._run.seed, self._here, where)
        return Supervisor(table, self._folder)


Launch = Callable[[Run, Path, Stop], Launcher]


def require_keys(team: Team, listen: Sequence[str], here: Collection[str]) -> None:
    """Says what a process would die of before any starts. Raises SecurityError."""
    for task in tasks(team, "", (), 0, here):
        link_of(team, task.identity, listen)
    if team.gateway is not None:
        link_of(team, Identity(Role.GATEWAY), listen)


def free_endpoint(protocol: str = "tcp") -> str:
    """An endpoint of this machine that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


def with_listen_endpoint(team: Team) -> Team:
    """The team with an endpoint for its router: its own, or a free one of this machine."""
    if team.transport.listen:
        return team
    endpoint = free_endpoint("tls" if team.transport.secured else "tcp")
    transport = msgspec.structs.replace(team.transport, listen=(endpoint,))
    return msgspec.structs.replace(team, transport=transport)


def local_endpoint(listen: str) -> str:
    """The endpoint at which robots of this machine find a router that listens everywhere."""
    return listen.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def router_endpoint(run: Run) -> str:
    """Where robots of this machine, and who watches the run here, find the router."""
    return run.connect[0] if run.connect else local_endpoint(run.team.transport.listen[0])


def run_team(
    run: Run,
    show: Show,
    stop: Stop,
    launch: Launch = OnThisMachine,
    watch: Watch = nullcontext,
) -> Report:
    """Runs a team until its time is over or `stop()`. Raises BusError without a router."""
    run = run._replace(team=with_listen_endpoint(run.team))
    with ExitStack() as stack:
        folder = run.folder or Path(stack.enter_context(TemporaryDirectory(prefix="cpcbl-")))
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: {error.strerror}; robots read their team there") from error
        launcher = launch(run, folder, stop)
        bus = stack.enter_context(launcher.router())
        recording = stack.enter_context(_open_recording(run, bus))
        recorder = Recorder(bus)
        stack.enter_context(watch(bus))
        clock = Clock.starting_in(launcher.lead_s, run.epoch_ns, run.speed)
        with launcher.processes(clock) as processes:
            end_ns = None if run.duration_s is None else int(run.duration_s * 1e9)
            while not stop():
                elapsed_ns = clock.now_ns() - clock.epoch_ns
                if end_ns is not None and elapsed_ns >= end_ns:
                    break
                processes.watch()
                show(recorder, processes, elapsed_ns * 1e-9)
                time.sleep(REFRESH_S)
            elapsed_s = (clock.now_ns() - clock.epoch_ns) * 1e-9
            restarts = processes.restarts
    report = _report(run, recorder, clock.epoch_ns * 1e-9, elapsed_s, restarts)
    if recording is not None and recording.failed:
        lost = {**report.not_written, str(run.record): recording.failed}
        report = msgspec.structs.replace(report, not_written=lost)
    return report


def simulate_run(run: Run, progress: Progress | None = None) -> Report:
    """The same in one process over the bus in memory, as fast as the machine is.

    Raises InputError for a robot that is not simulated, or too short a duration.
    """
    for name, robot in run.team.robots.items():
        if robot.source != "simulated":
            raise InputError(
                f"robots.{name}.source: {robot.source}: cannot be simulated; use `up`, or"
                " `evaluate` for a log"
            )
    duration_s = SIMULATED_S if run.duration_s is None else run.duration_s
    require_duration(duration_s, LEAST_S)
    with ExitStack() as stack:

        def tape_for(robot: Robot, team: Team, start: NodeStart) -> Tape:
            if (folder := run.record_folder) is None:
                return NO_TAPE
            return stack.enter_context(recorded(folder, robot, team, start))

        _, recorder = simulate(
            run.team,
            run.seed,
            duration_s,
            watch=lambda bus: stack.enter_context(_open_recording(run, bus)),
            progress=progress,
            tape_for=tape_for,
        )
    return _report(run, recorder, 0.0, duration_s, {})


def _open_recording(run: Run, bus: Bus) -> AbstractContextManager[Recording | None]:
    if run.record is None:
        return nullcontext()
    if (folder := run.record_folder) is not None:
        path = folder / BUS
        if path.exists():
            raise InputError(f"--record {folder}: holds a run already; name another folder")
        with suppress(OSError):  # what is wrong with it is said below
            folder.mkdir(parents=True, exist_ok=True)
    else:
        path = run.record
        replayed = [name for name, robot in run.team.robots.items() if robot.source == "mrclam"]
        if replayed:
            what = f"{path}: without the inputs of {', '.join(replayed)}"
            log.warning("%s: robots that replay a log do not publish them", what)
    try:
        return Recording(path, run.team, bus)
    except OSError as error:
        raise InputError(f"--record {run.record}: {error.strerror}; name another one") from error


def _report(
    run: Run, recorder: Recorder, epoch_s: float, elapsed_s: float, restarts: dict[str, int]
) -> Report:
    robots = run.team.robots
    truth = run.truth or recorder.simulated_truth()
    after_s = max(robot.collaboration.after_s for robot in robots.values())
    helped_from_s = epoch_s + after_s if after_s else None
    begin_s = -np.inf if helped_from_s is None else helped_from_s
    guests = guest_reports(recorder, list(robots), truth, epoch_s, begin_s)
    lost: dict[str, str] = {}
    if run.picture is not None:
        from cpcbl_launch.reporting.picture import Times, draw_run

        present_s = {name: guest.present_s for name, guest in guests.items()}
        times = Times(epoch_s, elapsed_s, helped_from_s, present_s)
        drawn = partial(draw_run, recorder, run.team, truth, run.picture, times)
        lost = write_or_reason(run.picture, drawn)
    report = recorder.report(variants_of(run.team), truth, begin_s)
    alone = {}
    if helped_from_s is not None:
        until = [Span(until_s=helped_from_s)]
        alone = {name: phase_report(recorder, name, truth.get(name), until) for name in robots}
    return msgspec.structs.replace(
        report,
        calibrated_on=run.team.calibrated_on,
        seen_before=bool(run.team.data) and is_calibrated_on(run.team, Path(run.team.data)),
        left_out=dict(run.left_out),
        duration_s=elapsed_s,
        restarts=restarts,
        alone=alone,
        guests=guests,
        not_written=lost,
    )
