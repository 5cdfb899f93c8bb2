"""The command line `cpcbl-team`."""

import logging
import math
import shlex
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from cpcbl_launch.experiments.cli import experiment_app

if TYPE_CHECKING:
    from cpcbl_team.config import Team

app = typer.Typer(
    help="A team of robots that find out where they are, together.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
evaluate_app = typer.Typer(help="Real logs in one process: deterministic and fast.")
app.add_typer(evaluate_app, name="evaluate")
app.add_typer(experiment_app, name="experiment")

TeamFile = Annotated[Path, typer.Option("--team", help="Team file (TOML).")]
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
AsJson = Annotated[bool, typer.Option("--json", help="Print the report as JSON.")]
Connect = Annotated[
    Optional[list[str]],
    typer.Option(help="Endpoint of the router, e.g. tcp/192.168.1.10:7447; default: the file's."),
]
ClockText = Annotated[str, typer.Option("--clock", hidden=True)]
Parent = Annotated[Optional[int], typer.Option(hidden=True)]


class VariantName(StrEnum):
    joint = "joint"
    oval = "oval"
    circular = "circular"
    weighted = "weighted"


class Kinds(StrEnum):
    none = "none"
    passive = "passive"
    active = "active"
    both = "both"


class FusionName(StrEnum):
    naive = "naive"
    split_ci = "split-ci"


class DirectionName(StrEnum):
    one_way = "one-way"
    both_ways = "both-ways"


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="Team file (TOML).")],
) -> None:
    """Validate a team file without starting anything."""

    team = _load(file)
    marks, walls = len(team.map.landmarks), len(team.map.walls)
    typer.echo(
        f"{file}: good: team {team.name!r}, {len(team.robots)} robots"
        f" ({', '.join(team.robots)}), {marks} landmarks, {walls} walls"
    )


