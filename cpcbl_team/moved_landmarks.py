"""Landmarks that a robot has found itself and that stand elsewhere now: pushed, or two of one name.

A push beyond the gates is rejected time after time (`map_rejections.py`). A smaller one is
accepted, and leads the estimate along. But innovations of a landmark that stands are white: those
of a pushed one have the same sign again and again, and no other landmark's have. Such a landmark
loses its place, and is found anew where it stands then.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.estimate import Estimate, circle_variance, dot
from cpcbl_team.gaussian import Gaussian2
from cpcbl_team.measurements import GatedObject

KEPT: Final = 0.9  # of a sum, after one more innovation
LEAST_SQUARES: Final = 3.0  # of weights: some four innovations
RECENT_NS: Final = 2_000_000_000
LEAST_BIAS: Final = 4.5  # sigmas, of a sum of innovations, and
LEAST_RATIO: Final = 1.5  # times that of any other landmark
LEAST_LANDMARKS: Final = 3  # of two that contradict each other either one may have moved
INFLATION: Final = 4.0  # of the variances of all that a moved landmark has led along
MOST_MOVES: Final = 3  # of one that moves more often nothing is used
SAME_M, SAME_SIGMAS = 0.1, 3.0  # so near it is found anew where it stood
SAID_NS: Final = 120_000_000_000  # after it was found anew


class InnovationSum(NamedTuple):
    """Normalized innovations of one kind of one landmark: sums that fade."""

    total: float = 0.0
    squares: float = 0.0  # of their weights

    def plus(self, normalized: float) -> "InnovationSum":
        return InnovationSum(KEPT * self.total + normalized, KEPT * KEPT * self.squares + 1.0)

    @property
    def is_known(self) -> bool:
        """Whether there are enough of them to tell."""
        return self.squares > LEAST_SQUARES

    @property
    def bias(self) -> float:
        """How far the sum is from zero, in sigmas."""
        return abs(self.total) / math.sqrt(self.squares) if self.is_known else 0.0


class LandmarkInnovations(NamedTuple):
    """Those of one landmark, until a time."""

    stamp_ns: int
    ranges: InnovationSum = InnovationSum()
    bearings: InnovationSum = InnovationSum()

    @property
    def bias(self) -> float:
        """The larger one."""
        return max(self.ranges.bias, self.bearings.bias)


Innovations = Mapping[str, LandmarkInnovations]


class MovedLandmark(NamedTuple):
    """A landmark that no longer stands where the robot had found it."""

    x: float  # where that was, in the field's frame (m)
    y: float
    times: int  # that it has moved
    stamp_ns: int  # when it moved, or was found anew
    apart_m: float = 0.0  # how far from there it was found anew; 0: it is looked for

    @property
    def is_unreliable(self) -> bool:
        """Whether it has moved so often that nothing of it is used."""
        return self.times >= MOST_MOVES

    def is_current(self, stamp_ns: int) -> bool:
        """Whether it is to be said at this time."""
        is_settled = self.apart_m > 0.0 and not self.is_unreliable
        return not is_settled or stamp_ns - self.stamp_ns < SAID_NS


Moves = Mapping[str, MovedLandmark]


def with_innovations(
    sums: Innovations,
    estimate: Estimate,
    common: CommonErrors,
    accepted: Sequence[GatedObject],
    stamp_ns: int,
) -> Innovations:
    """With those of a frame, before its update."""
    found = dict(sums)
    for g in accepted:
        m = g.measurement
        if not m.is_estimated or common.objects[m.source] not in common.found:
            continue
        before = found.get(m.source, LandmarkInnovations(0))
        pair = [before.ranges, before.bearings]
        for c, sensitivity in zip(g.constraints, g.sensitivities, strict=True):
            added = common.innovation((c.row,), (sensitivity,)).xx
            total = dot(c.row, estimate.covariance.times(c.row)) + added + c.sigma * c.sigma
            z = c.residual / math.sqrt(max(total, 1e-12))
            pair[c.is_bearing] = pair[c.is_bearing].plus(z)
        found[m.source] = LandmarkInnovations(stamp_ns, *pair)
    return found


def biased_landmark(sums: Innovations, stamp_ns: int) -> str:
    """The landmark whose innovations have the same sign again and again, while those of others that
    are seen at the same time have not; empty if none."""
    recent = {n: s for n, s in sums.items() if stamp_ns - s.stamp_ns <= RECENT_NS}
    known = {n: s for n, s in recent.items() if s.ranges.is_known or s.bearings.is_known}
    if len(known) < LEAST_LANDMARKS:
        return ""
    ranked = sorted((s.bias, name) for name, s in known.items())
    (second, _), (most, name) = ranked[-2:]
    return name if most > max(LEAST_BIAS, LEAST_RATIO * second) else ""


def with_move(moves: Moves, name: str, common: CommonErrors, stamp_ns: int) -> Moves:
    """With the place at which a landmark stood until now. One that moves again soon has moved from
    where it was before."""
    before = moves.get(name)
    times = before.times if before is not None and before.is_current(stamp_ns) else 0
    moved = MovedLandmark(*common.place_error(name), times + 1, stamp_ns)
    return {**moves, name: moved}


def with_found_anew(
    moves: Moves, name: str, common: CommonErrors, found: Gaussian2, stamp_ns: int
) -> Moves:
    """With the distance at which a landmark was `found` anew (in the robot's frame); without one
    that stands where it stood."""
    moved = moves.get(name)
    if moved is None:
        return moves
    x, y = common.place_error(name)
    apart_m = math.hypot(x - moved.x, y - moved.y)
    if apart_m < SAME_M + SAME_SIGMAS * math.sqrt(circle_variance(*found.covariance)):
        return {n: m for n, m in moves.items() if n != name}
    return {**moves, name: moved._replace(stamp_ns=stamp_ns, apart_m=apart_m)}
