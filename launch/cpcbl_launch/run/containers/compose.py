"""The compose file of a team: plain text for people, read by docker-compose 1.29 and 2, and swarm.

Nothing here is measured or started; what is written is decided by the team and a `Deployment`.
"""

import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import yaml

from cpcbl_launch.run.containers import BASE_IMAGE, BASE_VARIABLE
from cpcbl_launch.run.containers.docker import NAME, checkout, version
from cpcbl_launch.run.gateway.tokens import tokens_for
from cpcbl_launch.run.processes import tasks
from cpcbl_launch.team.file import parse_team
from cpcbl_team.config import GatewaySettings, Ros2Settings, Team
from cpcbl_team.errors import InputError
from cpcbl_transport.security import Identity, credentials_in
from cpcbl_transport.topics import Role

PORT = 7447  # where the router listens, inside
_SECRET = "gateway-tokens"
LOCAL = ("localhost", "127.0.0.1", "[::1]")


class Mount(NamedTuple):
    """A file or folder of the machine that a container may read."""

    source: str
    target: str
    is_writable: bool = False


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
    record: Mount | None = None
    """The folder that robots record into."""
    tokens: Mount | None = None
    """The gateway's tokens, a secret of its service; None: no gateway."""
    tokens_owner: str = ""  # uid:gid of who alone can read them
    user: str = ""  # uid:gid of all containers, where the image's will not do
    seed: int = 1
    speed: float = 1.0
    clock: str = ""
    here: Collection[str] | None = None  # the robots to start; None: all


def deployment_image(image: str | None) -> str:
    """The image that containers of a compose file run: the given one, or that of this version."""
    return image or f"{NAME}:{version()}"


def deployment_text(team: Team, file: Path, folder: Path, image: str | None, seed: int) -> str:
    """What `cpcbl-team compose` prints: the compose file of the team in `file`, to lie in `folder`.

    `file` is mounted into the containers unless it is a built-in team's name. Without `image` the
    file tells how to build one from the checkout. Raises InputError for robots that replay a log,
    and without an image and a checkout.
    """
    for name, robot in team.robots.items():
        if robot.source == "mrclam":
            raise InputError(
                f"robots.{name}.source: mrclam: a log is replayed by `up --containers --data DIR`"
            )
    top = None if image else checkout()
    if image is None and top is None:
        raise InputError(
            "compose: nobody has built an image for this installation, which has no checkout: in"
            f" one, docker build --file docker/Dockerfile --tag {NAME} . ; then --image {NAME}"
        )
    how = Deployment(
        str(file),
        deployment_image(image),
        None if top is None else _from(folder, top),
        user=key_owner(team, Identity(Role.ROUTER)),
        seed=seed,
    )
    if file.exists():
        inside = f"/team/{file.name}"
        how = how._replace(team_file=inside, mounts=(Mount(_from(folder, file), inside),))
    if team.transport.secured:
        keys_folder = parse_team(file.read_text(encoding="utf-8")).transport.keys
        target = os.path.normpath(os.path.join("/team", keys_folder))
        how = how._replace(keys=Mount(_from(folder, Path(team.transport.keys)), target))
    if team.recording.folder:
        Path(team.recording.folder).mkdir(parents=True, exist_ok=True)  # Docker would as root
        as_written = parse_team(file.read_text(encoding="utf-8")).recording.folder
        target = os.path.normpath(os.path.join("/team", as_written))
        record = Mount(team.recording.folder, target, is_writable=True)
        how = how._replace(user=user_of(team, Identity(Role.ROUTER), record))
        how = how._replace(record=record._replace(source=_from(folder, Path(record.source))))
    if team.gateway is not None:
        own = parse_team(file.read_text(encoding="utf-8")).gateway or GatewaySettings()
        inside = os.path.normpath(os.path.join("/team", own.tokens))
        outside = _from(folder, Path(team.gateway.tokens))
        how = how._replace(tokens=Mount(outside, inside), tokens_owner=token_owner(team))
    return compose_text(team, how)


