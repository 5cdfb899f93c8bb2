"""Docker's command line and the image that all containers of a team use.

Commands are started in sessions of their own, so that Ctrl-C reaches only us, and are ended when
they take too long or the user wants to stop.
"""

import hashlib
import os
import platform
import re
import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from cpcbl_launch.run.containers import BASE_VARIABLE
from cpcbl_team.errors import CpcblError

ON_DEBIAN = "docker/dockerd.sh start installs and starts what is missing on Debian"  # in a checkout
POLL_S = 0.05
NAME = "cpcbl-team"
DOCKERFILE = Path("docker/Dockerfile")
SOURCES = (
    *("pyproject.toml", "README.md", "LICENSE", "docker/Dockerfile", "docker/linked"),
    *("cpcbl_team", "transport", "agents", "launch"),
)
"""What goes into the image, from the top of the checkout; .dockerignore lets in the same."""
BUILD_TIMEOUT_S = 1800.0

PrintLine = Callable[[str], None]


class DockerError(CpcblError):
    """Docker cannot do it; the text says why in one line, and what to do."""


class CommandResult(NamedTuple):
    """A command that has ended."""

    code: int
    output: str  # standard output and standard error, as they came

    @property
    def last_line(self) -> str:
        lines = self.output.strip().splitlines()
        return lines[-1].strip() if lines else "it printed nothing"

    @property
    def problem(self) -> str:
        """The line that says what went wrong: one that begins with error, or the last of all."""
        found = re.search(r"^\s*error\b.*$", self.output, re.IGNORECASE | re.MULTILINE)
        return found[0].strip() if found else self.last_line


def never_stop() -> bool:
    return False


def run_command(
    command: Sequence[str],
    stop: Callable[[], bool] = never_stop,
    print_line: PrintLine = lambda line: None,
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
                    began = f"{shlex.join(command[:4])} ..."
                    if stop():
                        raise DockerError(f"stopped during {began}")
                    if time.monotonic() > until_s:
                        raise DockerError(f"no end of {began} in time; is Docker well?")
                    time.sleep(POLL_S)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    return CommandResult(process.returncode, received.decode(errors="replace"))


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
            f"no program {command[0]} here: install Docker, docs.docker.com/engine/install"
            f"{_on_debian()}"
        ) from None


def _on_debian() -> str:
    return "" if checkout() is None else f"; {ON_DEBIAN}"


def command_output(
    command: Sequence[str],
    stop: Callable[[], bool] = never_stop,
    print_line: PrintLine = lambda line: None,
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
        if "permission denied" in answer.last_line:
            raise DockerError(
                "this user may not use Docker: permission denied at its socket; add the user to the"
                " group docker, and log in anew"
            )
        raise DockerError(f"no Docker daemon answers ({answer.last_line}); start it{_on_debian()}")
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
        "neither `docker compose` nor docker-compose here: apt-get install docker-compose"
        f"{_on_debian()}"
    )


# The image: named after what it is built from ---------------------------------------------------


def version() -> str:
    return metadata.version(NAME)


def checkout() -> Path | None:
    """The top of the checkout that this program runs from; None: it was installed without one."""
    top = Path(__file__).parents[4]
    return top if (top / DOCKERFILE).exists() else None


def tag(top: Path, base: str, extras: str = "") -> str:
    """cpcbl-team:VERSION-HASH, of the sources, the recipe, the base's name and the extras."""
    content = hashlib.sha256(f"{base} {extras}".encode())
    for path in _source_files(top):
        content.update(f"\n{path.relative_to(top)}\n".encode())
        content.update(path.read_bytes())
    return f"{NAME}:{version()}-{content.hexdigest()[:12]}"


def _source_files(top: Path) -> Iterator[Path]:
    for source in SOURCES:
        for path in (top / source, *sorted((top / source).rglob("*"))):
            if path.is_file() and "__pycache__" not in path.parts:
                yield path


def ensure_image(
    base: str, stop: Callable[[], bool], print_line: PrintLine, extras: str = ""
) -> str:
    """The name of an image of this very program with these extras, built where there is none yet.

    Raises DockerError.
    """
    top = checkout()
    if top is None:
        raise DockerError(
            "the image is built from a checkout, and this program was installed without one; name"
            " one that you have: --image NAME"
        )
    name = tag(top, base, extras)
    if not has_image(name):
        without_registry = f"docker/base-image.sh, then {BASE_VARIABLE}=cpcbl-base"
        fetch_image(base, stop, print_line, f"without a registry of images: {without_registry}")
        print_line(f"building image {name} on {base}, once for these sources")
        arguments = ("--build-arg", f"BASE_IMAGE={base}", "--build-arg", f"EXTRAS={extras}")
        command = ["docker", "build", "--force-rm", "--tag", name, *arguments]
        command += ["--file", str(top / DOCKERFILE), str(top)]

        def print_step(line: str) -> None:
            if step := build_step(line):
                print_line(step)

        command_output(command, stop, print_step, BUILD_TIMEOUT_S)
    return name


def has_image(image: str) -> bool:
    """Whether the daemon has an image."""
    return run_command(["docker", "image", "inspect", "--format", "{{.Id}}", image]).code == 0


def fetch_image(
    image: str, stop: Callable[[], bool], print_line: PrintLine, otherwise: str
) -> None:
    """Fetches an image that is not there. Raises DockerError, with what to do `otherwise`."""
    if has_image(image):
        return
    print_line(f"fetching image {image}")
    fetched = run_command(["docker", "pull", "--quiet", image], stop, timeout_s=BUILD_TIMEOUT_S)
    if fetched.code:
        raise DockerError(f"no image {image} ({fetched.problem}); {otherwise}")


def build_step(line: str) -> str | None:
    """Of all that a builder says (the classic one, or BuildKit) the lines that begin a step."""
    step = re.match(r"(?:Step (\d+/\d+) :|#\d+ \[.*?(\d+/\d+)\]) (.+)", line)
    return f"  {step[1] or step[2]} {step[3]}"[:78] if step else None
