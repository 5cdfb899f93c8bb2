"""The drawings of a report: the field, each robot over time, who helped whom, traffic."""

import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from cpcbl_launch.recordings.summary import RunSummary
from cpcbl_launch.reporting.metrics import Floats, ellipse_of, position_nees
from cpcbl_launch.reporting.paths import RobotPath, places, robot_paths
from cpcbl_launch.reporting.tables import short
from cpcbl_launch.views.report.svg import (
    Axis,
    band,
    drawing,
    line,
    nice_step,
    rectangle,
    text,
)
from cpcbl_transport.messages import LandmarkEstimate

WIDE, HIGH, NEES_HIGH = 460.0, 132.0, 74.0  # of a robot's drawing over time
LEFT, RIGHT = 44.0, 8.0
FIELD_WIDE, MOST_FIELD_HIGH = 560.0, 640.0
MOST_BINS = 260
LEAST_M, LARGEST_M = 1e-3, 1e3
NEES_95 = 0.0506, 7.378  # of 95 % of the samples, of a consistent estimate: chi-squared, 2 degrees
NEES_AXIS = 1e-2, 3e2
COLOURS = 7
MOST_NAMED = 24


class Scales(NamedTuple):
    """What drawings of all runs of a page have in common."""

    low_m: float
    high_m: float
    duration_s: float


class Drawn(NamedTuple):
    """What is drawn of a robot."""

    path: RobotPath
    colour: str  # a class of the style sheet
    nees_s: Floats  # times of the samples with truth, shape (n,)
    nees: Floats  # empty where the truth or the covariance is not known


def drawn_robots(run: RunSummary) -> list[Drawn]:
    """All robots of the team and its guests."""
    paths = robot_paths(run.recorder, run.names, run.truth, run.begin_s, run.duration_s)
    order = {name: i for i, name in enumerate(sorted(run.names))}
    found = []
    for path in paths:
        times_s, nees = np.empty(0), np.empty(0)
        if path.has_truth and path.has_sigma:
            times_s, samples = run.recorder.timed_samples(path.name, run.truth[path.name])
            squares = position_nees(samples)
            if squares is None:
                times_s = np.empty(0)
            else:
                times_s, nees = times_s - run.begin_s, squares
        found.append(Drawn(path, f"c{order[path.name] % COLOURS}", times_s, nees))
    return found


def common_scales(runs: Sequence[tuple[RunSummary, Sequence[Drawn]]]) -> Scales:
    """Axes from below what is usual up to the largest, in whole decades."""
    values = [np.empty(0)]
    for _, robots in runs:
        for robot in robots:
            values += [robot.path.error_or_sigma_m, 3.0 * robot.path.sigma_m]
    every = np.concatenate(values)
    every = np.clip(every[np.isfinite(every)], LEAST_M, LARGEST_M)
    duration_s = max((run.duration_s for run, _ in runs), default=0.0)
    if not len(every):
        return Scales(1e-2, 1.0, duration_s)
    low, high = np.percentile(every, 2.0), every.max()
    low_m = 10.0 ** math.floor(math.log10(low))
    return Scales(low_m, max(1.3 * float(high), 10.0 * low_m), duration_s)


# The field ----------------------------------------------------------------------------------------


def field(run: RunSummary, robots: Sequence[Drawn]) -> str:
    """The map with the paths; true ones behind them, and the last 3 sigma ellipses."""
    x, y, wide, high = _field_axes(run, robots)
    parts = list(_grid(x, y, wide, high))
    for wall in run.team.map.walls.values():
        ends = np.array([wall.from_m, wall.to_m])
        parts.append(line(x.at(ends[:, 0]), y.at(ends[:, 1]), "wall"))
    for robot in robots:
        truth = _thin(robot.path.truth)
        if len(truth):
            parts.append(line(x.at(truth[:, 1]), y.at(truth[:, 2]), "true"))
    for robot in robots:
        parts += _field_path(robot, x, y)
    names = len(run.team.map.landmarks) <= MOST_NAMED
    for name, mark in run.team.map.landmarks.items():
        at_x, at_y = float(x.at(np.array(mark.x_m))), float(y.at(np.array(mark.y_m)))
        title = f"<title>{escape(name)}</title>"
        parts.append(
            f'<path class="mark" d="M{at_x:.1f} {at_y - 6:.1f}l6 6-6 6-6-6z">{title}</path>'
        )
        if names:
            parts.append(text(at_x, at_y + 18, name, "soft", "middle"))
    for robot in robots:
        parts += _found_places(run, robot, x, y)
    taken: list[tuple[float, float]] = []
    for robot in robots:
        parts += _field_end(robot, x, y, taken)
    step = nice_step(x.high - x.low, 8)
    length = float(x.at(np.array(x.low + step)) - x.start)
    parts.append(f'<path class="scale" d="M12 {high - 12:.0f}v4h{length:.1f}v-4"/>')
    parts.append(text(18 + length, high - 8, f"{step:g} m", "soft"))
    return drawing(wide, high, parts, "Paths of the robots on the field", "field")


