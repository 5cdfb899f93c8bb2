"""Finding oneself when one is lost: the pose from recent evidence alone.

This is triangulation from what was measured and reported within the last seconds. Dead reckoning
brings each piece of evidence to the present. A closed-form alignment gives the start where ranges
are known, else many starts are tried. An ambiguous answer is no answer. The pose that fits best is
estimated again by a Kalman filter from the oldest piece to the present, for what dead reckoning
errs between two pieces is in all that are older.
"""

import math
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from cpcbl_team.arcs import lever_change
from cpcbl_team.config import Field, OdometryNoise
from cpcbl_team.constraints import NEAREST_M, circle
from cpcbl_team.constraints import heading as heading_of
from cpcbl_team.estimate import (
    POSE,
    SMALLEST_VARIANCE,
    ZERO3,
    Covariance3,
    Estimate,
    FilteredOffset,
    InformationSum,
    Row,
    dot,
    merge,
    offset_pose,
    outer,
    row_sum,
)
from cpcbl_team.fusion import chi_square_bound
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.motion import drift_sigmas, motion_noise
from cpcbl_team.state import Evidence

DRIFT_FACTOR = 1.0  # on the variance of the odometry's noise
MOST_STARTS = 10
CELLS = 5, 4, 8  # of x, y and heading: from the middle of each a pose is looked for
OUTLIER = 14.0  # the chi-square of a piece that is left out
RIVAL = 6.0  # another pose whose chi-square is larger by less than this may be the right one
STEPS = (-8.0, -4.0, -2.0, 2.0, 4.0, 8.0)  # sigmas along the weakest axis
MOST_WIDENING = 4.0  # of the variance along it
LEAST_RISE = 0.5  # of the chi-square, against that of the Gaussian,
FAR = 32.0  # which counts as this at most
UNKNOWNS = 3  # of a pose
Rows = list[tuple[Row, float, float]]  # with the residual and the variance of each
Lever = tuple[float, float]  # by how much x and y then change with the heading now
_OPEN = Covariance3(1e6, 0.0, 1e6, 0.0, 0.0, 1e3)
_STEP = Covariance3(9.0, 0.0, 9.0, 0.0, 0.0, 1.0)  # how far one iteration of a fit may lead
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

    It needs one residual more than unknowns, a fit that the chi-square bound accepts, no second
    pose that fits nearly as well, and a chi-square that rises to either side as that of a Gaussian
    does. What n pieces owe to teammates may be one and the same error: each counts it with n times
    its variance (split covariance intersection of n, equal weights), and so do places that the
    robot has found itself, from poses with one and the same error. A fix with a heading counts as
    two, for one error of its observer may be in both. It is a whole pose, but nothing confirms it
    while it is alone.
    """
    headed = sum(e.heading_rad is not None for e in evidence)
    if not headed and len({(e.x, e.y) for e in evidence}) < 2:
        return None
    repeated = sum(e.from_teammate for e in evidence) + headed
    uses = Counter(e.source for e in evidence if e.source in field.landmarks)
    own = [e for e in evidence if e.source in field.unsurveyed and not e.from_teammate]
    uses |= Counter({e.source: len(own) for e in own})
    pieces = [
        PropagatedEvidence(e, odometry_from_robot, repeated if e.from_teammate else uses[e.source])
        for e in evidence
    ]
    if sum(readings_of(e) for e in evidence) < 4:
        return None
    fits = [_fit(start, pieces) for start in _spread_starts(pieces, field)]
    found = sorted((f for f in fits if f is not None), key=lambda f: f.cost)
    if not found:
        return None
    best = found[0]
    if any(f.cost < best.cost + RIVAL and are_apart(f.pose, best.pose) for f in found[1:]):
        return None
    cost, estimate = _with_drift(best, noise)
    freedom = sum(readings_of(piece.evidence) for piece in best.used) - 3
    if freedom < 1 or not _is_certain(estimate) or cost > chi_square_bound(freedom):
        return None
    widened = _wider_covariance(cost, estimate, best.used, noise)
    if widened is None or not _is_certain(estimate._replace(covariance=widened)):
        return None
    covariance = widened.scaled(max(1.0, cost / freedom))
    return Estimate(estimate.pose, covariance, covariance if repeated else ZERO3)


def readings_of(e: Evidence) -> int:
    """How many numbers a piece of evidence says: a position is two."""
    if e.range_m is None and e.bearing_rad is None:
        return 2 + (e.heading_rad is not None)
    return (e.range_m is not None) + (e.bearing_rad is not None)


class PropagatedEvidence:
    """A piece of evidence that dead reckoning has brought to the present."""

    def __init__(self, evidence: Evidence, odometry_from_robot: Pose2, repeated: int) -> None:
        """`repeated`: how many pieces may have the same error of a teammate, or of a place."""
        self.evidence = evidence
        self.now_from_then = odometry_from_robot.inverse() @ evidence.odometry_from_robot
        drift_m, drift_rad = drift_sigmas(self.now_from_then)
        self.is_fix = evidence.range_m is None and evidence.bearing_rad is None
        factor = math.sqrt(max(repeated, 1))
        self._teammate_m = factor * evidence.teammate_sigma_m
        self._teammate_rad = factor * evidence.teammate_sigma_rad
        self.sigma_m = math.hypot(self._teammate_m, drift_m)
        self._sigma_rad = math.hypot(self._teammate_rad, drift_rad)
        self._range_variance = _variance(evidence.range_sigma_m**2 + self.sigma_m**2)

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

    def rows(self, pose: Pose2) -> Rows:
        """(row, residual, variance) about the present pose."""
        then = pose @ self.now_from_then
        lever = pose.y - then.y, then.x - pose.x  # d(position then) / d(heading now)
        return self._rows_then(then, lever, self.sigma_m, self._sigma_rad, self._range_variance)

    def rows_without_drift(self, then: Pose2) -> Rows:
        """(row, residual, variance) about the pose of that time."""
        sigma_m, sigma_rad = self._teammate_m, self._teammate_rad
        range_variance = _variance(self.evidence.range_sigma_m**2 + sigma_m**2)
        return self._rows_then(then, (0.0, 0.0), sigma_m, sigma_rad, range_variance)

    def _rows_then(
        self, then: Pose2, lever: Lever, sigma_m: float, sigma_rad: float, range_variance: float
    ) -> Rows:
        """About a pose with this lever on that of then, with these sigmas beside the sensor's."""
        e, (hx, hy) = self.evidence, lever
        if self.is_fix:
            return _rows_of_fix(e, then, lever, sigma_m, sigma_rad)
        then_x, then_y, then_heading = then
        dx, dy = e.x - then_x, e.y - then_y
        distance = math.hypot(dx, dy)
        if distance < NEAREST_M:
            return []
        rows = []
        if e.range_m is not None:
            u, v, residual = circle(dx, dy, distance, e.range_m)
            rows.append(((u, v, 0.0 + u * hx + v * hy), residual, range_variance))
        if e.bearing_rad is not None:
            u, v, residual = heading_of(dx, dy, distance**2, e.bearing_rad, then_heading)
            spread = math.hypot(sigma_m / distance, sigma_rad)
            variance = _variance(e.bearing_sigma_rad**2 + spread**2)
            rows.append(((u, v, 1.0 + u * hx + v * hy), residual, variance))
        return rows


