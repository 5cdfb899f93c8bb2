"""Windows of a drive: the commanded motion in each, compared with the true motion.

The conventions are those of `OdometrySettings`. A displacement is compared along its own direction.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.logs import LONGEST_GAP_S, RobotLog
from cpcbl_launch.calibration.statistics import Integers, join_rows, stretch_numbers
from cpcbl_launch.reporting.metrics import Floats

WINDOW_S = 2.0
NOISE_WINDOWS_S = (1.0, 2.0, 4.0, 8.0, 16.0)
NUDGE_S = 0.01


class OdometryWindows(NamedTuple):
    """Commanded and true motion in windows of a drive. Shapes (n,); m, rad."""

    stretch: Integers
    turn: Floats  # commanded
    turn_rate: Floats  # decrease of `turn` for a second of delay
    true_turn: Floats
    displacement: Floats  # commanded, along the true headings
    displacement_rate: Floats
    true_displacement: Floats  # its part along `displacement`
    loss: Floats  # |turn| while driving, its part along `displacement`
    distance: Floats  # sum of distances
    turn_while_driving: Floats  # sum of |turn| while driving
    distance_along: Floats  # sum of |distance| x cos^2 of the angle to `displacement`
    turn_along: Floats  # sum of |turn| x the same
    path_length: Floats  # sum of |distance|
    turn_total: Floats  # sum of |turn|


class OdometryCorrections(NamedTuple):
    """Present values, named as in `OdometrySettings`."""

    distance_scale: float
    turn_scale: float
    delay_s: float
    loss: float
    bias: float

    def displacement(self, rows: OdometryWindows) -> Floats:
        return np.asarray(self.distance_scale * rows.displacement - self.loss * rows.loss)

    def turn(self, rows: OdometryWindows) -> Floats:
        return np.asarray(self.turn_scale * rows.turn + self.bias * self.distance(rows))

    def distance(self, rows: OdometryWindows) -> Floats:
        return np.asarray(self.distance_scale * rows.distance - self.loss * rows.turn_while_driving)


def odometry_windows(logs: Sequence[RobotLog], delay_s: float, length_s: float) -> OdometryWindows:
    """Windows of about `length_s` that lie between rows of truth without long gaps."""
    return join_rows([_windows_of_log(log, i, delay_s, length_s) for i, log in enumerate(logs)])


def _windows_of_log(log: RobotLog, number: int, delay_s: float, length_s: float) -> OdometryWindows:
    stamps = log.truth[:, 0]
    x, y, heading = log.truth[:, 1], log.truth[:, 2], np.unwrap(log.truth[:, 3])
    first, last = _window_rows(stamps, log.odometry, delay_s, length_s)
    a, b = stamps[first], stamps[last]
    before, now, after = (
        _commanded_motion(log.odometry, stamps, heading, delay_s + nudge, a, b)
        for nudge in (-NUDGE_S, 0.0, NUDGE_S)
    )
    turn, px, py, lx, ly, distance, turn_while_driving, path_length, turn_total, *doubled = now.T
    displacement = np.hypot(px, py)
    still = displacement < 1e-3
    ux = np.where(still, np.cos(heading[first]), px / np.maximum(displacement, 1e-9))
    uy = np.where(still, np.sin(heading[first]), py / np.maximum(displacement, 1e-9))
    rate = (after - before) / (2.0 * NUDGE_S)
    cos2, sin2 = ux * ux - uy * uy, 2.0 * ux * uy
    return OdometryWindows(
        stretch_numbers(a, stamps, number),
        turn,
        rate[:, 0],
        heading[last] - heading[first],
        ux * px + uy * py,
        ux * rate[:, 1] + uy * rate[:, 2],
        ux * (x[last] - x[first]) + uy * (y[last] - y[first]),
        ux * lx + uy * ly,
        distance,
        turn_while_driving,
        0.5 * (path_length + cos2 * doubled[0] + sin2 * doubled[1]),
        0.5 * (turn_total + cos2 * doubled[2] + sin2 * doubled[3]),
        path_length,
        turn_total,
    )


def _window_rows(
    stamps: Floats, odometry: Floats, delay_s: float, length_s: float
) -> tuple[Integers, Integers]:
    """The first and last row of truth of each window; windows do not overlap."""
    begin, end = max(stamps[0], odometry[0, 0]) + 1.0, min(stamps[-1], odometry[-1, 1]) - 1.0
    grid = np.arange(begin, end - length_s, length_s)
    ends = odometry[:, 1] + delay_s
    first = _row_near_odometry_end(stamps, ends, grid)
    last = _row_near_odometry_end(stamps, ends, stamps[first] + length_s)
    gaps = np.concatenate(([0], np.cumsum(np.diff(stamps) > LONGEST_GAP_S)))
    seconds = stamps[last] - stamps[first]
    good = (gaps[first] == gaps[last]) & (stamps[first] - grid < 0.5 * length_s)
    good &= (seconds > 0.75 * length_s) & (seconds < 1.5 * length_s)
    return first[good], last[good]


def _row_near_odometry_end(stamps: Floats, ends: Floats, times_s: Floats) -> Integers:
    """Of the next rows of truth, the one nearest to the end of a piece of odometry: inside a piece
    only the mean speed is known.
    """
    rows = np.searchsorted(stamps, times_s)[:, None] + np.arange(6)
    rows = np.minimum(rows, len(stamps) - 1)
    after = np.clip(np.searchsorted(ends, stamps[rows]), 1, len(ends) - 1)
    aside = np.minimum(np.abs(ends[after] - stamps[rows]), np.abs(stamps[rows] - ends[after - 1]))
    late = stamps[rows] - stamps[rows[:, :1]] > 0.12
    return np.asarray(rows[np.arange(len(rows)), np.argmin(np.where(late, 9.0, aside), axis=1)])


def _commanded_motion(
    odometry: Floats, stamps: Floats, heading: Floats, delay_s: float, a: Floats, b: Floats
) -> Floats:
    """The commanded motion from a to b, shape (n, 13): turn; distance, and |turn| while driving, in
    x and y along the true headings; distance; |turn| while driving; |distance|; |turn|; the last
    two times cos and sin of twice the heading.
    """
    from_s, until_s, distance, turn = odometry.T
    direction = np.interp(0.5 * (from_s + until_s) + delay_s, stamps, heading)
    c, s = np.cos(direction), np.sin(direction)
    displacement, turn_total = np.abs(distance), np.abs(turn)
    cos2, sin2 = np.cos(2.0 * direction), np.sin(2.0 * direction)
    lost = np.sign(distance) * turn_total
    distance_along = [distance * c, distance * s, lost * c, lost * s]
    doubled = [displacement * cos2, displacement * sin2, turn_total * cos2, turn_total * sin2]
    pieces = np.stack([turn, *distance_along, distance, lost, displacement, turn_total, *doubled])
    knots = np.stack([from_s, until_s], axis=1).ravel() + delay_s
    sums = []
    for piece in pieces:
        total = np.cumsum(piece)
        levels = np.stack([total - piece, total], axis=1).ravel()
        sums.append(np.interp(b, knots, levels) - np.interp(a, knots, levels))
    return np.stack(sums, axis=1)
