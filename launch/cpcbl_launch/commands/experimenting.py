"""`cpcbl-team experiment ...`."""

from collections.abc import Callable, Iterable
from functools import partial
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

from msgspec.structs import replace
from typer import Argument, Context, Exit, Option, Typer, echo

from cpcbl_launch.commands import options
from cpcbl_launch.team.requirements import require_matplotlib, require_opencv

if TYPE_CHECKING:
    from rich.console import RenderableType

    from cpcbl_launch.lab.experiments.runs import Experiment
    from cpcbl_launch.lab.seeds import Workers

experiment_app = Typer(
    help="The paper's experiments and others: each prints a table and writes NAME.json; most of"
    " them draw NAME.png.",
    no_args_is_help=True,
)

FILE_WIDTH = 130

Seeds = Annotated[int, Option(min=1, help="Runs of each case, each with its own noise.")]
FromSeed = Annotated[int, Option(min=0, help="The first seed.")]
Output = Annotated[Path, Option(help="Folder for NAME.json and NAME.png.")]


def _add_command(name: str, where: str, runs: int, text: str) -> None:
    """Adds the command of an experiment whose only options are seeds, jobs and output."""

    def command(
        seeds: Seeds = runs,
        jobs: options.Jobs = None,
        cluster: options.Cluster = "",
        output: Output = Path(),
        as_json: options.AsJson = False,
    ) -> None:
        module, attribute = where.split(":")
        experiment = getattr(import_module(f"cpcbl_launch.lab.experiments.{module}"), attribute)
        conduct(experiment, seeds, options.workers(jobs, cluster), output, as_json)

    experiment_app.command(name, help=text)(command)


_add_command(
    "table1",
    "table1:EXPERIMENT",
    20,
    "One robot, odometry alone and landmarks A, B, C, beside table 1 of the paper.",
)
_add_command(
    "figure7",
    "figure7:EXPERIMENT",
    5,
    "A navigator, alone and helped by an observer, A-F, beside figure 7 of the paper.",
)
_add_command(
    "figure7-cameras",
    "figure7:WITH_CAMERAS",
    5,
    "The same from pixels: a cheap camera on the navigator, a sharper one on the observer.",
)
_add_command(
    "circular-vs-oval", "figure7:OF_VARIANTS", 10, "All four variants: accuracy and consistency."
)


@experiment_app.command("one-way-vs-both")
def one_way_vs_both(
    seeds: Seeds = 3,
    jobs: options.Jobs = None,
    cluster: options.Cluster = "",
    output: Output = Path(),
    as_json: options.AsJson = False,
    team_sizes: Annotated[str, Option(help="Sizes of the teams.")] = "2,5,10,20",
) -> None:
    """Accuracy against bytes in teams of 2 to 20, with observers that are wrong."""
    from cpcbl_launch.lab.experiments.directions import experiment_of_sizes

    sizes = [int(s) if s.strip().isdecimal() else 0 for s in team_sizes.split(",")]
    where = options.workers(jobs, cluster)
    conduct(experiment_of_sizes(sizes), seeds, where, output, as_json)


@experiment_app.command("budget")
def budget(
    data: Annotated[Optional[Path], Argument(help="Folder of an MRCLAM log, e.g. MRCLAM6.")] = None,
    blind: Annotated[str, Option(help="Robots that shall not see landmarks.")] = "3,4,5",
    duration: Annotated[Optional[float], Option(help="Seconds of the log; default: all.")] = None,
    robots: Annotated[
        int,
        Option("--team-size", min=2, max=50, help="Without a log: the size of simulated teams."),
    ] = 10,
    world: Annotated[
        str, Option(help="Their world: mixed, few-landmarks, one-observer or chain.")
    ] = "mixed",
    seeds: Seeds = 3,
    jobs: options.Jobs = None,
    cluster: options.Cluster = "",
    output: Output = Path(),
    as_json: options.AsJson = False,
) -> None:
    """Accuracy against bytes, by value and budget, by fixed intervals, all of it: on a real log, or
    with simulated teams of mixed quality."""
    from cpcbl_launch.lab.experiments import budget as experiment
    from cpcbl_launch.lab.experiments import mixed_teams
    from cpcbl_launch.run import logged_team
    from cpcbl_launch.team.file import load_team
    from cpcbl_launch.team.overrides import with_blind_robots

    if data is None:
        runs = experiment.simulated_runs(robots, seeds, mixed_teams.known_world(world))
    else:
        team = load_team(logged_team.builtin_for(data))
        logged = logged_team.with_duration(logged_team.load_logged_team(team, data), duration)
        team = with_blind_robots(logged.team, options.parse_names(blind), logged.left_out)
        runs = experiment.runs_of_log(logged._replace(team=team))
    measure = partial(experiment.measure_curve, runs, options.workers(jobs, cluster))
    total = len(experiment.cases())
    _conduct("budget", measure, experiment.tables, output, as_json, total=total)


