"""`observer --container`: the same command in a container on this machine's network."""

import re
import secrets
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from cpcbl_launch.containers.compose import Mount
from cpcbl_launch.containers.docker import Said, check_daemon, ran
from cpcbl_launch.containers.image import image_for
from cpcbl_launch.containers.launch import INSIDE, KEYS_INSIDE, inside
from cpcbl_launch.team_file import save_resolved
from cpcbl_team.config import Team
from cpcbl_transport.security import Identity, credentials_in
from cpcbl_transport.topics import Role

SENSOR_INSIDE = "/team/sensor.toml"
LEAVES_WITHIN_S = 10.0


def run_observer(
    team: Team,
    name: str,
    sensor: str,
    options: Sequence[str],
    image: str,
    stop: Callable[[], bool],
) -> int:
    """Runs an observer of `team` in a container until it leaves or `stop()`; its exit code.

    `sensor`: a preset or a file; `options`: all others of the command, without the team's.
    Raises DockerError, SecurityError.
    """
    with tempfile.TemporaryDirectory(prefix="cpcbl-") as folder:
        team_file = Path(folder) / "team.json"
        save_resolved(inside(team), team_file)
        team_file.chmod(0o644)
        mounts, user = [Mount(str(team_file), INSIDE)], ""
        if team.transport.secured:
            keys, user = own_keys(team, Identity(Role.OBSERVER, name))
            mounts.append(keys)
        if Path(sensor).exists():
            mounts.append(Mount(str(Path(sensor).resolve()), SENSOR_INSIDE))
            sensor = SENSOR_INSIDE
        container = container_name(team, name)
        arguments = ["observer", name, "--team", INSIDE, f"--sensor={sensor}", *options]
        return _followed(docker_run(image, container, mounts, user, arguments), container, stop)


def have_image(image: str | None, base: str, stop: Callable[[], bool], said: Said) -> str:
    """`image`, or the one of these sources on `base`. Raises DockerError."""
    check_daemon()
    return image or image_for(base, stop, said)


def docker_run(
    image: str, container: str, mounts: Sequence[Mount], user: str, arguments: Sequence[str]
) -> list[str]:
    """The command for one confined container that is gone when it ends."""
    command = ["docker", "run", "--rm", "--init", "--name", container, "--network", "host"]
    command += ["--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"]
    command += ["--security-opt", "no-new-privileges"]
    for mount in mounts:
        fields = ("type=bind", f"source={mount.source}", f"target={mount.target}", "readonly")
        command += ["--mount", ",".join(map(_quoted, fields))]
    if user:
        command += ["--user", user]
    return [*command, image, *arguments]


def own_keys(team: Team, identity: Identity) -> tuple[Mount, str]:
    """A member's own folder of keys, and uid:gid of who alone can read it."""
    folder = Path(team.transport.keys)
    owner = Path(credentials_in(folder, identity).private_key).stat()
    mount = Mount(str((folder / str(identity)).resolve()), f"{KEYS_INSIDE}/{identity}")
    return mount, f"{owner.st_uid}:{owner.st_gid}"


def container_name(team: Team, name: str) -> str:
    return re.sub(r"[^a-z0-9_.-]", "-", f"cpcbl-{team.name}-{name}-{secrets.token_hex(3)}".lower())


def _quoted(field: str) -> str:
    """A field of the comma-separated values that `--mount` takes."""
    return '"' + field.replace('"', '""') + '"'


def _followed(command: Sequence[str], container: str, stop: Callable[[], bool]) -> int:
    """Runs a container in the foreground; what it says goes where what we say goes."""
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        while process.poll() is None and not stop():
            time.sleep(0.05)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)  # docker hands it on
        return process.wait(LEAVES_WITHIN_S)
    finally:
        ran(["docker", "rm", "--force", container])
        process.kill()
        process.wait()
