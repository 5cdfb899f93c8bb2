"""The experiments as pictures. Needs extra `plot`."""

import math
import textwrap
from collections.abc import Callable, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge

from cpcbl_launch.lab.experiments.budget import Curve
from cpcbl_launch.lab.experiments.figure7 import LABELS, ONE_LANDMARK
from cpcbl_launch.lab.experiments.liars import Liars
from cpcbl_launch.lab.experiments.runs import Outcome, Spread
from cpcbl_team.config import RobotSettings, Team

mpl.use("Agg")
mpl.rcParams.update({"figure.constrained_layout.use": True, "savefig.dpi": 90})


def draw_table1(result: Outcome) -> Figure:
    """Field, then a panel a quantity: the paper's as bars, ours as points with 10-90 %."""
    figure = plt.figure(figsize=(13, 7))
    panels = figure.subplot_mosaic("FFabc\nFFdef", width_ratios=(1, 1, 1.2, 1.2, 1.2))
    _field(panels["F"], result.teams["joint C"])
    for i, quantity in enumerate(result.figures["quantities"]):
        axes = panels["abcdef"[i]]
        theirs = [result.paper[c][i] for c in "ABC"]
        axes.bar(range(3), theirs, color="0.85", label="paper")
        for k, (how, rows) in enumerate(result.figures["rows"].items()):
            for x, c in enumerate("ABC"):
                s = rows[c][i]
                at, label = x - 0.24 + 0.16 * k, how if x == 0 else None
                _bar(axes, at, s, f"C{k}", capsize=2, label=label)
        axes.set(title=quantity, xticks=range(3), xticklabels="ABC", ylim=(0, None))
    figure.legend(*panels["a"].get_legend_handles_labels(), loc="outside lower right", ncols=5)
    return figure


def draw_figure7(result: Outcome) -> Figure:
    """The field, and as figure 7 of the paper: mean position error, bars of one sigma."""
    figure, (field, errors) = plt.subplots(1, 2, figsize=(13, 4.6), width_ratios=(1, 1))
    _field(field, result.teams["F"])
    names = list(result.figures)
    for x, a in enumerate(result.figures.values()):
        mean = a.position_mean_m
        if mean is not None:
            errors.errorbar(x, mean, a.position_sigma_m, fmt="o", capsize=5, color="C0")
            near = {"textcoords": "offset points", "annotation_clip": True}
            errors.annotate(f"{mean:.3f}", (x, mean), (8, 0), **near)
    labels = [f"{name}\n{textwrap.fill(LABELS[name], 14)}" for name in names]
    errors.set_xticks(range(len(names)), labels, fontsize=8)
    errors.set(ylabel="position error (m)")
    errors.set(title="mean error of the navigator, and one σ (A is off the scale where cut)")
    others = [a for c, a in result.figures.items() if c != "A"]
    rest = [(a.position_mean_m or 0.0) + (a.position_sigma_m or 0.0) for a in others]
    errors.set_ylim(0.0, 1.6 * max(rest, default=0.0) or 1.0)
    errors.set_xlim(-0.6, len(names) - 0.2)
    errors.grid(True, axis="y", alpha=0.3)
    return figure


def draw_variants(result: Outcome) -> Figure:
    figure, (errors, inside) = plt.subplots(1, 2, figsize=(8, 3.8))
    variants = list(dict.fromkeys(case.split()[0] for case in result.figures))
    for k, case in enumerate(("alone", "helped", ONE_LANDMARK)):
        for x, variant in enumerate(variants):
            a = result.figures.get(f"{variant} {case}")
            if a is None:
                continue
            label, at = case if x == 0 else None, x - 0.2 + 0.2 * k
            if a.position_mean_m is not None:
                bar = a.position_mean_m, a.position_sigma_m
                errors.errorbar(at, *bar, fmt="o", capsize=4, color=f"C{k}", label=label)
            if a.inside_3_sigma is not None:
                inside.plot(at, 100.0 * a.inside_3_sigma, "o", color=f"C{k}")
    inside.axhline(98.9, color="0.4", linestyle="--", linewidth=1)
    errors.set(title="position error (m), mean and one σ", ylim=(0, None))
    inside.set(title="inside 3 σ (%); consistent: 98.9", ylim=(None, 100.2))
    for axes in (errors, inside):
        axes.set(xticks=range(len(variants)), xticklabels=variants)
        axes.set_xlim(-0.5, len(variants) - 0.5)
        axes.grid(True, axis="y", alpha=0.3)
    errors.legend()
    return figure


def draw_budget(result: Curve) -> Figure:
    """Team RMSE against bytes; lines to the left and below are better."""
    figure, axes = plt.subplots(figsize=(8.5, 5.0))
    for name, same in groupby(result.points, lambda point: point.series):
        points = list(same)
        cost = [p.bytes_per_s for p in points]
        errors = [p.position_rmse_m for p in points]
        if name == "nothing":
            axes.axhline(errors[0], color="0.5", linestyle=":", label="alone")
            continue
        style = "*" if len(points) == 1 else "--x" if name == "fixed interval" else "-o"
        axes.plot(cost, errors, style, ms=12 if len(points) == 1 else 5, label=name)
    for target in result.targets:
        axes.axhline(target.allowed_rmse_m, color="0.8", linewidth=0.8, zorder=0)
    title = f"{result.log}, blind: {', '.join(result.blind) or 'none'}"
    axes.set(xscale="log", yscale="log", xlabel="sent (B/s a robot, on the wire)")
    axes.set(ylabel="position RMSE, team (m)", title=title)
    axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    return figure


