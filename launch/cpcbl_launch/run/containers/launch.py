"""Starts a team in containers for `up`, which follows it as it follows processes; or an observer.

An observer has a container of its own, beside a team that runs anywhere.
"""

import re
import secrets
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec
from rich.console import Console

from cpcbl_agents.clock import Clock
from cpcbl_launch.run.containers import compose, docker
from cpcbl_launch.run.containers.fleet import ContainerSupervisor, Project
from cpcbl_launch.run.observer import presets
from cpcbl_launch.run.processes import Processes, tasks
from cpcbl_launch.run.up import Run, Stop, local_endpoint, require_keys
from cpcbl_launch.team.file import save_resolved
from cpcbl_team.config import Team
from cpcbl_transport.bus import Bus
from cpcbl_transport.security import Identity, Link, credentials_in, link_of
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
SENSOR_INSIDE = "/team/sensor.toml"
TOKENS_INSIDE = "/team/gateway-tokens.json"
RECORD_INSIDE = "/team/recording"
POLL_S = 0.1


class InContainers:
    """A container each for the router, the field, and every robot."""

    def __init__(
        self,
        run: Run,
        folder: Path,
        stop: Stop,
        image: str | None,
        base: str,
        print_line: docker.PrintLine,
    ) -> None:
        """`image`: the one to use; None: of these sources, on `base`. Raises DockerError."""
        self._here = run.team.robots if run.here is None else run.here
        require_keys(run.team, run.team.transport.listen, self._here)
        docker.check_daemon()
        program = docker.compose_program()
        self._run, self._folder, self._stop, self._print_line = run, folder, stop, print_line
        if image is not None:
            otherwise = "leave --image out to build one of these sources"
            docker.fetch_image(image, stop, print_line, otherwise)
        extras = compose.extras_of(run.team)
        self._image = image or docker.ensure_image(base, stop, print_line, extras)
        self.lead_s = LEAD_S + LEAD_S_A_CONTAINER * len(self._here)
        self._file = folder / "compose.yaml"
        name = re.sub(r"[^a-z0-9_-]", "-", run.team.name.lower())
        self._project = Project(program, f"cpcbl-{name}-{secrets.token_hex(3)}", self._file)

    @contextmanager
    def router(self) -> Iterator[Bus]:
        """Takes everything down at the end, however it ends."""
        team_file = self._folder / "team.json"
        save_resolved(team_in_containers(self._run.team), team_file)
        team_file.chmod(0o644)
        self._write("")
        number, project = len(self._here), self._project.name
        self._print_line(f"starting {number} robots in containers: project {project}")
        here = [local_endpoint(self._run.team.transport.listen[0])]
        link = link_of(self._run.team, Identity(Role.OPERATOR), here)
        try:
            began_s = time.monotonic()
            self._project.up("router")
            with self._open_session(link) as bus:
                routers = ROUTERS + ROUTERS_A_CONTAINER * len(self._here)
                self.lead_s = max(self.lead_s, routers * (time.monotonic() - began_s))
                yield bus
        finally:
            try:  # also when nobody reads the output any more
                self._print_line("taking the containers down")
                if self._run.folder is not None:
                    self._project.save_logs(self._folder)
            finally:
                self._project.down()

    def _open_session(self, link: Link) -> ZenohBus:
        until_s = time.monotonic() + ROUTER_WITHIN_S

        def give_up() -> bool:
            return self._stop() or time.monotonic() > until_s

        try:
            return open_bus(self._run.team.name, link.endpoints, give_up, link.credentials)
        except BusError as error:
            printed = f"the router's container printed: {self._project.last_log_line('router')}"
            raise docker.DockerError(f"{error}; {printed}") from error

    @contextmanager
    def processes(self, clock: Clock) -> Iterator[Processes]:
        self._write(str(clock))
        self._project.up()
        rows = tasks(self._run.team, "", (), self._run.seed, self._here)
        gateway = ["gateway"] if self._run.team.gateway else []
        names = ["router", *(row.name for row in rows), *gateway]
        yield ContainerSupervisor(self._project, names)

    def _write(self, clock: str) -> None:
        run, team, transport = self._run, self._run.team, self._run.team.transport
        mounts = [compose.Mount(str((self._folder / "team.json").resolve()), INSIDE)]
        if _replays(team):
            mounts.append(compose.Mount(str(Path(team.data).resolve()), DATA_INSIDE))
        tokens = None if team.gateway is None else Path(team.gateway.tokens).resolve()
        record = None if run.record_folder is None else recording_mount(run.record_folder)
        how = compose.Deployment(
            INSIDE,
            self._image,
            published=tuple(map(published_router, transport.listen)),
            mounts=tuple(mounts),
            keys=compose.Mount(transport.keys, KEYS_INSIDE) if transport.secured else None,
            record=record,
            tokens=None if tokens is None else compose.Mount(str(tokens), TOKENS_INSIDE),
            tokens_owner="" if tokens is None else compose.token_owner(team),
            user=compose.user_of(team, Identity(Role.ROUTER), record),
            seed=run.seed,
            speed=run.speed,
            clock=clock,
            here=self._here,
        )
        self._file.write_text(compose.compose_text(team, how), encoding="utf-8")


