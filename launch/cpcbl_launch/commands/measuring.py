"""Commands that measure: real logs, calibration, a simulated team in one process."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands.arguments import (
    AsJson,
    Blind,
    BytesPerS,
    MatchMessages,
    MessagesPerMinute,
    PictureFile,
    ReportFile,
    TeamArgument,
    parse_names,
    print_not_written,
    write_report,
)
from cpcbl_launch.team_file import find_team
from cpcbl_team.errors import InputError


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

    from cpcbl_launch.options import json_text, require_folder, write_or_reason
    from cpcbl_launch.reporting.tum import export_tum
    from cpcbl_launch.run import logged_team as real_logs
    from cpcbl_launch.simulation.in_process import (
        Overrides,
        evaluate_log_with_paths,
        with_overrides,
    )
    from cpcbl_launch.views.run import print_report, progress_bar

    team = find_team(team_file or real_logs.builtin_for(data))
    choice = Overrides(
        variant,
        collaboration,
        fusion,
        direction,
        bytes_per_s,
        messages_per_minute,
        match_messages,
    )
    logged = real_logs.load_logged_team(with_overrides(team, choice), data)
    logged = logged._replace(team=real_logs.with_blind_robots(logged.team, parse_names(blind)))
    logged = real_logs.with_duration(logged, duration)
    if export is not None:
        require_folder("--export", export)
    with progress_bar(f"{data.name}", quiet=as_json) as progress:
        result, paths = evaluate_log_with_paths(logged, progress, with_yardsticks=yardstick)
    lost: dict[str, str] = {}
    if (folder := export) is not None:
        lost |= write_or_reason(folder, lambda: export_tum(folder, paths, logged.truth))
    if as_json:
        typer.echo(json_text(result))
    else:
        print_report(result, Console())
    print_not_written(lost)


def calibrate(
    logs: Annotated[
        list[Path], typer.Argument(help="MRCLAM folders, or recordings of `up --record` (.mcap).")
    ],
    team_file: Annotated[
        Optional[Path],
        typer.Option(
            "--team",
            help="Team file to add types to; default: the recorded team, or mrclam-uncalibrated.",
        ),
    ] = None,
    output: Annotated[Path, typer.Option(help="Team file to write.")] = Path("calibrated.toml"),
    margin: Annotated[
        float,
        typer.Option(min=0.0, help="Share by which noise is written larger: days differ."),
    ] = 0.25,
    correction_margin: Annotated[
        float,
        typer.Option(
            min=0.0, help="Share of a range's, bearing's or crawl's correction added to its noise."
        ),
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
    from cpcbl_launch.options import (
        json_text,
        require_matplotlib,
        require_writable_file,
        write_or_reason,
    )
    from cpcbl_launch.views.run import progress_bar

    require_writable_file("--output", output)
    if picture is not None:
        require_writable_file("--picture", picture)
        require_matplotlib("--picture", picture)
    base, base_name = base_text(logs, team_file)
    names = [log.resolve().name for log in logs]
    robot_logs = read_logs(logs)
    with progress_bar("calibrating", quiet=as_json) as progress:
        result = calibrated(robot_logs, names, progress)
    text = team_text(result, base, base_name, margin=margin, correction_margin=correction_margin)
    lost = write_or_reason(output, lambda: output.write_text(text, encoding="utf-8"))
    if (drawing := picture) is not None:
        from cpcbl_launch.calibration.picture import draw_residuals

        lost |= write_or_reason(drawing, lambda: draw_residuals(robot_logs, result, drawing))
    if as_json:
        typer.echo(json_text(result))
    else:
        print_calibration(result, Console())
        if not lost:
            typer.echo(f"written: {output}")
    print_not_written(lost)


def simulate(
    file: TeamArgument = None,
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
    report: ReportFile = None,
    picture: PictureFile = None,
    as_json: AsJson = False,
) -> None:
    """Run a simulated team in one process, without Zenoh: deterministic for a seed.

    With a team file: the report of `up`. With --robots: what a robot costs in
    teams of each size, on a field that grows with them. Measured are the fixes
    and beliefs that it sends and receives, and the CPU time of its own steps;
    simulating the field is apart.
    """
    from rich.console import Console

    from cpcbl_launch.lab.scaling.measure import (
        DURATION_S,
        ScalingReport,
        measure_sizes,
        parse_sizes,
    )
    from cpcbl_launch.lab.scaling.show import print_scaling
    from cpcbl_launch.options import (
        json_text,
        require_matplotlib,
        require_team_opencv,
        require_writable_file,
        write_or_reason,
    )
    from cpcbl_launch.reporting.recorder import Report
    from cpcbl_launch.run.up import Run, simulate_run
    from cpcbl_launch.simulation.in_process import Overrides, with_overrides
    from cpcbl_launch.views.run import print_report, progress_bar

    budgets = Overrides(
        bytes_per_s=bytes_per_s,
        messages_per_minute=messages_per_minute,
        match_messages=match_messages,
    )
    if file is not None and robots:
        raise InputError("simulate: FILE or --robots, which generates its teams; leave one out")
    if robots and budgets != Overrides():
        raise InputError("simulate: generated teams have no budgets; name a team file instead")
    if report is not None:
        require_writable_file("--report", report)
    if picture is not None:
        require_writable_file("--picture", picture)
        require_matplotlib("--picture", picture)
    result: Report | ScalingReport
    with progress_bar("simulating", quiet=as_json) as progress:
        if robots:
            duration = DURATION_S if duration is None else duration
            result = measure_sizes(parse_sizes(robots), seed, duration, progress)
        else:
            team = with_overrides(find_team(file or Path("demo")), budgets)
            require_team_opencv(team, team.robots, field=True)
            run = Run(team, duration, seed=seed, picture=picture)
            result = simulate_run(run, progress)
    lost = write_report(report, result)
    if isinstance(result, Report):
        lost |= result.not_written
    elif (drawing := picture) is not None:
        from cpcbl_launch.lab.scaling.picture import draw_scaling

        lost |= write_or_reason(drawing, lambda: draw_scaling(result, drawing))
    if as_json:
        sys.stdout.write(json_text(result) + "\n")
    elif isinstance(result, ScalingReport):
        print_scaling(result, Console())
    else:
        print_report(result, Console())
    print_not_written(lost)
