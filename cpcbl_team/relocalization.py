"""Finding oneself when one is lost: the pose from recent evidence alone.

This is triangulation from what was measured and reported within the last seconds. Dead reckoning
brings each piece of evidence to the present. A closed-form alignment gives the start where ranges
are known, else many starts are tried. An ambiguous answer is no answer. The pose that fits best is
estimated again by a Kalman filter from the oldest piece to the present, for what dead reckoning
errs between two pieces is in all that are older.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

from cpcbl_team.config import Field, OdometryNoise
from cpcbl_team.constraints import Constraint, bearing_heading, range_circle
from cpcbl_team.estimate import (
    SMALLEST_VARIANCE,
    ZERO3,
    Covariance3,
    Estimate,
    Information,
    Row,
    merge,
)
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.motion import motion_noise
from cpcbl_team.state import Evidence

DRIFT_SHARE = 0.1  # of the way: how far dead reckoning errs, while a pose is looked for
DRIFT_FACTOR = 1.0  # on the variance of the odometry's noise
MOST_STARTS = 16
_OPEN = Covariance3(1e6, 0.0, 1e6, 0.0, 0.0, 1e3)
_SHARPEST = 1e-6  # (1 mm)^2, (1 mrad)^2: sharper evidence drowns _OPEN in rounding
_ENOUGH_POSITION_SIGMA_M = 0.7
_ENOUGH_HEADING_SIGMA_RAD = 0.5


def relocalize(
    evidence: tuple[Evidence, ...],
    odometry_from_robot: Pose2,
    field: Field,
    noise: OdometryNoise,
) -> Estimate | None:
    """The pose from recent evidence alone, or None where the evidence does not determine one.

    It needs one residual more than unknowns, a fit that the chi-square bound accepts, and no second
    pose that fits nearly as well. What n pieces owe to teammates may be one and the same error:
    each counts it with n times its variance (split covariance intersection of n, equal weights). A
    fix with a heading counts as two, for one error of its observer may be in both. It is a whole
    pose, but nothing confirms it while it is alone.
    """
    headed = sum(e.heading_rad is not None for e in evidence)
    if not headed and len({(e.x, e.y) for e in evidence}) < 2:
        return None
    repeated = sum(e.from_teammate for e in evidence) + headed
    pieces = [PropagatedEvidence(e, odometry_from_robot, repeated) for e in evidence]
    if sum(p.residual_count for p in pieces) < 4:
        return None
    starts = sorted(_starts(pieces, field), key=lambda start: _cost(start, pieces))
    fits = [_fit(start, pieces) for start in starts[:MOST_STARTS]]
    found = sorted((f for f in fits if f is not None), key=lambda f: f.cost)
    if not found:
        return None
    best = found[0]
    if any(f.cost < best.cost + 6.0 and _are_apart(f.pose, best.pose) for f in found[1:]):
        return None
    cost, estimate = _with_drift(best, noise)
    freedom = sum(piece.residual_count for piece in best.used) - 3
    if freedom < 1 or not _is_certain(estimate) or cost > _chi_square_bound(freedom):
        return None
    covariance = estimate.covariance.scaled(max(1.0, cost / freedom))
    return Estimate(estimate.pose, covariance, covariance if repeated else ZERO3)


class PropagatedEvidence:
    """A piece of evidence that dead reckoning has brought to the present."""

    def __init__(self, evidence: Evidence, odometry_from_robot: Pose2, repeated: int) -> None:
        """`repeated`: how many pieces may have the same error of a teammate."""
        self.evidence = evidence
        self.now_from_then = odometry_from_robot.inverse() @ evidence.odometry_from_robot
        way = math.hypot(self.now_from_then.x, self.now_from_then.y)
        drift_m = DRIFT_SHARE * (way + 0.3 * abs(self.now_from_then.heading))
        drift_rad = DRIFT_SHARE * (abs(self.now_from_then.heading) + 0.3 * way)
        self.is_fix = evidence.range_m is None and evidence.bearing_rad is None
        factor = math.sqrt(repeated) if evidence.from_teammate else 1.0
        self._teammate_m = factor * evidence.teammate_sigma_m
        self._teammate_rad = factor * evidence.teammate_sigma_rad
        self.sigma_m = math.hypot(self._teammate_m, drift_m)
        self._sigma_rad = math.hypot(self._teammate_rad, drift_rad)

    @property
    def residual_count(self) -> int:
        e = self.evidence
        if self.is_fix:
            return 2 + (e.heading_rad is not None)
        return (e.range_m is not None) + (e.bearing_rad is not None)

    def pose(self) -> Pose2 | None:
        """The present pose (field_from_robot), if a fix holds the whole of it."""
        e = self.evidence
        if e.heading_rad is None:
            return None
        return Pose2(e.x, e.y, e.heading_rad) @ self.now_from_then.inverse()

    def point(self) -> tuple[float, float] | None:
        """The object (or the robot then) in the present robot's frame, if its range is known."""
        if self.is_fix:
            return self.now_from_then.x, self.now_from_then.y
        r, a = self.evidence.range_m, self.evidence.bearing_rad
        if r is None or a is None:
            return None
        return self.now_from_then.transform(r * math.cos(a), r * math.sin(a))

    def rows(self, pose: Pose2) -> Iterator[tuple[Row, float, float]]:
        """(row, residual, variance) about the present pose."""
        then = pose @ self.now_from_then
        hx, hy = pose.y - then.y, then.x - pose.x  # d(position then) / d(heading now)
        for (x, y, a), residual, variance in self.rows_then(then, self.sigma_m, self._sigma_rad):
            yield (x, y, a + x * hx + y * hy), residual, variance

    def rows_without_drift(self, then: Pose2) -> Iterator[tuple[Row, float, float]]:
        """(row, residual, variance) about the pose of that time."""
        return self.rows_then(then, self._teammate_m, self._teammate_rad)

    def rows_then(
        self, then: Pose2, sigma_m: float, sigma_rad: float
    ) -> Iterator[tuple[Row, float, float]]:
        """The same, with these sigmas beside the sensor's."""
        e = self.evidence
        if self.is_fix:
            variance = _variance(sigma_m**2 + e.range_sigma_m**2)
            yield (1.0, 0.0, 0.0), e.x - then.x, variance
            yield (0.0, 1.0, 0.0), e.y - then.y, variance
            if e.heading_rad is not None:
                off = math.remainder(e.heading_rad - then.heading, math.tau)
                yield (0.0, 0.0, 1.0), off, _variance(sigma_rad**2 + e.bearing_sigma_rad**2)
            return
        constraints: list[Constraint | None] = []
        if e.range_m is not None:
            constraints.append(range_circle(then, e.x, e.y, e.range_m, e.range_sigma_m))
        if e.bearing_rad is not None:
            constraints.append(bearing_heading(then, e.x, e.y, e.bearing_rad, e.bearing_sigma_rad))
        for c in constraints:
            if c is not None:
                spread = sigma_m
                if c.on_heading:
                    spread = math.hypot(sigma_m / c.distance_m, sigma_rad)
                yield c.row, c.residual, _variance(c.sigma**2 + spread**2)


