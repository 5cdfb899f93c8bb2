"""`cpcbl-team experiment ...`."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from cpcbl_launch.commands.arguments import parse_names, print_not_written
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from cpcbl_launch.lab.experiments.results import Experiment

experiment_app = typer.Typer(
    help="The paper's experiments and others: each prints a table and writes NAME.json; most of"
    " them draw NAME.png.",
    no_args_is_help=True,
)

_ANY_ARGUMENTS = {"allow_extra_args": True, "ignore_unknown_options": True}

Seeds = Annotated[int, typer.Option(min=1, help="Runs of each case, each with its own noise.")]
Jobs = Annotated[
    Optional[int], typer.Option(min=1, help="Processes at a time; default: all cores.")
]
Output = Annotated[Path, typer.Option(help="Folder for NAME.json and NAME.png.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the JSON instead of tables.")]


@experiment_app.command("table1")
def table1(
    seeds: Seeds = 20, jobs: Jobs = None, output: Output = Path(), as_json: AsJson = False
) -> None:
    """One robot, odometry alone and landmarks A, B, C, beside table 1 of the paper."""
    from cpcbl_launch.lab.experiments.table1 import EXPERIMENT

    conduct(EXPERIMENT, seeds, jobs, output, as_json)


@experiment_app.command("figure7")
def figure7(
    seeds: Seeds = 5, jobs: Jobs = None, output: Output = Path(), as_json: AsJson = False
) -> None:
    """A navigator, alone and helped by an observer, A-F, beside figure 7 of the paper."""
    from cpcbl_launch.lab.experiments.figure7 import EXPERIMENT

    conduct(EXPERIMENT, seeds, jobs, output, as_json)


@experiment_app.command("figure7-cameras")
def figure7_cameras(
    seeds: Seeds = 5, jobs: Jobs = None, output: Output = Path(), as_json: AsJson = False
) -> None:
    """The same from pixels: a cheap camera on the navigator, a sharper one on the observer."""
    from cpcbl_launch.checks import require_opencv
    from cpcbl_launch.lab.experiments.figure7_cameras import EXPERIMENT

    require_opencv("experiment figure7-cameras")
    conduct(EXPERIMENT, seeds, jobs, output, as_json)


@experiment_app.command("circular-vs-oval")
def circular_vs_oval(
    seeds: Seeds = 10, jobs: Jobs = None, output: Output = Path(), as_json: AsJson = False
) -> None:
    """All four variants: accuracy and consistency."""
    from cpcbl_launch.lab.experiments.variants import EXPERIMENT

    conduct(EXPERIMENT, seeds, jobs, output, as_json)


@experiment_app.command("one-way-vs-both")
def one_way_vs_both(
    seeds: Seeds = 3,
    jobs: Jobs = None,
    output: Output = Path(),
    as_json: AsJson = False,
    robots: Annotated[str, typer.Option(help="Sizes of the teams.")] = "2,5,10,20",
) -> None:
    """Accuracy against bytes in teams of 2 to 20, with observers that are wrong."""
    from cpcbl_launch.lab.experiments.directions import experiment_of_sizes

    sizes = [int(s) if s.strip().isdecimal() else 0 for s in robots.split(",")]
    conduct(experiment_of_sizes(sizes), seeds, jobs, output, as_json)


@experiment_app.command("budget")
def budget(
    data: Annotated[Path, typer.Argument(help="Folder of an MRCLAM log, e.g. MRCLAM6.")],
    blind: Annotated[str, typer.Option(help="Robots that shall not see landmarks.")] = "3,4,5",
    duration: Annotated[
        Optional[float], typer.Option(help="Seconds of the log; default: all.")
    ] = None,
    jobs: Jobs = None,
    output: Output = Path(),
    as_json: AsJson = False,
) -> None:
    """A real log: accuracy against bytes, by value and budget, by fixed intervals, all of it."""
    from cpcbl_launch.checks import require_matplotlib
    from cpcbl_launch.lab.experiments import budget as experiment
    from cpcbl_launch.lab.experiments.pictures import draw_budget
    from cpcbl_launch.overrides import with_blind_robots
    from cpcbl_launch.run import logged_team
    from cpcbl_launch.team_file import load_team

    require_matplotlib("experiment")
    _must_be_writable(output, "budget")
    logged = logged_team.with_duration(
        logged_team.load_logged_team(load_team(logged_team.builtin_for(data)), data), duration
    )
    logged = logged._replace(team=with_blind_robots(logged.team, parse_names(blind)))
    with _progress("budget", len(experiment.cases())) as done:
        result = experiment.measure_curve(logged, jobs, done)
    _written(result, experiment.tables(result), output, as_json, draw_budget)


@experiment_app.command("liars")
def liars(
    seeds: Seeds = 10, jobs: Jobs = None, output: Output = Path(), as_json: AsJson = False
) -> None:
    """One observer of several lies for a while: what it does to the team, and when it is found."""
    from cpcbl_launch.checks import require_matplotlib
    from cpcbl_launch.lab.experiments import liars as experiment
    from cpcbl_launch.lab.experiments.pictures import draw_liars

    require_matplotlib("experiment")
    _must_be_writable(output, "liars")
    with _progress("liars", len(experiment.cases()) * seeds) as done:
        result = experiment.measure(seeds, jobs or os.cpu_count() or 1, done)
    _written(result, experiment.tables(result), output, as_json, draw_liars)


@experiment_app.command("eyes")
def eyes(
    frames: Annotated[int, typer.Option(min=1, help="Rendered frames.")] = 2000,
    seed: Annotated[int, typer.Option(min=0, help="Of poses, light and noise.")] = 1,
    jobs: Jobs = None,
    output: Output = Path(),
    as_json: AsJson = False,
) -> None:
    """What cameras see of rendered frames: precision, recall, errors against stated sigmas."""
    from cpcbl_launch.checks import require_matplotlib, require_opencv

    require_matplotlib("experiment")
    require_opencv("experiment eyes")
    _must_be_writable(output, "eyes")
    from cpcbl_launch.lab.experiments import eyes as experiment

    with _progress("eyes", -(-frames // experiment.CHUNK), "batches") as done:
        result = experiment.measure(frames, seed, jobs or os.cpu_count() or 1, done)
    _written(result, experiment.tables(result), output, as_json, experiment.draw)


@experiment_app.command("pictures")
def pictures(
    name: Annotated[
        str,
        typer.Argument(
            metavar="SET",
            help="duckiebot, frc-speaker, frc-amp, nao; or NAME.csv, NAME.toml beside it.",
        ),
    ],
    folder: Annotated[Path, typer.Argument(help="Where the set's pictures are.")],
    output: Annotated[Path, typer.Option(help="Folder for pictures-SET.json.")] = Path(),
    as_json: AsJson = False,
) -> None:
    """Real pictures whose truth is known: what is found and missed of them, and by how much."""
    from cpcbl_launch.checks import require_opencv

    require_opencv("experiment pictures")
    from cpcbl_launch.lab.experiments import real_pictures

    _must_be_writable(output, f"pictures-{real_pictures.picture_set(name).stem}", drawn=False)
    result = real_pictures.measure(name, folder)
    _written(result, real_pictures.tables(result), output, as_json)


@experiment_app.command("latency", hidden=True, context_settings=_ANY_ARGUMENTS)
def latency() -> None:
    """Moved to `make bench-latency`."""
    raise InputError("experiment latency: it is a benchmark now: make bench-latency, in a checkout")


@experiment_app.command("processes", hidden=True, context_settings=_ANY_ARGUMENTS)
def processes() -> None:
    """Moved to `make bench-processes`."""
    raise InputError(
        "experiment processes: it is a benchmark now: make bench-processes, in a checkout"
    )


def conduct(
    experiment: "Experiment", seeds: int, jobs: int | None, output: Path, as_json: bool
) -> None:
    """Runs, writes and shows one experiment. Raises InputError for what the user can mend."""
    from cpcbl_launch.checks import require_matplotlib
    from cpcbl_launch.lab.experiments.runs import run_cases

    require_matplotlib("experiment")
    _must_be_writable(output, experiment.name)
    cases = experiment.cases()
    with _progress(experiment.name, len(cases) * seeds) as done:
        results = run_cases(cases, range(1, seeds + 1), jobs or os.cpu_count() or 1, done)
    outcome = experiment.outcome(results)
    _written(outcome, experiment.tables(outcome), output, as_json, experiment.draw)


def _must_be_writable(output: Path, name: str, *, drawn: bool = True) -> None:
    """Raises InputError where the files of an experiment could not be written later on."""
    from cpcbl_launch.commands.options import require_folder, require_writable_file

    require_folder("--output", output)
    for ending in ("json", "png") if drawn else ("json",):
        require_writable_file("--output", output / f"{name}.{ending}")


def _written(
    result: Any,
    tables: "Iterable[RenderableType]",
    output: Path,
    as_json: bool,
    draw: Callable[[Any, Path], None] | None = None,
) -> None:
    """Writes what came out, a picture too where one is drawn, and shows it, written or not."""
    from rich.console import Console

    from cpcbl_launch.reporting.files import json_text, write_or_reason

    text, name = json_text(result) + "\n", output / result.experiment
    figures, picture = Path(f"{name}.json"), Path(f"{name}.png")
    lost = write_or_reason(figures, lambda: figures.write_text(text, encoding="utf-8"))
    if draw is not None:
        lost |= write_or_reason(picture, lambda: draw(result, picture))
    if as_json:
        sys.stdout.write(text)
    else:
        console = Console()
        for shown in tables:
            console.print(shown, highlight=False)
        pictured = ", .png" if draw is not None else ""
        if not lost:
            console.print(f"written: {figures}{pictured}", highlight=False)
    print_not_written(lost)


@contextmanager
def _progress(title: str, total: int, unit: str = "runs") -> Iterator[Callable[[], None]]:
    """How many are done of all, on standard error."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
    console = Console(stderr=True)
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as progress:
        task = progress.add_task(title, total=total)
        yield lambda: progress.advance(task)
