"""What a person sees: the live table, the report, progress."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from cpcbl_launch.recorder import Recorder, Report
from cpcbl_launch.supervisor import Supervisor
from cpcbl_team.collaboration import LOWEST_TIER

SNAPSHOT_S = 5.0
ProgressSetter = Callable[[float], None]


class LiveTable:
    """The team as it runs: redrawn on a terminal, else a snapshot every few seconds."""

    def __init__(self, title: str, console: Console, quiet: bool = False) -> None:
        self._title, self._console, self._quiet = title, console, quiet
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._shown_s = -math.inf

    def __enter__(self) -> "LiveTable":
        if self._console.is_terminal and not self._quiet:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, recorder: Recorder, supervisor: Supervisor, elapsed_s: float) -> None:
        if self._quiet:
            return
        if self._console.is_terminal:
            self._live.update(self._table(recorder, supervisor, elapsed_s), refresh=True)
        elif elapsed_s > 0.0 and time.monotonic() - self._shown_s >= SNAPSHOT_S:
            self._shown_s = time.monotonic()
            self._console.print(self._table(recorder, supervisor, elapsed_s))

    def _table(self, recorder: Recorder, supervisor: Supervisor, elapsed_s: float) -> Group:
        tracks, statuses, truths = recorder.latest()
        table = Table(title=f"{self._title}   {elapsed_s:6.1f} s", title_justify="left")
        table.add_column("robot")
        for column in ("pid", "x m", "y m", "heading deg", "sigma m", "error m", "tier"):
            table.add_column(column, justify="right")
        table.add_column("state")
        for column in ("out msg", "out B", "in msg", "in B"):
            table.add_column(column, justify="right")
        pids, restarts = supervisor.pids, supervisor.restarts
        names = [n.removeprefix("robot-") for n in {**pids, **restarts} if n != "field"]
        for name in sorted(set(names) | tracks.keys()):
            process, track, status = f"robot-{name}", tracks.get(name), statuses.get(name)
            pid = str(pids.get(process, "down"))
            row: list[str | Text] = [name, pid]
            if track is None:
                table.add_row(*row, *[""] * 5, Text("starting", style="dim"))
                continue
            truth = truths.get(name)
            error = (
                math.hypot(truth.x_m - track.x_m, truth.y_m - track.y_m)
                if truth is not None
                else None
            )
            sigma = (
                None
                if track.covariance is None
                else math.sqrt(0.5 * (track.covariance[0] + track.covariance[2]))
            )
            state = Text(track.lost, style="bold red") if track.lost else Text("ok", "green")
            if process not in pids:
                state = Text("down", style="bold red")
            if restarts.get(process):
                state.append(f" (restart {restarts[process]})", style="yellow")
            row += [
                f"{track.x_m:.2f}",
                f"{track.y_m:.2f}",
                f"{math.degrees(track.heading_rad):.0f}",
                "-" if sigma is None else f"{sigma:.3f}",
                _graded(error),
                "lost" if track.lost else _tier(track.tier),
                state,
            ]
            if status is not None:
                row += [
                    str(status.messages_sent),
                    str(status.bytes_sent),
                    str(status.messages_received),
                    str(status.bytes_received),
                ]
            table.add_row(*row)
        return Group(table)


def _graded(error: float | None) -> Text:
    if error is None:
        return Text("-")
    style = "green" if error < 0.15 else "yellow" if error < 0.5 else "red"
    return Text(f"{error:.3f}", style=style)


def _tier(tier: int) -> Text:
    return Text(str(tier), style="green" if tier < LOWEST_TIER // 2 else "yellow")


def print_report(report: Report, console: Console) -> None:
    """The figures of a run as a table with units."""
    figures = Table(title="position and heading against the truth", title_justify="left")
    figures.add_column("robot")
    if report.alone:
        figures.add_column("RMSE m before help", justify="right")
    for column in (
        "RMSE m",
        "mean m",
        "max m",
        "heading RMSE deg",
        "inside 3 sigma",
        "NEES (2 due)",
        "lost",
        "bumps",
        "sent msg",
        "sent B",
    ):
        figures.add_column(column, justify="right")
    for name, r in report.robots.items():
        alone = report.alone.get(name)
        row = [name, *([_number(alone.position_rmse_m)] if alone is not None else [])]
        figures.add_row(
            *row,
            _number(r.position_rmse_m),
            _number(r.position_mean_m),
            _number(r.position_max_m),
            _number(r.heading_rmse_deg, 1),
            _share(r.inside_3_sigma),
            _number(r.nees, 1),
            _share(r.lost_share),
            str(r.bumps),
            str(r.messages_sent),
            str(r.bytes_sent),
        )
    t = report.team
    alone_rmse = [a.position_rmse_m for a in report.alone.values() if a.position_rmse_m]
    mean_alone = sum(alone_rmse) / len(alone_rmse) if alone_rmse else None
    figures.add_section()
    figures.add_row(
        "team",
        *([_number(mean_alone)] if report.alone else []),
        _number(t.position_rmse_m),
        _number(t.position_mean_m),
        _number(t.position_max_m),
        _number(t.heading_rmse_deg, 1),
        _share(t.inside_3_sigma),
        _number(t.nees, 1),
        "",
        "",
        str(t.messages_sent),
        str(t.bytes_sent),
        style="bold",
    )
    console.print(figures)
    for name, reason in report.left_out.items():
        console.print(f"left out: robot {name}: {reason}", style="yellow", highlight=False)
    for name, r in report.robots.items():
        if r.lost_at_end:
            console.print(f"robot {name} is lost: {r.lost_at_end}", style="red", highlight=False)
    for name, n in report.restarts.items():
        console.print(f"{name} was restarted {n} times", style="yellow", highlight=False)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f} %"


@contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[ProgressSetter]:
    """A bar on standard error; call what it yields with the share that is done."""
    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=quiet) as progress:
        task = progress.add_task(title, total=1.0)
        yield lambda done: progress.update(task, completed=done)