def _rows_of_fix(e: Evidence, then: Pose2, lever: Lever, sigma_m: float, sigma_rad: float) -> Rows:
    variance, (hx, hy) = _variance(sigma_m**2 + e.range_sigma_m**2), lever
    rows = [((1.0, 0.0, hx), e.x - then.x, variance), ((0.0, 1.0, hy), e.y - then.y, variance)]
    if e.heading_rad is not None:
        off = math.remainder(e.heading_rad - then.heading, math.tau)
        rows.append(((0.0, 0.0, 1.0), off, _variance(sigma_rad**2 + e.bearing_sigma_rad**2)))
    return rows


def _variance(variance: float) -> float:
    variance += SMALLEST_VARIANCE
    return variance if variance > _SHARPEST else _SHARPEST


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
    x0, y0, side = _square(field)
    of_x, of_y, of_heading = CELLS
    for i in range(of_x):
        for j in range(of_y):
            x, y = x0 + side * (i + 0.5) / of_x, y0 + side * (j + 0.5) / of_y
            for k in range(of_heading):
                yield Pose2(x, y, math.tau * k / of_heading)


def _square(field: Field) -> tuple[float, float, float]:
    """(least x, least y, side) in metres of the square around what is on the map: objects in a line
    leave both sides of it."""
    x0, y0, x1, y1 = field.bounds()
    side = max(x1 - x0, y1 - y0)
    return 0.5 * (x0 + x1 - side), 0.5 * (y0 + y1 - side), side