@app.command()
def up(
    file: Annotated[
        Optional[Path], typer.Argument(help="Team file, or a built-in one: demo (default), mrclam.")
    ] = None,
    duration: Annotated[
        Optional[float],
        typer.Option(help="Seconds of robot time; default: 30 simulated, or the whole log."),
    ] = None,
    speed: Annotated[float, typer.Option(min=0.05, help="Times real time.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Of the simulated noise.")] = 1,
    data: Annotated[
        Optional[Path], typer.Option(help="Folder of an MRCLAM log, for source mrclam.")
    ] = None,
    blind: Blind = "",
    robots: Annotated[
        str, typer.Option(help="Robots to start on this machine; default: all.")
    ] = "",
    bytes_per_s: BytesPerS = None,
    messages_per_minute: MessagesPerMinute = None,
    match_messages: MatchMessages = None,
    report: Annotated[
        Optional[Path], typer.Option(help="Write the report to this file (JSON).")
    ] = None,
    picture: Annotated[
        Optional[Path],
        typer.Option(help="Draw paths and errors into this file (PNG or SVG; extra `plot`)."),
    ] = None,
    record: Annotated[
        Optional[Path],
        typer.Option(help="Record inputs, tracks, status and truth into this file (MCAP)."),
    ] = None,
    logs: Annotated[
        Optional[Path], typer.Option(help="Keep the processes' logs in this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Start a team: the field, a process per robot, a live table, a report at the end."""
    from rich.console import Console

    from cpcbl_agents.process import Stop
    from cpcbl_launch import logs as real_logs
    from cpcbl_launch.evaluation import Choice, chosen
    from cpcbl_launch.options import encoded, must_draw
    from cpcbl_launch.show import LiveTable, print_report
    from cpcbl_launch.up import SIMULATED_S, Run, dialled, listening, run_team

    typed = file or Path("demo")
    if file == Path("mrclam") and data is not None and not file.exists():
        file = real_logs.builtin_for(data)
    team = listening(_load(file or Path("demo")))
    budgets = Choice(
        bytes_per_s=bytes_per_s,
        messages_per_minute=messages_per_minute,
        match_messages=match_messages,
    )
    team = chosen(team, budgets)
    if picture is not None:
        must_draw("--picture")
    run = Run(team, duration, speed, seed, folder=logs, picture=picture, record=record)
    if any(robot.source == "mrclam" for robot in team.robots.values()):
        logged = real_logs.on_log(team, Path(data or team.data or "."))
        run = run._replace(
            team=logged.team,
            truth=logged.truth,
            left_out=logged.left_out,
            epoch_ns=logged.start_ns,
            duration_s=min(duration or 1e9, (logged.end_ns - logged.start_ns) * 1e-9),
        )
    elif duration is None:
        run = run._replace(duration_s=SIMULATED_S)
    run = run._replace(team=real_logs.blinded(run.team, _names(blind)))
    if robots:
        run = run._replace(here=_names(robots))
    console = Console(stderr=as_json)
    title = f"team {team.name}, {len(run.team.robots)} robots, {speed:g} x real time"
    watch = ["cpcbl-team", "traffic", str(typed), "--connect", dialled(team.transport.listen[0])]
    console.print(f"watch it: {shlex.join(watch)}", style="dim", highlight=False, soft_wrap=True)
    with LiveTable(title, console, quiet=as_json) as table:
        result = run_team(run, table, Stop())
    if report is not None:
        report.write_text(encoded(result), encoding="utf-8")
    if as_json:
        sys.stdout.write(encoded(result) + "\n")
    else:
        print_report(result, console)


@app.command()
def traffic(
    file: Annotated[
        Optional[Path], typer.Argument(help="Team file, or a built-in one: demo (default).")
    ] = None,
    team_name: Annotated[
        Optional[str], typer.Option(help="The running team's name, where its file is not at hand.")
    ] = None,
    connect: Connect = None,
    duration: Annotated[
        Optional[float], typer.Option("--for", help="Seconds to watch; default: until Ctrl-C.")
    ] = None,
    wait: Annotated[
        float, typer.Option(min=0.1, help="Seconds to wait for the team's router.")
    ] = 5.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print what was seen last as JSON, at the end.")
    ] = False,
) -> None:
    """Watch a running team, from any machine: who helps whom, and what it costs.

    Listens to the robots' status (1 Hz) only, never to fixes or beliefs: these
    are sent where somebody listens, and watching must not cause any.
    """
    from rich.console import Console

    from cpcbl_agents.process import Stop
    from cpcbl_launch.options import encoded
    from cpcbl_launch.traffic.show import TrafficView, drawn
    from cpcbl_launch.traffic.watch import Watch, watch_team
    from cpcbl_team.config import TransportSettings

    if duration is not None and not duration > 0.0:
        raise ValueError(f"--for {duration:g}: more than 0 seconds")
    logging.getLogger("cpcbl_transport").setLevel(logging.WARNING)
    team = None if team_name is not None and file is None else _load(file or Path("demo"))
    endpoints = connect or (team.transport if team is not None else TransportSettings()).connect
    watch = Watch(
        team_name or (team.name if team is not None else ""),
        () if team is None else tuple(team.robots),
        endpoints,
        math.inf if duration is None else duration,
        wait,
    )
    console, where = Console(), ", ".join(endpoints)
    with TrafficView(where, console, quiet=as_json) as view:
        result = watch_team(watch, view, Stop())
    if as_json:
        sys.stdout.write(encoded(result) + "\n")
    else:
        console.print(drawn(result, where))


@app.command()
def robot(
    name: Annotated[str, typer.Argument(help="The robot's name in the team file.")],
    team_file: TeamFile,
    connect: Connect = None,
    clock: ClockText = "",
    parent: Parent = None,
    restarted: Annotated[
        bool, typer.Option(help="It does not know where it is: find the pose first.")
    ] = False,
) -> None:
    """Run one robot, on any machine, until SIGINT or SIGTERM."""
    from cpcbl_agents.clock import Clock
    from cpcbl_agents.process import Stop, run_robot
    from cpcbl_launch.team_file import TeamFileError

    team = _load(team_file)
    if name not in team.robots:
        raise TeamFileError(
            f"{team_file}: robots.{name}: not in the file; it has: {', '.join(team.robots)}"
        )
    when = Clock.parse(clock) if clock else Clock.wall()
    run_robot(name, team, connect or team.transport.connect, when, Stop(parent), restarted)


@app.command()
def field(
    team_file: TeamFile,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 1,
    connect: Connect = None,
    clock: ClockText = "",
    parent: Parent = None,
) -> None:
    """Run the simulated field until SIGINT or SIGTERM."""
    from cpcbl_agents.clock import Clock
    from cpcbl_agents.process import Stop
    from cpcbl_launch.field import run_field
    from cpcbl_transport.zenoh_bus import open_bus

    team = _load(team_file)
    stop = Stop(parent)
    with open_bus(team.name, connect or team.transport.connect, stop) as bus:
        run_field(team, seed, bus, Clock.parse(clock) if clock else Clock.wall(), stop)


@evaluate_app.command("mrclam")
def evaluate_mrclam(
    data: Annotated[Path, typer.Argument(help="Folder of one data set, e.g. MRCLAM6.")],
    team_file: Annotated[
        Optional[Path],
        typer.Option("--team", help="Team file; default: the built-in mrclam without this log."),
    ] = None,
    blind: Blind = "",
    variant: Annotated[Optional[VariantName], typer.Option(help="For all robots.")] = None,
    collaboration: Annotated[Optional[Kinds], typer.Option(help="For all robots.")] = None,
    fusion: Annotated[Optional[FusionName], typer.Option(help="For all robots.")] = None,
    direction: Annotated[Optional[DirectionName], typer.Option(help="For all robots.")] = None,
    bytes_per_s: BytesPerS = None,
    messages_per_minute: MessagesPerMinute = None,
    match_messages: MatchMessages = None,
    duration: Annotated[
        Optional[float], typer.Option(help="Seconds of the log; default: all.")
    ] = None,
    yardstick: Annotated[
        bool,
        typer.Option(help="Also dead reckoning, a solo EKF a robot, a centralized EKF."),
    ] = False,
    export: Annotated[
        Optional[Path],
        typer.Option(help="Write estimates and truth into this folder (TUM files, as evo reads)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Five robots of a real log (UTIAS MRCLAM) against its ground truth."""
    from rich.console import Console

    from cpcbl_launch import logs as real_logs
    from cpcbl_launch.evaluation import Choice, chosen, evaluated
    from cpcbl_launch.options import encoded, folder_for
    from cpcbl_launch.show import print_report, progress_bar
    from cpcbl_launch.tum import export_tum

    team = _load(team_file or real_logs.builtin_for(data))
    choice = Choice(
        variant,
        collaboration,
        fusion,
        direction,
        bytes_per_s,
        messages_per_minute,
        match_messages,
    )
    logged = real_logs.on_log(chosen(team, choice), data)
    logged = logged._replace(team=real_logs.blinded(logged.team, _names(blind)))
    logged = real_logs.shortened(logged, duration)
    folder = None if export is None else folder_for("--export", export)
    with progress_bar(f"{data.name}", quiet=as_json) as progress:
        result, paths = evaluated(logged, progress, with_yardsticks=yardstick)
    if folder is not None:
        export_tum(folder, paths, logged.truth)
    if as_json:
        typer.echo(encoded(result))
    else:
        print_report(result, Console())


@app.command()
def calibrate(
    logs: Annotated[
        list[Path], typer.Argument(help="MRCLAM folders, or recordings of `up --record` (.mcap).")
    ],
    team_file: Annotated[
        Optional[Path],
        typer.Option(
            "--team", help="Team file to add types to; default: the recorded team, or mrclam."
        ),
    ] = None,
    output: Annotated[Path, typer.Option(help="Team file to write.")] = Path("calibrated.toml"),
    margin: Annotated[
        float,
        typer.Option(min=0.0, help="Share by which noise is written larger: days differ."),
    ] = 0.5,
    picture: Annotated[
        Optional[Path],
        typer.Option(help="Draw residuals into this file (PNG or SVG; extra `plot`)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate odometry and sensor errors from logs with truth, as types of a team file."""
    from rich.console import Console

    from cpcbl_launch.calibration.logs import read_logs
    from cpcbl_launch.calibration.robots import calibrated
    from cpcbl_launch.calibration.show import print_calibration
    from cpcbl_launch.calibration.team_text import base_text, team_text
    from cpcbl_launch.options import encoded, must_draw
    from cpcbl_launch.show import progress_bar

    if picture is not None:
        must_draw("--picture")
    base, base_name = base_text(logs, team_file)
    names = [log.resolve().name for log in logs]
    robot_logs = read_logs(logs)
    with progress_bar("calibrating", quiet=as_json) as progress:
        result = calibrated(robot_logs, names, progress)
    output.write_text(team_text(result, base, base_name, margin), encoding="utf-8")
    if picture is not None:
        from cpcbl_launch.calibration.picture import draw_residuals

        draw_residuals(robot_logs, result, picture)
    if as_json:
        typer.echo(encoded(result))
    else:
        print_calibration(result, Console())
        typer.echo(f"written: {output}")


@app.command()
def simulate(
    file: Annotated[
        Optional[Path], typer.Argument(help="Team file, or a built-in one: demo (default).")
    ] = None,
    robots: Annotated[
        str,
        typer.Option(help="No FILE: generated teams of these sizes, e.g. 2,10,50,200,1000."),
    ] = "",
    duration: Annotated[
        Optional[float],
        typer.Option(help="Seconds of robot time; default: 5 with --robots, else 30."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the noise, and of generated teams.")] = 1,
    bytes_per_s: BytesPerS = None,
    messages_per_minute: MessagesPerMinute = None,
    match_messages: MatchMessages = None,
    report: Annotated[
        Optional[Path], typer.Option(help="Write the report to this file (JSON).")
    ] = None,
    picture: Annotated[
        Optional[Path],
        typer.Option(help="Draw it into this file (PNG or SVG; extra `plot`)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run a simulated team in one process, without Zenoh: deterministic for a seed.

    With a team file: the report of `up`. With --robots: what a robot costs in
    teams of each size, on a field that grows with them. Measured are the fixes
    and beliefs that it sends and receives, and the CPU time of its own steps;
    simulating the field is apart.
    """
    from rich.console import Console

    from cpcbl_launch.evaluation import Choice, chosen
    from cpcbl_launch.options import encoded, file_for, must_draw
    from cpcbl_launch.recorder import Report
    from cpcbl_launch.scale.measure import DURATION_S, Scale, measured, parsed_sizes
    from cpcbl_launch.scale.show import print_scale
    from cpcbl_launch.show import print_report, progress_bar
    from cpcbl_launch.up import Run, simulate_run

    budgets = Choice(
        bytes_per_s=bytes_per_s,
        messages_per_minute=messages_per_minute,
        match_messages=match_messages,
    )
    if file is not None and robots:
        raise ValueError("simulate: FILE or --robots, which generates its teams; leave one out")
    if robots and budgets != Choice():
        raise ValueError("simulate: generated teams have no budgets; name a team file instead")
    if report is not None:
        file_for("--report", report)
    if picture is not None:
        file_for("--picture", picture)
        must_draw("--picture", picture)
    result: Report | Scale
    with progress_bar("simulating", quiet=as_json) as progress:
        if robots:
            duration = DURATION_S if duration is None else duration
            result = measured(parsed_sizes(robots), seed, duration, progress, picture)
        else:
            team = chosen(_load(file or Path("demo")), budgets)
            run = Run(team, duration, seed=seed, picture=picture)
            result = simulate_run(run, progress)
    if report is not None:
        report.write_text(encoded(result), encoding="utf-8")
    if as_json:
        sys.stdout.write(encoded(result) + "\n")
    elif isinstance(result, Scale):
        print_scale(result, Console())
    else:
        print_report(result, Console())


def _load(path: Path) -> "Team":
    """The team in a file, or one that comes with the package by its name."""
    from cpcbl_launch.team_file import builtin, load_team

    own = builtin(path.name)
    return load_team(
        own if not path.exists() and path == Path(path.name) and own.exists() else path
    )


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def main() -> None:
    """Runs the command line; what the user can mend is one line and exit code 2."""
    from cpcbl_agents.sources.mrclam import LogError
    from cpcbl_launch.team_file import TeamFileError
    from cpcbl_transport.zenoh_bus import BusError

    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    try:
        app()
    except (TeamFileError, LogError, BusError, ValueError) as error:
        typer.secho(f"cpcbl-team: {error}", fg="red", err=True)
        sys.exit(2)
