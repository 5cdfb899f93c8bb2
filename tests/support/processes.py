"""Starting the command line as a user would, and looking at processes."""

import io
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout

from cpcbl_launch.cli import main
from cpcbl_launch.run.processes import PROGRAM

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def cpcbl_team(*arguments: object, timeout_s: float = 300.0) -> "subprocess.CompletedProcess[str]":
    """Runs `cpcbl-team ARGUMENTS` to its end."""
    return subprocess.run(
        [*PROGRAM, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def command_line(*arguments: object) -> "subprocess.CompletedProcess[str]":
    """What `cpcbl-team ARGUMENTS` prints and its exit code, run in this process: for commands that
    start no others. The import of a process of its own costs up to a second of CPU time."""
    words, output, errors = [*map(str, arguments)], io.StringIO(), io.StringIO()
    code = 0
    with _as_in_a_new_process(["cpcbl-team", *words]):
        try:
            with redirect_stdout(output), redirect_stderr(errors):
                main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return subprocess.CompletedProcess(words, code, output.getvalue(), errors.getvalue())


@contextmanager
def _as_in_a_new_process(argv: list[str]) -> Iterator[None]:
    """Words of a command line, and logging that nobody has configured. Afterwards all is as it was,
    and so are the handlers of signals."""
    root, words = logging.root, sys.argv
    handlers, level = root.handlers[:], root.level
    signals = {number: signal.getsignal(number) for number in STOPS}
    output = os.dup(1)  # a command that cannot write a file closes it
    sys.argv, root.handlers[:] = argv, []
    try:
        yield
    finally:
        sys.argv, root.handlers[:] = words, handlers
        root.setLevel(level)
        os.dup2(output, 1)
        os.close(output)
        for number, handler in signals.items():
            signal.signal(number, handler)


PATIENT = """
import cpcbl_launch.run.up
from cpcbl_launch.cli import main
cpcbl_launch.run.up.LEAD_S = 5.0
main()
"""


def patient_up(*arguments: object) -> "subprocess.CompletedProcess[str]":
    """Runs `cpcbl-team up ARGUMENTS` with a longer lead: on a machine that is busy a robot starts
    late, and then it does not know where it is."""
    words = [sys.executable, "-c", PATIENT, "up", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=90.0, check=False)


def command_of(pid: int) -> str:
    """The command line of a process, from the system's process list; empty if there is none."""
    found = subprocess.run(
        ["ps", "-ww", "-o", "args=", "-p", str(pid)], capture_output=True, text=True, check=False
    )
    return found.stdout


def pids_of(words: Sequence[str]) -> list[int]:
    """The processes whose command lines hold all these words."""
    listed = subprocess.run(
        ["ps", "-ww", "-eo", "pid=,args="], capture_output=True, text=True, check=True
    )
    lines = [line.split(maxsplit=1) for line in listed.stdout.splitlines()]
    return [int(pid) for pid, command in lines if all(word in command for word in words)]


def eventually(condition: Callable[[], bool], within_s: float = 40.0) -> bool:
    """Whether a condition comes true in time. Some conditions start a program, so it asks ever more
    seldom."""
    until, pause_s = time.monotonic() + within_s, 0.02
    while time.monotonic() < until:
        if condition():
            return True
        time.sleep(pause_s)
        pause_s = min(1.1 * pause_s, 0.1)
    return condition()
