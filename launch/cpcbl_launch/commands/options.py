"""Options that several commands share, the checks of their values, and what ends every command."""

import math
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, CallbackParam, Context, Exit, Option, secho

from cpcbl_launch.reporting.files import json_text, write_or_reason
from cpcbl_launch.run.containers import BASE_VARIABLE
from cpcbl_launch.team.file import builtin_path, find_team
from cpcbl_launch.team.requirements import require_endpoints, require_matplotlib
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.lab.seeds import Workers

LARGE_RUN = 20_000_000  # bytes, of which one file is not made in a moment


def require_folder(option: str, folder: Path) -> None:
    """Makes a folder to write into, if it is not there. Raises InputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{option} {folder}: {error.strerror}; name a folder") from error
    _require_writable(option, folder, folder)


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


def _require_recording(option: str, path: Path) -> None:
    """A file of a recording, or a folder for one."""
    if path.suffix == ".mcap":
        require_writable_file(option, path)
    else:
        require_folder(option, path)


def _require_picture(option: str, path: Path) -> None:
    require_writable_file(option, path)
    require_matplotlib(option, path)


def _require_limit(option: str, limit: float) -> None:
    if not math.isfinite(limit):
        raise InputError(f"{option} {limit:g}: not a limit; write a number, 0 for no limit")


def _require_time(option: str, seconds: float) -> None:
    if not seconds > 0.0:
        raise InputError(f"{option} {seconds:g}: more than 0 seconds")


def check_callback(require: Callable[[str, Any], object]) -> Callable[[CallbackParam, Any], Any]:
    """A callback of an option that passes the option as typed, and its value if there is one, to
    `require`."""

    def callback(option: CallbackParam, value: Any) -> Any:
        if value is not None:
            require(option.opts[0], value)
        return value

    return callback


writable_file, writable_picture = (
    check_callback(require_writable_file),
    check_callback(_require_picture),
)
folder, endpoints = check_callback(require_folder), check_callback(require_endpoints)
recording = check_callback(_require_recording)
duration = check_callback(_require_time)


def complete_team(incomplete: str) -> list[str]:
    """Team files of the present folder and built-in teams, for a shell."""
    built_in = [path.stem for path in builtin_path("demo").parent.glob("*.toml")]
    names = [*sorted(map(str, Path().glob("*.toml"))), *sorted(built_in)]
    return [name for name in names if name.startswith(incomplete)]


def complete_robot(context: Context, incomplete: str) -> list[str]:
    """The robots of the team that is named before, for a shell."""
    try:
        team = find_team(Path(str(context.params.get("team_file"))))
    except InputError:
        return []
    return [name for name in team.robots if name.startswith(incomplete)]


team_argument = partial(Argument, metavar="TEAM", autocompletion=complete_team)
robot_argument = partial(Argument, autocompletion=complete_robot)
Team = Annotated[Path, team_argument(help="Team file (TOML), or the name of a built-in one.")]
TeamIfAny = Annotated[
    Path | None, team_argument(help="Team file (TOML), or the name of a built-in one.")
]
TeamOrDemo = Annotated[
    Path | None, team_argument(help="Team file, or a built-in one: demo (default).")
]
Blind = Annotated[str, Option(help="Robots that cannot see landmarks, e.g. 3,4,5.")]
_limit = partial(Option, min=0.0, callback=check_callback(_require_limit))
BytesPerS = Annotated[
    float | None,
    _limit(help="Bytes per second of help that each robot may send; 0: no limit."),
]
MessagesPerMinute = Annotated[
    float | None,
    _limit(help="Messages of help per minute that each robot may send; 0: no limit."),
]
MatchMessages = Annotated[
    int | None,
    Option(min=0, help="Messages of help that the team may send in a match; 0: no limit."),
]
NoiseSeed = Annotated[int, Option(help="Seed of the simulated noise.")]
Jobs = Annotated[int | None, Option(min=1, help="Processes at a time; default: all cores.")]
Cluster = Annotated[
    str,
    Option(
        metavar="ADDRESS",
        help="Run on the Dask cluster of this scheduler, e.g. tcp://10.0.0.2:8786, not here.",
    ),
]
ReportFile = Annotated[
    Path | None, Option(callback=writable_file, help="File to write the report into, as JSON.")
]
PictureFile = Annotated[
    Path | None,
    Option(
        callback=writable_picture, help="File to draw the result into (PNG or SVG; extra `plot`)."
    ),
]
RecordPath = Annotated[
    Path | None,
    Option(
        callback=recording,
        help="Folder to record the whole run into, to have it again with `replay`; or a file (MCAP)"
        " for inputs, tracks, images, status and truth.",
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
PageListen = Annotated[
    str | None,
    Option(help="ADDRESS:PORT of the page; default: 127.0.0.1:8700. 0.0.0.0:8700: for phones too."),
]
OpenPage = Annotated[bool, Option("--open", help="Open the page in a browser of this machine.")]
ClockText = Annotated[str, Option("--clock", hidden=True)]
Parent = Annotated[int | None, Option(hidden=True)]


def workers(jobs: int | None, cluster: str) -> "Workers":
    """What `--jobs` and `--cluster` ask for. Raises InputError for both."""
    from cpcbl_launch.lab.seeds import Workers

    if cluster and jobs is not None:
        raise InputError(f"--jobs {jobs}: not with --cluster, whose workers run all; leave one out")
    return Workers(jobs, cluster)


def write_report(path: Path | None, result: object) -> dict[str, str]:
    """Writes what `--report` asks for. Returns the file and the reason where that failed."""
    if path is None:
        return {}
    return write_or_reason(path, lambda: path.write_text(json_text(result), encoding="utf-8"))


def print_result(
    result: object,
    as_json: bool,
    show: Callable[[], None],
    lost: Mapping[str, str] = {},
    recorded: Path | None = None,
) -> None:
    """Prints a result as JSON on standard output, or shows it to a person; then what was lost.
    `recorded`: the folder of a run of which one file is to be made last."""
    if as_json:
        sys.stdout.write(json_text(result) + "\n")
    else:
        show()
    if recorded is not None:
        sys.stdout.flush()
        lost = {**lost, **_merge_recording(recorded)}
    print_not_written(lost)


def print_not_written(lost: Mapping[str, str]) -> None:
    """Prints a line for each file that could not be written; with any, the exit code is 1."""
    for name, reason in lost.items():
        secho(f"cpcbl-team: {name}: not written: {reason}", fg="red", err=True)
    if lost:
        raise Exit(1)


def _merge_recording(folder: Path) -> dict[str, str]:
    """Makes one file of a recorded run; of a long one that takes minutes, so a signal ends it.
    Returns the file and the reason where that failed: the robots' own files are there all the
    same."""
    from cpcbl_launch.recordings.gather import MERGED
    from cpcbl_launch.recordings.merge import merge, merged_line

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
    if sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) > LARGE_RUN:
        words = f"making {folder / MERGED}; Ctrl-C leaves that to `cpcbl-team merge {folder}`"
        secho(words, err=True, dim=True)
    try:
        merged = merge(folder)
    except InputError as error:
        return {str(folder / MERGED): str(error)}
    except OSError as error:
        return {str(folder / MERGED): error.strerror or str(error)}
    secho(merged_line(merged), err=True, dim=True)
    return {}


def refuse_moved(old: str, target: str) -> None:
    """Raises InputError for what became a benchmark: a target of make."""
    raise InputError(f"{old}: it is a benchmark now: make {target}, in a checkout")


def team_and_files(words: Sequence[Path]) -> tuple[Path | None, list[Path]]:
    """The team, if the first word is a team file or the name of a built-in team, and the rest."""
    first = words[0] if words else Path()
    is_name = first == Path(first.name) and not first.exists() and builtin_path(first.name).exists()
    is_team = is_name or first.suffix == ".toml"
    return (first, list(words[1:])) if is_team else (None, list(words))


def parse_names(text: str) -> list[str]:
    """The names of a list with commas."""
    return [name.strip() for name in text.split(",") if name.strip()]
