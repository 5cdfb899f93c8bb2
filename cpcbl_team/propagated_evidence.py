"""Evidence of a robot's pose that dead reckoning has brought to another time."""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Final

from cpcbl_team.config import Field
from cpcbl_team.constraints import Constraint, bearing_heading, range_circle
from cpcbl_team.estimate import SMALLEST_VARIANCE, Row
from cpcbl_team.geometry import Pose2
from cpcbl_team.motion import drift_sigmas
from cpcbl_team.state import Evidence

_SHARPEST: Final = 1e-6  # (1 mm)^2, (1 mrad)^2: sharper evidence drowns _OPEN in rounding


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


def propagated(
    evidence: tuple[Evidence, ...], odometry_from_robot: Pose2, field: Field
) -> list[PropagatedEvidence]:
    """Evidence that dead reckoning has brought to another time, with what of it may err alike."""
    repeated = sum(e.from_teammate + (e.heading_rad is not None) for e in evidence)
    uses = Counter(e.source for e in evidence if e.source in field.landmarks)
    own = [e for e in evidence if e.source in field.unsurveyed and not e.from_teammate]
    uses |= Counter({e.source: len(own) for e in own})
    return [
        PropagatedEvidence(e, odometry_from_robot, repeated if e.from_teammate else uses[e.source])
        for e in evidence
    ]