def _found_places(run: RunSummary, robot: Drawn, x: Axis, y: Axis) -> Iterator[str]:
    """The landmarks that a robot found itself, as it took them to be in the end, with 3 sigma."""
    for place in _found(run, robot):
        at_x, at_y = float(x.at(np.array(place.x_m))), float(y.at(np.array(place.y_m)))
        major, minor, turn = ellipse_of(*place.covariance)
        scale = abs(float(x.at(np.array(place.x_m + 1.0))) - at_x)
        title = f"<title>{escape(place.landmark)}, found by {escape(robot.path.name)}</title>"
        shape = f"M{at_x:.1f} {at_y - 5:.1f}l5 5-5 5-5-5z"
        yield f'<path class="found {robot.colour}" d="{shape}">{title}</path>'
        yield (
            f'<ellipse class="found {robot.colour}" cx="{at_x:.1f}" cy="{at_y:.1f}"'
            f' rx="{3 * major * scale:.1f}" ry="{3 * minor * scale:.1f}"'
            f' transform="rotate({-math.degrees(turn):.1f} {at_x:.1f} {at_y:.1f})"/>'
        )


def _found(run: RunSummary, robot: Drawn) -> tuple[LandmarkEstimate, ...]:
    status, recorder = run.recorder.status.get(robot.path.name), run.recorder
    if status is None:
        return ()
    places, frame = recorder.origins.places_in_field(status.places, status.frame)
    return places if frame == recorder.shown_frame else ()


def _field_axes(run: RunSummary, robots: Sequence[Drawn]) -> tuple[Axis, Axis, float, float]:
    """Of the map, and of nearly all that robots believed and that was true."""
    fixed = [(mark.x_m, mark.y_m) for mark in run.team.map.landmarks.values()]
    fixed += [end for wall in run.team.map.walls.values() for end in (wall.from_m, wall.to_m)]
    for robot in robots:
        fixed += [(found.x_m, found.y_m) for found in _found(run, robot)]
    moving = [np.empty((0, 2))]
    for robot in robots:
        known = robot.path.pose[~robot.path.is_lost, :2]
        known = known[np.isfinite(known).all(axis=1)]
        moving += [known, robot.path.truth[:, 1:3]]
    every = np.concatenate(moving)
    corners = [np.percentile(every, share, axis=0) for share in (0.5, 99.5)] if len(every) else []
    points = np.array([*fixed, *corners]).reshape(-1, 2)
    low, high = (
        (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.ones(2))
    )
    margin = 0.1 * max(float((high - low).max()), 1.0)
    low, high = low - margin, high + margin
    span_x, span_y = (float(s) for s in high - low)
    wide, tall = FIELD_WIDE, FIELD_WIDE * span_y / span_x
    tall = min(max(tall, 0.45 * wide), MOST_FIELD_HIGH)
    scale = min(wide / span_x, tall / span_y)
    middle = 0.5 * (low + high)
    half_x, half_y = 0.5 * wide / scale, 0.5 * tall / scale
    x = Axis(middle[0] - half_x, middle[0] + half_x, 0.0, wide)
    return x, Axis(middle[1] - half_y, middle[1] + half_y, tall, 0.0), wide, tall


def _grid(x: Axis, y: Axis, wide: float, high: float) -> Iterator[str]:
    step = nice_step(x.high - x.low, 8)
    columns = np.arange(math.ceil(x.low / step), x.high / step) * step
    rows = np.arange(math.ceil(y.low / step), y.high / step) * step
    lines = "".join(f"M{at:.1f} 0v{high:.0f}" for at in x.at(columns))
    lines += "".join(f"M0 {at:.1f}h{wide:.0f}" for at in y.at(rows))
    yield f'<path class="grid" d="{lines}"/>'


