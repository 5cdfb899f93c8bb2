"""Commands that measure: real logs, calibration, a simulated team in one process, faults."""

import logging
import signal
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console
from typer import Argument, Option

from cpcbl_launch.commands import options
from cpcbl_launch.reporting.files import write_or_reason
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.overrides import Overrides, with_blind_robots, with_overrides
from cpcbl_launch.team.requirements import require_team_opencv
from cpcbl_team.config import Variant
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.reporting.metrics import Floats, Trajectory

TeamAndLog = Annotated[
    list[Path],
    options.team_argument(
        metavar="[TEAM] LOG",
        help="Team file, or a built-in one (mrclam is the one that was not calibrated on this log),"
        " and the folder of one data set, such as MRCLAM6; or a recorded run alone.",
    ),
]
Collaboration = Annotated[
    Literal["none", "passive", "active", "both"] | None, Option(help="Collaboration of all robots.")
]
Fusion = Annotated[Literal["naive", "split-ci"] | None, Option(help="Fusion of all robots.")]
Direction = Annotated[
    Literal["one-way", "both-ways"] | None, Option(help="Direction of all robots.")
]
UnknownStarts = Annotated[
    bool, Option("--unknown-starts", help="Robots do not know where they start.")
]
KnownLandmarks = Annotated[
    str | None,
    Option(
        metavar="NAMES",
        help="Landmarks whose places are known, e.g. 6,20 (or none); robots find the others.",
    ),
]
Yardstick = Annotated[
    Literal["ekf", "batch"] | None,
    Option(
        help="ekf, or no value: also run dead reckoning, a solo EKF per robot, a centralized EKF;"
        " batch: these, and batch least squares over all robots, which knows the future.",
        metavar="[ekf|batch]",
    ),
]
ExportFolder = Annotated[
    Path | None,
    Option(
        callback=options.folder,
        help="Folder to write estimates and truth into (TUM files, which evo reads).",
    ),
]
Scenarios = Annotated[
    list[str] | None, Argument(help="Names of scenarios, or all.", metavar="SCENARIO")
]
FaultSeconds = Annotated[
    float | None,
    Option(
        help="Seconds of faults: of the soak (at least 120, the default), and of the nemesis"
        " (at least 20; default: 60)."
    ),
]
WithKeys = Annotated[bool, Option("--keys", help="Give the teams keys: TLS and access control.")]
HistoryFile = Annotated[
    Path | None,
    Option(
        callback=options.writable_file,
        help="File for what the nemesis and the soak did (JSON Lines).",
    ),
]
RequireJudged = Annotated[
    bool, Option("--require-judged", help="Exit with 3 if the machine was too busy to judge.")
]
MarkdownFile = Annotated[
    Path | None,
    Option(callback=options.writable_file, help="File to write the table into, as Markdown."),
]
Retries = Annotated[
    int,
    Option(min=0, help="Run a scenario that does not hold up to N times more; both are reported."),
]
AtOnce = Annotated[
    int,
    Option(
        min=1, help="Run up to N scenarios at the same time, but alone those that load the machine."
    ),
]


def evaluate(
    words: TeamAndLog,
    blind: options.Blind = "",
    variant: Annotated[Variant | None, Option(help="Variant of all robots.")] = None,
    collaboration: Collaboration = None,
    fusion: Fusion = None,
    direction: Direction = None,
    bytes_per_s: options.BytesPerS = None,
    messages_per_minute: options.MessagesPerMinute = None,
    match_messages: options.MatchMessages = None,
    duration: Annotated[float | None, Option(help="Seconds of the log; default: all.")] = None,
    unknown_starts: UnknownStarts = False,
    known_landmarks: KnownLandmarks = None,
    yardstick: Yardstick = None,
    export: ExportFolder = None,
    as_json: options.AsJson = False,
) -> None:
    """Evaluate robots of a real log (UTIAS MRCLAM) against its ground truth, in one process.

    Of a recorded run (folder or .mcap) what the robots stated then is scored: evaluate RUN.
    """
    budgets = bytes_per_s, messages_per_minute, match_messages
    if len(words) == 1:
        changes = blind, variant, collaboration, fusion, direction, duration, *budgets
        is_changed = any((*changes, unknown_starts, known_landmarks, yardstick))
        _evaluate_recording(words[0], is_changed, export, as_json)
        return
    team_file, data = _team_and_log(words)
    from cpcbl_launch.lab.evaluation import evaluate_log
    from cpcbl_launch.run import logged_team
    from cpcbl_launch.views.run import print_report, progress_bar

    overrides = Overrides(*budgets, variant, collaboration, fusion, direction)
    team = with_overrides(find_team(logged_team.file_for(team_file, data)), overrides)
    logged = logged_team.load_logged_team(team, data)
    blind_team = with_blind_robots(logged.team, options.parse_names(blind), logged.left_out)
    logged = logged_team.with_duration(logged._replace(team=blind_team), duration)
    if unknown_starts:
        logged = logged_team.with_unknown_starts(logged)
    known = None if known_landmarks is None else options.parse_names(known_landmarks)
    logged = logged_team.with_known_landmarks(logged, [] if known == ["none"] else known)
    with progress_bar(f"{data.name}", quiet=as_json) as progress:
        result, paths = evaluate_log(
            logged,
            progress,
            with_baselines=yardstick is not None,
            with_batch=yardstick == "batch",
        )
    lost = _export_paths(export, paths, logged.truth)
    options.print_result(result, as_json, lambda: print_report(result, Console()), lost)


