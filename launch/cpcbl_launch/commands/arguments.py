"""Arguments and options that several commands have in common."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from cpcbl_launch.commands import options
from cpcbl_launch.run.containers import BASE_IMAGE as BASE_IMAGE
from cpcbl_launch.run.containers import BASE_VARIABLE
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_team.config import Team

TeamFile = Annotated[Path, typer.Option("--team", help="Team file (TOML).")]
TeamArgument = Annotated[
    Optional[Path], typer.Argument(help="Team file, or a built-in one: demo (default).")
]
Blind = Annotated[str, typer.Option(help="Robots that cannot see landmarks, e.g. 3,4,5.")]
BytesPerS = Annotated[
    Optional[float],
    typer.Option(
        min=0.0,
        callback=options.finite_limit,
        help="Bytes per second of fixes and beliefs that each robot may send; 0: no limit.",
    ),
]
MessagesPerMinute = Annotated[
    Optional[float],
    typer.Option(
        min=0.0,
        callback=options.finite_limit,
        help="Fixes and beliefs per minute that each robot may send; 0: no limit.",
    ),
]
MatchMessages = Annotated[
    Optional[int],
    typer.Option(min=0, help="Fixes and beliefs that the team may send in a match; 0: no limit."),
]
ReportFile = Annotated[
    Optional[Path],
    typer.Option(callback=options.writable_file, help="File to write the report into, as JSON."),
]
PictureFile = Annotated[
    Optional[Path],
    typer.Option(
        callback=options.writable_picture,
        help="File to draw the result into (PNG or SVG; extra `plot`).",
    ),
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
        callback=options.endpoints,
        help="Endpoint of the router, e.g. tcp/192.168.1.10:7447; default: the file's.",
    ),
]
ClockText = Annotated[str, typer.Option("--clock", hidden=True)]
Parent = Annotated[Optional[int], typer.Option(hidden=True)]


def write_report(path: Path | None, result: object) -> dict[str, str]:
    """Writes what `--report` asks for. Returns the file and the reason where that failed."""
    from cpcbl_launch.reporting.files import json_text, write_or_reason

    if path is None:
        return {}
    return write_or_reason(path, lambda: path.write_text(json_text(result), encoding="utf-8"))


def print_result(result: object, as_json: bool, show: Callable[[], None]) -> None:
    """Prints a result as JSON on standard output, or shows it to a person."""
    from cpcbl_launch.reporting.files import json_text

    if as_json:
        sys.stdout.write(json_text(result) + "\n")
    else:
        show()


def print_not_written(lost: dict[str, str]) -> None:
    """Prints a line for each file that could not be written; with any, the exit code is 1."""
    for name, reason in lost.items():
        typer.secho(f"cpcbl-team: {name}: not written: {reason}", fg="red", err=True)
    if lost:
        raise typer.Exit(1)


def parse_robots(option: str, text: str, team: "Team") -> list[str]:
    """The robots of a list with commas. Raises InputError for one that the team does not have."""
    from cpcbl_launch.checks import require_robots

    if not (names := parse_names(text)):
        raise InputError(f"{option} {text}: names no robot; there are {', '.join(team.robots)}")
    require_robots(f"{option} {text}", names, team)
    return names


def parse_names(text: str) -> list[str]:
    """The names of a list with commas."""
    return [name.strip() for name in text.split(",") if name.strip()]
