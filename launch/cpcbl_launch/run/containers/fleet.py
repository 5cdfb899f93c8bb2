"""The containers of a run: as the supervisor does for processes, watched and started again."""

import json
import logging
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cpcbl_launch.run.containers.docker import DockerError, command_output, run_command

log = logging.getLogger(__name__)

LOOK_S = 1.0
LONGEST_START_S = 120.0
PROJECT_LABEL = "com.docker.compose.project"
SERVICE_LABEL = "com.docker.compose.service"


class Container(NamedTuple):
    """What Docker says of one."""

    id: str
    running: bool
    restarting: bool  # Docker waits a moment before it starts it again
    pid: int  # on this machine; of its init
    code: int
    started_at: str
    restarts: int  # by Docker itself, since it was last started by hand


def containers_by_service(inspected: Sequence[Mapping[str, Any]]) -> dict[str, Container]:
    """Service -> container, of what `docker inspect` says."""
    found = {}
    for c in inspected:
        state = c["State"]
        running, restarting = state["Running"], state["Restarting"]
        process = state["Pid"], state["ExitCode"], state["StartedAt"]
        found[c["Config"]["Labels"][SERVICE_LABEL]] = Container(
            c["Id"], running and not restarting, restarting, *process, c["RestartCount"]
        )
    return found


def restarts_between(before: Container, now: Container) -> int:
    """How often it was started from one look to the next."""
    if (now.id, now.started_at) == (before.id, before.started_at):
        return 0
    return max(1, now.restarts - before.restarts)


class Project:
    """A compose file that is brought up step by step, and taken down as a whole."""

    def __init__(self, program: Sequence[str], name: str, file: Path) -> None:
        self.name = name
        self._compose = [*program, "--project-name", name, "--file", str(file)]

    def up(self, *services: str) -> None:
        """Creates and starts what does not run. Raises DockerError."""
        command = [*self._compose, "up", "--detach", "--no-build", "--no-recreate", *services]
        command_output(command, timeout_s=LONGEST_START_S)

    def down(self) -> None:
        """Stops and removes all containers and networks; it logs what is left over."""
        command = [*self._compose, "down", "--timeout", "3", "--volumes", "--remove-orphans"]
        try:
            command_output(command, timeout_s=LONGEST_START_S)
        except DockerError as error:
            log.error("containers of project %s may be left: %s", self.name, error)

    def containers(self) -> dict[str, Container]:
        """Service -> container, those that stand still too. Raises DockerError."""
        label = f"label={PROJECT_LABEL}={self.name}"
        command = ["docker", "ps", "--all", "--quiet", "--no-trunc", "--filter", label]
        ids = command_output(command).split()
        inspected = json.loads(command_output(["docker", "inspect", *ids])) if ids else []
        return containers_by_service(inspected)

    def last_log_line(self, service: str) -> str:
        """The last line that a container wrote."""
        container = self.containers().get(service)
        if container is None:
            return "nothing"
        return run_command(["docker", "logs", container.id]).last_line

    def save_logs(self, folder: Path) -> None:
        """The output of every container, as SERVICE.log."""
        for service, container in self.containers().items():
            logs = run_command(["docker", "logs", container.id])
            (folder / f"{service}.log").write_text(logs.output, encoding="utf-8")


class ContainerSupervisor:
    """The containers of a project. Docker starts again what crashes; what was killed or removed by
    hand it leaves, so that is done here.
    """

    def __init__(self, project: Project, names: Sequence[str]) -> None:
        self._project, self.names = project, list(names)
        self._now: dict[str, Container] = {}
        self._last: dict[str, Container] = {}
        self._restarts: Counter[str] = Counter()
        self._next_s = 0.0

    @property
    def pids(self) -> dict[str, int]:
        return {name: c.pid for name, c in self._now.items() if c.running}

    @property
    def restarts(self) -> dict[str, int]:
        return dict(self._restarts)

    def watch(self) -> None:
        """To be called several times a second; looks once a second."""
        if time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + LOOK_S
        try:
            self._look()
        except (DockerError, json.JSONDecodeError) as error:
            log.warning("containers: %s", error)

    def _look(self) -> None:
        self._now = self._project.containers()
        for name, container in self._now.items():
            if new := restarts_between(self._last.get(name, container), container):
                self._restarts[name] += new
                log.warning("container %s was started again", name)
        self._last |= self._now
        down = []
        for name in self.names:
            if (now := self._now.get(name)) is None:
                log.warning("container %s is gone", name)
                down.append(name)
            elif not now.running and not now.restarting:
                log.warning("container %s ended (%d)", name, now.code)
                down.append(name)
        if down:
            self._project.up(*down)