def _variance(variance: float) -> float:
    return max(variance + SMALLEST_VARIANCE, _SHARPEST)


def _cost(pose: Pose2, pieces: list[PropagatedEvidence]) -> float:
    return sum(e * e / v for piece in pieces for _, e, v in piece.rows(pose))


def _starts(pieces: list[PropagatedEvidence], field: Field) -> Iterator[Pose2]:
    """Poses (field_from_robot) from which the fit begins."""
    reported = [pose for piece in pieces if (pose := piece.pose()) is not None]
    aligned = _alignment(pieces)
    if reported:
        yield min(reported, key=lambda pose: _cost(pose, pieces))
    if aligned is not None:
        yield aligned
    if reported or aligned is not None:
        return
    x0, y0, x1, y1 = field.bounds()
    for i in range(5):
        for j in range(4):
            for k in range(8):
                x, y = x0 + (x1 - x0) * (i + 0.5) / 5, y0 + (y1 - y0) * (j + 0.5) / 4
                yield Pose2(x, y, math.tau * k / 8)


def _alignment(pieces: list[PropagatedEvidence]) -> Pose2 | None:
    """Weighted rigid alignment of points in the robot's frame to points in the field."""
    pairs = []
    for piece in pieces:
        point = piece.point()
        if point is not None:
            sigma = math.hypot(piece.sigma_m, piece.evidence.range_sigma_m)
            pairs.append((1.0 / (sigma * sigma + 1e-6), *point, piece.evidence.x, piece.evidence.y))
    total = sum(p[0] for p in pairs)
    if len(pairs) < 2:
        return None
    ax, ay, bx, by = (sum(p[0] * p[i] for p in pairs) / total for i in range(1, 5))
    dot = sum(w * ((px - ax) * (qx - bx) + (py - ay) * (qy - by)) for w, px, py, qx, qy in pairs)
    cross = sum(w * ((px - ax) * (qy - by) - (py - ay) * (qx - bx)) for w, px, py, qx, qy in pairs)
    if math.hypot(dot, cross) < 1e-9:
        return None
    heading = math.atan2(cross, dot)
    c, s = math.cos(heading), math.sin(heading)
    return Pose2(bx - c * ax + s * ay, by - s * ax - c * ay, heading)


