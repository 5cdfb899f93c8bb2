"""What `doctor` looks at: the facts of this machine, of a team file, and of a router."""

import importlib.metadata
import importlib.util
import platform
import socket
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

import msgspec

from cpcbl_launch.run.containers.docker import DockerError, check_daemon
from cpcbl_launch.team.checks import warnings
from cpcbl_launch.team.file import TeamFileError, find_team
from cpcbl_launch.views.listening import TeamHeard, listen
from cpcbl_team.config import Team, TransportSettings
from cpcbl_team.errors import CpcblError
from cpcbl_transport.security import CERTIFICATE, Identity, Link, SecurityError, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import BusError, open_bus

PACKAGES = ("cpcbl-team", "eclipse-zenoh", "msgspec", "numpy")
EXTRAS = {"camera": "cv2", "plot": "matplotlib", "security": "cryptography"}
CONNECT_S = 1.0


class EndpointFacts(msgspec.Struct, frozen=True, kw_only=True):
    """What answers at an endpoint."""

    endpoint: str
    answer: str
    """open, refused, unknown host, or silent: nothing came back in a second."""


class CertificateFile(msgspec.Struct, frozen=True, kw_only=True):
    """A certificate in the team's key folder."""

    who: str
    file: str
    valid_until: datetime | None  # None: it cannot be read


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """All that the checks judge."""

    now: datetime
    python: str
    packages: dict[str, str]  # name -> version, empty where it is not installed
    extras: dict[str, bool]
    docker: str = ""  # why there is none
    file: str = ""
    file_problems: tuple[str, ...] = ()
    file_warnings: tuple[str, ...] = ()
    team: Team | None = None
    endpoints: tuple[EndpointFacts, ...] = ()
    link_problem: str = ""  # of keys or endpoints of a secured team
    router_problem: str = ""  # why there is no session; empty: there is one
    heard: dict[str, TeamHeard] = {}
    seconds: float = 0.0  # of listening
    certificates: tuple[CertificateFile, ...] = ()
    missing_frames: dict[str, str] = {}  # robot -> its camera, which is not here


def gather(
    path: Path | None,
    connect: Sequence[str] | None,
    seconds: float,
    wait_s: float,
    stop: Callable[[], bool],
) -> Facts:
    """The facts; waits `wait_s` for a router, and listens for so many seconds."""
    team, problems = None, tuple[str, ...]()
    if path is not None:
        try:
            team = find_team(path)
        except TeamFileError as error:
            problems = tuple(str(error).splitlines())
    machine = Facts(
        now=datetime.now().astimezone(),
        python=platform.python_version(),
        packages={name: _version(name) for name in PACKAGES},
        extras={name: importlib.util.find_spec(m) is not None for name, m in EXTRAS.items()},
        docker=_docker_problem(),
        file="" if path is None else str(path),
        file_problems=problems,
        file_warnings=tuple(warnings(team)) if team else (),
        team=team,
        certificates=_certificates(team),
        missing_frames=_missing_frames(team),
        seconds=seconds,
    )
    if problems:
        return machine
    return _with_router(machine, team, connect, wait_s, stop)


def _with_router(
    facts: Facts,
    team: Team | None,
    connect: Sequence[str] | None,
    wait_s: float,
    stop: Callable[[], bool],
) -> Facts:
    """The facts with what the router lets hear."""
    endpoints = tuple(connect or (team.transport if team else TransportSettings()).connect)
    answers = tuple(EndpointFacts(endpoint=e, answer=tcp_answer(e)) for e in endpoints)
    facts = msgspec.structs.replace(facts, endpoints=answers)
    try:
        link = Link(endpoints) if team is None else link_of(team, _OPERATOR, endpoints)
    except SecurityError as error:
        return msgspec.structs.replace(facts, link_problem=str(error))
    until_s = time.monotonic() + wait_s
    # Access control lets an operator of a secured team hear its own team only
    own = team.name if team is not None and team.transport.secured else ""
    try:
        with open_bus(
            own, link.endpoints, lambda: stop() or time.monotonic() > until_s, link.credentials
        ) as bus:
            heard = listen(bus, facts.seconds, stop, own)
    except BusError as error:
        return msgspec.structs.replace(facts, router_problem=str(error))
    return msgspec.structs.replace(facts, heard=heard)


_OPERATOR = Identity(Role.OPERATOR)


def tcp_answer(endpoint: str) -> str:
    """open, refused, unknown host or silent."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
    except socket.gaierror:
        return "unknown host"
    except ConnectionRefusedError:
        return "refused"
    except (OSError, ValueError, OverflowError):
        return "silent"
    return "open"


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _docker_problem() -> str:
    try:
        check_daemon()
    except (DockerError, OSError) as error:
        return str(error)
    return ""


def _certificates(team: Team | None) -> tuple[CertificateFile, ...]:
    """The certificates below the team's key folder; none where they cannot be read here."""
    if team is None or not team.transport.secured:
        return ()
    folder = Path(team.transport.keys)
    return tuple(
        CertificateFile(
            who=str(path.parent.relative_to(folder)), file=str(path), valid_until=_valid_until(path)
        )
        for path in sorted(folder.rglob(CERTIFICATE))
    )


def _valid_until(path: Path) -> datetime | None:
    try:
        from cpcbl_launch.keys.authority import certificate_facts

        return certificate_facts(path.read_bytes()).not_after
    except (CpcblError, OSError):
        return None


def _missing_frames(team: Team | None) -> dict[str, str]:
    """Robots whose camera is a device or a file that this machine does not have."""
    missing = {}
    for name in team.cameras if team else ():
        assert team is not None
        where = team.robots[name].camera.frames
        device = f"/dev/video{where}" if where.isdecimal() else where
        if where and "://" not in where and not Path(device).exists():
            missing[name] = device
    return missing
