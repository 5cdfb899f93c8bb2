"""Knowing that one is lost, and finding oneself again.

Lost is a sigma over its limit, or a window of innovations most of which were rejected. The way
back is triangulation from what was seen and told within the last seconds, each piece carried to
the present by dead reckoning: a closed-form alignment where ranges are known, else many starts.
An ambiguous answer is no answer.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple, TypeVar

from msgspec.structs import replace

from cpcbl_team.config import Field, LocalizerSettings
from cpcbl_team.constraints import Constraint, bearing_heading, range_circle
from cpcbl_team.estimate import SMALLEST_VARIANCE, ZERO3, Covariance3, Estimate, Information, merge
from cpcbl_team.geometry import Pose2
from cpcbl_team.measurements import Measured
from cpcbl_team.state import FIX, Evidence, Glance, Memory, State
from cpcbl_team.whereabouts import Whereabouts

WINDOW_NS = 20_000_000_000
SPACING_NS = 500_000_000  # one piece of evidence an object and so long
MOST_PIECES = 30
DRIFT_SHARE = 0.1  # of the way: how far dead reckoning errs within the window
MOST_STARTS = 16
WIDEN_NS = 1_000_000_000
_OPEN = Covariance3(1e6, 0.0, 1e6, 0.0, 0.0, 1e3)
_SHARPEST = 1e-6  # (1 mm)^2, (1 mrad)^2: sharper evidence drowns _OPEN in rounding
_LEVER_M = 2.0  # over such a way an error of position has become one of heading
_ENOUGH_POSITION_SIGMA_M = 0.7
_ENOUGH_HEADING_SIGMA_RAD = 0.5
Seen = TypeVar("Seen", Evidence, Glance)


def seen_evidence(state: State, m: Measured) -> Evidence:
    """A sighting as evidence."""
    x, y, covariance = m.place
    sigma = math.sqrt(0.5 * (covariance.xx + covariance.yy))
    return Evidence(
        state.stamp_ns,
        state.odometry_from_robot,
        m.source,
        x,
        y,
        m.range_m,
        m.bearing,
        m.range_sigma,
        m.bearing_sigma,
        sigma,
        m.teammate,
    )


def told_evidence(state: State, said: Whereabouts) -> Evidence:
    """What a teammate or a position sensor says of the robot's own place (and heading)."""
    now, pose = state.stamp_ns, state.odometry_from_robot
    source, x, y, sensor, observer, heading = said
    own = math.sqrt(0.5 * (sensor.xx + sensor.yy))
    its = 0.0 if observer is None else math.sqrt(0.5 * (observer.xx + observer.yy))
    place = now, pose, source, x, y, None, None, own
    if heading is None:
        return Evidence(*place, 0.0, its, observer is not None)
    own_rad, its_rad = math.sqrt(heading.sensor), math.sqrt(heading.observer)
    return Evidence(*place, own_rad, its, True, heading.rad, its_rad)


def glanced(memory: Memory, glance: Glance) -> Memory:
    """The memory with landmarks that were not `noted`, without what is too old."""
    now, recent = glance.stamp_ns, _recent(memory, glance.stamp_ns)
    for seen in glance.sightings:
        recent[seen.id] = now
    until_ns = min(recent.values()) + SPACING_NS
    glances = latest((*memory.glances, glance))
    return replace(memory, glances=glances, noted=frozenset(recent), noted_until_ns=until_ns)


def remembered(memory: Memory, pieces: Sequence[Evidence]) -> Memory:
    """The memory with new evidence of one time, without what is too old or too alike."""
    now = pieces[0].stamp_ns
    recent = _recent(memory, now)
    new = []
    for piece in pieces:
        if piece.source not in recent:
            recent[piece.source] = now
            new.append(piece)
    if not new:
        return memory
    kept = latest((*memory.evidence, *new))
    until_ns = min(recent.values()) + SPACING_NS
    return replace(memory, evidence=kept, noted=frozenset(recent), noted_until_ns=until_ns)