def _spread_starts(pieces: list[PropagatedEvidence], field: Field) -> list[Pose2]:
    """The best starts: first those that are better than all starts beside them, lest all be near
    one pose."""
    starts = sorted(_starts(pieces, field), key=lambda start: _cost(start, pieces))
    _, _, side = _square(field)
    of_x, of_y, of_heading = CELLS
    near_x, near_y, near_rad = 1.2 * side / of_x, 1.2 * side / of_y, 1.2 * math.tau / of_heading
    first: list[Pose2] = []
    rest: list[Pose2] = []
    for i, (x, y, heading) in enumerate(starts):
        is_beside = any(
            abs(better.x - x) < near_x
            and abs(better.y - y) < near_y
            and abs(math.remainder(better.heading - heading, math.tau)) < near_rad
            for better in starts[:i]
        )
        (rest if is_beside else first).append(starts[i])
    return (first + rest)[:MOST_STARTS]


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
    """A pose that fits some pieces of evidence, and the chi-square of all: of those that are left
    out `OUTLIER` each."""

    cost: float
    pose: Pose2
    used: list[PropagatedEvidence]


def _fit(start: Pose2, pieces: list[PropagatedEvidence]) -> Fit | None:
    """By Gauss-Newton with the worst pieces left out."""
    used = list(pieces)
    while True:
        estimate = Estimate(start, _OPEN)
        for _ in range(10):
            evidence = InformationSum()
            for piece in used:
                for (x, y, a), residual, variance in piece.rows(estimate.pose):
                    evidence.add(x, y, a, residual, 1.0 / variance)
            if evidence.hh <= 0.0:
                return None
            before = estimate.pose
            estimate = merge(Estimate(before, _STEP), evidence.sums())
            change = math.hypot(estimate.pose.x - before.x, estimate.pose.y - before.y)
            if change < 1e-4 and abs(estimate.pose.heading - before.heading) < 1e-4:
                break
        costs = [_cost(estimate.pose, [piece]) for piece in used]
        worst = max(range(len(used)), key=costs.__getitem__)
        if costs[worst] < OUTLIER or len(used) - 1 < max(2, 0.75 * len(pieces)):
            left_out = OUTLIER * (len(pieces) - len(used))
            return Fit(sum(costs) + left_out, estimate.pose, used)
        del used[worst]
        start = estimate.pose


def _with_drift(fit: Fit, noise: OdometryNoise) -> tuple[float, Estimate]:
    """(chi-square, estimate) of the pieces that a fit used, with the drift between them: linear
    around its path, and around the better one."""
    pose = fit.pose
    for _ in range(2):
        covariance, offset, cost = _filtered(pose, fit.used, noise)[:3]
        pose = offset_pose(pose, offset, POSE)
    return cost, Estimate(pose, covariance)


