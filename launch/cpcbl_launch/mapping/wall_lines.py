"""Walls as lines: their first places from poses, and a frame from lines that are known in it."""

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.align import Rigid
from cpcbl_launch.mapping.drives import Drive
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Wall

LEAST_READINGS = 5
LEAST_SPREAD_M = 0.5  # of poses, along and across, from which ranges alone give a line
LEAST_LEVER_M = 0.5  # by which a direction (rad) counts as a distance
PARALLEL = math.radians(2.0)
DIRECTIONS = 180  # of lines that are tried for ranges alone


class Line(NamedTuple):
    """An endless line, with the part of it that robots saw."""

    point: Floats  # (2,), the middle of that part
    direction: float  # rad
    half_m: float  # half of the length of that part

    @property
    def along(self) -> Floats:
        return np.array([math.cos(self.direction), math.sin(self.direction)])

    @property
    def normal(self) -> Floats:
        """To the left of the direction."""
        return np.array([-math.sin(self.direction), math.cos(self.direction)])

    def in_frame(self, rigid: Rigid) -> "Line":
        return Line(rigid.points(self.point[None])[0], self.direction + rigid.angle, self.half_m)

    def like(self, other: "Line") -> "Line":
        """This line or its reverse: whichever direction is within a quarter of a turn of that of
        the other line."""
        turned = math.remainder(self.direction - other.direction, math.pi)
        return self._replace(direction=other.direction + turned)


def line_of(wall: Wall) -> Line:
    """The line of a wall of a team file."""
    ends = np.array([wall.from_m, wall.to_m])
    return Line(ends.mean(axis=0), wall.direction_rad, 0.5 * math.dist(*ends))


# First places -------------------------------------------------------------------------------------


def first_lines(
    drives: Sequence[Drive], poses: Sequence[Floats], walls: Collection[str]
) -> dict[str, Line]:
    """The lines of the walls that ranges with bearings, or ranges alone, place. Their directions
    are such that most robots see them from the left."""
    both: dict[str, list[tuple[float, float, float, float]]] = {}
    ranges: dict[str, list[tuple[float, float, float]]] = {}
    for drive, path in zip(drives, poses, strict=True):
        for used in drive.sightings:
            name, r, b = used.sighting.id, used.sighting.range_m, used.sighting.bearing_rad
            if name not in walls or r is None:
                continue
            x, y, heading = path[used.pose].tolist()
            ranges.setdefault(name, []).append((x, y, r))
            if b is not None:
                both.setdefault(name, []).append((x, y, r, heading + b))
    found = dict[str, Line]()
    for name, rows in ranges.items():
        line = _from_both(np.array(both.get(name, ())))
        line = _from_ranges(np.array(rows)) if line is None else line
        if line is not None:
            found[name] = line
    return found


def _from_both(rows: Floats) -> Line | None:
    """From rows x, y, range, direction to the wall, shape (n, 4)."""
    if len(rows) < LEAST_READINGS:
        return None
    # Twice the direction is the same from both sides.
    twice = np.exp(2j * rows[:, 3])
    mean = np.median(twice.real) + 1j * np.median(twice.imag)
    towards = 0.5 * float(np.angle(mean))
    if np.median(np.cos(rows[:, 3] - towards)) < 0.0:
        towards += math.pi
    feet = rows[:, :2] + rows[:, 2:3] * np.stack([np.cos(rows[:, 3]), np.sin(rows[:, 3])], axis=1)
    return _line_through(feet, towards + 0.5 * math.pi)


def _from_ranges(rows: Floats) -> Line | None:
    """From rows x, y, range, shape (n, 3), all from one side of the wall."""
    centred = rows[:, :2] - rows[:, :2].mean(axis=0)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred / len(rows)), 0.0))
    if len(rows) < LEAST_READINGS or spread[0] < LEAST_SPREAD_M:
        return None
    angles = np.arange(DIRECTIONS) * (math.tau / DIRECTIONS)
    feet_along = rows[:, :2] @ np.stack([np.cos(angles), np.sin(angles)]) + rows[:, 2:3]
    scatter = np.median(np.abs(feet_along - np.median(feet_along, axis=0)), axis=0)
    towards = float(angles[int(np.argmin(scatter))])
    feet = rows[:, :2] + rows[:, 2:3] * (math.cos(towards), math.sin(towards))
    return _line_through(feet, towards + 0.5 * math.pi)


def _line_through(feet: Floats, direction: float) -> Line:
    """The line of this direction through the middle of points (n, 2)."""
    line = Line(np.median(feet, axis=0), direction, 0.0)
    along, across = feet @ line.along, float(np.median(feet @ line.normal))
    low, high = np.quantile(along, (0.02, 0.98)).tolist()
    point = 0.5 * (low + high) * line.along + across * line.normal
    return Line(point, direction, 0.5 * (high - low))


