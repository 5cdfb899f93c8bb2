"""A pose that somebody sets, such as a person in RViz, as the robot's estimate.

It is treated as the start of a team file: no teammate has told it, and no teammate knows it, so
nothing of it is shared, whatever the robot told and heard before.
"""

import math
from typing import Final

from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import InitialPose

LEAST_SIGMA_M: Final = 0.01
LEAST_SIGMA_RAD: Final = 0.01
"""Below these nobody knows where a robot stands, and programs write zeros for what they do not
know. A robot that took such a pose for exact would reject all landmarks that contradict it."""
MOST_SIGMA_RAD: Final = math.pi  # of a heading of which nothing is known


def estimate_of(given: InitialPose) -> Estimate:
    """The estimate that begins with this pose."""
    xx, xy, yy, xh, yh, hh = given.covariance
    least_m2, least_rad2 = LEAST_SIGMA_M**2, LEAST_SIGMA_RAD**2
    if hh > MOST_SIGMA_RAD**2:
        share = MOST_SIGMA_RAD / math.sqrt(hh)
        xh, yh, hh = share * xh, share * yh, MOST_SIGMA_RAD**2
    covariance = Covariance3(max(xx, least_m2), xy, max(yy, least_m2), xh, yh, max(hh, least_rad2))
    return Estimate(Pose2(given.x_m, given.y_m, wrap_angle(given.heading_rad)), covariance)


def is_covariance(c: tuple[float, float, float, float, float, float]) -> bool:
    """Whether these six numbers (xx, xy, yy, xh, yh, hh) can be a covariance; a variance of zero
    means that it is exact, and has no correlation."""
    xx, xy, yy, xh, yh, hh = c
    if min(xx, yy, hh) < 0.0:
        return False
    minors = ((xy, xx, yy), (xh, xx, hh), (yh, yy, hh))
    if any(cross * cross > a * b * (1.0 + 1e-6) + 1e-12 for cross, a, b in minors):
        return False
    scale = xx * yy * hh
    return Covariance3(*c).determinant() >= -1e-6 * scale - 1e-12
