"""What a person sees: the live table, the report, progress. Fits 80 columns."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from cpcbl_launch.recorder import LearnedReport, MeanScore, Recorder, Report
from cpcbl_launch.supervisor import Supervisor
from cpcbl_launch.tables import number, percent, table
from cpcbl_team.collaboration import LOWEST_TIER
from cpcbl_team.metrics import Score
from cpcbl_transport.messages import Status, Track, Truth

SNAPSHOT_S = 5.0
FIGURES = ("RMSE m", "mean m", "max m", "deg", "in 3 σ", "NEES")
ProgressSetter = Callable[[float], None]
Cell = str | Text


class LiveTable:
    """The team as it runs: redrawn on a terminal, else a snapshot every few seconds."""

    def __init__(self, title: str, console: Console, quiet: bool = False) -> None:
        self._title, self._console, self._quiet = title, console, quiet
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._next_s = 0.0

    def __enter__(self) -> "LiveTable":
        if self._console.is_terminal and not self._quiet:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, recorder: Recorder, supervisor: Supervisor, elapsed_s: float) -> None:
        """Called several times a second."""
        if self._quiet:
            return
        if self._console.is_terminal:
            self._live.update(self._table(recorder, supervisor, elapsed_s), refresh=True)
        elif recorder.tracks and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + SNAPSHOT_S
            self._console.print(self._table(recorder, supervisor, elapsed_s))

    def _table(self, recorder: Recorder, supervisor: Supervisor, elapsed_s: float) -> Table:
        tracks, statuses, truths = recorder.latest()
        shown = table(
            f"{self._title}, {elapsed_s:.1f} s",
            ("robot",),
            ("pid", "x m", "y m", "deg", "σ m", "err m", "tier", "out", "B", "in", "B"),
        )
        shown.add_column("", overflow="fold")
        pids, restarts = supervisor.pids, supervisor.restarts
        here = [n.removeprefix("robot-") for n in supervisor.names if n != "field"]
        for name in [*here, *sorted(tracks.keys() - set(here))]:
            process = f"robot-{name}"
            pid = str(pids[process]) if process in pids else "down" if name in here else "away"
            state = _state(tracks.get(name), pid, restarts.get(process, 0))
            shown.add_row(
                name,
                pid,
                *_pose_cells(tracks.get(name), truths.get(name)),
                *_traffic_cells(statuses.get(name)),
                state,
            )
        return shown


def _state(track: Track | None, pid: str, restarts: int) -> Text:
    if pid == "down":
        state = Text("down", style="bold red")
    elif track is None:
        state = Text("starting", style="dim")
    else:
        state = Text(f"lost: {track.lost}", "bold red") if track.lost else Text("ok", "green")
    return state.append(f" (restarted {restarts})", "yellow") if restarts else state


def _pose_cells(track: Track | None, truth: Truth | None) -> list[Cell]:
    if track is None:
        return [""] * 6
    c = track.covariance
    error = None if truth is None else math.hypot(truth.x_m - track.x_m, truth.y_m - track.y_m)
    tier = Text(str(track.tier), "green" if track.tier < LOWEST_TIER // 2 else "yellow")
    return [
        f"{track.x_m:.2f}",
        f"{track.y_m:.2f}",
        f"{math.degrees(track.heading_rad):.0f}",
        "-" if c is None else f"{math.sqrt(0.5 * (c[0] + c[2])):.3f}",
        _graded(error),
        tier,
    ]


def _traffic_cells(status: Status | None) -> list[Cell]:
    if status is None:
        return [""] * 4
    s = status
    return [
        _short(n) for n in (s.messages_sent, s.bytes_sent, s.messages_received, s.bytes_received)
    ]


def _short(n: int) -> str:
    for unit, size in (("", 1.0), ("k", 1e3), ("M", 1e6)):
        if n < 999.5 * size:
            digits = 1 if unit and n < 9.95 * size else 0
            return f"{n / size:.{digits}f}{unit}"
    return f"{n / 1e9:.1f}G"


def _graded(error: float | None) -> Text:
    if error is None:
        return Text("-")
    return Text(f"{error:.3f}", "green" if error < 0.15 else "yellow" if error < 0.5 else "red")


def print_report(report: Report, console: Console) -> None:
    """The figures of a run as a table with units."""
    before = ("before m",) if report.alone else ()
    figures = table(
        "errors of position and heading (deg, RMSE)",
        ("robot",),
        (*before, *FIGURES, "lost", "out", "B"),
    )
    for name, r in report.robots.items():
        alone = report.alone.get(name)
        figures.add_row(
            name,
            *([number(alone.position_rmse_m)] if alone is not None else []),
            *_figures(r),
            percent(r.lost_share),
            _short(r.messages_sent),
            _short(r.bytes_sent),
        )
    t = report.team
    known = [s.position_rmse_m for s in report.alone.values() if s.position_rmse_m is not None]
    figures.add_section()
    figures.add_row(
        "team",
        *([number(sum(known) / len(known) if known else None)] if report.alone else []),
        *_figures(t),
        "",
        _short(t.messages_sent),
        _short(t.bytes_sent),
        style="bold",
    )
    console.print(figures)
    if report.yardsticks:
        console.print(_yardsticks(report))
    for line in _remarks(report):
        console.print(line, style="yellow", highlight=False)


def _yardsticks(report: Report) -> Table:
    """Plain filters beside the team: means over the robots."""
    shown = table("yardsticks: the same data and settings, team means", ("filter",), FIGURES)
    for name, yardstick in report.yardsticks.items():
        shown.add_row(name.replace("_", " ").replace("ekf", "EKF"), *_figures(yardstick.team))
    shown.add_section()
    shown.add_row("this team", *_figures(report.team), style="bold")
    return shown


def _figures(s: Score | MeanScore) -> list[str]:
    """The cells below FIGURES."""
    return [
        number(s.position_rmse_m),
        number(s.position_mean_m),
        number(s.position_max_m),
        number(s.heading_rmse_deg, 1),
        percent(s.inside_3_sigma),
        number(s.nees, 1),
    ]


def _remarks(report: Report) -> Iterator[str]:
    if report.alone:
        yield "before: RMSE before teammates began to help; the other columns are from then on"
    yield "consistent: 98.9 % in 3 σ, NEES 2; out, B: help sent, its payload bytes"
    if report.calibrated_on:
        flattering = ": this log too, the figures flatter" if report.seen_before else ""
        yield f"robots calibrated on {', '.join(report.calibrated_on)}{flattering}"
    for name, reason in report.left_out.items():
        yield f"left out: robot {name}: {reason}"
    for name, r in report.robots.items():
        if r.bumps:
            yield f"robot {name} bumped into a landmark {r.bumps} times"
        if r.lost_at_end:
            yield f"robot {name} is lost: {r.lost_at_end}"
    for name, r in report.robots.items():
        if r.learned is not None:
            yield f"robot {name} learned: {_corrections(r.learned)}"
    for name, n in report.restarts.items():
        yield f"{name} was restarted {n} times"


def _corrections(found: LearnedReport) -> str:
    """What is done to readings: `distance × 0.98, turn × 0.96, bearings -0.6°`."""
    distance, turn, turned = found.distance_scale, found.turn_scale, -found.bearing_bias_deg
    return f"distance × {distance:.2f}, turn × {turn:.2f}, bearings {turned:+z.1f}°"


@contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[ProgressSetter]:
    """A bar on standard error; call what it yields with the share that is done."""
    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(), TimeRemainingColumn())
    disable = quiet or not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=disable) as progress:
        task = progress.add_task(title, total=1.0)
        yield lambda done: progress.update(task, completed=done)