# Frames -------------------------------------------------------------------------------------------


class Pairs(NamedTuple):
    """Points and lines as they were measured, and where they are in the frame that is sought."""

    points: Floats  # (n, 2)
    places: Floats
    measured: Sequence[Line]
    targets: Sequence[Line]

    def without(self, index: int) -> "Pairs":
        """Without a point, or, counted on behind the points, a line."""
        rest = np.arange(len(self.points)) != index
        lines = [i for i in range(len(self.targets)) if i + len(self.points) != index]
        return Pairs(
            self.points[rest],
            self.places[rest],
            [self.measured[i] for i in lines],
            [self.targets[i] for i in lines],
        )

    @property
    def fixes_position(self) -> bool:
        """Whether a point, or two lines that cross, leave no freedom along the lines."""
        first = self.targets[0] if self.targets else None
        return len(self.points) > 0 or any(
            first is not None and abs(math.sin(line.direction - first.direction)) > PARALLEL
            for line in self.targets
        )


def errors_m(pairs: Pairs, rigid: Rigid) -> Floats:
    """How far each point, and then each line, is from its target: of a line at the ends of the part
    that robots saw."""
    apart = rigid.points(pairs.points) - pairs.places
    lines = []
    for measured, target in zip(pairs.measured, pairs.targets, strict=True):
        here = measured.in_frame(rigid)
        offset = abs(float(target.normal @ (here.point - target.point)))
        turned = abs(math.sin(here.direction - target.direction))
        lines.append(offset + turned * max(here.half_m, LEAST_LEVER_M))
    return np.concatenate([np.hypot(*apart.T), lines])


def fit_frames(pairs: Pairs) -> list[Rigid]:
    """The transforms that bring what was measured onto its targets as well as possible, the best
    one first. Two are due where nothing says from which side of its lines the robots saw them."""
    angles = []
    for measured, target in zip(pairs.measured, pairs.targets, strict=True):
        angle = target.direction - measured.direction
        angles += [angle, angle + math.pi]
    fits = [_refined(pairs, angle) for angle in angles]
    fits.sort(key=lambda rigid: float(np.sum(errors_m(pairs, rigid))))
    different = list[Rigid]()
    for rigid in fits:
        if all(abs(math.sin(0.5 * (rigid.angle - o.angle))) > 0.5 for o in different):
            different.append(rigid)
    return different


def _refined(pairs: Pairs, angle: float) -> Rigid:
    """First the shift alone; then both by Gauss and Newton, with distances that count less where
    they are large."""
    rows, values = _linearized(pairs, Rigid(angle, np.zeros(2)))
    rigid = Rigid(angle, np.asarray(np.linalg.lstsq(rows[:, 1:], values, rcond=1e-6)[0]))
    for _ in range(15):
        rows, values = _linearized(pairs, rigid)
        weights = 1.0 / np.sqrt(1.0 + (values / max(float(np.median(np.abs(values))), 0.05)) ** 2)
        step = np.linalg.lstsq(rows * weights[:, None], values * weights, rcond=1e-6)[0]
        rigid = Rigid(rigid.angle + float(step[0]), rigid.shift + step[1:])
    return rigid


def _linearized(pairs: Pairs, rigid: Rigid) -> tuple[Floats, Floats]:
    """Rows (n, 3) by angle and shift, and what they should gain (n,), in metres."""
    rows, values = list[Floats](), list[float]()
    turned = rigid.points(pairs.points) - rigid.shift
    for arm, place in zip(turned, pairs.places, strict=True):
        error = place - arm - rigid.shift
        rows += [np.array([-arm[1], 1.0, 0.0]), np.array([arm[0], 0.0, 1.0])]
        values += error.tolist()
    for measured, target in zip(pairs.measured, pairs.targets, strict=True):
        here, normal = measured.in_frame(rigid), target.normal
        arm, lever = here.point - rigid.shift, max(here.half_m, LEAST_LEVER_M)
        rows.append(np.array([normal @ (-arm[1], arm[0]), *normal]))
        values.append(float(normal @ (target.point - here.point)))
        rows.append(np.array([lever, 0.0, 0.0]))
        values.append(lever * math.remainder(target.direction - here.direction, math.pi))
    return np.array(rows), np.array(values)


def sees_from_inside(line: Line, rigid: Rigid, poses: Sequence[Floats], middle: Floats) -> bool:
    """Whether most poses (n, 3) are on the side of a line on which `middle` lies."""
    points = rigid.points(np.concatenate(poses)[:, :2])
    side = float(np.median((points - line.point) @ line.normal))
    return side * float((middle - line.point) @ line.normal) >= 0.0
