"""The place of a landmark beside the errors of the dead reckoning between its readings.

The readings are gone through from the newest to the oldest. The state is the place, and the error
of the pose at which the next reading was taken, in the frame of the robot now: from reading to
reading it grows by the noise of odometry, so what is wrong at one reading is wrong at all older
ones.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from cpcbl_team.config import OdometryNoise
from cpcbl_team.constraints import NEAREST_M, circle, heading
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.landmark_readings import SPACING_NS, LandmarkReading
from cpcbl_team.motion import motion_jacobian, motion_noise

Row5 = tuple[float, float, float, float, float]
PRIOR_SHARE: Final = 10.0  # sigma by distance, of the place before any reading: nothing is known
_ROUNDS: Final = 6  # of linearization
_CONVERGED: Final = 0.01  # squared sigmas


def place_beside_drift(
    x: float, y: float, seen: Sequence[tuple[Pose2, LandmarkReading]], noise: OdometryNoise
) -> tuple[Gaussian2 | None, float]:
    """The place near (x, y) that fits best, None where it is not found soon, and the chi-square of
    all readings there, of as many degrees of freedom as there are scalars, less two. `seen`:
    readings, the oldest first, and the poses at which they were taken, all in the frame of the
    robot now (m, rad)."""
    ways = _ways(seen)
    for _ in range(_ROUNDS):
        run, newer = _Sweep(x, y), Pose2(0.0, 0.0, 0.0)
        for (pose, reading), way_m in zip(reversed(seen), ways, strict=True):
            run.go_back(newer, pose, way_m, noise)
            run.add(pose, reading)
            newer = pose
        dx, dy = run.mean[:2]
        x, y = x + dx, y + dy
        covariance = run.place_covariance
        if covariance.mahalanobis_squared(dx, dy) < _CONVERGED:
            return Gaussian2(x, y, covariance), run.chi_square
    return None, run.chi_square


def _ways(seen: Sequence[tuple[Pose2, LandmarkReading]]) -> list[float]:
    """How far the robot has driven back from each reading to the one before it (m), the newest
    first: as far as it is away, or in a long time as it drives in a short one."""
    poses = [Pose2(0.0, 0.0, 0.0), *(pose for pose, _ in reversed(seen))]
    stamps = [seen[-1][1].stamp_ns, *(r.stamp_ns for _, r in reversed(seen))]
    chords = [math.hypot(b.x - a.x, b.y - a.y) for a, b in pairwise(poses)]
    times = [(a - b) * 1e-9 for a, b in pairwise(stamps)]
    soon_s = 2e-9 * SPACING_NS
    speeds = [c / t for c, t in zip(chords, times, strict=True) if 0.0 < t <= soon_s]
    speed = max(speeds, default=0.0)
    return [max(c, speed * t) for c, t in zip(chords, times, strict=True)]


class _Sweep:
    """The place (x, y) and the error of a pose (x, y, heading), as offsets from what they are
    linearized at."""

    def __init__(self, x: float, y: float) -> None:
        self._x, self._y = x, y
        self.mean = [0.0] * 5
        self._covariance = [[0.0] * 5 for _ in range(5)]
        self._covariance[0][0] = self._covariance[1][1] = PRIOR_SHARE**2 * (x * x + y * y + 1.0)
        self.chi_square = 0.0

    @property
    def place_covariance(self) -> Covariance2:
        (xx, xy, *_), (_, yy, *_), *_ = self._covariance
        return Covariance2(xx, xy, yy)

    def go_back(self, newer: Pose2, older: Pose2, way_m: float, noise: OdometryNoise) -> None:
        """The error of the pose where the robot was before. It has driven `way_m` from there."""
        turn = wrap_angle(older.heading - newer.heading)
        dx, dy = older.x - newer.x, older.y - newer.y
        middle = newer.heading + 0.5 * turn
        along = dx * math.cos(middle) + dy * math.sin(middle)
        _, _, to_x, _, _, to_y, *_ = motion_jacobian(newer.heading, along, turn)
        m, c = self.mean, self._covariance
        m[2], m[3] = m[2] + to_x * m[4], m[3] + to_y * m[4]
        for row in c:
            row[2], row[3] = row[2] + to_x * row[4], row[3] + to_y * row[4]
        c[2] = [a + to_x * b for a, b in zip(c[2], c[4], strict=True)]
        c[3] = [a + to_y * b for a, b in zip(c[3], c[4], strict=True)]
        xx, xy, yy, xh, yh, hh = motion_noise(
            newer.heading, math.copysign(way_m, along), turn, noise
        )
        added = (xx, xy, xh), (xy, yy, yh), (xh, yh, hh)
        for i in range(3):
            for j in range(3):
                c[2 + i][2 + j] += added[i][j]

    def add(self, pose: Pose2, r: LandmarkReading) -> None:
        """What was read at this pose."""
        dx, dy = self._x - pose.x, self._y - pose.y
        distance = max(math.hypot(dx, dy), NEAREST_M)
        if r.range_m is not None:  # a constraint is about the robot's place: the other way round
            u, v, residual = circle(dx, dy, distance, r.range_m)
            self._update((-u, -v, u, v, 0.0), residual, r.range_sigma_m**2)
        if r.bearing_rad is not None:
            u, v, residual = heading(dx, dy, distance**2, r.bearing_rad, pose.heading)
            self._update((u, v, -u, -v, -1.0), -residual, r.bearing_sigma_rad**2)

    def _update(self, h: Row5, residual: float, variance: float) -> None:
        """A scalar update."""
        gain = [sum(a * b for a, b in zip(row, h, strict=True)) for row in self._covariance]
        total = sum(a * b for a, b in zip(h, gain, strict=True)) + max(variance, 1e-12)
        innovation = residual - sum(a * b for a, b in zip(h, self.mean, strict=True))
        self.chi_square += innovation * innovation / total
        k = innovation / total
        self.mean = [m + g * k for m, g in zip(self.mean, gain, strict=True)]
        self._covariance = [
            [c - a * b / total for c, b in zip(row, gain, strict=True)]
            for row, a in zip(self._covariance, gain, strict=True)
        ]