def latest(seen: tuple[Seen, ...]) -> tuple[Seen, ...]:
    """Without what is too old, or too much."""
    kept = seen[-MOST_PIECES:]
    if kept and kept[-1].stamp_ns - kept[0].stamp_ns > WINDOW_NS:
        kept = tuple(one for one in kept if kept[-1].stamp_ns - one.stamp_ns <= WINDOW_NS)
    return kept


def _recent(memory: Memory, now_ns: int) -> dict[str, int]:
    """The sources of which no more evidence is needed yet, and when each gave some."""
    recent = {}
    for glance in reversed(memory.glances):
        if now_ns - glance.stamp_ns >= SPACING_NS:
            break
        for seen in glance.sightings:
            recent[seen.id] = glance.stamp_ns
    for e in reversed(memory.evidence):
        if now_ns - e.stamp_ns >= SPACING_NS:
            break
        recent[e.source] = e.stamp_ns
    return recent


def noted(memory: Memory, now_ns: int) -> frozenset[str]:
    """The sources of which no more evidence is needed yet."""
    if now_ns < memory.noted_until_ns:
        return memory.noted
    return frozenset(_recent(memory, now_ns))


def with_seen(state: State, seen: Sequence[Measured]) -> Memory:
    """The memory with those of a frame's sightings that are not too alike to what it holds."""
    memory, now = state.memory, state.stamp_ns
    recent = noted(memory, now)
    new = [m for m in seen if m.source not in recent and m.usable and m.wall is None]
    return remembered(memory, [seen_evidence(state, m) for m in new]) if new else memory


def innovated(window: int, accepted: int, rejected: int, length: int) -> int:
    """The window of innovations after these more: the last `length`, the latest in the lowest bit.

    A bit each, set for an accepted one, after a leading bit that is always set: 1 is empty.
    """
    window = ((window + 1 << accepted) - 1) << rejected
    full = 1 << length
    return window if window < full else full | window & full - 1


class Limits(NamedTuple):
    """Beyond one of these a robot is lost."""

    position_variance: float  # m^2, the mean of both axes
    heading_variance: float  # rad^2
    innovations: int  # the window has at least so many,
    rejected: float  # of which more than so many were rejected

    @staticmethod
    def of(settings: LocalizerSettings, slack: float = 1.0) -> "Limits":
        """`slack`: the share of each limit that counts."""
        return Limits(
            (slack * settings.lost_position_sigma_m) ** 2,
            math.radians(slack * settings.lost_heading_sigma_deg) ** 2,
            settings.lost_window // 2,
            slack * settings.lost_share * settings.lost_window,
        )


def lost_reason(estimate: Estimate, innovations: int, limits: Limits) -> str:
    """Why the robot is lost; empty if it is not."""
    position_variance, heading_variance, least, most = limits
    xx, _, yy, _, _, hh = estimate.covariance
    if 0.5 * (xx + yy) > position_variance:
        return f"position sigma {estimate.position_sigma_m:.2f} m"
    if hh > heading_variance:
        return f"heading sigma {math.degrees(estimate.heading_sigma_rad):.0f} deg"
    digits = innovations.bit_length()
    rejected = digits - innovations.bit_count()
    if rejected > most and digits > least:
        return f"{rejected} of the last {digits - 1} innovations rejected"
    return ""


def widened(estimate: Estimate, settings: LocalizerSettings) -> Estimate:
    """For a robot that rejects what it sees: doubt itself more, until its gates open.

    Sigma doubles, from 0.1 m and 0.1 rad at least to the limits of being lost at most.
    """
    c = estimate.covariance
    position = 0.5 * (c.xx + c.yy)
    position_goal = min(max(4.0 * position, 0.01), settings.lost_position_sigma_m**2)
    heading_limit = 0.9 * math.radians(settings.lost_heading_sigma_deg)
    heading_goal = min(max(4.0 * c.hh, 0.01), heading_limit**2)
    p, h = max(position_goal - position, 0.0), max(heading_goal - c.hh, 0.0)
    doubt = Covariance3(p, 0.0, p, 0.0, 0.0, h)
    return estimate._replace(covariance=c.plus(doubt))