class Fit(NamedTuple):
    """A pose that fits some pieces of evidence, and their chi-square."""

    cost: float
    pose: Pose2
    used: list[PropagatedEvidence]


def _fit(start: Pose2, pieces: list[PropagatedEvidence]) -> Fit | None:
    """By Gauss-Newton with the worst pieces left out."""
    used = list(pieces)
    while True:
        estimate = Estimate(start, _OPEN)
        for _ in range(10):
            evidence = Information.none()
            for piece in used:
                for row, residual, variance in piece.rows(estimate.pose):
                    evidence = evidence.add(row, residual, variance)
            if evidence.matrix.hh <= 0.0:
                return None
            before = estimate.pose
            estimate = merge(Estimate(before, _OPEN), evidence)
            change = math.hypot(estimate.pose.x - before.x, estimate.pose.y - before.y)
            if change < 1e-4 and abs(estimate.pose.heading - before.heading) < 1e-4:
                break
        costs = [_cost(estimate.pose, [piece]) for piece in used]
        worst = max(range(len(used)), key=costs.__getitem__)
        if costs[worst] < 14.0 or len(used) - 1 < max(2, 0.75 * len(pieces)):
            return Fit(sum(costs), estimate.pose, used)
        del used[worst]
        start = estimate.pose


def _with_drift(fit: Fit, noise: OdometryNoise) -> tuple[float, Estimate]:
    """(chi-square, estimate) by a Kalman filter over the pieces that a fit used, linear around its
    path, and around the better one."""
    pose, cost = fit.pose, 0.0
    for _ in range(2):
        cost, (x, y, heading), covariance = 0.0, (0.0, 0.0, 0.0), _OPEN
        last = None
        for piece in (*fit.used, None):
            then = pose if piece is None else pose @ piece.now_from_then
            if last is not None:
                dx, dy, turn = then.x - last.x, then.y - last.y, then.heading - last.heading
                x, y = x - dy * heading, y + dx * heading
                covariance = covariance.transformed((1.0, 0.0, -dy, 0.0, 1.0, dx, 0.0, 0.0, 1.0))
                way = math.hypot(dx, dy)
                drift = motion_noise(last.heading, way, wrap_angle(turn), noise)
                covariance = covariance.plus(drift, DRIFT_FACTOR)
            last = then
            for row, residual, variance in () if piece is None else piece.rows_without_drift(then):
                px, py, ph = covariance.times(row)
                k = 1.0 / (row[0] * px + row[1] * py + row[2] * ph + variance)
                off = residual - row[0] * x - row[1] * y - row[2] * heading
                cost += k * off * off
                x, y, heading = x + k * off * px, y + k * off * py, heading + k * off * ph
                gained = px * px, px * py, py * py, px * ph, py * ph, ph * ph
                covariance = covariance.plus(Covariance3(*gained), -k)
        pose = Pose2(pose.x + x, pose.y + y, wrap_angle(pose.heading + heading))
    return cost, Estimate(pose, covariance)


def _is_certain(estimate: Estimate) -> bool:
    """Sharp evidence that determines no pose leaves variances that are nothing but rounding."""
    xx, _, yy, _, _, hh = estimate.covariance
    if min(xx, yy, hh) <= 0.0:
        return False
    return 0.5 * (xx + yy) < _ENOUGH_POSITION_SIGMA_M**2 and hh < _ENOUGH_HEADING_SIGMA_RAD**2


def _are_apart(a: Pose2, b: Pose2) -> bool:
    turn = math.remainder(a.heading - b.heading, math.tau)
    return math.hypot(a.x - b.x, a.y - b.y) > 0.5 or abs(turn) > 0.5


def _chi_square_bound(freedom: int) -> float:
    """About the 99.9 % quantile (Wilson & Hilferty 1931)."""
    k = max(freedom, 1)
    return k * (1.0 - 2.0 / (9.0 * k) + 3.09 * math.sqrt(2.0 / (9.0 * k))) ** 3
