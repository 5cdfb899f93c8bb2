"""Arguments and options that several commands have in common."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from cpcbl_launch.run.containers import BASE_IMAGE as BASE_IMAGE
from cpcbl_launch.run.containers import BASE_VARIABLE
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_team.config import Team


def endpoints(option: typer.CallbackParam, given: list[str] | None) -> list[str] | None:
    """Raises InputError for what Zenoh would try again and again, and never say why."""
    from cpcbl_launch.team_file import endpoint_problem

    for endpoint in given or ():
        if reason := endpoint_problem(endpoint):
            raise InputError(f"--{option.name} {endpoint}: {reason}")
    return given


TeamFile = Annotated[Path, typer.Option("--team", help="Team file (TOML).")]
TeamArgument = Annotated[
    Optional[Path], typer.Argument(help="Team file, or a built-in one: demo (default).")
]
Blind = Annotated[str, typer.Option(help="Robots that shall not see landmarks, e.g. 3,4,5.")]
BytesPerS = Annotated[
    Optional[float],
    typer.Option(
        min=0.0, help="Budget of each robot for fixes and beliefs, on its link; 0: no limit."
    ),
]
MessagesPerMinute = Annotated[
    Optional[float],
    typer.Option(min=0.0, help="The same in messages; 0: no limit."),
]
MatchMessages = Annotated[
    Optional[int],
    typer.Option(min=0, help="The team's fixes and beliefs in a match; 0: no limit."),
]
ReportFile = Annotated[Optional[Path], typer.Option(help="Write the report to this file (JSON).")]
PictureFile = Annotated[
    Optional[Path], typer.Option(help="Draw it into this file (PNG or SVG; extra `plot`).")
]
Image = Annotated[
    Optional[str],
    typer.Option(help="Image of cpcbl-team to use; default: built from the checkout, when needed."),
]
BaseImage = Annotated[str, typer.Option(envvar=BASE_VARIABLE, help="What the image is built on.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the report as JSON.")]
Connect = Annotated[
    Optional[list[str]],
    typer.Option(
        callback=endpoints,
        help="Endpoint of the router, e.g. tcp/192.168.1.10:7447; default: the file's.",
    ),
]
ClockText = Annotated[str, typer.Option("--clock", hidden=True)]
Parent = Annotated[Optional[int], typer.Option(hidden=True)]


def write_report(path: Path | None, result: object) -> dict[str, str]:
    """Writes what `--report` asks for; what could not be written, with the reason."""
    from cpcbl_launch.options import json_text, write_or_reason

    if path is None:
        return {}
    return write_or_reason(path, lambda: path.write_text(json_text(result), encoding="utf-8"))


def print_not_written(lost: dict[str, str]) -> None:
    """A line for each file that could not be written; with any, the exit code is 1."""
    for name, reason in lost.items():
        typer.secho(f"cpcbl-team: {name}: not written: {reason}", fg="red", err=True)
    if lost:
        raise typer.Exit(1)


def parse_robots(option: str, text: str, team: "Team") -> list[str]:
    """The robots of a list with commas. Raises InputError for one that the team does not have."""
    names = parse_names(text)
    unknown = [name for name in names if name not in team.robots]
    if unknown or not names:
        who = ", ".join(unknown) or "it names none"
        raise InputError(
            f"{option} {text}: no such robot: {who}; there are {', '.join(team.robots)}"
        )
    return names


def parse_names(text: str) -> list[str]:
    """The names of a list with commas."""
    return [name.strip() for name in text.split(",") if name.strip()]