_add_command(
    "liars",
    "liars:EXPERIMENT",
    10,
    "An observer that sends wrong positions: the team's error, and when the fault is found.",
)


@experiment_app.command("worlds")
def worlds(
    seeds: Seeds = 60,
    names: Annotated[
        str, Option("--worlds", help='Words in the names of worlds: "landmark,helper".')
    ] = "",
    variants: Annotated[str, Option(help="Variants to compare.")] = "joint,oval,circular",
    jobs: options.Jobs = None,
    cluster: options.Cluster = "",
    output: Output = Path(),
    as_json: options.AsJson = False,
) -> None:
    """Consistency outside the usual case: few landmarks, lost odometry, unknown starts, ..."""
    from cpcbl_launch.lab.experiments import worlds as experiment

    cases = partial(experiment.cases, options.parse_names(names), options.parse_names(variants))
    where = options.workers(jobs, cluster)
    conduct(experiment.EXPERIMENT._replace(cases=cases), seeds, where, output, as_json)


@experiment_app.command("random-worlds")
def random_worlds(
    seeds: Annotated[int, Option(min=1, help="Worlds, each of its own seed.")] = 100,
    from_seed: FromSeed = 0,
    rough: Annotated[
        bool,
        Option(
            "--rough",
            help="Calibrations and maps of which only a sigma is known; noise that is correlated;"
            " delays, budgets, and odometry that gets lost.",
        ),
    ] = False,
    show: Annotated[
        Optional[int], Option(min=0, help="Print the team file of this seed, and run nothing.")
    ] = None,
    jobs: options.Jobs = None,
    cluster: options.Cluster = "",
    output: Output = Path(),
    as_json: options.AsJson = False,
) -> None:
    """Random teams with settings that are right: who errs more than it says, and false alarms."""
    from cpcbl_launch.lab.experiments import random_worlds as experiment
    from cpcbl_launch.lab.experiments.random_teams import random_team
    from cpcbl_launch.lab.experiments.rough_teams import rough_team

    if show is not None:
        team = rough_team(show) if rough else random_team(show)
        echo(experiment.team_text(team), nl=False)
        return
    where, cases = options.workers(jobs, cluster), partial(experiment.cases, rough)
    chosen = experiment.EXPERIMENT._replace(cases=cases, first_seed=from_seed)
    conduct(chosen, seeds, where, output, as_json)


_add_command(
    "mapping",
    "mapping:EXPERIMENT",
    50,
    "Teams that find all landmarks while they drive, beside the same teams on the surveyed map.",
)


_add_command(
    "wrong-maps",
    "wrong_maps:EXPERIMENT",
    20,
    "Landmarks that are pushed, or of one name; maps that are mirrored or in other units.",
)


