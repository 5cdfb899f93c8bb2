"""An estimate that waits until what the robot measures determines a pose.

Where heading and position are hardly known, a single range or bearing leaves a curve that no
Gaussian describes, and perhaps two poses. A filter that is linear at one of them becomes certain of
it. So the estimate from before is kept, and is fitted to all evidence since then at once
(`delayed_update.py`).
"""

import math
from typing import Final, NamedTuple

from cpcbl_team.arcs import Arc
from cpcbl_team.estimate import Estimate, FilteredOffset, dot
from cpcbl_team.geometry import Pose2, wrap_angle

ALLOWED: Final = 16.27  # the chi-square of a pose (99.9 %, three degrees of freedom)


class DelayedPrior(NamedTuple):
    """The estimate from before what the robot measured did not determine a pose."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2  # dead reckoning at that time
    tried_ns: int = -1  # the newest evidence with which no pose was found


class PropagatedPrior:
    """A delayed prior along its arc, and the motion since then."""

    def __init__(self, prior: DelayedPrior, odometry_from_robot: Pose2) -> None:
        """Raises ZeroDivisionError for a heading without variance."""
        self._prior, self.arc = prior.estimate, Arc.of(prior.estimate)
        self.now_from_then = odometry_from_robot.inverse() @ prior.odometry_from_robot

    def about(self, then: Pose2) -> FilteredOffset:
        """The prior as a Gaussian on the tangent at a pose (field_from_robot) of its time: the
        offset of its mean from there, the covariance, and the chi-square of that pose."""
        mean, arc = self._prior.pose, self.arc
        turn = wrap_angle(then.heading - mean.heading)
        c, s = math.cos(turn), math.sin(turn)
        x, y = then.x - mean.x + arc.x, then.y - mean.y + arc.y
        offset = c * x + s * y - arc.x, c * y - s * x - arc.y, turn
        covariance = self._prior.covariance.transformed(arc.tangent_map(offset))
        dx, dy, turn = arc.tangent_offset(offset)
        return FilteredOffset(covariance, (-dx, -dy, -turn), arc.cost(offset))

    def allows(self, pose: Pose2) -> bool:
        """Whether the robot may be at this pose (field_from_robot) now."""
        _, offset, _ = found = self.about(pose @ self.now_from_then)
        return dot(offset, found.covariance.inverse().times(offset)) <= ALLOWED
