"""The least squares problem: its unknowns, its residuals in units of their sigma, and the Jacobian.

The unknowns are the poses of all drives (x, y, heading), the landmarks (x, y), the walls (offset,
direction), and four constant errors of each drive: shares of its odometry's distance and turn, the
bias of its bearings, the share of its ranges. A reading is expected as (1 + share) times what the
unknowns say. If instead the reading were scaled, a smaller map would have smaller residuals, and
the map would shrink.

The offset of a wall is that from its pivot, a fixed point near it, along its normal, which points
to the left of its direction.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import sparse

from cpcbl_launch.calibration.logs import wrap_angles
from cpcbl_launch.calibration.statistics import Integers
from cpcbl_launch.reporting.metrics import Floats

DISTANCE, TURN, BEARING, RANGE = range(4)
CONSTANTS = 4  # constant errors of a drive


class Motions(NamedTuple):
    """Odometry between successive poses of a drive."""

    pose: Integers  # (m,), that before; the next index is the pose after
    drive: Integers  # (m,)
    read: Floats  # (m, 3): x, y, heading of the pose after in the frame of that before
    whitening: Floats  # (m, 3, 3): W with W^T W = the inverse of the covariance


class Readings(NamedTuple):
    """Ranges and bearings; NaN: not measured."""

    pose: Integers  # (s,), of the observer
    landmark: Integers  # (s,), -1: a robot or a wall is seen
    wall: Integers  # (s,), -1: a robot or a landmark is seen
    mate: Integers  # (s,), the pose of the robot that is seen; -1: a landmark or a wall is
    drive: Integers  # (s,)
    range_m: Floats
    bearing: Floats
    range_sigma: Floats  # of one reading
    bearing_sigma: Floats
    range_inflation: Floats  # of the variance, because successive errors resemble each other
    bearing_inflation: Floats
    stamp_s: Floats


class Priors(NamedTuple):
    """What unknowns are known to be, in rows of two: the sum of factor * (unknown - value) has the
    standard deviation 1. Shapes (p, 2); the second factor is 0 where one unknown stands alone."""

    columns: Integers
    values: Floats
    factors: Floats

    def residuals(self, x: Floats) -> Floats:
        """In units of sigma, shape (p,)."""
        return np.asarray(np.sum(self.factors * (x[self.columns] - self.values), axis=1))


NO_PRIORS = Priors(np.empty((0, 2), np.int64), np.empty((0, 2)), np.empty((0, 2)))


class Problem(NamedTuple):
    """All that the unknowns must fit."""

    poses: int
    landmarks: int
    pivots: Floats  # (walls, 2)
    drives: int
    in_time: Integers  # (poses,), the poses in the order of runs, and there of time
    motions: Motions
    readings: Readings
    priors: Priors

    @property
    def walls(self) -> int:
        return len(self.pivots)

    @property
    def size(self) -> int:
        return self.constant_column(self.drives)

    def landmark_column(self, landmark: int = 0) -> int:
        return 3 * self.poses + 2 * landmark

    def wall_column(self, wall: int = 0) -> int:
        return self.landmark_column(self.landmarks) + 2 * wall

    def constant_column(self, drive: int = 0) -> int:
        return self.wall_column(self.walls) + CONSTANTS * drive

    def parts(self, x: Floats) -> tuple[Floats, Floats, Floats]:
        """The poses (n, 3), landmarks (l, 2) and constant errors (d, 4) among the unknowns."""
        poses, landmarks = x[: self.landmark_column()], x[self.landmark_column() :]
        landmarks, constants = landmarks[: 2 * self.landmarks], x[self.constant_column() :]
        return poses.reshape(-1, 3), landmarks.reshape(-1, 2), constants.reshape(-1, CONSTANTS)

    def lines(self, x: Floats) -> Floats:
        """The walls among the unknowns: offset (m) and direction (rad), shape (w, 2)."""
        return x[self.wall_column() : self.constant_column()].reshape(-1, 2)


class Weights(NamedTuple):
    """Factors on the residuals of motions (m,) and of readings (s,): roots of robust weights."""

    motions: Floats
    readings: Floats


class Blocks(NamedTuple):
    """Residuals (k, r) of some measurements, and their derivatives (k, r, c) by the unknowns in
    `columns` (k, c)."""

    residuals: Floats
    derivatives: Floats
    columns: Integers


# Motions ------------------------------------------------------------------------------------------


def motion_blocks(problem: Problem, x: Floats) -> Blocks:
    """Odometry minus what is expected, in units of sigma: r = 3, c = 8."""
    motions = problem.motions
    poses, _, constants = problem.parts(x)
    before, after = poses[motions.pose], poses[motions.pose + 1]
    distance, turn = constants[motions.drive, DISTANCE], constants[motions.drive, TURN]
    dx, dy = (after - before)[:, :2].T
    turned = (after - before)[:, 2]
    # seen along half of the turn, as odometry compounds an arc
    angle = 0.5 * turn * turned - before[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    px, py = c * dx - s * dy, s * dx + c * dy
    expected = np.stack([(1.0 + distance) * px, (1.0 + distance) * py, (1.0 + turn) * turned], 1)
    residuals = motions.read - expected
    residuals[:, 2] = wrap_angles(residuals[:, 2])
    k = 1.0 + distance
    d = np.zeros((len(px), 3, 8))  # of the expected: by before x, y, h, after x, y, h, shares
    d[:, 0, 0], d[:, 0, 1], d[:, 1, 0], d[:, 1, 1] = -k * c, k * s, -k * s, -k * c
    d[:, :2, 3:5] = -d[:, :2, 0:2]
    by_angle = np.stack([-k * py, k * px], axis=1)
    d[:, :2, 2] = by_angle * (-0.5 * turn - 1.0)[:, None]
    d[:, :2, 5] = by_angle * (0.5 * turn)[:, None]
    d[:, 0, 6], d[:, 1, 6] = px, py
    d[:, :2, 7] = by_angle * (0.5 * turned)[:, None]
    d[:, 2, 2], d[:, 2, 5], d[:, 2, 7] = -1.0 - turn, 1.0 + turn, turned
    columns = np.concatenate(
        [
            3 * motions.pose[:, None] + np.arange(6),
            problem.constant_column() + CONSTANTS * motions.drive[:, None] + (DISTANCE, TURN),
        ],
        axis=1,
    )
    white = np.einsum("mij,mj->mi", motions.whitening, residuals)
    return Blocks(white, -motions.whitening @ d, columns)


# Readings -----------------------------------------------------------------------------------------


def reading_blocks(problem: Problem, x: Floats) -> Blocks:
    """Ranges and bearings minus what is expected, in units of the sigma of one reading; zero for
    those that were not measured: r = 2, c = 7."""
    readings = problem.readings
    poses, landmarks, constants = problem.parts(x)
    mate, is_mate, is_wall = readings.mate, readings.mate >= 0, readings.wall >= 0
    places = np.where(
        is_mate[:, None], poses[mate, :2], landmarks[readings.landmark] if len(landmarks) else 0.0
    )
    own = poses[readings.pose]
    dx, dy = (places - own[:, :2]).T
    squared = np.maximum(dx * dx + dy * dy, 1e-12)
    r = np.sqrt(squared)
    share, bias = constants[readings.drive, RANGE], constants[readings.drive, BEARING]
    ranges = readings.range_m - (1.0 + share) * r
    bearings = wrap_angles(readings.bearing - np.arctan2(dy, dx) + own[:, 2] - bias)
    d = np.zeros((len(r), 2, 7))  # of the residuals: by own x, y, h, place x, y, share, bias
    ux, uy = (1.0 + share) * dx / r, (1.0 + share) * dy / r
    vx, vy = -dy / squared, dx / squared
    d[:, 0, 0], d[:, 0, 1], d[:, 0, 3], d[:, 0, 4], d[:, 0, 5] = ux, uy, -ux, -uy, -r
    d[:, 1, 0], d[:, 1, 1], d[:, 1, 3], d[:, 1, 4], d[:, 1, 6] = vx, vy, -vx, -vy, -1.0
    d[:, 1, 2] = 1.0
    residuals = np.stack([ranges, bearings], axis=1)
    if problem.walls:
        residuals[is_wall], d[is_wall] = _of_walls(problem, x)
    sigmas = np.stack([readings.range_sigma, readings.bearing_sigma], axis=1)
    residuals /= sigmas
    d /= sigmas[..., None]
    unread = np.isnan(residuals)
    residuals[unread] = 0.0
    d[unread] = 0.0
    place = np.where(is_mate, 3 * mate, problem.landmark_column() + 2 * readings.landmark)
    place = np.where(is_wall, problem.wall_column() + 2 * readings.wall, place)
    constant = problem.constant_column() + CONSTANTS * readings.drive
    columns = np.concatenate(
        [
            3 * readings.pose[:, None] + np.arange(3),
            place[:, None] + np.arange(2),
            constant[:, None] + (RANGE, BEARING),
        ],
        axis=1,
    )
    return Blocks(residuals, d, columns)


class WallViews(NamedTuple):
    """From where walls are seen, of the readings (v,) of walls."""

    distance_m: Floats  # signed: positive to the left of the wall
    side: Floats  # 1: the reading is from the left of the wall, -1: from its right
    along_m: Floats  # along its direction, from its pivot


def wall_views(problem: Problem, x: Floats) -> WallViews:
    """Their poses tell the side."""
    readings = problem.readings
    mine = readings.wall >= 0
    wall = readings.wall[mine]
    own, (offset, direction) = problem.parts(x)[0][readings.pose[mine]], problem.lines(x)[wall].T
    dx, dy = (own[:, :2] - problem.pivots[wall]).T
    c, s = np.cos(direction), np.sin(direction)
    distance = c * dy - s * dx - offset
    return WallViews(distance, np.where(distance >= 0.0, 1.0, -1.0), c * dx + s * dy)


def _of_walls(problem: Problem, x: Floats) -> tuple[Floats, Floats]:
    """Residuals (v, 2) in metres and radians, and their derivatives (v, 2, 7), of the readings of
    walls: their range is the perpendicular distance, their bearing the direction of it."""
    readings = problem.readings
    mine = readings.wall >= 0
    poses, _, constants = problem.parts(x)
    drive, direction = readings.drive[mine], problem.lines(x)[readings.wall[mine], 1]
    distance, side, along = wall_views(problem, x)
    share, bias = constants[drive, RANGE], constants[drive, BEARING]
    ranges = readings.range_m[mine] - (1.0 + share) * side * distance
    towards = direction - side * (0.5 * np.pi)
    own_heading = poses[readings.pose[mine], 2]
    bearings = wrap_angles(readings.bearing[mine] - towards + own_heading - bias)
    d = np.zeros((len(side), 2, 7))  # by own x, y, h, offset, direction, share, bias
    k = (1.0 + share) * side
    d[:, 0, 0], d[:, 0, 1] = k * np.sin(direction), -k * np.cos(direction)
    d[:, 0, 3], d[:, 0, 4], d[:, 0, 5] = k, k * along, -side * distance
    d[:, 1, 2], d[:, 1, 4], d[:, 1, 6] = 1.0, -1.0, -1.0
    return np.stack([ranges, bearings], axis=1), d


# All of it ----------------------------------------------------------------------------------------


class Linearized(NamedTuple):
    """residuals(x + step) ~ residuals + jacobian @ step, in units of sigma."""

    residuals: Floats  # (rows,)
    jacobian: sparse.csr_matrix  # (rows, unknowns)


def linearize(problem: Problem, x: Floats, weights: Weights) -> Linearized:
    """All residuals and their Jacobian at these unknowns, with these weights."""
    motions, readings = motion_blocks(problem, x), reading_blocks(problem, x)
    of_readings = problem.readings
    inflation = np.stack([of_readings.range_inflation, of_readings.bearing_inflation], axis=1)
    inflated = weights.readings[:, None] / np.sqrt(inflation)
    parts, rows, columns, values = [], [], [], []
    first = 0
    for blocks, factor in ((motions, weights.motions[:, None]), (readings, inflated)):
        k, r, c = blocks.derivatives.shape
        parts.append((blocks.residuals * factor).ravel())
        row = first + np.arange(k * r).reshape(k, r)
        rows.append(np.repeat(row.ravel(), c))
        columns.append(np.broadcast_to(blocks.columns[:, None, :], (k, r, c)).ravel())
        values.append((blocks.derivatives * factor[..., None]).ravel())
        first += k * r
    priors = problem.priors
    number = len(priors.columns)
    parts.append(priors.residuals(x))
    rows.append(np.repeat(first + np.arange(number), 2))
    columns.append(priors.columns.ravel())
    values.append(priors.factors.ravel())
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    shape = first + number, problem.size
    return Linearized(np.concatenate(parts), sparse.csr_matrix(entries, shape=shape))


def expected_readings(pose: Floats, place: Floats) -> tuple[float, float]:
    """Range (m) and bearing (rad) of a point (2,) from a pose (3,)."""
    dx, dy = (place[:2] - pose[:2]).tolist()
    return math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - float(pose[2]), math.tau)
