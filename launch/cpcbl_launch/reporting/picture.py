"""A run as one picture: where the robots went, how sure and how wrong they were, what they used
and refused, and what help they received. Works without truth. Needs extra `plot`."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.paths import MOST_POINTS, RobotPath, robot_paths, thin, worst_first
from cpcbl_launch.reporting.picture_field import OTHERS, draw_field
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_team.config import Team

Spans = Sequence[tuple[float, float]]  # from when until when (s)
MOST_STRIPS = 6  # robots with a strip of their own
MOST_GUESTS = 20
MOST_REMARKS = 6
COLOURS = ("C0", "C1", "C2", "C4", "C5", "C9")  # without red, which says that a robot is lost
LOST: dict[str, Any] = {"color": "tab:red", "alpha": 0.25, "linewidth": 0}
SILENT: dict[str, Any] = {"facecolor": "none", "edgecolor": "0.75", "hatch": "///", "linewidth": 0}
LEAST_M, LARGEST_M = 1e-3, 1e3  # of the axis of errors
GRID = 300  # spans of time in which a large team is summarized
FEW = 5


class Times(NamedTuple):
    """The time of a run."""

    begin_s: float  # when it began, in the time of stamps
    duration_s: float
    helped_from_s: float | None  # in the time of stamps; None: from the start
    guests_s: Mapping[str, Spans]  # when each guest was there, since the start of the run


def draw_run(
    recorder: Recorder, team: Team, truth: Mapping[str, Floats], path: Path, times: Times
) -> None:
    """Draws a run into a file (PNG or SVG)."""
    run_figure(recorder, team, truth, times).savefig(path, dpi=110)


def run_figure(recorder: Recorder, team: Team, truth: Mapping[str, Floats], times: Times) -> Figure:
    """The field; measurements and help; a strip a robot with its error or sigma over time, up to
    six of them, else those that were worst and the whole team in one."""
    names = [*team.robots, *sorted(times.guests_s)[:MOST_GUESTS]]
    paths = robot_paths(recorder, names, truth, times.begin_s, times.duration_s)
    chosen = paths if len(paths) <= MOST_STRIPS else worst_first(paths)[: MOST_STRIPS - 1]
    colours = dict.fromkeys(names, OTHERS)
    colours |= {p.name: colour for p, colour in zip(chosen, COLOURS, strict=False)}
    strips = len(chosen) + (len(chosen) < len(paths))
    figure = Figure(figsize=(13.5, max(6.4, 2.4 + 1.15 * strips)), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False)[0]
    field, used, received = left.subplots(3, 1, height_ratios=(3.8, 1.0, 1.0))
    outside = draw_field(field, team, paths, colours)
    _draw_activity(used, received, recorder, paths, colours, times)
    panels = right.subplots(strips, 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    _draw_strips(right, panels, chosen, paths, colours, times)
    figure.suptitle(_title(team, paths, times), fontsize=12, parse_math=False)
    remarks = [textwrap.shorten(line, 160) for line in (*_remarks(paths), *outside)]
    if len(remarks) > MOST_REMARKS:
        remarks[MOST_REMARKS - 1 :] = [f"... and {len(remarks) - MOST_REMARKS + 1} remarks more."]
    if remarks:
        figure.supxlabel("\n".join(remarks), fontsize=8, color="tab:red", parse_math=False)
    return figure


def _title(team: Team, paths: Sequence[RobotPath], times: Times) -> str:
    guests = f" and {n} guests" if (n := len(times.guests_s)) > 1 else " and a guest" if n else ""
    robots = "1 robot" if len(team.robots) == 1 else f"{len(team.robots)} robots"
    known = [path.has_truth for path in paths]
    truth = "" if all(known) else "; true poses are not known"
    if any(known) and not all(known):
        truth = "; true poses are known of some"
    return f"team {team.name}: {robots}{guests}, {_duration(times.duration_s)}{truth}"


def _remarks(paths: Sequence[RobotPath]) -> list[str]:
    silent = [path.name for path in paths if not len(path.times_s)]
    unsure = [path.name for path in paths if len(path.times_s) and not path.has_sigma]
    remarks = [f"Nothing was heard of {', '.join(silent)}."] if silent else []
    if unsure:
        remarks.append(f"No σ is stated by {', '.join(unsure)}.")
    return remarks + [
        f"{path.name}: {path.outside} estimates have stamps outside of the run."
        for path in paths
        if path.outside
    ]


def _draw_strips(
    figure: Any,
    panels: Sequence[Axes],
    chosen: Sequence[RobotPath],
    paths: Sequence[RobotPath],
    colours: Mapping[str, str],
    times: Times,
) -> None:
    for axes, path in zip(panels, chosen, strict=False):
        _draw_strip(axes, path, colours[path.name], times.duration_s)
    if len(chosen) < len(paths):
        _draw_team(panels[-1], paths, times.duration_s)
    limits = [limit for path in paths if (limit := _limits(path)) is not None]
    low = min((limit[0] for limit in limits), default=0.01)
    high = max((limit[1] for limit in limits), default=1.0)
    panels[0].set(yscale="log", ylim=(low, max(high, 10.0 * low)))
    panels[0].yaxis.set_major_formatter(lambda value, _: _length(value))
    panels[0].yaxis.set_minor_formatter("")
    for number, axes in enumerate(panels):
        axes.grid(visible=True, alpha=0.25)
        _draw_events(axes, times, named=number == 0)
    _set_time(panels[-1], times.duration_s)
    handles = _strip_legend(paths, times.duration_s)
    figure.legend(handles=handles, loc="outside upper center", ncols=5, fontsize=8, frameon=False)


def _strip_legend(paths: Sequence[RobotPath], duration_s: float) -> list[Line2D | Patch]:
    known = [path.has_truth for path in paths]
    what = "position error" if any(known) else "σ of the position"
    if any(known) and not all(known):
        what += " (σ of it where truth is not known)"
    if any(len(path.times_s) > MOST_POINTS for path in paths):
        what += f", the largest in each {duration_s / MOST_POINTS:.1f} s"
    handles: list[Line2D | Patch] = [Line2D([], [], color="0.3", label=what)]
    if any(path.has_sigma for path in paths):
        handles.append(Patch(color="0.3", alpha=0.2, label="3 σ, as the robot states"))
    if any(path.is_lost.any() for path in paths):
        handles.append(Patch(label="lost", **LOST))
    if any(path.silent_spans(duration_s) for path in paths):
        handles.append(Patch(label="nothing heard", **SILENT))
    return handles


def _draw_strip(axes: Axes, path: RobotPath, colour: str, duration_s: float) -> None:
    """The error beside three sigma; without truth sigma itself; when it was lost or silent."""
    at_s, sigma_m = thin(path.times_s, path.sigma_m)
    shown = np.where(np.isfinite(sigma_m), np.clip(3.0 * sigma_m, LEAST_M, LARGEST_M), LEAST_M)
    axes.fill_between(at_s, LEAST_M / 10.0, shown, color=colour, alpha=0.2, linewidth=0)
    _plot(axes, path.times_s, path.error_or_sigma_m, color=colour, linewidth=1)
    at_s, lost = thin(path.times_s, path.is_lost.astype(np.float64))
    whole = axes.get_xaxis_transform()
    axes.fill_between(at_s, 0.0, 1.0, where=lost > 0.0, transform=whole, **LOST)
    for from_s, until_s in path.silent_spans(duration_s):
        axes.axvspan(from_s, until_s, zorder=0, **SILENT)
    text: dict[str, Any] = {
        "transform": axes.transAxes,
        "fontsize": 8,
        "va": "top",
        "parse_math": False,
    }
    text["bbox"] = {"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1}
    axes.text(0.01, 0.95, path.name, color=colour, weight="bold", **text)
    axes.text(0.99, 0.95, _summary(path), ha="right", **text)


def _plot(axes: Axes, times_s: Floats, values: Floats, **style: Any) -> None:
    """A line; so few points that a line would hardly be seen are also marked."""
    marker = "." if len(times_s) <= FEW else ""
    axes.plot(*thin(times_s, values), marker=marker, **style)


def _summary(path: RobotPath) -> str:
    if not len(path.times_s):
        return "nothing was heard of it"
    parts = [] if path.has_sigma else ["states no σ"]
    if path.has_truth:
        rmse_m = math.sqrt(np.nanmean(path.error_m**2))
        parts.append(f"RMSE {_length(rmse_m)}")
    elif path.has_sigma:
        parts.append(f"median σ {_length(float(np.nanmedian(path.sigma_m)))}")
    if path.is_lost.any():
        parts.append(f"lost {max(path.lost_share, 0.001):.1%}: {', '.join(path.reasons[:2])}")
    return "; ".join(parts)


def _draw_team(axes: Axes, paths: Sequence[RobotPath], duration_s: float) -> None:
    """The median of the errors (or sigmas) of all robots, with the middle 80 % of them."""
    edges = np.linspace(0.0, max(duration_s, 1e-3), GRID + 1)
    grid = np.full((len(paths), GRID), np.nan)
    for row, path in zip(grid, paths, strict=True):
        span = np.clip(np.searchsorted(edges, path.times_s, side="right") - 1, 0, GRID - 1)
        row[span] = path.error_or_sigma_m
    at_s = 0.5 * (edges[1:] + edges[:-1])
    is_known = np.isfinite(grid).any(axis=0)
    if is_known.any():
        low, middle, high = np.nanpercentile(grid[:, is_known], (10, 50, 90), axis=0)
        axes.fill_between(at_s[is_known], low, high, color="0.3", alpha=0.2, linewidth=0)
        axes.plot(at_s[is_known], middle, color="0.3", linewidth=1)
    text: dict[str, Any] = {"transform": axes.transAxes, "fontsize": 8, "va": "top"}
    what = "position error" if any(path.has_truth for path in paths) else "σ"
    axes.text(0.01, 0.95, f"all {len(paths)} robots", weight="bold", **text)
    about = f"median {what}, band: middle 80 %"
    lost = sum(bool(path.is_lost.any()) for path in paths)
    axes.text(0.99, 0.95, f"{about}; {lost} lost at times", ha="right", **text)


def _limits(path: RobotPath) -> tuple[float, float] | None:
    """From below what is usual up to the largest value, in whole decades."""
    usual, most = (v[np.isfinite(v)] for v in (path.error_or_sigma_m, 3.0 * path.sigma_m))
    values = np.clip(np.concatenate([usual, most]), LEAST_M, LARGEST_M)
    if not len(values):
        return None
    least = float(np.percentile(np.clip(usual, LEAST_M, LARGEST_M), 5.0)) if len(usual) else 1.0
    low = min(least, float(values.min())) if not path.has_truth else least
    return 10.0 ** math.floor(math.log10(low)), 2.0 * float(values.max())


def _duration(seconds: float) -> str:
    if seconds < 300.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 3 * 3600.0 else f"{seconds / 3600.0:.1f} h"


def _length(metres: float) -> str:
    if metres < 0.00995:
        return f"{1e3 * metres:.2g} mm"
    return f"{1e2 * metres:.2g} cm" if metres < 0.995 else f"{metres:.3g} m"


def _draw_activity(
    used: Axes,
    received: Axes,
    recorder: Recorder,
    paths: Sequence[RobotPath],
    colours: Mapping[str, str],
    times: Times,
) -> None:
    """Measurements used above and refused below zero; fixes and beliefs received; per second."""
    grid_s = np.linspace(0.0, times.duration_s, GRID)
    means: list[list[Floats]] = [[], [], []]
    for path in paths:
        if (log := recorder.activity.get(path.name)) is None:
            continue
        rates, colour = log.rates(times.begin_s), colours[path.name]
        inside = (rates.times_s >= 0.0) & (rates.times_s <= times.duration_s)
        at_s, refused = rates.times_s[inside], -(rates.rejected + rates.refused)[inside]
        lines = rates.used[inside], refused, rates.help[inside]
        for mean, values in zip(means, lines, strict=True):
            if len(at_s):
                mean.append(np.interp(grid_s, at_s, values, np.nan, np.nan))
        if colour == OTHERS:
            continue
        for axes, values in zip((used, used, received), lines, strict=True):
            if values.any() or axes is received:
                _plot(axes, at_s, values, color=colour, linewidth=1)
    if OTHERS in colours.values():
        for axes, mean in zip((used, used, received), means, strict=True):
            _plot_mean(axes, grid_s, mean)
    used.axhline(0.0, color="0.3", linewidth=0.8)
    used.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
    thick = "; thick: mean of all" if OTHERS in colours.values() else ""
    used.set_title(f"measurements per second: used (above 0), rejected or refused (below){thick}")
    received.set_title("fixes and beliefs received from teammates per second")
    received.set_ylim(bottom=0.0)
    for axes in (used, received):
        axes.title.set_fontsize(9)
        axes.grid(visible=True, alpha=0.25)
        _draw_events(axes, times, named=False)
        _set_time(axes, times.duration_s)
    used.set_xlabel("")
    if not any(np.any(row > 0.0) for row in means[2]):
        received.text(0.5, 0.5, "none", transform=received.transAxes, ha="center", color="0.5")


def _plot_mean(axes: Axes, grid_s: Floats, rows: Sequence[Floats]) -> None:
    """The mean of all robots, where there is one."""
    grid = np.array(rows).reshape(-1, len(grid_s))
    is_known = np.isfinite(grid).any(axis=0)
    if is_known.any():
        mean = np.nanmean(grid[:, is_known], axis=0)
        axes.plot(grid_s[is_known], mean, color="0.2", linewidth=2.5, alpha=0.7)


def _draw_events(axes: Axes, times: Times, named: bool) -> None:
    """When help began, and when guests came and went."""
    events = [(at, f"{name} joins") for name, spans in times.guests_s.items() for at, _ in spans]
    events += [(at, f"{name} leaves") for name, spans in times.guests_s.items() for _, at in spans]
    if times.helped_from_s is not None:
        events.append((times.helped_from_s - times.begin_s, "teammates begin to help"))
    for at_s, text in events:
        if not 0.0 < at_s < times.duration_s - 1.0:
            continue
        axes.axvline(at_s, color="0.2", linestyle="--", linewidth=0.9)
        if named:
            near: dict[str, Any] = {
                "textcoords": "offset points",
                "xycoords": ("data", "axes fraction"),
            }
            axes.annotate(text, (at_s, 0.0), (3, 4), fontsize=8, parse_math=False, **near)


def _set_time(axes: Axes, duration_s: float) -> None:
    """A time axis in seconds, or in minutes or hours for a long run."""
    unit, size = ("s", 1.0) if duration_s < 300.0 else ("min", 60.0)
    if duration_s >= 3 * 3600.0:
        unit, size = "h", 3600.0
    axes.set_xlim(0.0, max(duration_s, 1e-3))
    axes.set_xlabel(f"time since the start ({unit})")
    locator = MaxNLocator(8, steps=(1, 2, 2.5, 3, 5, 6, 10))
    ticks = [size * t for t in locator.tick_values(0.0, duration_s / size)]
    axes.set_xticks([t for t in ticks if 0.0 <= t <= duration_s * 1.001])
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / size:g}")
