"""The least squares problem of some drives, from a first estimate of all unknowns."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import Integers
from cpcbl_launch.mapping.drives import Drive
from cpcbl_launch.mapping.problem import (
    BEARING,
    CONSTANTS,
    DISTANCE,
    NO_PRIORS,
    RANGE,
    TURN,
    Motions,
    Priors,
    Problem,
    Readings,
    expected_readings,
)
from cpcbl_launch.mapping.wall_lines import LEAST_LEVER_M, Line, line_of
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Landmark, Wall
from cpcbl_team.sensors import sighting_sigmas

CERTAIN = 1e-6  # m, rad: of what fixes a frame that nothing else fixes
NEAREST_M = 0.05  # of a nearer object a bearing says nothing
SMALLEST_SIGMA = 1e-6


class ConstantErrors(NamedTuple):
    """How far the constant errors of a drive may be from what its settings correct: sigmas."""

    distance_share: float = 0.02
    turn_share: float = 0.02
    bearing_deg: float = 1.0
    range_share: float = 0.01

    @property
    def sigmas(self) -> Floats:
        """In the order of the unknowns, shape (4,)."""
        result = np.zeros(CONSTANTS)
        result[DISTANCE], result[TURN] = self.distance_share, self.turn_share
        result[BEARING], result[RANGE] = math.radians(self.bearing_deg), self.range_share
        return np.maximum(result, 1e-9)


class Start(NamedTuple):
    """A first estimate: the poses of each drive (n, 3), the landmarks (2,), and the walls."""

    poses: tuple[Floats, ...]
    landmarks: Mapping[str, Floats]
    lines: Mapping[str, Line]


class Gauge(NamedTuple):
    """The pose of one drive that fixes the frame, as far as known landmarks do not."""

    drive: int
    pose: Floats  # (3,): x, y, heading of its first pose
    position_sigma_m: float | None = None  # None: known landmarks fix the position
    heading_sigma: float | None = None  # rad; None: known landmarks fix the direction
    along: Floats | None = None
    """(2,), where known walls leave the position open along them alone: their direction."""


class Frame(NamedTuple):
    """What fixes the frame: known places, and a pose."""

    known: Mapping[str, Landmark]  # exactly
    place_sigma_m: float
    gauge: Gauge | None = None
    rough: Mapping[str, Landmark] = {}  # with their sigma or covariance
    walls: Mapping[str, Wall] = {}  # exactly, or with their sigmas

    @property
    def known_names(self) -> frozenset[str]:
        """Of landmarks and walls that are known exactly."""
        exact = (name for name, wall in self.walls.items() if wall.is_exact)
        return frozenset((*self.known, *exact))


def assemble(
    drives: Sequence[Drive], start: Start, frame: Frame, errors: ConstantErrors
) -> tuple[Problem, Floats, tuple[str, ...]]:
    """The problem, the first unknowns, and the names of the landmarks, and then of the walls, in
    their order."""
    names, walls = tuple(start.landmarks), tuple(start.lines)
    pivots = [_pivot(line, frame.walls.get(name)) for name, line in start.lines.items()]
    first = np.cumsum([0, *(len(d.stamps_ns) for d in drives)])
    poses = int(first[-1])
    unknowns = [
        np.concatenate([*start.poses, np.empty((0, 3))]).ravel(),
        np.array([start.landmarks[n] for n in names]).ravel(),
        np.array(
            [_unknowns(start.lines[n], p) for n, p in zip(walls, pivots, strict=True)]
        ).ravel(),
        np.zeros(CONSTANTS * len(drives)),
    ]
    problem = Problem(
        poses,
        len(names),
        np.array(pivots).reshape(-1, 2),
        len(drives),
        _in_time(drives),
        _motions(drives, first.tolist()),
        _readings(drives, start, first.tolist()),
        NO_PRIORS,
    )
    names = (*names, *walls)
    priors = _priors(problem, names, first.tolist(), frame, errors)
    return problem._replace(priors=priors), np.concatenate(unknowns), names


def _pivot(line: Line, wall: Wall | None) -> Floats:
    """Of a wall with a known place its middle, where its errors are independent."""
    return line.point if wall is None else line_of(wall).point


def _unknowns(line: Line, pivot: Floats) -> tuple[float, float]:
    return float(line.normal @ (line.point - pivot)), line.direction


def _in_time(drives: Sequence[Drive]) -> Integers:
    runs = list(dict.fromkeys(drive.run for drive in drives))
    run = np.concatenate([np.full(len(d.stamps_ns), runs.index(d.run)) for d in drives])
    stamps = np.concatenate([np.array(d.stamps_ns, dtype=np.int64) for d in drives])
    return np.lexsort((stamps, run))


def _motions(drives: Sequence[Drive], first: Sequence[int]) -> Motions:
    pose = [first[i] + np.arange(len(d.motions)) for i, d in enumerate(drives)]
    noise = np.concatenate([d.noises for d in drives])
    lower = np.linalg.cholesky(noise)
    return Motions(
        np.concatenate(pose).astype(np.int64),
        np.concatenate([np.full(len(d.motions), i) for i, d in enumerate(drives)]),
        np.concatenate([d.motions for d in drives]),
        np.linalg.inv(lower),
    )


def _readings(drives: Sequence[Drive], start: Start, first: Sequence[int]) -> Readings:
    landmark_of = {name: i for i, name in enumerate(start.landmarks)}
    wall_of = {name: i for i, name in enumerate(start.lines)}
    mates = {(d.run, d.robot): i for i, d in enumerate(drives)}
    rows = []
    for i, drive in enumerate(drives):
        sensor = drive.settings.sensor
        for used in drive.sightings:
            sighting, name, mate = used.sighting, used.sighting.id, -1
            landmark, wall = landmark_of.get(name, -1), wall_of.get(name, -1)
            own = start.poses[i][used.pose]
            if wall >= 0:
                line = start.lines[name]
                distance = abs(float(line.normal @ (own[:2] - line.point)))
            elif landmark >= 0:
                distance = expected_readings(own, start.landmarks[name])[0]
            else:
                other = mates.get((drive.run, name))
                seen = None if other is None else drives[other].pose_of.get(used.stamp_ns)
                if other is None or seen is None:
                    continue
                mate = first[other] + seen
                distance = expected_readings(own, start.poses[other][seen, :2])[0]
            sigmas = sighting_sigmas(sighting, sensor, max(distance, NEAREST_M))
            range_m = math.nan if sighting.range_m is None else sighting.range_m
            bearing = math.nan if sighting.bearing_rad is None else sighting.bearing_rad
            row = first[i] + used.pose, landmark, wall, mate, i, range_m, bearing, *sigmas
            rows.append((*row, used.inflation, used.inflation, used.stamp_ns * 1e-9))
    table = np.array(rows, dtype=np.float64).reshape(-1, 12)
    indices = table[:, :5].astype(np.int64)
    least = np.maximum(table[:, 7:9], SMALLEST_SIGMA)
    return Readings(*indices.T, *table[:, 5:7].T, *least.T, *table[:, 9:].T)


# Priors -------------------------------------------------------------------------------------------


def landmark_covariance(mark: Landmark) -> Floats:
    """What a team file says of the error of a place, (2, 2) in m^2."""
    xx, xy, yy = mark.covariance_m2 or (mark.sigma_m**2, 0.0, mark.sigma_m**2)
    return np.array(((xx, xy), (xy, yy)))


def wall_covariance(wall: Wall) -> Floats:
    """What a team file says of the error of a wall: of the offset of its middle (m^2) and of its
    direction (rad^2), (2, 2)."""
    return np.diag((wall.sigma_m**2, math.radians(wall.direction_sigma_deg) ** 2))


def seen_landmark_covariance(place_sigma_m: float) -> Floats:
    """Of how far a landmark seems to be from where it was measured, (2, 2)."""
    return place_sigma_m**2 * np.eye(2)


def seen_wall_covariance(place_sigma_m: float, half_m: float) -> Floats:
    """The same of a wall of this half length: its ends seem to be so far from where they are, along
    its normal. (2, 2), of offset and direction."""
    return np.diag((0.5, 0.5 / max(half_m, LEAST_LEVER_M) ** 2)) * place_sigma_m**2


class _Rows:
    """Priors, row by row."""

    def __init__(self) -> None:
        self.columns = list[tuple[int, int]]()
        self.values = list[tuple[float, float]]()
        self.factors = list[tuple[float, float]]()

    def add_pair(self, column: int, values: tuple[float, float], covariance: Floats) -> None:
        """Two unknowns with this covariance (2, 2)."""
        least = np.diag(np.maximum(CERTAIN**2 - np.diag(covariance), 0.0))
        rows = np.linalg.inv(np.linalg.cholesky(covariance + least))
        for row in rows.tolist():
            self.columns.append((column, column + 1))
            self.values.append(values)
            self.factors.append((row[0], row[1]))

    def add(self, column: int, value: float, sigma: float) -> None:
        self.columns.append((column, column))
        self.values.append((value, value))
        self.factors.append((1.0 / sigma, 0.0))

    def priors(self) -> Priors:
        return Priors(
            np.array(self.columns, np.int64).reshape(-1, 2),
            np.array(self.values).reshape(-1, 2),
            np.array(self.factors).reshape(-1, 2),
        )


def _priors(
    problem: Problem,
    names: Sequence[str],
    first: Sequence[int],
    frame: Frame,
    errors: ConstantErrors,
) -> Priors:
    rows, seen = _Rows(), seen_landmark_covariance(frame.place_sigma_m)
    for i, name in enumerate(names[: problem.landmarks]):
        if (mark := frame.known.get(name, frame.rough.get(name))) is not None:
            place, covariance = (mark.x_m, mark.y_m), landmark_covariance(mark)
            rows.add_pair(problem.landmark_column(i), place, covariance + seen)
    for i, name in enumerate(names[problem.landmarks :]):
        if (wall := frame.walls.get(name)) is not None:
            line = line_of(wall)
            seen = seen_wall_covariance(frame.place_sigma_m, line.half_m)
            values = 0.0, line.direction
            rows.add_pair(problem.wall_column(i), values, wall_covariance(wall) + seen)
    if (gauge := frame.gauge) is not None:
        column = 3 * first[gauge.drive]
        of_pose = (gauge.position_sigma_m, gauge.position_sigma_m, gauge.heading_sigma)
        for i, one in enumerate(of_pose):
            if one is not None:
                rows.add(column + i, float(gauge.pose[i]), max(one, CERTAIN))
        if gauge.along is not None:
            rows.columns.append((column, column + 1))
            rows.values.append((float(gauge.pose[0]), float(gauge.pose[1])))
            ax, ay = (gauge.along / CERTAIN).tolist()
            rows.factors.append((ax, ay))
    for drive in range(problem.drives):
        for kind, sigma in enumerate(errors.sigmas.tolist()):
            rows.add(problem.constant_column(drive) + kind, 0.0, sigma)
    return rows.priors()