def draw_directions(result: Outcome) -> Figure:
    """RMSE against bytes, a panel for each error of the observers; a line through team sizes."""
    rows = [row for row in result.figures["rows"] if row["direction"] != "deaf"]
    offsets = sorted({row["observer_off_m"] for row in rows})
    ways = list(dict.fromkeys((r["direction"], r["fusion"]) for r in rows if r["fusion"]))
    figure, panels = plt.subplots(1, len(offsets), figsize=(12, 4), sharey=True, squeeze=False)
    for axes, offset in zip(panels[0], offsets, strict=True):
        for k, way in enumerate(ways):
            line = [
                (r["bytes_per_s"], r["position_rmse_m"], r["robots"])
                for r in rows
                if (r["direction"], r["fusion"], r["observer_off_m"]) == (*way, offset)
            ]
            style = "o-" if way[0] == "one-way" else "s--"
            bytes_, rmse, _ = zip(*line, strict=True)
            axes.plot(bytes_, rmse, style, ms=4, color=f"C{k}", label=" ".join(way))
            for x, y, robots in line:
                axes.annotate(str(robots), (x, y), (3, 3), textcoords="offset points", fontsize=7)
        axes.set(title=f"observers off by {offset:g} m", xlabel="bytes/s a robot", xscale="symlog")
        axes.set_yscale("log")
        axes.grid(True, which="both", alpha=0.3)
    panels[0][0].set(ylabel="position RMSE (m); numbers: robots")
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(ways))
    return figure


def draw_liars(result: Liars) -> Figure:
    """The team's error beside that without the liar, judged and believed; when it was found."""
    sizes = sorted({row.case.honest for row in result.rows}, reverse=True)
    figure, panels = plt.subplots(2, len(sizes), figsize=(12, 6.5), sharex=True, squeeze=False)
    kinds = list(dict.fromkeys(row.case.lie for row in result.rows if row.case.lie))
    for (ratios, times), honest in zip(panels.T, sizes, strict=True):
        for row in [r for r in result.rows if r.case.lie and r.case.honest == honest]:
            at, judged = kinds.index(row.case.lie), row.case.trust
            colour, shift = ("C0", -0.1) if judged else ("C3", 0.1)
            _bar(ratios, at + shift, row.ratio, colour, capsize=3)
            if judged:
                _bar(times, at, row.found_after_s, "C1", capsize=3)
                _bar(times, at, row.readmitted_after_s, "C2", capsize=3)
        ratios.axhline(1.3, color="0.5", linestyle="--")
        ratios.set(title=f"one liar, {honest} honest", yscale="log")
        times.set_xticks(range(len(kinds)), kinds, rotation=30, ha="right")
    panels[0][0].set_ylabel("RMSE, to the team without it")
    panels[1][0].set_ylabel("found, taken back (s)")
    colours = {"judged": "C0", "believed": "C3", "found": "C1", "taken back": "C2"}
    handles = [Line2D([], [], marker="o", color=c, label=n) for n, c in colours.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(colours))
    return figure


# How the result of each experiment is drawn, by its name
DRAWINGS: Mapping[str, Callable[[Any], Figure]] = {
    "table1": draw_table1,
    "figure7": draw_figure7,
    "figure7-cameras": draw_figure7,
    "circular-vs-oval": draw_variants,
    "one-way-vs-both": draw_directions,
    "budget": draw_budget,
    "liars": draw_liars,
}


def draw(result: Any, path: Path) -> None:
    """Draws the result of an experiment into a file."""
    figure = DRAWINGS[result.experiment](result)
    figure.savefig(path)
    plt.close(figure)


def _bar(axes: Any, at: float, found: Spread | None, colour: str, **style: Any) -> None:
    if found is not None:
        bars = [[found.median - found.low], [found.high - found.median]]
        axes.errorbar(at, found.median, bars, fmt="o", ms=4, color=colour, **style)


def _field(axes: Any, team: Team) -> None:
    """Landmarks, circuit, and what an observer sees."""
    for mark in team.map.landmarks.values():
        both = mark.gives == "both"
        axes.plot(mark.x_m, mark.y_m, "s" if both else "^", color="0.3" if both else "C1")
    for robot in team.robots.values():
        _robot(axes, robot)
    axes.plot([0, 9, 9, 0, 0], [0, 0, 5, 5, 0], color="0.6", linewidth=0.8)
    axes.set(xlabel="x (m)", ylabel="y (m)", title="the circuit; ■ landmarks, ▲ bearing only")
    axes.set_aspect("equal")


def _robot(axes: Any, robot: RobotSettings) -> None:
    start = robot.start
    assert start is not None
    if robot.waypoints_m:
        axes.plot(*zip(*robot.waypoints_m, robot.waypoints_m[0], strict=True), "o-", color="C0")
    half, heading = 0.5 * robot.sensor.field_of_view_deg, start.heading_deg
    if robot.sensing == "camera":
        half = math.degrees(math.atan(0.5 * robot.camera.width_px / robot.camera.fx_px))
    reach = 1.0 if robot.waypoints_m else 4.0
    centre = (start.x_m, start.y_m)
    axes.add_patch(Wedge(centre, reach, heading - half, heading + half, color="C2", alpha=0.15))
    tip = (math.cos(math.radians(heading)), math.sin(math.radians(heading)))
    axes.quiver(*centre, *tip, color="C2", scale=18)
