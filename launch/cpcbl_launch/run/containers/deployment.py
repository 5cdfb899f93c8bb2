"""What `cpcbl-team compose` prints: a compose file that stays, with paths from its own folder."""

import os
from pathlib import Path

from cpcbl_launch.run.containers.compose import Deployment, Mount, compose_text
from cpcbl_launch.run.containers.image import NAME, checkout, version
from cpcbl_launch.team_file import parse_team
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport.security import Identity, credentials_in
from cpcbl_transport.topics import Role


def deployment_text(team: Team, file: Path, folder: Path, image: str | None, seed: int) -> str:
    """The compose file of the team in `file`, to lie in `folder`.

    `file` is mounted into the containers unless it is a built-in team's name. Without `image` the
    file tells how to build one from the checkout. Raises InputError for robots that replay a log.
    """
    for name, robot in team.robots.items():
        if robot.source == "mrclam":
            raise InputError(
                f"robots.{name}.source: mrclam: a log is replayed by `up --containers --data DIR`"
            )
    inside, mounts, keys = str(file), tuple[Mount, ...](), None
    if file.exists():
        inside = f"/team/{file.name}"
        mounts = (Mount(_from(folder, file), inside),)
    if team.transport.secured:
        keys_folder = parse_team(file.read_text(encoding="utf-8")).transport.keys
        target = os.path.normpath(os.path.join("/team", keys_folder))
        keys = Mount(_from(folder, Path(team.transport.keys)), target)
    top = None if image else checkout()
    return compose_text(
        team,
        Deployment(
            inside,
            image or f"{NAME}:{version()}",
            None if top is None else _from(folder, top),
            mounts=mounts,
            keys=keys,
            user=key_owner(team, Identity(Role.ROUTER)),
            seed=seed,
        ),
    )


def key_owner(team: Team, identity: Identity) -> str:
    """uid:gid of who alone can read somebody's keys of a secured team; empty for another team.

    Raises SecurityError without the keys.
    """
    if not team.transport.secured:
        return ""
    credentials = credentials_in(Path(team.transport.keys), identity)
    whose = Path(credentials.private_key).stat()
    return f"{whose.st_uid}:{whose.st_gid}"


def _from(folder: Path, path: Path) -> str:
    """A path from a folder, as compose files want it."""
    relative = os.path.relpath(path.resolve(), folder.resolve())
    return relative if relative.startswith(".") else f"./{relative}"