def doubted(estimate: Estimate, offset_m: float, settings: LocalizerSettings) -> Estimate:
    """For a robot that followed somebody who was wrong by so much: it may be, too."""
    most_m = settings.lost_position_sigma_m
    most_rad = 0.9 * math.radians(settings.lost_heading_sigma_deg)
    p, h = min(offset_m, most_m) ** 2, min(offset_m / _LEVER_M, most_rad) ** 2
    grown = estimate.covariance.plus(Covariance3(p, 0.0, p, 0.0, 0.0, h))
    return estimate._replace(covariance=grown)


def without(memory: Memory, senders: Collection[str]) -> Memory:
    """The memory without the evidence of these teammates."""
    kept = tuple(
        e for e in memory.evidence if not (e.told and e.source.removeprefix(FIX) in senders)
    )
    return memory if len(kept) == len(memory.evidence) else replace(memory, evidence=kept)


def relocalized(
    evidence: tuple[Evidence, ...], odometry_from_robot: Pose2, field: Field
) -> Estimate | None:
    """The pose from recent evidence alone, or None where it does not determine one.

    Needs one residual more than unknowns, a fit that the chi-square bound accepts, and no second
    pose that fits nearly as well. What n pieces owe to teammates may be one and the same error:
    each counts it with n times its variance (split covariance intersection of n, equal weights). A
    fix with a heading counts as two, for one error of its observer may be in both; it is a whole
    pose, but alone there is nothing that confirms it.
    """
    headed = sum(e.heading_rad is not None for e in evidence)
    if not headed and len({(e.x, e.y) for e in evidence}) < 2:
        return None
    told = sum(e.told for e in evidence) + headed
    pieces = [_Carried(e, odometry_from_robot, told) for e in evidence]
    if sum(p.residual_count for p in pieces) < 4:
        return None
    starts = sorted(_starts(pieces, field), key=lambda start: _cost(start, pieces))
    fits = [_refined(start, pieces) for start in starts[:MOST_STARTS]]
    found = sorted((f for f in fits if f is not None), key=lambda f: f[0])
    if not found:
        return None
    cost, estimate, freedom = found[0]
    if freedom < 1 or not _certain(estimate) or cost > _chi_square_bound(freedom):
        return None
    if any(f[0] < cost + 6.0 and _apart(f[1].pose, estimate.pose) for f in found[1:]):
        return None
    covariance = estimate.covariance.scaled(max(1.0, cost / freedom))
    return Estimate(estimate.pose, covariance, covariance if told else ZERO3)


class _Carried:
    """A piece of evidence, carried to the present by dead reckoning."""

    def __init__(self, evidence: Evidence, odometry_from_robot: Pose2, told: int) -> None:
        self.e = evidence
        self.now_from_then = odometry_from_robot.inverse() @ evidence.odometry_from_robot
        way = math.hypot(self.now_from_then.x, self.now_from_then.y)
        self.drift = DRIFT_SHARE * (way + 0.3 * abs(self.now_from_then.heading))
        self.is_fix = evidence.range_m is None and evidence.bearing_rad is None
        repeated = math.sqrt(told) if evidence.told else 1.0
        self.sigma_m = math.hypot(repeated * evidence.place_sigma_m, self.drift)
        turned = DRIFT_SHARE * (abs(self.now_from_then.heading) + 0.3 * way)
        self.sigma_rad = math.hypot(
            repeated * evidence.place_sigma_rad, turned, evidence.bearing_sigma_rad
        )

    @property
    def residual_count(self) -> int:
        e = self.e
        if self.is_fix:
            return 2 + (e.heading_rad is not None)
        return (e.range_m is not None) + (e.bearing_rad is not None)

    def pose(self) -> Pose2 | None:
        """The present pose, if a fix tells the whole of it."""
        e = self.e
        if e.heading_rad is None:
            return None
        return Pose2(e.x, e.y, e.heading_rad) @ self.now_from_then.inverse()

    def point(self) -> tuple[float, float] | None:
        """The object (or the robot then) in the present robot's frame, if its range is known."""
        if self.is_fix:
            return self.now_from_then.x, self.now_from_then.y
        r, a = self.e.range_m, self.e.bearing_rad
        if r is None or a is None:
            return None
        return self.now_from_then.transform(r * math.cos(a), r * math.sin(a))

    def rows(self, pose: Pose2) -> Iterator[tuple[tuple[float, float, float], float, float]]:
        """(row, residual, variance) about the present pose."""
        then = pose @ self.now_from_then
        e = self.e
        hx, hy = pose.y - then.y, then.x - pose.x  # d(place then) / d(heading now)
        if self.is_fix:
            variance = _variance(self.sigma_m**2 + e.range_sigma_m**2)
            yield (1.0, 0.0, hx), e.x - then.x, variance
            yield (0.0, 1.0, hy), e.y - then.y, variance
            if e.heading_rad is not None:
                off = math.remainder(e.heading_rad - then.heading, math.tau)
                yield (0.0, 0.0, 1.0), off, _variance(self.sigma_rad**2)
            return
        seen: list[Constraint | None] = []
        if e.range_m is not None:
            seen.append(range_circle(then, e.x, e.y, e.range_m, e.range_sigma_m))
        if e.bearing_rad is not None:
            seen.append(bearing_heading(then, e.x, e.y, e.bearing_rad, e.bearing_sigma_rad))
        for c in seen:
            if c is not None:
                x, y, a = c.row
                spread = self.sigma_m / c.distance_m if c.on_heading else self.sigma_m
                row = x, y, a + x * hx + y * hy
                yield row, c.residual, _variance(c.sigma**2 + spread**2)


