"""Docker's command line: which there is, whether a daemon answers, one command at a time.

Commands are started in sessions of their own, so that Ctrl-C reaches only us, and are ended when
they take too long or the user wants to stop.
"""

import os
import platform
import re
import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from cpcbl_team.errors import CpcblError

ON_DEBIAN = "docker/dockerd.sh start installs and starts what is missing on Debian"
POLL_S = 0.05

PrintLine = Callable[[str], None]


class DockerError(CpcblError):
    """Docker cannot do it; the text says why in one line, and what to do."""


class CommandResult(NamedTuple):
    """A command that has ended."""

    code: int
    output: str
    """Standard output and standard error, as they came."""

    @property
    def last_line(self) -> str:
        lines = [line.strip() for line in self.output.splitlines() if line.strip()]
        return lines[-1] if lines else "it printed nothing"

    @property
    def problem(self) -> str:
        """The line that says what went wrong: one that begins with error, or the last of all."""
        found = re.search(r"^\s*error\b.*$", self.output, re.IGNORECASE | re.MULTILINE)
        return found[0].strip() if found else self.last_line


def never_stop() -> bool:
    return False


def ignore_line(line: str) -> None:
    """For those who do not want to hear what a command says."""


def run_command(
    command: Sequence[str],
    stop: Callable[[], bool] = never_stop,
    print_line: PrintLine = ignore_line,
    timeout_s: float = 60.0,
) -> CommandResult:
    """Runs a command to its end, and tells each line as it comes.

    Raises DockerError when there is no such program, it takes too long, or `stop()`.
    """
    until_s, received, printed = time.monotonic() + timeout_s, b"", 0
    with tempfile.TemporaryFile() as output:
        process = _start(command, output.fileno())
        try:
            running = True
            while running:
                running = process.poll() is None
                received += os.pread(output.fileno(), 1 << 24, len(received))
                *lines, _ = received[printed:].split(b"\n")
                for line in lines:
                    printed += len(line) + 1
                    print_line(line.decode(errors="replace").rstrip())
                if running:
                    _check_limits(command, stop, until_s)
                    time.sleep(POLL_S)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    return CommandResult(process.returncode, received.decode(errors="replace"))


def command_output(
    command: Sequence[str],
    stop: Callable[[], bool] = never_stop,
    print_line: PrintLine = ignore_line,
    timeout_s: float = 60.0,
) -> str:
    """What a command says. Raises DockerError also when it fails."""
    ended = run_command(command, stop, print_line, timeout_s)
    if ended.code:
        raise DockerError(f"{shlex.join(command[:4])} ...: {ended.problem}")
    return ended.output


def check_daemon() -> None:
    """Raises DockerError unless a daemon answers that runs on this machine's kernel."""
    answer = run_command(["docker", "info", "--format", "{{.KernelVersion}}"], timeout_s=20.0)
    if answer.code:
        raise DockerError(f"no Docker daemon answers ({answer.last_line}); start it: {ON_DEBIAN}")
    kernel, own = answer.last_line, platform.release()
    if kernel != own:
        raise DockerError(
            f"Docker runs on another machine or a virtual one (kernel {kernel}, here {own}), which"
            " does not share this one's clock; use `cpcbl-team compose` and start that"
        )


def compose_program() -> tuple[str, ...]:
    """`docker compose` where there is one, else docker-compose. Raises DockerError."""
    for program in (("docker", "compose"), ("docker-compose",)):
        try:
            if run_command([*program, "version"]).code == 0:
                return program
        except DockerError:
            continue
    raise DockerError(
        "neither `docker compose` nor docker-compose here: apt-get install docker-compose;"
        f" {ON_DEBIAN}"
    )


def _start(command: Sequence[str], output: int) -> "subprocess.Popen[bytes]":
    try:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except FileNotFoundError:
        raise DockerError(
            f"no program {command[0]} here: install Docker, docs.docker.com/engine/install;"
            f" {ON_DEBIAN}"
        ) from None


def _check_limits(command: Sequence[str], stop: Callable[[], bool], until_s: float) -> None:
    if stop():
        raise DockerError(f"stopped during {shlex.join(command[:4])} ...")
    if time.monotonic() > until_s:
        raise DockerError(f"no end of {shlex.join(command[:4])} ... in time; is Docker well?")
