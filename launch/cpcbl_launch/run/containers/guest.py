"""An observer in a container of its own, beside a team that runs anywhere."""

import secrets
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from cpcbl_launch.run.containers.compose import Mount
from cpcbl_launch.run.containers.deployment import key_owner
from cpcbl_launch.run.containers.docker import check_daemon, run_command
from cpcbl_launch.run.containers.launch import INSIDE, KEYS_INSIDE, team_in_containers
from cpcbl_launch.run.observer import presets
from cpcbl_launch.team_file import save_resolved
from cpcbl_team.config import Team
from cpcbl_transport.security import Identity, credentials_in
from cpcbl_transport.topics import Role

SENSOR_INSIDE = "/team/sensor.toml"
POLL_S = 0.1


def run_observer_container(
    name: str,
    team: Team,
    sensor: str,
    arguments: Sequence[str],
    image: str,
    stop: Callable[[], bool],
) -> int:
    """Runs `cpcbl-team observer NAME ARGUMENTS` in a container until it ends or `stop()`.

    `sensor` is a preset or a file, which the container then reads. The container shares this
    machine's network, so that endpoints stay what they are, and this process's output. Returns its
    exit code. Raises DockerError, or SecurityError without the observer's keys.
    """
    check_daemon()
    with tempfile.TemporaryDirectory(prefix="cpcbl-") as folder:
        team_file = Path(folder) / "team.json"
        save_resolved(team_in_containers(team), team_file)
        team_file.chmod(0o644)
        mounts = [Mount(str(team_file), INSIDE), *mounts_of_keys(name, team)]
        if sensor not in presets():
            mounts.append(Mount(str(Path(sensor).resolve()), SENSOR_INSIDE))
            sensor = SENSOR_INSIDE
        container = f"cpcbl-{name}-{secrets.token_hex(3)}"
        inner = ["observer", name, "--team", INSIDE, f"--sensor={sensor}", *arguments]
        user = key_owner(team, Identity(Role.OBSERVER, name))
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
        run_command(["docker", "stop", "--time", "3", container])
        with suppress(subprocess.TimeoutExpired):
            process.wait(POLL_S)


def docker_run(
    container: str, image: str, mounts: Sequence[Mount], user: str, inner: Sequence[str]
) -> list[str]:
    """The command: read-only, without rights, gone when it ends."""
    return [
        *("docker", "run", "--rm", "--init", "--name", container, "--network", "host"),
        *("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"),
        *("--security-opt", "no-new-privileges:true"),
        *(("--user", user) if user else ()),
        *(part for m in mounts for part in ("--volume", f"{m.source}:{m.target}:ro")),
        image,
        *inner,
    ]


def mounts_of_keys(name: str, team: Team) -> list[Mount]:
    """The observer's own, and nobody else's. Raises SecurityError without them."""
    if not team.transport.secured:
        return []
    identity = Identity(Role.OBSERVER, name)
    credentials_in(Path(team.transport.keys), identity)
    own = Path(team.transport.keys).resolve() / str(identity)
    return [Mount(str(own), f"{KEYS_INSIDE}/{identity}")]
