"""`cpcbl-team what-if`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from typer import Argument, Option

from cpcbl_launch.commands import options
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.requirements import require_duration, require_team_opencv
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.lab.what_if.comparison import WhatIf
    from cpcbl_launch.lab.what_if.inputs import RecordedInputs

Words = Annotated[
    list[Path],
    Argument(
        metavar="[TEAM] RUN",
        help="Folder or file that `up --record` wrote, or folder of an MRCLAM log; TEAM: for a"
        " log, default: the built-in one that was not calibrated on it.",
    ),
]
Without = Annotated[
    list[str] | None, Option(help="Robot to leave out; may be repeated.", metavar="ROBOT")
]
Hide = Annotated[
    list[str] | None,
    Option(help="Landmark or wall that nobody sees; may be repeated.", metavar="LANDMARK"),
]
Settings = Annotated[
    list[str] | None,
    Option(
        "--set",
        help="Key of the team file with another value, of all robots (fusion=naive) or one"
        " (robots.r3.sensor.range_share=0.1); may be repeated.",
        metavar="KEY=VALUE",
    ),
]
Ledger = Annotated[
    bool,
    Option(
        "--ledger",
        help="What each robot, landmark, sensor and kind of message was worth; also without any"
        " change.",
    ),
]
LEAST_S = 1.0
WIDE = 120


def what_if(
    words: Words,
    without: Without = None,
    hide: Hide = None,
    settings: Settings = None,
    ledger: Ledger = False,
    duration: Annotated[float | None, Option(help="Seconds of the run; default: all.")] = None,
    jobs: options.Jobs = None,
    cluster: options.Cluster = "",
    as_json: options.AsJson = False,
) -> None:
    """Make a recorded run again with something changed, on what its robots sensed.

    Who helps whom is decided anew. Without a change it prints the ledger of the run as it is.
    """
    from cpcbl_launch.lab.what_if import comparison
    from cpcbl_launch.lab.what_if.changes import Change
    from cpcbl_launch.views.run import progress_bar

    where = options.workers(jobs, cluster)
    change = Change(tuple(without or ()), tuple(hide or ()), tuple(settings or ()))
    inputs = _inputs(words, duration)
    require_team_opencv(inputs.team, inputs.robots)
    asked = None if change == Change() else change
    with progress_bar(f"what if, {inputs.name}", quiet=as_json) as progress:
        result = comparison.what_if(inputs, asked, ledger or asked is None, where, progress)
    options.print_result(result, as_json, lambda: _print(result))


def _print(result: "WhatIf") -> None:
    from cpcbl_launch.lab.what_if.tables import tables

    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, WIDE)
    for shown in tables(result):
        console.print(shown, highlight=False)


def _inputs(words: list[Path], duration_s: float | None) -> "RecordedInputs":
    """The inputs of the run that the words name. Raises InputError."""
    from cpcbl_launch.lab.what_if.inputs import inputs_of_log, read_inputs
    from cpcbl_launch.run import logged_team

    team_file, runs = options.team_and_files(words)
    if len(runs) != 1:
        raise InputError("what-if: name one run, after the team if there is one")
    (run,) = runs
    is_log = any(run.glob("Robot*_Odometry.dat"))
    if team_file is not None and not is_log:
        raise InputError(f"what-if {team_file}: a recording has its team; leave {team_file} out")
    if is_log:
        team = find_team(logged_team.file_for(team_file or Path("mrclam"), run))
        logged = logged_team.load_logged_team(team, run)
        return inputs_of_log(logged_team.with_duration(logged, duration_s), run.name)
    inputs = read_inputs(run)
    if duration_s is None:
        return inputs
    require_duration(duration_s, LEAST_S)
    return inputs.until(inputs.start_ns + int(duration_s * 1e9))
