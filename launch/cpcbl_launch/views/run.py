"""What a person sees: the live table, the report, progress. Fits 80 columns."""

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from statistics import fmean

from rich.console import Console, Group, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from cpcbl_agents.robot_state import (
    RobotState,
    learned_text,
    miscalibration_text,
    misplaced_objects,
    robot_state,
)
from cpcbl_launch.reporting.frames import frames_text
from cpcbl_launch.reporting.metrics import ErrorFigures
from cpcbl_launch.reporting.phases import AWAY_S
from cpcbl_launch.reporting.recorder import Effect, GuestReport, Recorder, Report, RobotReport
from cpcbl_launch.reporting.statuses import (
    problem_remarks,
    trust_remarks,
)
from cpcbl_launch.reporting.tables import STYLES, number, percent, short, table, times
from cpcbl_launch.run.observer import ObserverReport
from cpcbl_launch.run.processes import ROBOT, Processes
from cpcbl_launch.views.live import LiveView
from cpcbl_launch.views.own_figures import own_figures_table
from cpcbl_launch.views.traffic_tables import (
    COLUMNS_EXPLAINED,
    help_traffic_table,
    kinds_text,
    limits_text,
)
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport.messages import Track

NARROW = 61  # columns of a terminal, with which a table does without its less important ones
WITHOUT = ("before m", "mean m", "max m", "out", "B")
FIGURES = ("RMSE m", "mean m", "max m", "deg", "in 3 σ", "NEES")
ProgressSetter = Callable[[float], None]
Cell = str | Text


class LiveTable(LiveView):
    """The team as it runs: redrawn on a terminal, else a snapshot every few seconds."""

    def __init__(
        self, title: str, robots: Collection[str], console: Console, quiet: bool = False
    ) -> None:
        """`robots` are those of the team file; every other robot is a guest."""
        super().__init__(console, quiet)
        self._title, self._robots = title, robots
        self._heard: dict[str, tuple[int, float]] = {}

    def show(self, recorder: Recorder, processes: Processes, elapsed_s: float) -> None:
        """Called several times a second."""
        drawn = bool(recorder.tracks)
        self.draw(lambda: self._table_and_problems(recorder, processes, elapsed_s), drawn)

    def _table_and_problems(
        self, recorder: Recorder, processes: Processes, elapsed_s: float
    ) -> RenderableType:
        here = [n.removeprefix(ROBOT) for n in processes.names if n.startswith(ROBOT)]
        (tracks, statuses, _), pids = recorder.latest(), processes.pids
        others = sorted(tracks.keys() - {*here}, key=lambda name: (name not in self._robots, name))
        states = {
            name: robot_state(
                statuses.get(name),
                tracks.get(name),
                is_alive=f"{ROBOT}{name}" in pids,
                silent_s=self._silent_s(name, tracks[name]) if name in tracks else 0.0,
                pause_s=1.0,  # it may be drawn late
                ended_s=math.inf if name in here and f"{ROBOT}{name}" not in pids else None,
            )
            for name in [*here, *others]  # guests last
        }
        lines = [
            Text(f"{name}: {reason}", STYLES[state.severity])
            for name, state in states.items()
            if state.word != "waiting" and (state.word != "gone" or name in self._robots)
            for reason in state.reasons
        ]
        frames = {name: tracks[name].frame for name in states if name in tracks}
        if text := frames_text(frames):
            lines.insert(0, Text(text))
        return Group(self._table(recorder, processes, elapsed_s, states), *lines)

    def _silent_s(self, name: str, track: Track) -> float:
        """Real seconds since the latest track of a robot came."""
        now_s = time.monotonic()
        if self._heard.get(name, (-1, 0.0))[0] != track.stamp_ns:
            self._heard[name] = track.stamp_ns, now_s
        return now_s - self._heard[name][1]

    def _table(
        self,
        recorder: Recorder,
        processes: Processes,
        elapsed_s: float,
        states: Mapping[str, RobotState],
    ) -> Table:
        (tracks, statuses, _), errors_m = recorder.latest(), recorder.latest_errors_m()
        shown = table(
            f"{self._title}, {elapsed_s:.1f} s",
            ("robot",),
            ("pid", "x m", "y m", "deg", "σ m", "err m", "tier", "out", "B", "in", "B"),
        )
        shown.add_column("", overflow="fold")
        pids, restarts = processes.pids, processes.restarts
        newest_ns = max((t.stamp_ns for t in tracks.values()), default=0)
        for name, found in states.items():
            process = f"{ROBOT}{name}"
            here = "down" if process in processes.names else "away"
            pid, status = str(pids.get(process, here)), statuses.get(name)
            state = Text(found.word, STYLES[found.severity])
            if restarts.get(process):
                state.append(f" (restarted {restarts[process]})", "yellow")
            if name not in self._robots:
                there = newest_ns - tracks[name].stamp_ns <= AWAY_S * 1e9
                pid, state = "guest", state if there else Text("left", "dim")
            pose = _pose_cells(tracks.get(name), errors_m.get(name))
            traffic = [""] * 4
            if (s := status) is not None:
                counts = s.messages_sent, s.bytes_sent, s.messages_received, s.bytes_received
                traffic = [short(n) for n in counts]
            shown.add_row(name, pid, *pose, *traffic, state)
        if not self.fits(shown):
            shown.padding = (0, 0)  # closer together, before a state is folded
        if self.width < NARROW:  # without traffic and process, before "ok" is
            del shown.columns[8:12], shown.columns[1]
        return shown