def _filtered(pose: Pose2, used: list[PropagatedEvidence], noise: OdometryNoise) -> FilteredOffset:
    """The least chi-square, its offset from `pose` and the offset's covariance, by a Kalman filter
    from the oldest piece to the present. It is linear around the path that ends at `pose`."""
    state = FilteredOffset(_OPEN)
    last = None
    for piece in (*used, None):
        then = pose if piece is None else pose @ piece.now_from_then
        if last is not None:
            covariance, (x, y, heading) = state[:2]
            dx, dy, turn = then.x - last.x, then.y - last.y, then.heading - last.heading
            offset = x - dy * heading, y + dx * heading, heading
            covariance = covariance.transformed(lever_change(dx, dy))
            way = math.hypot(dx, dy)
            drift = motion_noise(last.heading, way, wrap_angle(turn), noise)
            state = state._replace(covariance=covariance.plus(drift, DRIFT_FACTOR), offset=offset)
        last = then
        if piece is not None:
            state = state.after(piece.rows_without_drift(then))
    return state


def _wider_covariance(
    cost: float, estimate: Estimate, used: list[PropagatedEvidence], noise: OdometryNoise
) -> Covariance3 | None:
    """The covariance, wider along its weakest axis where the chi-square rises less there than that
    of a Gaussian; None if it rises so little somewhere that the pose may be elsewhere.

    The chi-square is the profile: that of the best pose so many sigmas along the axis. Bearings
    and dead reckoning alone give one that is steep at its least and flat far away, and curved.
    """
    variance, axis = _weakest_axis(estimate.covariance)
    sigma = math.sqrt(variance)
    profile = [_profile(estimate.pose, k * sigma, axis, used, noise) for k in STEPS]
    wider = 1.0
    for k, (least, _) in zip(STEPS, profile, strict=True):
        if not least - cost > 0.0:
            return None
        if k * k < FAR:
            wider = max(wider, k * k / (least - cost))
    more = variance * (min(wider, MOST_WIDENING) - 1.0)
    covariance = estimate.covariance.plus(outer(axis), more)
    information = covariance.inverse()
    for least, offset in profile:
        claimed = min(dot(offset, information.times(offset)), FAR)
        if least - cost < LEAST_RISE * claimed:
            return None
    return covariance


def _profile(
    origin: Pose2, goal: float, axis: Row, used: list[PropagatedEvidence], noise: OdometryNoise
) -> tuple[float, Row]:
    """(chi-square, offset) of the best pose among those that are so far along an axis."""
    offset, least = row_sum((0.0, 0.0, 0.0), axis, goal), math.nan
    for _ in range(3):
        covariance, step, least = _filtered(offset_pose(origin, offset, POSE), used, noise)[:3]
        towards = covariance.times(axis)
        along = dot(axis, towards)
        if along <= 0.0:
            return math.nan, offset
        k = -dot(axis, step) / along
        least += k * k * along
        offset = row_sum(row_sum(offset, step), towards, k)
    return least, offset


def _weakest_axis(covariance: Covariance3) -> tuple[float, Row]:
    """The largest eigenvalue of a covariance (m and rad alike), and its axis: the power method."""
    axis = 1.0, 0.7, 0.4
    for _ in range(30):
        towards = covariance.times(axis)
        axis = row_sum((0.0, 0.0, 0.0), towards, 1.0 / math.sqrt(dot(towards, towards)))
    return dot(axis, covariance.times(axis)), axis


def _is_certain(estimate: Estimate) -> bool:
    """Sharp evidence that determines no pose leaves variances that are nothing but rounding."""
    xx, _, yy, _, _, hh = estimate.covariance
    if min(xx, yy, hh) <= 0.0:
        return False
    return 0.5 * (xx + yy) < _ENOUGH_POSITION_SIGMA_M**2 and hh < _ENOUGH_HEADING_SIGMA_RAD**2


def are_apart(a: Pose2, b: Pose2) -> bool:
    turn = math.remainder(a.heading - b.heading, math.tau)
    return math.hypot(a.x - b.x, a.y - b.y) > 0.5 or abs(turn) > 0.5
