"""Commands that make a team's keys."""

import sys
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands.arguments import AsJson
from cpcbl_launch.team_file import find_team
from cpcbl_team.errors import InputError


def keys(
    file: Annotated[Path, typer.Argument(help="Team file (TOML).")],
    output: Annotated[
        Optional[Path],
        typer.Option(help="Folder of the keys; default: transport.keys, beside the team file."),
    ] = None,
    observer: Annotated[
        Optional[list[str]], typer.Option(help="Name of an observer that may join; repeatable.")
    ] = None,
    host: Annotated[
        Optional[list[str]],
        typer.Option(
            help="Name or address at which the router is dialled, beyond localhost, `router`, and"
            " the team file's endpoints; repeatable."
        ),
    ] = None,
    days: Annotated[float, typer.Option(help="Validity of the certificates made now.")] = 365.0,
    renew: Annotated[
        Optional[list[str]],
        typer.Option(help="Who gets a new key: a name, `all`, or `ca` (beside the old one)."),
    ] = None,
    revoke: Annotated[
        Optional[list[str]],
        typer.Option(help="Whose certificate counts no more, once the router is started again."),
    ] = None,
    retire_ca: Annotated[bool, typer.Option(help="Trust the newest authority alone.")] = False,
    as_json: AsJson = False,
) -> None:
    """Make the keys of a team: its authority, and a certificate for each member.

    Makes what is missing and leaves the rest as it is. Needs the extra `security`.
    """
    from rich.console import Console

    from cpcbl_launch.keys.folder import KeyRequest, make_keys
    from cpcbl_launch.keys.show import key_table
    from cpcbl_launch.options import json_text
    from cpcbl_launch.team_file import key_folder

    team = find_team(file)
    if not 0.0 < days < 36500.0:
        raise InputError(f"--days {days:g}: more than 0, and less than a hundred years")
    if output is None and not file.exists():
        raise InputError(f"{file}: comes with the package; copy it, or name a folder by --output")
    folder = output or key_folder(team, file)
    wish = KeyRequest(
        observers=tuple(observer or ()),
        hosts=tuple(host or ()),
        lasting=timedelta(days=days),
        renew=tuple(renew or ()),
        revoke=tuple(revoke or ()),
        retire_ca=retire_ca,
    )
    try:
        made = make_keys(team, folder, wish)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: {error.strerror}; name a folder") from error
    if as_json:
        sys.stdout.write(json_text(made) + "\n")
        return
    Console().print(key_table(made))
    router = next(member for member in made if member.hosts)
    typer.echo(f"the router can be dialled at {', '.join(router.hosts)}")
    typer.echo(f"{folder}: bring ca/private.key to a safe place, each other folder to its machine")
    if not team.transport.secured:
        typer.echo(f'{file}: [transport] security = "mtls" makes the team use them')