def _pose_cells(track: Track | None, error_m: float | None) -> list[Cell]:
    if track is None:
        return [""] * 6
    x, y, heading = f"{track.x_m:.2f}", f"{track.y_m:.2f}", f"{math.degrees(track.heading_rad):.0f}"
    c, error_cell = track.covariance, Text("-")
    if error_m is not None:
        colour = "green" if error_m < 0.15 else "yellow" if error_m < 0.5 else "red"
        error_cell = Text(f"{error_m:.3f}", colour)
    tier = Text(str(track.tier), "green" if track.tier < LOWEST_TIER // 2 else "yellow")
    sigma = number(None if c is None else math.sqrt(0.5 * (c[0] + c[2])))
    return [x, y, heading, sigma, error_cell, tier]


def print_report(report: Report, console: Console) -> None:
    """The figures of a run as a table with units."""
    figures = _figures_table(report)
    if console.width < NARROW:
        figures.columns[:] = [c for c in figures.columns if c.header not in WITHOUT]
    scores = (report.team, *report.alone.values())  # a short run ends before teammates help
    if any(s.position_rmse_m is not None for s in scores) or not report.has_data:
        console.print(figures)
    else:
        console.print(own_figures_table(report))
    for name, guest in report.guests.items():
        console.print()
        console.print(_effects(name, guest))
    if any(r.sent or r.spending for r in report.robots.values()):
        console.print()
        console.print(help_traffic_table(report))
        console.print(COLUMNS_EXPLAINED, style="yellow", highlight=False)
    if (text := limits_text(report)) is not None:
        console.print(text)
    if report.yardsticks:
        console.print(_baseline_table(report))
    for line in _remarks(report, console.width >= NARROW):
        console.print(line, style="yellow", highlight=False, markup=False)  # robots may say [/b]


def _figures_table(report: Report) -> Table:
    before = ("before m",) if report.alone else ()
    columns = (*before, *FIGURES, "lost", "out", "B")
    shown = table("errors of position and heading (deg, RMSE)", ("robot",), columns)
    for name, r in report.robots.items():
        alone = report.alone.get(name)
        before_m = [] if alone is None else [number(alone.position_rmse_m)]
        shown.add_row(name, *before_m, *_robot_cells(r))
    known = [s.position_rmse_m for s in report.alone.values() if s.position_rmse_m is not None]
    before_m = [number(fmean(known) if known else None) for _ in before]
    sent = short(report.team.messages_sent), short(report.team.bytes_sent)
    shown.add_section()
    shown.add_row("team", *before_m, *_figures(report.team), "", *sent, style="bold")
    if report.guests:
        shown.add_section()
    for name, guest in report.guests.items():
        shown.add_row(f"{name}, guest", *("-" for _ in before), *_robot_cells(guest))
    return shown


def _robot_cells(r: RobotReport) -> list[str]:
    """The cells of a robot from FIGURES on."""
    lost = percent(r.lost_share) if r.has_data else "-"
    return [*_figures(r), lost, short(r.messages_sent), short(r.bytes_sent)]


def _effects(name: str, guest: GuestReport) -> Table:
    parts = Effect.__struct_fields__
    present = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in guest.present_s)
    shown = table(
        f"before, during and after guest {name}, present from {present}",
        ("robot",),
        [f"{what} {part}" for what in ("RMSE", "σ") for part in parts],
    )
    for robot, effect in guest.robots.items():
        phases = [getattr(effect, part) for part in parts]
        rmse = [number(p.position_rmse_m) for p in phases]
        shown.add_row(robot, *rmse, *(number(p.position_sigma_m) for p in phases))
    return shown


