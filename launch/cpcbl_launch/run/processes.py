"""The processes of a run: THE table of them, who starts and stops them, and what each has used."""

import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from cpcbl_agents.clock import Clock
from cpcbl_team.config import Team
from cpcbl_team.errors import DependencyError
from cpcbl_transport.security import Identity
from cpcbl_transport.topics import Role

log = logging.getLogger(__name__)

PROGRAM = (sys.executable, "-m", "cpcbl_launch")
ROBOT = "robot-"
BRIDGE = ("bridge", "ros2")
FIRST_BACKOFF_S = 0.5
LONGEST_BACKOFF_S = 8.0
HEALTHY_S = 10.0
PATIENCE_S = 3.0
_PROC = Path("/proc")


class Task(NamedTuple):
    """One row: what `cpcbl-team ARGUMENTS` does."""

    name: str
    arguments: tuple[str, ...]
    identity: Identity  # whose keys it needs in a secured team


def tasks(
    team: Team,
    team_file: str,
    common: tuple[str, ...],
    seed: int,
    here: Collection[str],
    record: str = "",
) -> list[Task]:
    """name | arguments | when: the field if any robot is simulated, one process a robot, the bridge
    if the team file has a table `ros2`. `record`: the folder that the robots record into."""
    own = ("--record", record) if record else ()
    rows = [
        Task(ROBOT + name, ("robot", team_file, name, *common, *own), Identity(Role.ROBOT, name))
        for name in team.robots
        if name in here
    ]
    if team.simulated:
        field = ("field", team_file, "--seed", str(seed), *common)
        rows.insert(0, Task("field", field, Identity(Role.FIELD)))
    if team.ros2 is not None:
        bridge = (*BRIDGE, team_file, *common, "--robots", ",".join(here))
        rows.append(Task("bridge", bridge, bridge_identity(here)))
    return rows


class ProcessSpec(NamedTuple):
    """A row of the table as a process of this machine."""

    name: str
    command: tuple[str, ...]


def process_table(
    team: Team,
    team_file: Path,
    endpoint: str,
    clock: Clock,
    seed: int,
    here: Collection[str],
    record: str = "",
) -> list[ProcessSpec]:
    """The same as processes of this machine, which end with the one that started them."""
    common = ("--connect", endpoint, "--clock", str(clock), "--parent", str(os.getpid()))
    clocks = {
        ROBOT + name: ("--clock", str(clock._replace(epoch_ns=clock.epoch_ns + int(s * 1e9))))
        for name, s in team.simulation.clocks_ahead_s.items()
    }
    table = [
        ProcessSpec(name, (*PROGRAM, *arguments, *clocks.get(name, ())))
        for name, arguments, _ in tasks(team, str(team_file), common, seed, here, record)
    ]
    if team.gateway is not None:
        gateway = ("gateway", str(team_file), "--connect", endpoint, "--parent", str(os.getpid()))
        table.append(ProcessSpec("gateway", (*PROGRAM, *gateway)))
    return table


def bridge_spec(
    team_file: str, connect: Sequence[str], clock: str, robots: Collection[str]
) -> ProcessSpec:
    """The bridge of these robots to ROS 2 as a process of this one. `clock`: robot time, empty for
    that of the machine."""
    words = [*BRIDGE, team_file, "--parent", str(os.getpid())]
    words += [word for endpoint in connect for word in ("--connect", endpoint)]
    words += ["--clock", clock] if clock else []
    words += ["--robots", ",".join(robots)]
    return ProcessSpec("bridge", (*PROGRAM, *words))


def bridge_identity(robots: Collection[str]) -> Identity:
    """Whose keys the bridge of these robots uses: that of one robot the keys of its machine."""
    return Identity(Role.ROBOT, *robots) if len(robots) == 1 else Identity(Role.BRIDGE)


# Starting, watching and stopping them --------------------------------------------------------


class Processes(Protocol):
    """What runs a team's robots and field: processes of this machine, or containers."""

    @property
    def names(self) -> list[str]:
        """All of them, in the order of the table."""

    @property
    def pids(self) -> dict[str, int]:
        """Those that run at present."""

    @property
    def restarts(self) -> dict[str, int]:
        """Those that were started again, and how often."""

    def watch(self) -> None:
        """To be called several times a second: starts again what has ended."""


