"""Landmarks whose places nobody has surveyed: where one is, from what a robot has read of it.

The readings of the last seconds are brought to the present by dead reckoning, which gives the place
in the robot's frame by least squares. One reading of range and bearing is a place; bearings alone
are one when they were taken from places far enough apart (parallax), and so are ranges alone.
Places that may be right are looked for as if the errors of dead reckoning at each reading were
independent. They are not: an error remains in all that was read before it. So the best place is
estimated anew beside these errors (`drifting_landmarks.py`).
"""

import math
from collections.abc import Iterator, Sequence
from typing import Final

from cpcbl_team.config import OdometryNoise
from cpcbl_team.constraints import NEAREST_M, circle, heading
from cpcbl_team.drifting_landmarks import place_beside_drift
from cpcbl_team.estimate import circle_variance
from cpcbl_team.fusion import chi_square_bound
from cpcbl_team.gaussian import Gaussian2
from cpcbl_team.geometry import Pose2
from cpcbl_team.landmark_readings import LandmarkReading
from cpcbl_team.motion import drift_sigmas

LEAST_READINGS: Final = 3  # one alone may have a wrong name
LARGEST_SHARE: Final = 0.2  # sigma by distance: beyond, the place cannot be linearized
RIVAL: Final = 16.0
"""Another place whose chi-square is larger by less than this may be the right one."""
SAME_M: Final = 0.05
APART_SIGMAS: Final = 3.0
FARTHEST_M: Final = 1000.0
EXACT_ODOMETRY: Final = OdometryNoise(
    distance_sigma_m_per_sqrt_m=0.0, turn_sigma_rad_per_sqrt_rad=0.0, turn_sigma_rad_per_sqrt_m=0.0
)
_DISTANCES_M: Final = (1.0, 3.0, 10.0)  # along a bearing without a range: a place is looked for
_DIRECTIONS: Final = 8  # around a range without a bearing
_ITERATIONS: Final = 10


def relative_place(
    readings: Sequence[LandmarkReading],
    odometry_from_robot: Pose2,
    noise: OdometryNoise = EXACT_ODOMETRY,
) -> Gaussian2 | None:
    """The place that the readings determine, in the frame of the robot at this time; None where
    they do not: too few, too little parallax, contradictory, or two places that fit. `noise`: of
    the odometry."""
    if len(readings) < LEAST_READINGS:
        return None
    now_from_odometry = odometry_from_robot.inverse()
    seen = [_Seen(r, now_from_odometry @ r.odometry_from_robot) for r in readings]
    fits = [_fit(x, y, seen) for x, y in _starts(seen)]
    found = sorted((fit for fit in fits if fit is not None), key=lambda fit: fit[1])
    if not found:
        return None
    read = [(s.pose, s.reading) for s in seen]
    place, nis = place_beside_drift(*found[0][0], read, noise)
    if place is None:
        return None
    x, y, covariance = place
    freedom = sum((r.range_m is not None) + (r.bearing_rad is not None) for r in readings) - 2
    spread = circle_variance(*covariance)
    nearest = min(math.hypot(x - s.pose.x, y - s.pose.y) for s in seen)
    if spread > (LARGEST_SHARE * nearest) ** 2 or freedom < 1 or nis > chi_square_bound(freedom):
        return None
    apart_m = APART_SIGMAS * math.sqrt(spread)
    for other in _distinct([fit for fit, _ in found])[1:]:
        rival, other_nis = place_beside_drift(*other, read, noise)
        is_same = rival is not None and math.hypot(rival.x - x, rival.y - y) <= apart_m
        if not is_same and other_nis < nis + RIVAL:
            return None
    return place


def _distinct(places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The places, each once."""
    kept: list[tuple[float, float]] = []
    for x, y in places:
        if all(math.hypot(x - a, y - b) > SAME_M for a, b in kept):
            kept.append((x, y))
    return kept


class _Seen:
    """A reading from where the robot was, seen from where it is."""

    def __init__(self, reading: LandmarkReading, pose: Pose2) -> None:
        self.pose, self.reading = pose, reading
        self.drift_m, self.drift_rad = drift_sigmas(pose)

    def rows(self, x: float, y: float) -> Iterator[tuple[float, float, float, float]]:
        """(d/dx, d/dy, residual, variance) of what is expected of an object at (x, y)."""
        dx, dy = x - self.pose.x, y - self.pose.y
        distance, r = max(math.hypot(dx, dy), NEAREST_M), self.reading
        if r.range_m is not None:  # a constraint is about the robot's place: the other way round
            u, v, residual = circle(dx, dy, distance, r.range_m)
            yield -u, -v, residual, r.range_sigma_m**2 + self.drift_m**2
        if r.bearing_rad is not None:
            u, v, residual = heading(dx, dy, distance**2, r.bearing_rad, self.pose.heading)
            variance = r.bearing_sigma_rad**2 + self.drift_rad**2 + (self.drift_m / distance) ** 2
            yield u, v, -residual, variance


def _starts(seen: Sequence[_Seen]) -> Iterator[tuple[float, float]]:
    """Places from which the best one is looked for, by the newest reading."""
    r, pose = seen[-1].reading, seen[-1].pose
    turns = [2.0 * math.pi * k / _DIRECTIONS for k in range(_DIRECTIONS)]
    bearings = turns if r.bearing_rad is None else [r.bearing_rad]
    for distance in _DISTANCES_M if r.range_m is None else (r.range_m,):
        for bearing in bearings:
            yield pose.transform(distance * math.cos(bearing), distance * math.sin(bearing))


def _fit(x: float, y: float, seen: Sequence[_Seen]) -> tuple[tuple[float, float], float] | None:
    """The place by least squares (Levenberg-Marquardt) from a start, and its chi-square."""
    damping, cost = 1e-3, _cost(x, y, seen)
    for _ in range(_ITERATIONS):
        xx, xy, yy, bx, by = _normal_equations(x, y, seen)
        a, c = xx * (1.0 + damping) + 1e-12, yy * (1.0 + damping) + 1e-12
        determinant = a * c - xy * xy
        if determinant <= 0.0:
            return None
        sx, sy = (c * bx - xy * by) / determinant, (a * by - xy * bx) / determinant
        after = _cost(x + sx, y + sy, seen)
        if after > cost:
            damping *= 10.0
            continue
        x, y, cost, damping = x + sx, y + sy, after, 0.1 * damping
        if math.hypot(sx, sy) < 1e-4:
            break
    if math.hypot(x, y) > FARTHEST_M:
        return None
    xx, xy, yy, _, _ = _normal_equations(x, y, seen)
    return None if xx * yy - xy * xy <= 1e-12 * xx * yy else ((x, y), cost)


def _normal_equations(
    x: float, y: float, seen: Sequence[_Seen]
) -> tuple[float, float, float, float, float]:
    xx = xy = yy = bx = by = 0.0
    for u, v, residual, variance in (row for one in seen for row in one.rows(x, y)):
        w = 1.0 / max(variance, 1e-12)
        xx, xy, yy = xx + w * u * u, xy + w * u * v, yy + w * v * v
        bx, by = bx + w * u * residual, by + w * v * residual
    return xx, xy, yy, bx, by


def _cost(x: float, y: float, seen: Sequence[_Seen]) -> float:
    rows = (row for one in seen for row in one.rows(x, y))
    return sum(residual * residual / max(variance, 1e-12) for _, _, residual, variance in rows)
