"""Where a lost robot is if its ranges are hardly known: there its second filters begin."""

import math
from collections.abc import Iterable
from typing import Final

from cpcbl_team.config import Field, OdometryNoise
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.relocalization import relocalize
from cpcbl_team.state import Evidence

SHARE: Final = 0.2  # of a range: its sigma


def rough_pose(
    evidence: Iterable[Evidence], odometry_from_robot: Pose2, field: Field, noise: OdometryNoise
) -> Estimate | None:
    """The pose by this evidence of landmarks; None if it determines none. Its covariance takes the
    errors of ranges for independent, which they are not."""
    in_order = sorted(evidence, key=lambda e: e.stamp_ns)
    pieces = tuple(e if e.range_m is None else _with_wide_range(e, e.range_m) for e in in_order)
    return relocalize(pieces, odometry_from_robot, field, noise)


def _with_wide_range(e: Evidence, range_m: float) -> Evidence:
    return e._replace(range_sigma_m=math.hypot(e.range_sigma_m, SHARE * range_m))