def last_message(text: str) -> str:
    """What a process said last: its last line with a word in it, or the exception of its last
    traceback, whose message may have several lines."""
    _, traceback, after = text.rpartition("Traceback (most recent call last):")
    lines = [line.rstrip() for line in after.splitlines() if any(map(str.isalnum, line))]
    raised = (line for line in lines if not line[0].isspace()) if traceback else iter(())
    return next(raised, lines[-1].strip() if lines else "it printed nothing")


class _Child:
    def __init__(self, spec: ProcessSpec, folder: Path | None) -> None:
        self.spec, self.restarts, self.backoff_s = spec, 0, FIRST_BACKOFF_S
        self.due_s: float | None = None
        self._log = None if folder is None else folder / f"{spec.name}.log"
        self.process = self._start()

    def _start(self) -> "subprocess.Popen[bytes]":
        self.started_s = time.monotonic()
        with self._open_log() as output:
            return subprocess.Popen(
                self.spec.command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output and subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches the supervisor only
            )

    def _open_log(self) -> AbstractContextManager[BinaryIO | None]:
        if self._log is None:
            return nullcontext()
        try:
            return self._log.open("ab")
        except OSError as error:  # better a process without a log than none
            log.warning("%s: not written: %s", self._log, error.strerror)
            return Path(os.devnull).open("wb")

    def _last_line(self) -> str:
        if self._log is None:
            return "see above"
        try:
            return last_message(self._log.read_text(errors="replace"))
        except OSError as error:
            return f"its log cannot be read: {error.strerror}"

    def watch(self) -> None:
        """Restarts the process some time after it ended, longer each time that it ends early."""
        if self.process.poll() is None:
            return
        now = time.monotonic()
        if self.due_s is None:
            if now - self.started_s > HEALTHY_S:
                self.backoff_s = FIRST_BACKOFF_S
            name, code, wait_s = self.spec.name, self.process.returncode, self.backoff_s
            last_line = f": {self._last_line()}" if code > 0 else ""
            log.warning("%s ended (%s)%s; again in %g s", name, code, last_line, wait_s)
            self.due_s = now + self.backoff_s
            self.backoff_s = min(2.0 * self.backoff_s, LONGEST_BACKOFF_S)
        elif now >= self.due_s:
            self.due_s = None
            self.restarts += 1
            self.process = self._start()


class Supervisor:
    """The processes of a run; a context manager that leaves none behind."""

    def __init__(self, table: Sequence[ProcessSpec], folder: Path | None) -> None:
        """`folder`: where they write their logs; None: to the outputs of this process."""
        self._table, self._folder = table, folder
        self._children: dict[str, _Child] = {}

    def __enter__(self) -> "Supervisor":
        try:
            for spec in self._table:
                self._children[spec.name] = _Child(spec, self._folder)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def watch(self) -> None:
        for child in self._children.values():
            child.watch()

    def change(self, spec: ProcessSpec) -> None:
        """From its next start on, the process of this name runs this command."""
        self._children[spec.name].spec = spec

    @property
    def names(self) -> list[str]:
        return list(self._children)

    @property
    def pids(self) -> dict[str, int]:
        children = self._children.items()
        return {name: c.process.pid for name, c in children if c.process.poll() is None}

    @property
    def restarts(self) -> dict[str, int]:
        return {n: c.restarts for n, c in self._children.items() if c.restarts}

    def stop(self) -> None:
        """SIGINT to all, a bounded wait, then SIGKILL."""
        running = [c.process for c in self._children.values() if c.process.poll() is None]
        for process in running:
            process.send_signal(signal.SIGINT)
        until = time.monotonic() + PATIENCE_S
        for process in running:
            try:
                process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                log.warning("pid %d did not stop within %.0f s", process.pid, PATIENCE_S)
                process.kill()
                process.wait()


# What a process uses, from /proc (Linux) ---------------------------------------------------------


def require_process_usage(what: str) -> None:
    """Raises DependencyError where processes cannot be measured."""
    if not (_PROC / "self" / "smaps_rollup").exists():
        raise DependencyError(f"{what} needs /proc/PID/smaps_rollup: run it on Linux")


def own_memory_mib(pid: int) -> float:
    """Heap and stacks of a process, without pages of files. Raises OSError for no process."""
    rollup = (_PROC / str(pid) / "smaps_rollup").read_text()
    (kib,) = re.findall(r"^Anonymous: +(\d+) kB$", rollup, re.MULTILINE)
    return int(kib) / 1024
