"""Starts a team in containers for `up`, which follows it as it follows processes."""

import re
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
from rich.console import Console

from cpcbl_agents.clock import Clock
from cpcbl_launch.run.containers.compose import Deployment, Mount, compose_text, extras_of
from cpcbl_launch.run.containers.deployment import key_owner
from cpcbl_launch.run.containers.docker import DockerError, PrintLine, check_daemon, compose_program
from cpcbl_launch.run.containers.fleet import ContainerSupervisor, Project
from cpcbl_launch.run.containers.image import ensure_image, fetch_image
from cpcbl_launch.run.processes import tasks
from cpcbl_launch.run.supervisor import Processes
from cpcbl_launch.run.up import Run, local_endpoint, require_keys
from cpcbl_launch.team_file import save_resolved
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport.bus import Bus
from cpcbl_transport.security import Identity, Link, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import BusError, ZenohBus, open_bus

LEAD_S = 4.0
LEAD_S_A_CONTAINER = 0.5
ROUTERS, ROUTERS_A_CONTAINER = 3.0, 0.8
"""The same in times that the router took: on a busy machine all take as much longer."""
ROUTER_WITHIN_S = 60.0
INSIDE = "/team/team.json"
DATA_INSIDE = "/team/data"
KEYS_INSIDE = "/team/keys"


class InContainers:
    """A container each for the router, the field, and every robot."""

    def __init__(
        self,
        run: Run,
        folder: Path,
        stop: Callable[[], bool],
        image: str | None,
        base: str,
        print_line: PrintLine,
    ) -> None:
        """`image`: the one to use; None: of these sources, on `base`. Raises DockerError."""
        self._here = run.team.robots if run.here is None else run.here
        require_keys(run.team, run.team.transport.listen, self._here)
        check_daemon()
        program = compose_program()
        self._run, self._folder, self._stop, self._print_line = run, folder, stop, print_line
        if image is not None:
            fetch_image(image, stop, print_line, "leave --image out to build one of these sources")
        self._image = image or ensure_image(base, stop, print_line, extras_of(run.team))
        self.lead_s = LEAD_S + LEAD_S_A_CONTAINER * len(self._here)
        self._file = folder / "compose.yaml"
        name = f"{_project_name(run.team)}-{secrets.token_hex(3)}"
        self._project = Project(program, name, self._file)

    @contextmanager
    def router(self) -> Iterator[Bus]:
        """Takes everything down at the end, however it ends."""
        team_file = self._folder / "team.json"
        save_resolved(team_in_containers(self._run.team), team_file)
        team_file.chmod(0o644)
        self._write("")
        self._print_line(
            f"starting {len(self._here)} robots in containers: project {self._project.name}"
        )
        team = self._run.team
        here = [local_endpoint(team.transport.listen[0])]
        link = link_of(team, Identity(Role.OPERATOR), here)
        try:
            began_s = time.monotonic()
            self._project.up("router")
            with self._open_session(link) as bus:
                routers = ROUTERS + ROUTERS_A_CONTAINER * len(self._here)
                self.lead_s = max(self.lead_s, routers * (time.monotonic() - began_s))
                yield bus
        finally:
            self._end()

    def _open_session(self, link: Link) -> ZenohBus:
        until_s = time.monotonic() + ROUTER_WITHIN_S

        def give_up() -> bool:
            return self._stop() or time.monotonic() > until_s

        try:
            return open_bus(self._run.team.name, link.endpoints, give_up, link.credentials)
        except BusError as error:
            last_line = self._project.last_log_line("router")
            raise DockerError(f"{error}; the router's container printed: {last_line}") from error

    @contextmanager
    def processes(self, clock: Clock) -> Iterator[Processes]:
        self._write(str(clock))
        self._project.up()
        rows = tasks(self._run.team, (), self._run.seed, self._here)
        yield ContainerSupervisor(self._project, ["router", *(row.name for row in rows)])

    def _end(self) -> None:
        try:  # also when nobody reads the output any more
            self._print_line("taking the containers down")
            if self._run.folder is not None:
                self._project.save_logs(self._folder)
        finally:
            self._project.down()

    def _write(self, clock: str) -> None:
        run, endpoints = self._run, self._run.team.transport.listen
        how = Deployment(
            INSIDE,
            self._image,
            published=tuple(published_port(endpoint) for endpoint in endpoints),
            mounts=(Mount(str((self._folder / "team.json").resolve()), INSIDE), *_data(run.team)),
            keys=_keys(run.team),
            user=key_owner(run.team, Identity(Role.ROUTER)),
            seed=run.seed,
            speed=run.speed,
            clock=clock,
            here=self._here,
        )
        self._file.write_text(compose_text(run.team, how), encoding="utf-8")


def line_printer(console: Console) -> PrintLine:
    """Says what is being done, for people."""
    return lambda line: console.print(
        line, style="dim", markup=False, highlight=False, soft_wrap=True
    )


def team_in_containers(team: Team) -> Team:
    """The team as containers see it: a log's folder and keys are where they are mounted."""
    if _replays(team):
        team = msgspec.structs.replace(team, data=DATA_INSIDE)
    if team.transport.secured:
        transport = msgspec.structs.replace(team.transport, keys=KEYS_INSIDE)
        team = msgspec.structs.replace(team, transport=transport)
    return team


def published_port(endpoint: str) -> str:
    """[address:]port of this machine for an endpoint; all addresses for 0.0.0.0 and [::].

    Raises InputError for a name, at which Docker cannot publish.
    """
    address, _, port = endpoint.partition("/")[2].rpartition(":")
    if address in ("0.0.0.0", "[::]"):
        return port
    if not re.fullmatch(r"[0-9.]+", address):
        raise InputError(
            f"transport.listen: {endpoint}: Docker publishes at an IPv4 address; write one, or"
            " tcp/0.0.0.0:7447"
        )
    return f"{address}:{port}"


def _data(team: Team) -> tuple[Mount, ...]:
    return (Mount(str(Path(team.data).resolve()), DATA_INSIDE),) if _replays(team) else ()


def _keys(team: Team) -> Mount | None:
    return Mount(team.transport.keys, KEYS_INSIDE) if team.transport.secured else None


def _replays(team: Team) -> bool:
    return any(robot.source == "mrclam" for robot in team.robots.values())


def _project_name(team: Team) -> str:
    return "cpcbl-" + re.sub(r"[^a-z0-9_-]", "-", team.name.lower())