def _field_path(robot: Drawn, x: Axis, y: Axis) -> Iterator[str]:
    path = robot.path
    for css, chosen in ((f"path {robot.colour}", ~path.is_lost), ("path lost", path.is_lost)):
        if chosen.any():
            at = places(path, chosen)
            at = at[:: max(1, len(at) // 700)]
            yield line(x.at(at[:, 0]), y.at(at[:, 1]), css)


def _field_end(robot: Drawn, x: Axis, y: Axis, taken: list[tuple[float, float]]) -> Iterator[str]:
    """The robot where it was last, its ellipse and its name, beside the names before."""
    path = robot.path
    if not len(path.times_s) or not np.isfinite(path.pose[-1]).all():
        return
    (at_x, at_y, heading), covariance = path.pose[-1], path.covariance[-1]
    px, py = float(x.at(at_x)), float(y.at(at_y))
    scale = abs(x.end - x.start) / (x.high - x.low)
    if np.isfinite(covariance).all():
        major, minor, turned = ellipse_of(*covariance.tolist())
        radii = [min(max(3.0 * s * scale, 1.5), 2.0 * FIELD_WIDE) for s in (major, minor)]
        place = f'cx="{px:.1f}" cy="{py:.1f}" rx="{radii[0]:.1f}" ry="{radii[1]:.1f}"'
        turn = f'transform="rotate({-math.degrees(turned):.0f} {px:.1f} {py:.1f})"'
        yield f'<ellipse class="sure {robot.colour}" {place} {turn}/>'
    turn = f"translate({px:.1f} {py:.1f}) rotate({-math.degrees(heading):.0f})"
    css = "lost" if path.is_lost[-1] else robot.colour
    yield f'<path class="robot {css}" transform="{turn}" d="M11 0-7 6-3 0-7-6z"/>'
    below = py - 14
    while any(abs(below - b) < 13 and abs(px - a) < 60 for a, b in taken):
        below += 13
    taken.append((px, below))
    yield text(px, below, path.name, f"name {robot.colour}", "middle")


def _thin(truth: Floats) -> Floats:
    return truth[:: max(1, len(truth) // 700)]


# Over time ----------------------------------------------------------------------------------------


def over_time(robot: Drawn, scales: Scales, own_s: float) -> str:
    """The error beside 3 sigma (without truth: sigma), when it was lost or silent, and NEES;
    `own_s`: the length of its run."""
    path, duration_s = robot.path, max(scales.duration_s, 1e-3)
    has_nees = bool(len(robot.nees))
    high = HIGH + (NEES_HIGH if has_nees else 0.0)
    x = Axis(0.0, duration_s, LEFT, WIDE - RIGHT)
    y = Axis(scales.low_m, scales.high_m, HIGH - 22.0, 6.0, is_log=True)
    parts = [*_axes(x, y, "m")]
    at_s, three_sigma = binned(path.times_s, 3.0 * path.sigma_m)
    parts.append(
        band(
            x.at(at_s), np.full(len(at_s), y.start), _level(y, three_sigma), f"sure {robot.colour}"
        )
    )
    parts += _marked_spans(path, x, y, own_s)
    at_s, values = binned(path.times_s, path.error_or_sigma_m)
    parts.append(line(x.at(at_s), _level(y, values), f"value {robot.colour}"))
    if has_nees:
        parts += _nees(robot, x, HIGH)
    label = f"{path.name} over time: position error and 3 sigma" if path.has_truth else path.name
    return drawing(WIDE, high, parts, label)


def _axes(x: Axis, y: Axis, unit: str) -> Iterator[str]:
    for value in y.ticks(5):
        at = float(y.at(np.array(value)))
        yield f'<path class="grid" d="M{x.start:.0f} {at:.1f}H{x.end:.0f}"/>'
        yield text(x.start - 5, at + 4, f"{value:g}", "soft", "end")
    yield text(x.start + 4, 15, unit, "soft")
    for value in x.ticks(6):
        at = float(x.at(np.array(value)))
        yield text(at, y.start + 17, time_text(value), "soft", "middle")


def time_text(seconds: float) -> str:
    """`40 s`, `2:30`."""
    if seconds < 180.0:
        return f"{seconds:g} s"
    whole = round(seconds)
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"


def _level(y: Axis, values: Floats) -> Floats:
    """Pixels of values on a logarithmic axis, with NaN as it is."""
    known = np.isfinite(values)
    at = y.at(np.where(known, np.maximum(values, y.low), y.low))
    return np.asarray(np.where(known, at, np.nan))


def _marked_spans(path: RobotPath, x: Axis, y: Axis, duration_s: float) -> Iterator[str]:
    top, high = y.end, y.start - y.end
    for from_s, until_s in lost_spans(path):
        at = x.at(np.array([from_s, until_s]))
        title = f"lost from {time_text(from_s)} to {time_text(until_s)}"
        yield rectangle(at[0], top, max(at[1] - at[0], 1.0), high, "lost-span", title)
    for from_s, until_s in path.silent_spans(duration_s):
        at = x.at(np.array([from_s, until_s]))
        title = f"nothing heard from {time_text(from_s)} to {time_text(until_s)}"
        yield rectangle(at[0], top, at[1] - at[0], high, "silent-span", title)


def lost_spans(path: RobotPath) -> list[tuple[float, float]]:
    """When it was lost: from when until when (s)."""
    edges = np.flatnonzero(
        np.diff(np.concatenate([[False], path.is_lost, [False]]).astype(np.int8))
    )
    last = len(path.times_s) - 1
    return [
        (float(path.times_s[start]), float(path.times_s[min(end, last)]))
        for start, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def _nees(robot: Drawn, x: Axis, top: float) -> Iterator[str]:
    y = Axis(*NEES_AXIS, top + NEES_HIGH - 8.0, top + 6.0, is_log=True)
    low, high = (float(y.at(np.array(bound))) for bound in NEES_95)
    title = "a consistent estimate is between these bounds in 95 % of its samples"
    yield rectangle(x.start, high, x.end - x.start, low - high, "bounds", title)
    for value in (0.1, 2.0, 100.0):
        at = float(y.at(np.array(value)))
        yield f'<path class="grid" d="M{x.start:.0f} {at:.1f}H{x.end:.0f}"/>'
        yield text(x.start - 5, at + 4, f"{value:g}", "soft", "end")
    yield text(x.start + 4, top + 16, "NEES", "soft")
    at_s, values = binned(robot.nees_s, robot.nees, is_mean=True)
    yield line(x.at(at_s), _level(y, values), f"value {robot.colour}")


def binned(times_s: Floats, values: Floats, is_mean: bool = False) -> tuple[Floats, Floats]:
    """The largest value, or the mean, in each of at most `MOST_BINS` spans; NaN where there is none
    for long."""
    known = np.isfinite(values)
    if not len(times_s):
        return np.empty(0), np.empty(0)
    steps = np.diff(times_s)
    usual_s = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    span_s = max(float(times_s[-1] - times_s[0]), 1e-3)
    count = max(1, min(MOST_BINS, int(span_s / (3.0 * usual_s))))
    place = np.clip(((times_s - times_s[0]) / span_s * count).astype(np.int64), 0, count - 1)
    middle = times_s[0] + (np.arange(count) + 0.5) * span_s / count
    if is_mean:
        sums = np.bincount(place[known], values[known], count)
        numbers = np.bincount(place[known], minlength=count)
        return middle, np.where(numbers > 0, sums / np.maximum(numbers, 1), np.nan)
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, place[known], values[known])
    return middle, np.where(np.isfinite(largest), largest, np.nan)


# Help and traffic ---------------------------------------------------------------------------------


def help_matrix(helps: Mapping[tuple[str, str], Mapping[str, int]], names: Sequence[str]) -> str:
    """A row for each helper, a column for each robot that it helped; the darker the more."""
    most = max((sum(counts.values()) for counts in helps.values()), default=1)
    head = "".join(f'<th scope="col"><span>{escape(name)}</span></th>' for name in names)
    rows = []
    for helper in names:
        cells = []
        for helped in names:
            counts = helps.get((helper, helped), {})
            total = sum(counts.values())
            if helper == helped or not total:
                cells.append(f'<td class="{"self" if helper == helped else "none"}"></td>')
                continue
            share = 10 + 50 * math.log1p(total) / math.log1p(most)
            title = f"{helper} helped {helped}: " + ", ".join(f"{n} {t}" for t, n in counts.items())
            cells.append(
                f'<td style="--share:{share:.0f}%" title="{escape(title)}">{short(total)}</td>'
            )
        rows.append(f'<tr><th scope="row">{escape(helper)}</th>{"".join(cells)}</tr>')
    body = "".join(rows)
    return (
        '<div class="wide"><table class="matrix"><thead><tr><th>helper ↓ helped →</th>'
        f"{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def bar(parts: Sequence[tuple[str, float, str]], most: float) -> str:
    """A bar of parts, each with its class, its size and what it says."""
    inside = "".join(
        f'<i class="{css}" style="width:{100.0 * size / most:.2f}%" title="{escape(title)}"></i>'
        for css, size, title in parts
        if size > 0.0
    )
    return f'<span class="bar">{inside}</span>'
