"""A map with its ellipses and the robots' paths, drawn into a file. Needs the extra `plot`."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from cpcbl_launch.mapping.mapped_walls import MappedWall, mapped_wall
from cpcbl_launch.mapping.mapper import Mapped
from cpcbl_launch.reporting import metrics

FACTORS = (1, 2, 5, 10, 20, 50, 100)
VISIBLE = 0.06  # of the size of the map: how large the largest ellipse is drawn at most


def draw_map(mapped: Mapped, path: Path) -> None:
    """Draws the map into a file (PNG or SVG)."""
    poses, landmarks, _ = mapped.problem.parts(mapped.solution.x)
    figure = Figure(figsize=(9, 7.5), layout="constrained")
    axes = figure.add_subplot()
    first = 0
    for i, drive in enumerate(mapped.drives):
        mine = poses[first : first + len(drive.stamps_ns), :2]
        first += len(drive.stamps_ns)
        axes.plot(*mine.T, color=f"C{i % 10}", linewidth=0.5, alpha=0.6, label=drive.name)
    extent = np.concatenate([poses[:, :2], landmarks])
    size = float(np.ptp(extent, axis=0).max(initial=1.0))
    walls = {name: mapped_wall(mapped, name) for name in mapped.walls}
    shapes = {name: mapped.ellipse(name) for name in mapped.names}
    sigmas = [shape.major_m for shape in shapes.values()]
    sigmas += [wall.sigma_at(s * 0.5 * wall.length_m) for wall in walls.values() for s in (-1, 1)]
    factor = max((f for f in FACTORS if 3.0 * f * max(sigmas) <= VISIBLE * size), default=1)
    _draw_landmarks(mapped, axes, shapes, factor)
    for name, wall in walls.items():
        _draw_wall(axes, name, wall, name in mapped.frame.known_names, factor)
    times = "" if factor == 1 else f", drawn {factor} times as large"
    what = " and ".join(["landmarks"] * bool(shapes) + ["walls"] * bool(walls))
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"{what}, 3 σ{times}")
    axes.grid(True, alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=110)


def _draw_wall(axes: Axes, name: str, wall: MappedWall, known: bool, factor: int) -> None:
    """Draws a wall between the bounds of 3 sigmas across it."""
    colour = "tab:green" if known else "black"
    axes.plot(*wall.ends.T, color=colour, linewidth=1.5, zorder=3)
    along = np.linspace(-0.5, 0.5, 41) * wall.length_m
    points = np.array([wall.point_at(s) for s in along])
    tangent = (wall.ends[1] - wall.ends[0]) / wall.length_m
    for side in (-3.0, 3.0):
        across = np.array([side * factor * wall.sigma_at(s) for s in along])
        bound = points + across[:, None] * (-tangent[1], tangent[0])
        axes.plot(*bound.T, color=colour, linewidth=0.5, linestyle="--", zorder=3)
    middle = wall.point_at(0.0)
    axes.annotate(name, middle.tolist(), textcoords="offset points", xytext=(5, 5), zorder=4)


def _draw_landmarks(
    mapped: Mapped, axes: Axes, shapes: Mapping[str, metrics.Ellipse], factor: int
) -> None:
    """Draws the ellipses of one sigma, all larger by 3 times the same factor."""
    for name, (major, minor, direction) in shapes.items():
        x, y = mapped.landmark(name)[0].tolist()
        known = name in mapped.frame.known_names
        colour = "tab:green" if known else "black"
        sizes = 6.0 * factor * major, 6.0 * factor * minor
        angle = math.degrees(direction)
        axes.add_patch(Ellipse((x, y), *sizes, angle=angle, fill=False, color=colour, zorder=3))
        axes.plot(x, y, "s" if known else "+", color=colour, markersize=5, zorder=3)
        axes.annotate(name, (x, y), textcoords="offset points", xytext=(5, 5), zorder=4)
