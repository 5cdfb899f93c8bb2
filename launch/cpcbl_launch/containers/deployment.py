"""What `cpcbl-team compose` prints: a compose file that stays, with paths from its own folder."""

import os
from pathlib import Path

from cpcbl_launch.containers.compose import Deployment, Mount, compose_text
from cpcbl_launch.containers.image import NAME, checkout, version
from cpcbl_team.config import Team


def deployed(team: Team, file: Path, folder: Path, image: str | None, seed: int) -> str:
    """The compose file of the team in `file`, to lie in `folder`.

    `file` is mounted into the containers unless it is a built-in team's name. Without `image` the
    file tells how to build one from the checkout. Raises ValueError for robots that replay a log.
    """
    for name, robot in team.robots.items():
        if robot.source == "mrclam":
            raise ValueError(
                f"robots.{name}.source: mrclam: a log is replayed by `up --containers --data DIR`"
            )
    inside, mounts = str(file), tuple[Mount, ...]()
    if file.exists():
        inside = f"/team/{file.name}"
        mounts = (Mount(_from(folder, file), inside),)
    top = None if image else checkout()
    return compose_text(
        team,
        Deployment(
            inside,
            image or f"{NAME}:{version()}",
            None if top is None else _from(folder, top),
            mounts=mounts,
            seed=seed,
        ),
    )


def _from(folder: Path, path: Path) -> str:
    """A path from a folder, as compose files want it."""
    relative = os.path.relpath(path.resolve(), folder.resolve())
    return relative if relative.startswith(".") else f"./{relative}"
