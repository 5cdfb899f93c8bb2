"""Starting the command line as a user would, and looking at processes."""

import io
import logging
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout

from cpcbl_launch.cli import main
from cpcbl_launch.run.processes import PROGRAM


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
    end before they start anything."""
    words, output, errors = [*map(str, arguments)], io.StringIO(), io.StringIO()
    handlers, argv, code = logging.root.handlers[:], sys.argv, 0
    try:
        sys.argv = ["cpcbl-team", *words]
        with redirect_stdout(output), redirect_stderr(errors):
            main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.argv, logging.root.handlers[:] = argv, handlers
    return subprocess.CompletedProcess(words, code, output.getvalue(), errors.getvalue())


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
    """Whether a condition comes true in time."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        if condition():
            return True
        time.sleep(0.02)
    return condition()
