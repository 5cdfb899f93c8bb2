"""Windows of a drive, what was commanded in each beside what the truth says.

Conventions are those of `OdometrySettings`. A way is compared along its own direction, a turn
whole.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.robot_log import LONGEST_GAP_S, RobotLog
from cpcbl_launch.calibration.statistics import Integers, stretches
from cpcbl_launch.reporting.metrics import Floats

WINDOW_S = 2.0
NOISE_WINDOWS_S = (1.0, 2.0, 4.0, 8.0, 16.0)
NUDGE_S = 0.01


class OdometryRows(NamedTuple):
    """Windows of a drive, each beside what the truth says. Shapes (n,)."""

    stretch: Integers
    turn: Floats  # commanded
    turn_rate: Floats  # by how much `turn` falls for a second of delay
    true_turn: Floats
    way: Floats  # commanded way along the true headings
    way_rate: Floats
    true_way: Floats  # the part of the true displacement along it
    loss: Floats  # the part along it of |turn| while driving
    drove: Floats  # sum of distance
    turned_driving: Floats  # sum of |turn| while driving
    along: Floats  # sum of |distance| that errs along it: times cos^2 of the direction between
    turned_along: Floats  # the same of |turn|
    path: Floats  # sum of |distance|
    turned: Floats  # sum of |turn|


class Corrections(NamedTuple):
    """Present values by the names of `OdometrySettings`."""

    distance_scale: float
    turn_scale: float
    delay_s: float
    loss: float
    bias: float

    def ways(self, rows: OdometryRows) -> Floats:
        return np.asarray(self.distance_scale * rows.way - self.loss * rows.loss)

    def turns(self, rows: OdometryRows) -> Floats:
        return np.asarray(self.turn_scale * rows.turn + self.bias * self.drove(rows))

    def drove(self, rows: OdometryRows) -> Floats:
        return np.asarray(self.distance_scale * rows.drove - self.loss * rows.turned_driving)


def odometry_rows(logs: Sequence[RobotLog], delay_s: float, length_s: float) -> OdometryRows:
    """Windows of about `length_s` that lie between rows of truth without long gaps."""
    parts = [_windows(log, i, delay_s, length_s) for i, log in enumerate(logs)]
    return OdometryRows(*map(np.concatenate, zip(*parts, strict=True)))


def _windows(log: RobotLog, number: int, delay_s: float, length_s: float) -> OdometryRows:
    stamps = log.truth[:, 0]
    x, y, heading = log.truth[:, 1], log.truth[:, 2], np.unwrap(log.truth[:, 3])
    first, last = _spans(stamps, log.odometry, delay_s, length_s)
    a, b = stamps[first], stamps[last]
    before, now, after = (
        _driven(log.odometry, stamps, heading, delay_s + nudge, a, b)
        for nudge in (-NUDGE_S, 0.0, NUDGE_S)
    )
    turn, px, py, lx, ly, drove, turned_driving, path, turned, *doubled = now.T
    way = np.hypot(px, py)
    still = way < 1e-3
    ux = np.where(still, np.cos(heading[first]), px / np.maximum(way, 1e-9))
    uy = np.where(still, np.sin(heading[first]), py / np.maximum(way, 1e-9))
    rate = (after - before) / (2.0 * NUDGE_S)
    cos2, sin2 = ux * ux - uy * uy, 2.0 * ux * uy
    return OdometryRows(
        stretches(a, stamps, number),
        turn,
        rate[:, 0],
        heading[last] - heading[first],
        ux * px + uy * py,
        ux * rate[:, 1] + uy * rate[:, 2],
        ux * (x[last] - x[first]) + uy * (y[last] - y[first]),
        ux * lx + uy * ly,
        drove,
        turned_driving,
        0.5 * (path + cos2 * doubled[0] + sin2 * doubled[1]),
        0.5 * (turned + cos2 * doubled[2] + sin2 * doubled[3]),
        path,
        turned,
    )


def _spans(
    stamps: Floats, odometry: Floats, delay_s: float, length_s: float
) -> tuple[Integers, Integers]:
    """First and last truth row of each window; windows do not overlap."""
    begin, end = max(stamps[0], odometry[0, 0]) + 1.0, min(stamps[-1], odometry[-1, 1]) - 1.0
    grid = np.arange(begin, end - length_s, length_s)
    ends = odometry[:, 1] + delay_s
    first = _row_at_end(stamps, ends, grid)
    last = _row_at_end(stamps, ends, stamps[first] + length_s)
    gaps = np.concatenate(([0], np.cumsum(np.diff(stamps) > LONGEST_GAP_S)))
    seconds = stamps[last] - stamps[first]
    good = (gaps[first] == gaps[last]) & (stamps[first] - grid < 0.5 * length_s)
    good &= (seconds > 0.75 * length_s) & (seconds < 1.5 * length_s)
    return first[good], last[good]


def _row_at_end(stamps: Floats, ends: Floats, times_s: Floats) -> Integers:
    """Of the next rows of truth the one nearest to an end of odometry, within which there is only
    a mean speed.
    """
    rows = np.searchsorted(stamps, times_s)[:, None] + np.arange(6)
    rows = np.minimum(rows, len(stamps) - 1)
    after = np.clip(np.searchsorted(ends, stamps[rows]), 1, len(ends) - 1)
    aside = np.minimum(np.abs(ends[after] - stamps[rows]), np.abs(stamps[rows] - ends[after - 1]))
    late = stamps[rows] - stamps[rows[:, :1]] > 0.12
    return np.asarray(rows[np.arange(len(rows)), np.argmin(np.where(late, 9.0, aside), axis=1)])


def _driven(
    odometry: Floats, stamps: Floats, heading: Floats, delay_s: float, a: Floats, b: Floats
) -> Floats:
    """What was commanded from a to b, shape (n, 13): turn; way, and |turn| while driving, in x and
    y along the true headings; way; |turn| while driving; |way|; |turn|; both times cos and sin of
    twice the heading.
    """
    from_s, until_s, distance, turn = odometry.T
    direction = np.interp(0.5 * (from_s + until_s) + delay_s, stamps, heading)
    c, s, way, turned = np.cos(direction), np.sin(direction), np.abs(distance), np.abs(turn)
    cos2, sin2 = np.cos(2.0 * direction), np.sin(2.0 * direction)
    lost = np.sign(distance) * turned
    along = [distance * c, distance * s, lost * c, lost * s]
    doubled = [way * cos2, way * sin2, turned * cos2, turned * sin2]
    pieces = np.stack([turn, *along, distance, lost, way, turned, *doubled])
    knots = np.stack([from_s, until_s], axis=1).ravel() + delay_s
    sums = []
    for piece in pieces:
        total = np.cumsum(piece)
        levels = np.stack([total - piece, total], axis=1).ravel()
        sums.append(np.interp(b, knots, levels) - np.interp(a, knots, levels))
    return np.stack(sums, axis=1)
