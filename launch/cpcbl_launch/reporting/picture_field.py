"""The field of a run: landmarks, walls, paths with their starts and ends. Needs extra `plot`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.paths import MOST_PLACES, RobotPath, places
from cpcbl_team.config import Team

MOST_NAMES = 12  # robots and landmarks; more names hide each other
ALMOST_ALL = (1.0, 99.0)  # percentiles of what must be in the picture
LARGEST_SHARE = 0.5  # of the field's size, by which lost robots may widen the picture
SMALL: dict[str, Any] = {"fontsize": 8}
OTHERS = "0.7"  # the colour of robots that are not told apart


class Box(NamedTuple):
    """A rectangle of the field (m)."""

    left: float
    bottom: float
    right: float
    top: float

    def holds(self, points: Floats) -> int:
        """How many of some points, shape (n, 2), are inside."""
        inside = (points >= self[:2]) & (points <= self[2:])
        return int(inside.all(axis=1).sum())


def draw_field(
    axes: Axes, team: Team, paths: Sequence[RobotPath], colours: Mapping[str, str]
) -> list[str]:
    """Draws it. Returns whole sentences on what is not to be seen in it."""
    view = visible_box(team, paths)
    middle_m = 0.5 * (view.left + view.right)
    _draw_map(axes, team, middle_m)
    remarks = []
    for path in paths:
        named = len(paths) <= MOST_NAMES or colours[path.name] != OTHERS
        _draw_path(axes, path, colours[path.name], named, middle_m)
        known = path.pose[np.isfinite(path.pose[:, :2]).all(axis=1), :2]
        if outside := len(known) - view.holds(known):
            share = f"{max(outside / len(known), 0.001):.1%}"
            remarks.append(f"{path.name}: {share} of the estimates lie outside of the field shown.")
    axes.set(xlim=(view.left, view.right), ylim=(view.bottom, view.top))
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal")
    handles = _legend(team, paths)
    axes.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=5,
        frameon=False,
        **SMALL,
    )
    return remarks


def visible_box(team: Team, paths: Sequence[RobotPath]) -> Box:
    """What a map must show: landmarks, walls, true paths, nearly all estimates. Robots that are
    lost may be anywhere: they widen it only so far."""
    least_x, least_y, most_x, most_y = team.map.bounds()
    points = [np.empty((0, 2))]
    if team.map.has_surveyed:
        points.append(np.array([(least_x, least_y), (most_x, most_y)]))
    for path in paths:
        points += [path.truth[:, 1:], _almost_all(path.pose[~path.is_lost, :2])]
    known = _box(np.concatenate(points))
    unsure = [*(_almost_all(p.pose[p.is_lost, :2]) for p in paths), *map(_ellipse_corners, paths)]
    lost = _box(np.concatenate(unsure or points))
    if known is None:
        known = lost or Box(0.0, 0.0, 1.0, 1.0)
    size = max(known.right - known.left, known.top - known.bottom, 1.0)
    far = LARGEST_SHARE * size
    if lost is not None:
        known = Box(
            min(known.left, max(lost.left, known.left - far)),
            min(known.bottom, max(lost.bottom, known.bottom - far)),
            max(known.right, min(lost.right, known.right + far)),
            max(known.top, min(lost.top, known.top + far)),
        )
    margin = 0.08 * size
    narrow = [max(0.0, 0.35 * size - (high - low)) / 2.0 for low, high in _sides(known)]
    return Box(
        known.left - margin - narrow[0],
        known.bottom - margin - narrow[1],
        known.right + margin + narrow[0],
        known.top + margin + narrow[1],
    )


def _ellipse_corners(path: RobotPath) -> Floats:
    """Two corners around the ellipse at the end of a path, of shape (2, 2); none without one."""
    known = np.flatnonzero(np.isfinite(path.pose).all(axis=1))
    if not len(known) or not np.isfinite(path.covariance[known[-1]]).all():
        return np.empty((0, 2))
    xx, _, yy = path.covariance[known[-1]]
    reach = 3.0 * np.sqrt(np.maximum([xx, yy], 0.0))
    return np.asarray([path.pose[known[-1], :2] - reach, path.pose[known[-1], :2] + reach])


def _sides(box: Box) -> tuple[tuple[float, float], tuple[float, float]]:
    return (box.left, box.right), (box.bottom, box.top)


def _almost_all(points: Floats) -> Floats:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 2:
        return points
    return np.asarray(np.percentile(points, ALMOST_ALL, axis=0))


def _box(points: Floats) -> Box | None:
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    return Box(*points.min(axis=0).tolist(), *points.max(axis=0).tolist())


def _draw_map(axes: Axes, team: Team, middle_m: float) -> None:
    for wall in team.map.walls.values():
        axes.plot(*zip(wall.from_m, wall.to_m, strict=True), color="0.3", linewidth=2)
    marks = team.map.landmarks
    for name, mark in marks.items():
        axes.plot(mark.x_m, mark.y_m, "s", color="0.3", markersize=5)
        if len(marks) <= MOST_NAMES:
            _name(axes, name, (mark.x_m, mark.y_m), "0.3", middle_m)
    axes.grid(visible=True, alpha=0.25)


def _draw_path(axes: Axes, path: RobotPath, colour: str, named: bool, middle_m: float) -> None:
    truth = path.truth[:: max(1, len(path.truth) // MOST_PLACES), 1:]
    axes.plot(*truth.T, color="black", linewidth=0.7)
    axes.plot(*places(path, ~path.is_lost).T, color=colour, linewidth=1.4)
    axes.plot(*places(path, path.is_lost).T, ":", color=colour, linewidth=1.2, alpha=0.7)
    known = np.flatnonzero(np.isfinite(path.pose).all(axis=1))
    if not len(known):
        return
    first, last = path.pose[known[0]], path.pose[known[-1]]
    axes.plot(*first[:2], "o", color=colour, markerfacecolor="white", markersize=6, zorder=4)
    turned = (3, 0, math.degrees(last[2]) - 90.0)
    axes.plot(*last[:2], marker=turned, color=colour, markersize=11, zorder=5)
    _draw_ellipse(axes, last[:2], path.covariance[known[-1]], colour)
    if named:
        _name(axes, path.name, (last[0], last[1]), colour, middle_m)


def _draw_ellipse(axes: Axes, centre: Floats, covariance: Floats, colour: str) -> None:
    """Three sigma; none where the covariance is not known, or is none."""
    xx, xy, yy = covariance
    if not np.isfinite(covariance).all():
        return
    values, vectors = np.linalg.eigh([[xx, xy], [xy, yy]])
    small, large = 6.0 * np.sqrt(np.maximum(values, 0.0))
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    style: dict[str, Any] = {"facecolor": "none", "edgecolor": colour, "zorder": 4}
    axes.add_patch(Ellipse(tuple(centre), large, small, angle=angle, **style))


def _name(axes: Axes, name: str, at: tuple[float, float], colour: str, middle_m: float) -> None:
    """On the side on which it stays in the picture."""
    offset, side = ((7, 4), "left") if at[0] < middle_m else ((-7, 4), "right")
    near: dict[str, Any] = {"textcoords": "offset points", "annotation_clip": True, "clip_on": True}
    text = axes.annotate(name, at, offset, color=colour, ha=side, parse_math=False, **SMALL, **near)
    text.set_in_layout(False)


def _legend(team: Team, paths: Sequence[RobotPath]) -> list[Line2D]:
    def handle(marker: str, label: str, **style: Any) -> Line2D:
        return Line2D([], [], marker=marker, color="0.4", label=label, **style)

    handles = [
        handle("", "estimated path"),
        handle("o", "start", linestyle="", markerfacecolor="white"),
        handle("^", "end, heading, 3 σ", linestyle=""),
    ]
    if any(path.has_truth for path in paths):
        handles.append(Line2D([], [], color="black", linewidth=0.7, label="true path"))
    if any(path.is_lost.any() for path in paths):
        handles.append(handle("", "while lost", linestyle=":"))
    if team.map.landmarks:
        handles.append(handle("s", "landmark", linestyle="", markersize=5))
    if team.map.walls:
        handles.append(handle("", "wall", linewidth=2))
    return handles