def line_printer(console: Console) -> docker.PrintLine:
    """Says what is being done, for people."""
    return lambda line: console.print(
        line, style="dim", markup=False, highlight=False, soft_wrap=True
    )


def team_in_containers(team: Team) -> Team:
    """The team as containers see it: a log's folder, keys and tokens are where they are mounted."""
    if _replays(team):
        team = msgspec.structs.replace(team, data=DATA_INSIDE)
    if team.transport.secured:
        transport = msgspec.structs.replace(team.transport, keys=KEYS_INSIDE)
        team = msgspec.structs.replace(team, transport=transport)
    if team.recording.folder:  # the commands name the folder inside
        recording = msgspec.structs.replace(team.recording, folder="")
        team = msgspec.structs.replace(team, recording=recording)
    if team.gateway is not None:
        gateway = msgspec.structs.replace(team.gateway, tokens=TOKENS_INSIDE)
        team = msgspec.structs.replace(team, gateway=gateway)
    return team


def recording_mount(folder: Path) -> compose.Mount:
    """The folder that is recorded into, as robots in containers find it."""
    return compose.Mount(str(folder.resolve()), RECORD_INSIDE, is_writable=True)


def published_router(endpoint: str) -> str:
    """[address:]port of this machine for an endpoint of the router. Raises InputError."""
    address, _, port = endpoint.partition("/")[2].rpartition(":")
    return compose.published_port("transport.listen", address, port)


def _replays(team: Team) -> bool:
    return any(robot.source == "mrclam" for robot in team.robots.values())


# An observer ------------------------------------------------------------------------------------


def run_observer_container(
    name: str,
    team: Team,
    sensor: str,
    arguments: Sequence[str],
    image: str,
    stop: Stop,
    record: Path | None = None,
) -> int:
    """Runs `cpcbl-team observer TEAM NAME ARGUMENTS` in a container until it ends or `stop()`.

    `sensor` is a preset or a file, which the container then reads; `record` the folder that it
    records into. The container shares this
    machine's network, so that endpoints stay what they are, and this process's output. Returns its
    exit code. Raises DockerError, or SecurityError without the observer's keys.
    """
    docker.check_daemon()
    with tempfile.TemporaryDirectory(prefix="cpcbl-") as folder:
        team_file = Path(folder) / "team.json"
        save_resolved(team_in_containers(team), team_file)
        team_file.chmod(0o644)
        mounts = [compose.Mount(str(team_file), INSIDE), *mounts_of_keys(name, team)]
        if sensor not in presets():
            mounts.append(compose.Mount(str(Path(sensor).resolve()), SENSOR_INSIDE))
            sensor = SENSOR_INSIDE
        container = f"cpcbl-{name}-{secrets.token_hex(3)}"
        inner = ["observer", INSIDE, name, f"--sensor={sensor}", *arguments]
        recording = None if record is None else recording_mount(record)
        if recording is not None:
            mounts.append(recording)
            inner.append(f"--record={RECORD_INSIDE}")
        user = compose.user_of(team, Identity(Role.OBSERVER, name), recording)
        command = docker_run(container, image, mounts, user, inner)
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        try:
            while process.poll() is None and not stop():
                time.sleep(POLL_S)
        finally:
            _stop_container(process, container)
        return process.returncode


def _stop_container(process: "subprocess.Popen[bytes]", container: str) -> None:
    """Stops the container until it ends: what is not there yet cannot be stopped."""
    while process.poll() is None:
        docker.run_command(["docker", "stop", "--time", "3", container])
        with suppress(subprocess.TimeoutExpired):
            process.wait(POLL_S)


def docker_run(
    container: str, image: str, mounts: Sequence[compose.Mount], user: str, inner: Sequence[str]
) -> list[str]:
    """The command: read-only, without rights, gone when it ends."""
    return [
        *("docker", "run", "--rm", "--init", "--name", container, "--network", "host"),
        *("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"),
        *("--security-opt", "no-new-privileges:true"),
        *(("--user", user) if user else ()),
        *(part for m in mounts for part in ("--volume", _volume(m))),
        image,
        *inner,
    ]


def _volume(mount: compose.Mount) -> str:
    return f"{mount.source}:{mount.target}" + ("" if mount.is_writable else ":ro")


def mounts_of_keys(name: str, team: Team) -> list[compose.Mount]:
    """The observer's own, and nobody else's. Raises SecurityError without them."""
    if not team.transport.secured:
        return []
    identity = Identity(Role.OBSERVER, name)
    credentials_in(Path(team.transport.keys), identity)
    own = Path(team.transport.keys).resolve() / str(identity)
    return [compose.Mount(str(own), f"{KEYS_INSIDE}/{identity}")]
