"""Options that several commands share, the checks of their values, and what ends every command."""

import math
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

from typer import Argument, CallbackParam, Exit, Option, secho

from cpcbl_launch.checks import require_matplotlib
from cpcbl_launch.reporting.files import json_text, write_or_reason
from cpcbl_launch.run.containers import BASE_VARIABLE
from cpcbl_launch.team_checks import endpoint_problem
from cpcbl_team.errors import InputError


def require_folder(option: str, folder: Path) -> Path:
    """A folder to write into, made if it was not there. Raises InputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{option} {folder}: {error.strerror}; name a folder") from error
    _require_writable(option, folder, folder)
    return folder


def require_writable_file(option: str, path: Path) -> None:
    """Raises InputError for a file that could not be written later on."""
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: no folder {path.parent}; make it first")
    if path.is_dir():
        raise InputError(f"{option} {path}: a folder; name a file")
    _require_writable(option, path, path if path.exists() else path.parent)


def _require_writable(option: str, path: Path, existing: Path) -> None:
    if not os.access(existing, os.W_OK):
        raise InputError(f"{option} {path}: {existing} cannot be written; name another place")


def writable_file(option: CallbackParam, path: Path | None) -> Path | None:
    """Callback of an option that names a file to write."""
    if path is not None:
        require_writable_file(option.opts[0], path)
    return path


def writable_picture(option: CallbackParam, path: Path | None) -> Path | None:
    """Callback of an option that names a picture to draw."""
    if writable_file(option, path) is not None:
        require_matplotlib(option.opts[0], path)
    return path


def folder(option: CallbackParam, path: Path | None) -> Path | None:
    """Callback of an option that names a folder to write into; the folder is made."""
    return None if path is None else require_folder(option.opts[0], path)


def endpoints(option: CallbackParam, given: list[str] | None) -> list[str] | None:
    """Callback of endpoints: Zenoh would try a wrong one again and again, and never say why."""
    for endpoint in given or ():
        if reason := endpoint_problem(endpoint):
            raise InputError(f"{option.opts[0]} {endpoint}: {reason}")
    return given


def number_that(
    is_good: Callable[[float], bool], problem: str
) -> Callable[[CallbackParam, float | None], float | None]:
    """Callback of an option whose number must be good; `problem` also says how to mend it."""

    def check(option: CallbackParam, number: float | None) -> float | None:
        if number is not None and not is_good(number):
            raise InputError(f"{option.opts[0]} {number:g}: {problem}")
        return number

    return check


more_than_no_time = number_that(lambda seconds: seconds > 0.0, "more than 0 seconds")
_finite_limit = number_that(math.isfinite, "no limit; write a number, 0 for as much as it likes")

TeamFile = Annotated[Path, Option("--team", help="Team file (TOML).")]
TeamArgument = Annotated[
    Path | None, Argument(help="Team file, or a built-in one: demo (default).")
]
Blind = Annotated[str, Option(help="Robots that cannot see landmarks, e.g. 3,4,5.")]
BytesPerS = Annotated[
    float | None,
    Option(
        min=0.0,
        callback=_finite_limit,
        help="Bytes per second of fixes and beliefs that each robot may send; 0: no limit.",
    ),
]
MessagesPerMinute = Annotated[
    float | None,
    Option(
        min=0.0,
        callback=_finite_limit,
        help="Fixes and beliefs per minute that each robot may send; 0: no limit.",
    ),
]
MatchMessages = Annotated[
    int | None,
    Option(min=0, help="Fixes and beliefs that the team may send in a match; 0: no limit."),
]
NoiseSeed = Annotated[int, Option(help="Seed of the simulated noise.")]
ReportFile = Annotated[
    Path | None, Option(callback=writable_file, help="File to write the report into, as JSON.")
]
PictureFile = Annotated[
    Path | None,
    Option(
        callback=writable_picture, help="File to draw the result into (PNG or SVG; extra `plot`)."
    ),
]
Image = Annotated[
    str | None,
    Option(help="Image of cpcbl-team to use; default: built from the checkout, when needed."),
]
BaseImage = Annotated[str, Option(envvar=BASE_VARIABLE, help="What the image is built on.")]
AsJson = Annotated[bool, Option("--json", help="Print the report as JSON.")]
Connect = Annotated[
    list[str] | None,
    Option(
        callback=endpoints,
        help="Endpoint of the router, e.g. tcp/192.168.1.10:7447; default: the file's.",
    ),
]
ClockText = Annotated[str, Option("--clock", hidden=True)]
Parent = Annotated[int | None, Option(hidden=True)]


def write_report(path: Path | None, result: object) -> dict[str, str]:
    """Writes what `--report` asks for. Returns the file and the reason where that failed."""
    if path is None:
        return {}
    return write_or_reason(path, lambda: path.write_text(json_text(result), encoding="utf-8"))


def print_result(
    result: object, as_json: bool, show: Callable[[], None], lost: Mapping[str, str] = {}
) -> None:
    """Prints a result as JSON on standard output, or shows it to a person; then what was lost."""
    if as_json:
        sys.stdout.write(json_text(result) + "\n")
    else:
        show()
    print_not_written(lost)


def print_not_written(lost: Mapping[str, str]) -> None:
    """Prints a line for each file that could not be written; with any, the exit code is 1."""
    for name, reason in lost.items():
        secho(f"cpcbl-team: {name}: not written: {reason}", fg="red", err=True)
    if lost:
        raise Exit(1)


def parse_names(text: str) -> list[str]:
    """The names of a list with commas."""
    return [name.strip() for name in text.split(",") if name.strip()]