def _variance(variance: float) -> float:
    return max(variance + SMALLEST_VARIANCE, _SHARPEST)


def _cost(pose: Pose2, pieces: list[_Carried]) -> float:
    return sum(e * e / v for piece in pieces for _, e, v in piece.rows(pose))


def _starts(pieces: list[_Carried], field: Field) -> Iterator[Pose2]:
    told = [pose for piece in pieces if (pose := piece.pose()) is not None]
    aligned = _aligned(pieces)
    if told:
        yield min(told, key=lambda pose: _cost(pose, pieces))
    if aligned is not None:
        yield aligned
    if told or aligned is not None:
        return
    x0, y0, x1, y1 = field.bounds()
    for i in range(5):
        for j in range(4):
            for k in range(8):
                x, y = x0 + (x1 - x0) * (i + 0.5) / 5, y0 + (y1 - y0) * (j + 0.5) / 4
                yield Pose2(x, y, math.tau * k / 8)


def _aligned(pieces: list[_Carried]) -> Pose2 | None:
    """Weighted rigid alignment of points in the robot's frame to points in the field."""
    pairs = []
    for piece in pieces:
        point = piece.point()
        if point is not None:
            sigma = math.hypot(piece.sigma_m, piece.e.range_sigma_m)
            pairs.append((1.0 / (sigma * sigma + 1e-6), *point, piece.e.x, piece.e.y))
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


def _refined(start: Pose2, pieces: list[_Carried]) -> tuple[float, Estimate, int] | None:
    """(chi-square, estimate, degrees of freedom) by Gauss-Newton with the worst pieces left out."""
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
        freedom = sum(p.residual_count for p in used) - 3
        worst = max(range(len(used)), key=costs.__getitem__)
        if costs[worst] < 14.0 or len(used) - 1 < max(2, 0.75 * len(pieces)):
            return sum(costs), estimate, freedom
        del used[worst]
        start = estimate.pose


def _certain(estimate: Estimate) -> bool:
    """Sharp evidence that determines no pose leaves variances that are nothing but rounding."""
    xx, _, yy, _, _, hh = estimate.covariance
    return (
        min(xx, yy, hh) > 0.0
        and 0.5 * (xx + yy) < _ENOUGH_POSITION_SIGMA_M**2
        and hh < _ENOUGH_HEADING_SIGMA_RAD**2
    )


def _apart(a: Pose2, b: Pose2) -> bool:
    return (
        math.hypot(a.x - b.x, a.y - b.y) > 0.5
        or abs(math.remainder(a.heading - b.heading, math.tau)) > 0.5
    )


def _chi_square_bound(freedom: int) -> float:
    """About the 99.9 % quantile (Wilson & Hilferty 1931)."""
    k = max(freedom, 1)
    return k * (1.0 - 2.0 / (9.0 * k) + 3.09 * math.sqrt(2.0 / (9.0 * k))) ** 3