def print_observer_report(report: ObserverReport, console: Console) -> None:
    """What an observer did while it was there."""
    sigma = number(report.position_sigma_m)
    text = f"{report.name} took part for {report.seconds:.1f} s, position σ {sigma} m at the end"
    console.print(text, style="bold", highlight=False)
    shown = table("", ("help",), ("messages", "B"))
    for direction, flows in (("sent", report.sent), ("heard", report.heard)):
        for flow in flows:
            peer = f" {'to' if direction == 'sent' else 'from'} {flow.peer}" if flow.peer else ""
            figures = short(flow.messages), short(flow.bytes)
            shown.add_row(f"{flow.topic} {direction}{peer}", *figures)
    if shown.row_count:
        console.print(shown)
    if report.lost:
        console.print(f"{report.name} is lost: {report.lost}", style="yellow", highlight=False)
    if report.unfed:
        console.print(f"{report.name}: {report.unfed}", style="yellow", highlight=False)
    for line in problem_remarks(report.name, report.problems):
        console.print(line, style="yellow", highlight=False, markup=False)


def _baseline_table(report: Report) -> Table:
    shown = table("baselines: the same data and settings, team means", ("filter",), FIGURES)
    for name, yardstick in report.yardsticks.items():
        shown.add_row(name.replace("_", " ").replace("ekf", "EKF"), *_figures(yardstick.team))
    shown.add_section()
    shown.add_row("this team", *_figures(report.team), style="bold")
    return shown


def _figures(s: ErrorFigures) -> list[str]:
    """The cells below FIGURES."""
    errors_m = s.position_rmse_m, s.position_mean_m, s.position_max_m
    heading, inside = number(s.heading_rmse_deg, 1), percent(s.inside_3_sigma)
    return [*map(number, errors_m), heading, inside, number(s.nees, 1)]


def _remarks(report: Report, is_wide: bool) -> Iterator[str]:
    if text := frames_text({name: r.frame for name, r in report.robots.items() if r.has_data}):
        yield f"At the end: {text}."
    if report.alone and is_wide:
        yield "Column before is the RMSE before teammates began to help, the others since then."
    if is_wide:
        yield f"Columns out and B count {kinds_text(report)} that were sent, and their bytes."
    yield "For reference: a consistent filter has 98.9 % in 3 σ and a NEES of 2."
    team = report.team
    if team.pooled_rmse_m is not None:
        pooled = f"All samples together: RMSE {team.pooled_rmse_m:.3f} m"
        nees = f"; NEES of the heading {number(team.heading_nees, 1)} (1 expected)"
        yield f"{pooled}{nees if team.heading_nees is not None else ''}."
    if team.scored_share is not None and team.scored_share < 0.995:
        yield f"Truth is known for {team.scored_share:.0%} of the estimates; the rest has no score."
    if report.starts:
        yield f"At the start: {report.starts}."
    if report.calibrated_on:
        too_good = " (also on this log: the figures are too good)" if report.seen_before else ""
        yield f"The robots were calibrated on {', '.join(report.calibrated_on)}{too_good}."
    for name, reason in report.left_out.items():
        yield f"Robot {name} did not take part: {reason}."
    for name, r in report.robots.items():
        if r.bumps:
            yield f"Robot {name} bumped into a landmark {times(r.bumps)}."
        if r.lost_at_end:
            yield f"Robot {name} is lost: {r.lost_at_end}."
        elif not r.has_data:
            yield f"Robot {name} received no input: neither odometry nor sightings nor a position."
    for name, r in report.robots.items():
        learned = None
        if (own := r.learned) is not None:  # what is done to readings
            text = learned_text(own.distance_scale, own.turn_scale, own.bearing_bias_deg)
            if text != learned_text(1.0, 1.0, 0.0):
                yield f"Robot {name} calibrated itself: {text}."
            bias_rad = math.radians(own.bearing_bias_deg)
            learned = own.distance_scale, own.turn_scale, bias_rad
        if text := miscalibration_text(r.counts, learned):
            yield f"Robot {name} is miscalibrated: {text}. Run `cpcbl-team calibrate`."
        for place, text in misplaced_objects(r.counts).items():
            yield f"Robot {name} finds {place} elsewhere than {text}. Measure its place again."
    for name, r in report.robots.items():
        yield from problem_remarks(name, r.problems)
        yield from trust_remarks(name, r.trust)
    if report.refused:
        counts = ", ".join(f"{reason} {n}" for reason, n in report.refused.items())
        yield f"Messages that could not be used, by reason: {counts}."
    for name, n in report.restarts.items():
        yield f"Process {name} was restarted {times(n)}."


@contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[ProgressSetter]:
    """A bar on standard error; call what it yields with the share that is done."""
    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(), TimeRemainingColumn())
    disable = quiet or not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=disable) as progress:
        task = progress.add_task(title, total=1.0)
        yield lambda done: progress.update(task, completed=done)