def _export_paths(
    folder: Path | None,
    paths: "Mapping[str, Mapping[str, Trajectory]]",
    truth: "Mapping[str, Floats]",
) -> dict[str, str]:
    """Writes what `--export` asks for. Returns the folder and the reason where that failed."""
    from cpcbl_launch.reporting.metrics import export_tum

    if folder is None:
        return {}
    return write_or_reason(folder, partial(export_tum, folder, paths, truth))


def _team_and_log(words: list[Path]) -> list[Path]:
    if len(words) != 2:
        raise InputError("evaluate: name a team and a log (mrclam MRCLAM6), or one recorded run")
    return words


def _evaluate_recording(run: Path, is_changed: bool, export: Path | None, as_json: bool) -> None:
    """Prints the figures of what was recorded. Raises InputError for options that change a run."""
    from cpcbl_launch.recordings.gather import is_recording
    from cpcbl_launch.recordings.summary import summarize
    from cpcbl_launch.views.run import print_report

    if not is_recording(run):
        raise InputError(
            f"evaluate {run}: no recorded run (a folder of `up --record`, or .mcap); of a log name"
            f" the team, too: evaluate mrclam {run}"
        )
    if is_changed:
        raise InputError(
            f"evaluate {run}: a recorded run is scored as it was; only --export and --json apply"
        )
    summary = summarize(run)
    paths = {name: summary.recorder.trajectory(name) for name in summary.names}
    lost = _export_paths(export, {"estimate": paths}, summary.truth)
    remarks = list(summary.remarks)
    if not summary.truth:
        remarks.append(f"{run}: holds no true poses, so errors are not known")
    for remark in remarks:
        typer.echo(remark, err=True)
    result = summary.report
    options.print_result(result, as_json, lambda: print_report(result, Console()), lost)


def calibrate(
    words: Annotated[
        list[Path],
        Argument(
            metavar="[TEAM] LOG",
            help="MRCLAM folders, or recorded runs of `up --record` (folders, .mcap). TEAM: to"
            " which types are added; default: the recorded team, or mrclam-uncalibrated.",
        ),
    ],
    output: Annotated[
        Path, Option(callback=options.writable_file, help="Team file to write.")
    ] = Path("calibrated.toml"),
    margin: Annotated[float, Option(min=0.0, help="Share by which noise is written larger.")] = 0.5,
    correction_margin: Annotated[
        float,
        Option(
            min=0.0,
            help="Share of a crawl's correction (one log: a range's too) added to its noise.",
        ),
    ] = 0.5,
    picture: options.PictureFile = None,
    as_json: options.AsJson = False,
) -> None:
    """Estimate odometry and sensor errors from logs with truth, as types of a team file."""
    from cpcbl_launch.calibration.logs import read_logs
    from cpcbl_launch.calibration.reports import print_calibration
    from cpcbl_launch.calibration.team_types import base_team, calibrate_robots, calibrated_team
    from cpcbl_launch.recordings.merge import recording_files
    from cpcbl_launch.views.run import progress_bar

    team_file, logs = options.team_and_files(words)
    if not logs:
        raise InputError(f"calibrate {team_file}: name logs after the team")
    with recording_files(logs) as files:
        base, base_name = base_team(files, team_file)
        robot_logs = read_logs(files)
    with progress_bar("calibrating", quiet=as_json) as progress:
        result = calibrate_robots(robot_logs, [log.resolve().name for log in logs], progress)
    text = calibrated_team(
        result, base, base_name, margin=margin, correction_margin=correction_margin
    )
    lost = write_or_reason(output, lambda: output.write_text(text, encoding="utf-8"))
    if picture is not None:
        from cpcbl_launch.calibration.plots import draw_residuals

        lost |= write_or_reason(picture, partial(draw_residuals, robot_logs, result, picture))
    options.print_result(result, as_json, lambda: print_calibration(result, Console()), lost)
    if not as_json:
        typer.echo(f"written: {output}")