def token_owner(team: Team) -> str:
    """uid:gid of who alone can read the tokens of a team's gateway, which are made where they are
    missing: a container could not write them. Raises InputError."""
    path = Path((team.gateway or GatewaySettings()).tokens)
    tokens_for(team.robots, path, {})
    whose = path.stat()
    return f"{whose.st_uid}:{whose.st_gid}"


def key_owner(team: Team, identity: Identity) -> str:
    """uid:gid of who alone can read somebody's keys of a secured team; empty for another team.

    Raises SecurityError without the keys.
    """
    if not team.transport.secured:
        return ""
    credentials = credentials_in(Path(team.transport.keys), identity)
    whose = Path(credentials.private_key).stat()
    return f"{whose.st_uid}:{whose.st_gid}"


def user_of(team: Team, identity: Identity, record: Mount | None) -> str:
    """uid:gid of who runs containers: who alone can read the keys, or else who owns the folder that
    robots record into; empty where the image's will do. Raises SecurityError without the keys."""
    if record is None or team.transport.secured:
        return key_owner(team, identity)
    whose = Path(record.source).stat()
    return f"{whose.st_uid}:{whose.st_gid}"


def _from(folder: Path, path: Path) -> str:
    """A path from a folder, as compose files want it."""
    relative = os.path.relpath(path.resolve(), folder.resolve())
    return relative if relative.startswith(".") else f"./{relative}"


def extras_of(team: Team) -> str:
    """The extras of this program that the containers of a team need."""
    if team.ros2 is None:
        return "camera" if team.cameras else ""
    from cpcbl_launch.run.ros2.command import needs_opencv  # no other team needs it

    detects = team.cameras or any(needs_opencv(team, name) for name in team.robots)
    return "camera ros2" if detects else "ros2"


def require_ros2_in_containers(ros2: Ros2Settings | None) -> None:
    """Raises InputError where a bridge in a container could not reach the router of ROS 2."""
    if ros2 is None:
        return
    beside = "or remove [ros2] here, and run `cpcbl-team bridge ros2` beside the containers"
    if ros2.keys:
        raise InputError(f"ros2.keys: a bridge in a container does not have them; {beside}")
    for endpoint in ros2.connect:
        if endpoint.partition("/")[2].rpartition(":")[0] in LOCAL:
            own = "in a container that is the container itself; write this machine's address"
            raise InputError(f"ros2.connect: {endpoint!r}: {own}, {beside}")


def compose_text(team: Team, how: Deployment) -> str:
    """The whole compose file: the router, the field if anything is simulated, a service a robot,
    the bridge to ROS 2. Raises InputError for a bridge that could not work there."""
    require_ros2_in_containers(team.ros2)
    here = team.robots if how.here is None else how.here
    field = " the simulated field," if team.simulated else ""
    robots = "one robot" if len(here) == 1 else f"{len(here)} robots"
    what = "folder of recordings is" if how.keys is None else "keys are; nobody else can read them"
    user = f"  user: {_flow(how.user)} # whose the {what}\n"
    protocol = "tcp" if how.keys is None else "tls"
    speed = () if how.speed == 1.0 else ("--speed", f"{how.speed:g}")
    router = ("router", how.team_file, "--listen", f"{protocol}/0.0.0.0:{PORT}", *speed)
    clock = ("--clock", how.clock) if how.clock else ()
    common = ("--connect", f"{protocol}/router:{PORT}", *clock)
    head = _HEAD.format(
        title=f"Team {team.name}: a router,{field} and {robots}",
        image=_flow(how.image),
        origin=image_origin(how.image, how.context is not None),
        user=user if how.user else "",
        mounts="" if how.keys else _mounts(how.mounts, ""),
        to=_flow(["CMD", "linked", "to", str(PORT)]),
    )
    router_service = _ROUTER.format(
        build="" if how.context is None else _build(how.context, extras_of(team)),
        command=_flow(router),
        keys=_own_mounts(how, Identity(Role.ROUTER)),
        ports=_flow([f"{outside}:{PORT}" for outside in how.published]),
        at=_flow(["CMD", "linked", "at", str(PORT)]),
    )
    services = []
    for name, arguments, identity in tasks(
        team, how.team_file, common, how.seed, here, how.record.target if how.record else ""
    ):
        keys = _own_mounts(how, identity)
        services.append(_SERVICE.format(name=name, command=_flow(arguments), keys=keys))
    if team.gateway is not None and how.tokens is not None:
        services.append(_gateway_service(team.gateway, how, how.tokens, common[:2]))
    return "".join([head, router_service, *services])


