"""A map with its ellipses and the robots' paths, drawn into a file. Needs the extra `plot`."""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from cpcbl_launch.mapping.mapper import Mapped

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
    factor = _draw_landmarks(mapped, axes, float(np.ptp(landmarks, axis=0).max(initial=1.0)))
    times = "" if factor == 1 else f", drawn {factor} times as large"
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"landmarks, 3 σ{times}")
    axes.grid(True, alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=110)


def _draw_landmarks(mapped: Mapped, axes: Axes, size: float) -> int:
    """Draws the ellipses, all larger by the same factor, which is returned."""
    shapes = {name: mapped.ellipse(name) for name in mapped.names}
    largest = 3.0 * max(major for major, _, _ in shapes.values())
    factor = max((f for f in FACTORS if f * largest <= VISIBLE * size), default=1)
    for name, (major, minor, direction) in shapes.items():
        x, y = mapped.landmark(name)[0].tolist()
        known = name in mapped.frame.known
        colour = "tab:green" if known else "black"
        sizes = 6.0 * factor * major, 6.0 * factor * minor
        angle = math.degrees(direction)
        axes.add_patch(Ellipse((x, y), *sizes, angle=angle, fill=False, color=colour, zorder=3))
        axes.plot(x, y, "s" if known else "+", color=colour, markersize=5, zorder=3)
        axes.annotate(name, (x, y), textcoords="offset points", xytext=(5, 5), zorder=4)
    return factor