def simulate(
    file: options.TeamOrDemo = None,
    robots: Annotated[str, Option(hidden=True)] = "",
    duration: Annotated[float | None, Option(help="Seconds of robot time; default: 30.")] = None,
    seed: options.NoiseSeed = 1,
    bytes_per_s: options.BytesPerS = None,
    messages_per_minute: options.MessagesPerMinute = None,
    match_messages: options.MatchMessages = None,
    report: options.ReportFile = None,
    picture: options.PictureFile = None,
    record: options.RecordPath = None,
    as_json: options.AsJson = False,
) -> None:
    """Run a simulated team in one process, without Zenoh: deterministic for a seed.

    The command reports as `up` does.
    """
    from cpcbl_launch.run.up import Run, simulate_run
    from cpcbl_launch.views.run import print_report, progress_bar

    if robots:
        options.refuse_moved("simulate --robots", f"bench-scaling ARGS='--team-sizes {robots}'")
    budgets = Overrides(bytes_per_s, messages_per_minute, match_messages)
    team = with_overrides(find_team(file or Path("demo")), budgets)
    require_team_opencv(team, team.robots, field=True)
    with progress_bar("simulating", quiet=as_json) as progress:
        run = Run(team, duration, seed=seed, picture=picture, record=record)
        result = simulate_run(run, progress)
    lost = options.write_report(report, result) | result.not_written
    recorded = run.record_folder
    options.print_result(result, as_json, lambda: print_report(result, Console()), lost, recorded)


def chaos(
    scenarios: Scenarios = None,
    listed: Annotated[bool, Option("--list", help="Show the scenarios.")] = False,
    seed: Annotated[int, Option(help="The seed of noise and of random faults.")] = 1,
    duration: FaultSeconds = None,
    keys: WithKeys = False,
    history: HistoryFile = None,
    require_judged: RequireJudged = False,
    markdown: MarkdownFile = None,
    retries: Retries = 0,
    at_once: AtOnce = 1,
    report: options.ReportFile = None,
    as_json: options.AsJson = False,
) -> None:
    """Inject faults into real processes, and compare what happens with what is expected.

    The exit code is 1 if an expectation was not met. A scenario that cannot run here (lost
    packets and full disks need root), or that cannot be judged because other programs used the
    processors, is named, and counts as neither met nor not met.
    """
    from cpcbl_launch.lab.chaos import runner
    from cpcbl_launch.lab.chaos.checks import report_data
    from cpcbl_launch.lab.chaos.scenario import ScenarioOptions
    from cpcbl_launch.lab.chaos.scenarios import SCENARIOS

    if listed or not scenarios:
        runner.print_scenarios(SCENARIOS, Console())
        return
    todo = runner.select_scenarios(scenarios)
    runner.require_judgeable(todo, duration)
    _prepare_for_faults()
    with runner.Progress(Console(stderr=True), len(todo)) as shown:
        chosen = ScenarioOptions(seed, duration_s=duration, secured=keys, history=history)
        faults = runner.run_scenarios(
            todo, chosen, shown.on_begin, shown.on_end, retries=retries, at_once=at_once
        )
    result = report_data(faults)
    lost = options.write_report(report, result)
    if (page := markdown) is not None:
        text = "\n".join(runner.markdown(faults)) + "\n"
        lost |= write_or_reason(page, lambda: page.write_text(text, encoding="utf-8"))
    options.print_result(result, as_json, lambda: runner.print_faults(faults, Console()), lost)
    if not faults.is_met:
        raise typer.Exit(1)
    if require_judged and not faults.is_judged:
        raise typer.Exit(3)


def _prepare_for_faults() -> None:
    """Restarts are part of it, so they are not logged; each signal ends what was started."""
    for logger in ("cpcbl_launch", "cpcbl_transport"):
        logging.getLogger(logger).setLevel(logging.ERROR)
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
