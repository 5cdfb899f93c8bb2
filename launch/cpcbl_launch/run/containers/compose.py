"""The compose file of a team: plain text for people, read by docker-compose 1.29 and 2, and swarm.

Nothing here is measured or started; what is written is decided by the team and a `Deployment`.
"""

from collections.abc import Collection
from typing import NamedTuple

import yaml

from cpcbl_launch.run.containers import BASE_IMAGE, BASE_VARIABLE
from cpcbl_launch.run.processes import tasks
from cpcbl_team.config import Team
from cpcbl_transport.security import Identity
from cpcbl_transport.topics import Role

PORT = 7447
"""Where the router listens, inside."""


class Mount(NamedTuple):
    """A file or folder of the machine that a container may read."""

    source: str
    target: str


class Deployment(NamedTuple):
    """How a team is put into containers."""

    team_file: str
    """What the commands call it: a built-in team's name, or a path inside the containers."""
    image: str
    context: str | None = None
    """The folder of the sources to build the image from; None: the image is there."""
    published: tuple[str, ...] = (f"127.0.0.1:{PORT}",)
    """Where the router can be reached from outside: [address:]port of this machine."""
    mounts: tuple[Mount, ...] = ()
    keys: Mount | None = None
    """The key folder of a secured team: of it each container may read its own part."""
    user: str = ""
    """uid:gid of all containers, where the image's will not do."""
    seed: int = 1
    speed: float = 1.0
    clock: str = ""
    here: Collection[str] | None = None
    """The robots to start; None: all."""


def compose_text(team: Team, how: Deployment) -> str:
    """The whole compose file: the router, the field if anything is simulated, a service a robot."""
    here = team.robots if how.here is None else how.here
    clock = ("--clock", how.clock) if how.clock else ()
    common = ("--team", how.team_file, "--connect", f"{_scheme(how)}/router:{PORT}", *clock)
    rows = tasks(team, common, how.seed, here)
    parts = [
        _HEAD.format(
            title=_title(team, here),
            image=_flow(how.image),
            user=_user(how.user),
            mounts="" if how.keys else _mounts(how.mounts, ""),
            to=_flow(["CMD", "linked", "to", str(PORT)]),
        ),
        _ROUTER.format(
            build=_build(how.context, extras_of(team)),
            command=_flow(_router(how)),
            keys=_own_mounts(how, Identity(Role.ROUTER)),
            ports=_flow([f"{outside}:{PORT}" for outside in how.published]),
            at=_flow(["CMD", "linked", "at", str(PORT)]),
        ),
        *(
            _SERVICE.format(
                name=row.name, command=_flow(row.arguments), keys=_own_mounts(how, row.identity)
            )
            for row in rows
        ),
    ]
    return "".join(parts)


def _title(team: Team, here: Collection[str]) -> str:
    return f"Team {team.name}: a router,{' the simulated field,' if team.simulated else ''} and" + (
        " one robot" if len(here) == 1 else f" {len(here)} robots"
    )


def _router(how: Deployment) -> list[str]:
    command = ["router", how.team_file, "--listen", f"{_scheme(how)}/0.0.0.0:{PORT}"]
    return command if how.speed == 1.0 else [*command, "--speed", f"{how.speed:g}"]


def _build(context: str | None, extras: str) -> str:
    if context is None:
        return ""
    base = f"${{{BASE_VARIABLE}:-{BASE_IMAGE}}}"
    return _BUILD.format(
        context=_flow(context), base=base, extras=f", EXTRAS: {extras}" if extras else ""
    )


def extras_of(team: Team) -> str:
    """The extras of this program that the containers of a team need."""
    return "camera" if team.cameras else ""


def _scheme(how: Deployment) -> str:
    return "tcp" if how.keys is None else "tls"


def _user(user: str) -> str:
    return (
        f"  user: {_flow(user)} # whose the keys are; nobody else can read them\n" if user else ""
    )


def _own_mounts(how: Deployment, identity: Identity) -> str:
    """What one service may read of a secured team: what all may, and its own keys."""
    if how.keys is None:
        return ""
    own = Mount(f"{how.keys.source}/{identity}", f"{how.keys.target}/{identity}")
    return _mounts((*how.mounts, own), "  ")


def _mounts(mounts: Collection[Mount], indent: str) -> str:
    if not mounts:
        return ""
    lines = [
        _flow({"type": "bind", "source": m.source, "target": m.target, "read_only": True})
        for m in mounts
    ]
    head = f"{indent}  volumes: # on every machine of a swarm\n"
    return head + "".join(f"{indent}    - {line}\n" for line in lines)


def _flow(value: object) -> str:
    """A value on one line, quoted where YAML needs it; compose's own `$` is escaped."""
    text = yaml.safe_dump(
        _plain(value), default_flow_style=True, sort_keys=False, width=float("inf")
    )
    return text.removesuffix("\n").removesuffix("\n...")


def _plain(value: object) -> object:
    match value:
        case str():
            return value.replace("$", "$$")
        case dict():
            return {key: _plain(inner) for key, inner in value.items()}
        case list() | tuple():
            return [_plain(inner) for inner in value]
    return value


_HEAD = """\
# {title}, each in a container.
# Written by `cpcbl-team compose`.
#   docker-compose -f FILE up         or: docker compose -f FILE up
#   docker-compose -f FILE down

x-container: &container
  image: {image}
  read_only: true
  tmpfs: [/tmp]
  cap_drop: [ALL]
  security_opt: ["no-new-privileges:true"]
  init: true
  restart: unless-stopped
  stop_grace_period: 3s
  logging: {{driver: json-file, options: {{max-size: 10m, max-file: "2"}}}}
{user}{mounts}
x-member: &member
  <<: *container
  depends_on: [router]
  healthcheck: # in the kernel's table of sockets; nothing is started in Python
    test: {to}
    interval: 15s

services:
"""

_ROUTER = """\
  router:
    <<: *container
{build}    command: {command}
    ports: {ports}
{keys}    healthcheck:
      test: {at}
      interval: 15s
"""

_BUILD = """\
    build: # of the image that all use
      context: {context}
      dockerfile: docker/Dockerfile
      args: {{BASE_IMAGE: "{base}"{extras}}}
"""

_SERVICE = """
  {name}:
    <<: *member
    command: {command}
{keys}"""
