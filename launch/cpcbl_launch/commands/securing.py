"""Commands that make a team's keys."""

from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from cpcbl_launch.commands.arguments import AsJson, print_result
from cpcbl_launch.team_file import find_team
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.keys.folder import KeysReport

KeyFolder = Annotated[
    Optional[Path],
    typer.Option(help="Folder of the keys; default: transport.keys, beside the team file."),
]
Observers = Annotated[
    Optional[list[str]], typer.Option(help="Name of an observer that may join; repeatable.")
]
Hosts = Annotated[
    Optional[list[str]],
    typer.Option(
        help="Name or address of the router, beyond localhost, `router`, and the team file's"
        " endpoints; repeatable."
    ),
]
Days = Annotated[float, typer.Option(help="Validity of the certificates made now.")]
Renew = Annotated[
    Optional[list[str]],
    typer.Option(help="Who gets a new key: a name, `all`, or `ca` (beside the old one)."),
]
Revoke = Annotated[
    Optional[list[str]],
    typer.Option(help="Whose certificate becomes invalid, from the next start of the router on."),
]
RetireCa = Annotated[bool, typer.Option(help="Trust only the newest authority.")]


def keys(
    file: Annotated[Path, typer.Argument(help="Team file (TOML).")],
    output: KeyFolder = None,
    observer: Observers = None,
    host: Hosts = None,
    days: Days = 365.0,
    renew: Renew = None,
    revoke: Revoke = None,
    retire_ca: RetireCa = False,
    as_json: AsJson = False,
) -> None:
    """Make the keys of a team: its authority, and a certificate for each member.

    Makes what is missing and leaves the rest as it is. Needs the extra `security`.
    """
    from cpcbl_launch.keys.folder import KeyRequest, make_keys
    from cpcbl_launch.team_file import key_folder

    team = find_team(file)
    if not 0.0 < days < 36500.0:
        raise InputError(f"--days {days:g}: more than 0, and less than a hundred years")
    if output is None and not file.exists():
        raise InputError(f"{file}: comes with the package; copy it, or name a folder by --output")
    folder = output or key_folder(team, file)
    request = KeyRequest(
        observers=tuple(observer or ()),
        hosts=tuple(host or ()),
        lasting=timedelta(days=days),
        renew=tuple(renew or ()),
        revoke=tuple(revoke or ()),
        retire_ca=retire_ca,
    )
    try:
        made = make_keys(team, folder, request)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: {error.strerror}; name a folder") from error
    print_result(made, as_json, lambda: _print_keys(made, folder))
    if not as_json and not team.transport.secured:
        typer.echo(f'{file}: write [transport] security = "mtls", and the team uses these keys')


def _print_keys(made: "list[KeysReport]", folder: Path) -> None:
    from rich.console import Console

    from cpcbl_launch.views.keys import key_table

    Console().print(key_table(made))
    router = next(member for member in made if member.hosts)
    typer.echo(f"robots reach the router at {', '.join(router.hosts)}")
    typer.echo(
        f"{folder}: move ca/private.key to a safe place, and each other folder to its machine"
    )