def image_origin(image: str, is_built: bool) -> str:
    """Who builds the image, with the command. `is_built`: the compose file holds how."""
    if is_built:
        return (
            f"`up` builds the image {image} if it is missing; after a change of the sources:"
            " docker-compose -f FILE build"
        )
    return (
        f"The image {image} must exist; in a checkout:"
        f" docker build --file docker/Dockerfile --tag {image} ."
    )


def _gateway_service(
    settings: GatewaySettings, how: Deployment, tokens: Mount, connect: tuple[str, ...]
) -> str:
    """The gateway, and the secret that its tokens are."""
    port = settings.port or GatewaySettings().port  # inside a container any port is free
    here = published_port("gateway.host", settings.host, settings.port)
    uid, gid = how.tokens_owner.split(":")
    secret = {"source": _SECRET, "target": tokens.target, "uid": uid, "gid": gid, "mode": 0o400}
    inside = ("--listen", f"0.0.0.0:{port}")
    return _GATEWAY.format(
        command=_flow(("gateway", how.team_file, *inside, *connect)),
        user=_flow(how.tokens_owner),
        ports=_flow([f"{here}:{port}"]),
        secret=_flow(secret),
        keys=_own_mounts(how, Identity(Role.GATEWAY)),
        file=_flow(tokens.source),
    )


def published_port(key: str, address: str, port: object) -> str:
    """[address:]port of this machine where Docker publishes; all addresses for 0.0.0.0 and [::].

    Raises InputError for a name, at which Docker cannot publish. `key`: of the team file.
    """
    if address == "localhost":
        address = "127.0.0.1"
    if address in ("0.0.0.0", "[::]", "::"):
        return str(port)
    if not re.fullmatch(r"[0-9.]+", address):
        raise InputError(
            f"{key}: {address}: Docker publishes at an IPv4 address; write one, or 0.0.0.0 for all"
        )
    return f"{address}:{port}"


def _build(context: str, extras: str) -> str:
    base = f"${{{BASE_VARIABLE}:-{BASE_IMAGE}}}"
    more = f", EXTRAS: {extras}" if extras else ""
    return _BUILD.format(context=_flow(context), base=base, extras=more)


def _own_mounts(how: Deployment, identity: Identity) -> str:
    """What one service may read and write: what all may read, its own keys of a secured team, and
    the folder that robots record into. Empty where that is what all may read."""
    own = []
    if how.keys is not None:
        own.append(Mount(f"{how.keys.source}/{identity}", f"{how.keys.target}/{identity}"))
    if how.record is not None and identity.role is Role.ROBOT:
        own.append(how.record)
    return _mounts((*how.mounts, *own), "  ") if own else ""


def _mounts(mounts: Collection[Mount], indent: str) -> str:
    head = f"{indent}  volumes: # on every machine of a swarm\n"
    binds = (
        {"type": "bind", "source": m.source, "target": m.target, "read_only": not m.is_writable}
        for m in mounts
    )
    lines = [f"{indent}    - {_flow(bind)}\n" for bind in binds]
    return "".join([head, *lines]) if lines else ""


def _flow(value: object) -> str:
    """A value on one line, quoted where YAML needs it; compose's own `$` is escaped."""
    plain = _plain(value)
    text = yaml.safe_dump(plain, default_flow_style=True, sort_keys=False, width=float("inf"))
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
# {origin}
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

_GATEWAY = """
  gateway:
    <<: *member
    command: {command}
    user: {user} # whose the tokens are; nobody else can read them
    ports: {ports}
    secrets: # of this service alone; uid, gid and mode are for a swarm
      - {secret}
{keys}
secrets:
  gateway-tokens:
    file: {file}
"""