@experiment_app.command("luck")
def luck(
    seeds: Annotated[int, Option(min=1, help="Histories, each of its own seed.")] = 20,
    from_seed: FromSeed = 0,
    duration: Annotated[
        float, Option(callback=options.duration, help="Seconds of each history.")
    ] = 60.0,
    replay: Annotated[
        Optional[Path], Option(help="Run this one history, such as luck-17.json.")
    ] = None,
    jobs: options.Jobs = None,
    cluster: options.Cluster = "",
    output: Annotated[Path, Option(help="Folder for failing histories, luck-SEED.json.")] = Path(),
    as_json: options.AsJson = False,
) -> None:
    """Simulated bad luck: networks, clocks and members that fail, and what must hold of any robot.
    A failing history is shrunk and written; the exit code is then 1."""
    from rich.console import Console

    from cpcbl_launch.lab.luck import sweep as luck
    from cpcbl_launch.lab.luck.outcome import run_history
    from cpcbl_launch.lab.luck.plan import read_history
    from cpcbl_launch.views.run import progress_bar

    options.require_folder("--output", output)
    if replay is not None:
        history = read_history(replay)
        found = luck.summed([outcome := run_history(history)])
        failures = [luck.Failure(history, outcome.violations)]
    else:
        chosen, finished = range(from_seed, from_seed + seeds), count(1)
        with progress_bar(f"luck, {seeds} histories", quiet=False) as show:
            where = options.workers(jobs, cluster)
            found = luck.sweep(chosen, duration, where, lambda: show(next(finished) / seeds))
        failures = list(luck.shrunk_failures(found, duration, output))
    found = replace(found, failures=failures)

    def show_tables() -> None:
        console = Console()
        for shown in luck.tables(found):
            console.print(shown, highlight=False)

    options.print_result(found, as_json, show_tables)
    if found.has_failed:
        raise Exit(1)


MOVED = {
    "eyes": "bench-detection",
    "latency": "bench-latency",
    "pictures": "bench-pictures",
    "processes": "bench-processes",
}
"""Experiments that are benchmarks of a checkout now: the target of make for each."""


def _refuse_benchmark(context: Context) -> None:
    name = str(context.info_name)
    options.refuse_moved(f"experiment {name}", MOVED[name])


for _name, _target in MOVED.items():
    _any_arguments = {"allow_extra_args": True, "ignore_unknown_options": True}
    experiment_app.command(
        _name, hidden=True, context_settings=_any_arguments, help=f"Moved to `make {_target}`."
    )(_refuse_benchmark)


def conduct(
    experiment: "Experiment", seeds: int, where: "Workers", output: Path, as_json: bool
) -> None:
    """Runs, writes and shows one experiment of cases and seeds. Raises CpcblError."""
    if experiment.needs_opencv:
        require_opencv(f"experiment {experiment.name}")
    cases = experiment.cases()

    def measure(done: Callable[[], None]) -> Any:
        return experiment.outcome(experiment.results(cases, seeds, where, done))

    name, tables, drawn = experiment.name, experiment.tables, experiment.drawn
    _conduct(name, measure, tables, output, as_json, total=len(cases) * seeds, drawn=drawn)


def _conduct(
    name: str,
    measure: Callable[[Callable[[], None]], Any],
    tables: "Callable[[Any], Iterable[RenderableType]]",
    output: Path,
    as_json: bool,
    *,
    total: int,
    drawn: bool = True,
) -> None:
    """Measures with a bar of progress, writes NAME.json (and NAME.png), and prints the result.

    Raises CpcblError, before anything is measured, if the files cannot be written or drawn.
    """
    from rich.console import Console

    from cpcbl_launch.reporting.files import json_text, write_or_reason
    from cpcbl_launch.views.run import progress_bar

    figures, picture = output / f"{name}.json", output / f"{name}.png"
    if drawn:
        require_matplotlib("experiment")
    options.require_folder("--output", output)
    for path in (figures, picture) if drawn else (figures,):
        options.require_writable_file("--output", path)
    with progress_bar(f"{name}, {total} runs", quiet=False) as show:
        finished = count(1)
        result = measure(lambda: show(next(finished) / total))
    text = json_text(result) + "\n"
    lost = write_or_reason(figures, lambda: figures.write_text(text, encoding="utf-8"))
    if drawn:
        from cpcbl_launch.lab.experiments.pictures import draw

        lost |= write_or_reason(picture, lambda: draw(result, picture))

    def show_tables() -> None:
        written = () if lost else (f"written: {figures}{', .png' * drawn}",)
        console = Console()
        if not console.is_terminal:  # a file; rich would cut the figures
            console.width = max(console.width, FILE_WIDTH)
        for shown in (*tables(result), *written):
            console.print(shown, highlight=False)

    options.print_result(result, as_json, show_tables, lost)
