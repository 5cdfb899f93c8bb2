"""Commands that check a team, make its keys, and put it on other machines."""

from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from typer import Option

from cpcbl_launch.commands import options
from cpcbl_launch.reporting.files import write_or_reason
from cpcbl_launch.reporting.tables import plural, table
from cpcbl_launch.team.checks import warnings
from cpcbl_launch.team.file import TeamFileError, find_team, key_folder, without_faulty_keys
from cpcbl_launch.team.units import unit_warnings
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.keys.folder import KeysReport


def check(file: options.Team) -> None:
    """Validate a team file without starting anything."""
    try:
        team = find_team(file)
    except TeamFileError:
        rest = without_faulty_keys(file)  # it may lack much, but its units can be judged
        for warning in unit_warnings(rest) if rest else ():
            typer.echo(f"{file}: warning: {warning}", err=True)
        raise
    field = team.map
    objects = [plural(len(field.landmarks), "landmark"), plural(len(field.walls), "wall")]
    if field.unsurveyed:
        objects.insert(1, f"{len(field.unsurveyed)} to be found")
    if field.unsurveyed_walls:
        objects.append(f"{plural(len(field.unsurveyed_walls), 'wall')} to be mapped")
    typer.echo(
        f"{file}: good: team {team.name!r}, {plural(len(team.robots), 'robot')}"
        f" ({', '.join(team.robots)}), {', '.join(objects)}"
    )
    for warning in warnings(team):
        typer.echo(f"{file}: warning: {warning}", err=True)


def keys(
    file: options.Team,
    output: Annotated[
        Path | None,
        Option(help="Folder of the keys; default: transport.keys, beside the team file."),
    ] = None,
    observer: Annotated[
        list[str] | None, Option(help="Name of an observer that may join; repeatable.")
    ] = None,
    host: Annotated[
        list[str] | None,
        Option(
            help="Name or address of the router, beyond localhost, `router`, and the team file's"
            " endpoints; repeatable."
        ),
    ] = None,
    days: Annotated[float, Option(help="Validity of the certificates made now.")] = 365.0,
    renew: Annotated[
        list[str] | None,
        Option(help="Who gets a new key: a name, `all`, or `ca` (beside the old one)."),
    ] = None,
    revoke: Annotated[
        list[str] | None,
        Option(help="Whose certificate becomes invalid, from the next start of the router on."),
    ] = None,
    retire_ca: Annotated[bool, Option(help="Trust only the newest authority.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Make the keys of a team: its authority, and a certificate for each member.

    Makes what is missing and leaves the rest as it is. Needs the extra `security`.
    """
    from cpcbl_launch.keys.folder import KeyRequest, make_keys

    team = find_team(file)
    if not 0.0 < days < 36500.0:
        raise InputError(f"--days {days:g}: more than 0, and less than a hundred years")
    if output is None and not file.exists():
        raise InputError(f"{file}: comes with the package; copy it, or name a folder by --output")
    folder = output or key_folder(team, file)
    lasting = timedelta(days=days)
    request = KeyRequest(observer or (), host or (), lasting, renew or (), revoke or (), retire_ca)
    try:
        made = make_keys(team, folder, request)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: {error.strerror}; name a folder") from error
    options.print_result(made, as_json, lambda: _print_keys(made, folder))
    if not as_json and not team.transport.secured:
        typer.echo(f'{file}: write [transport] security = "mtls", and the team uses these keys')


def _print_keys(made: "list[KeysReport]", folder: Path) -> None:
    shown = table("", ("who", "certificate says", "valid until (UTC)", ""), ())
    for member in made:
        until = f"{member.valid_until:%Y-%m-%d %H:%M}" if member.valid_until else "-"
        shown.add_row(member.who, member.common_name, until, member.deed)
    Console().print(shown)
    router = next(member for member in made if member.hosts)
    typer.echo(f"robots reach the router at {', '.join(router.hosts)}")
    typer.echo(
        f"{folder}: move ca/private.key to a safe place, and each other folder to its machine"
    )


def compose(
    file: options.TeamOrDemo = None,
    image: options.Image = None,
    seed: options.NoiseSeed = 1,
    output: Annotated[
        Path | None,
        Option(
            callback=options.writable_file,
            help="File to write, with paths relative to its folder; default: standard output.",
        ),
    ] = None,
) -> None:
    """Print a team's compose file: for docker-compose, docker compose, a swarm."""
    from cpcbl_launch.run.containers.compose import (
        deployment_image,
        deployment_text,
        image_origin,
    )

    file = file or Path("demo")
    folder = Path() if output is None else output.parent
    text = deployment_text(find_team(file), file, folder, image, seed)
    if output is None:
        typer.echo(text, nl=False)
    else:
        lost = write_or_reason(output, lambda: output.write_text(text, encoding="utf-8"))
        options.print_not_written(lost)
    typer.echo(f"compose: {image_origin(deployment_image(image), image is None)}", err=True)
