"""Starts processes, restarts those that die, stops them all within a bound."""

import logging
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, NamedTuple, Protocol

log = logging.getLogger(__name__)

FIRST_BACKOFF_S = 0.5
LONGEST_BACKOFF_S = 8.0
HEALTHY_S = 10.0
PATIENCE_S = 3.0


class ProcessSpec(NamedTuple):
    """One row of the process table."""

    name: str
    command: tuple[str, ...]
    on_restart: tuple[str, ...] = ()  # added to the command from the second start on


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


class _Child:
    def __init__(self, spec: ProcessSpec, folder: Path) -> None:
        self.spec = spec
        self.restarts = 0
        self.backoff_s = FIRST_BACKOFF_S
        self.due_s: float | None = None
        self._log = folder / f"{spec.name}.log"
        self.process = self._start(())

    def _start(self, more: tuple[str, ...]) -> "subprocess.Popen[bytes]":
        self.started_s = time.monotonic()
        with ExitStack() as stack:
            try:
                output: IO[bytes] | int = stack.enter_context(self._log.open("ab"))
            except OSError as error:  # better a process without a log than none
                log.warning("%s: not written: %s", self._log, error.strerror)
                output = subprocess.DEVNULL
            return subprocess.Popen(
                [*self.spec.command, *more],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches the supervisor only
            )

    def _last_line(self) -> str:
        try:
            lines = self._log.read_text(errors="replace").splitlines()
        except OSError as error:
            return f"its log cannot be read: {error.strerror}"
        return lines[-1] if lines else "it printed nothing"

    def watch(self) -> None:
        """Restarts the process some time after it ended, longer each time that it ends early."""
        if self.process.poll() is None:
            return
        now = time.monotonic()
        if self.due_s is None:
            if now - self.started_s > HEALTHY_S:
                self.backoff_s = FIRST_BACKOFF_S
            code = self.process.returncode
            last_line = f": {self._last_line()}" if code > 0 else ""
            log.warning(
                "%s ended (%s)%s; again in %g s", self.spec.name, code, last_line, self.backoff_s
            )
            self.due_s = now + self.backoff_s
            self.backoff_s = min(2.0 * self.backoff_s, LONGEST_BACKOFF_S)
        elif now >= self.due_s:
            self.due_s = None
            self.restarts += 1
            self.process = self._start(self.spec.on_restart)


class Supervisor:
    """The processes of a run; a context manager that leaves none behind."""

    def __init__(self, table: Sequence[ProcessSpec], folder: Path) -> None:
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
        """To be called several times a second."""
        for child in self._children.values():
            child.watch()

    @property
    def names(self) -> list[str]:
        """All processes, in the order of the table."""
        return list(self._children)

    @property
    def pids(self) -> dict[str, int]:
        """The processes that run at present."""
        return {
            name: child.process.pid
            for name, child in self._children.items()
            if child.process.poll() is None
        }

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
