"""The paper's non-probabilistic variant: weighted averages (section 3).

Its covariance is nominal: it has no estimate of its quality, but gates and tiers need a number.
That is what the last disagreement with a sensor left over, and a configured value at least.
"""

import math

from cpcbl_team.config import Weights
from cpcbl_team.constraints import Constraint
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.geometry import Pose2, wrap_angle


def merge_weighted(prior: Estimate, accepted: list[Constraint], weights: Weights) -> Estimate:
    """Steps 4 and 5 of a cycle: inverse-distance weights among the readings of one type."""
    if not accepted:
        return prior
    total = sum(1.0 / c.distance_m for c in accepted)
    x, y, h = (
        sum(c.residual * c.row[i] / c.distance_m for c in accepted) / total for i in range(3)
    )
    return weighted_average(prior, (x, y), h if accepted[0].on_heading else None, weights)


def weighted_average(
    prior: Estimate, offset: tuple[float, float], heading: float | None, weights: Weights
) -> Estimate:
    """The static weighted average of estimate and sensor: of heading, if one is given, or else of
    position."""
    (x, y, h), c = prior.pose, prior.covariance
    if heading is not None:
        nominal = math.radians(weights.nominal_heading_sigma_deg) ** 2
        variance = max(nominal, ((1.0 - weights.heading) * heading) ** 2)
        pose = Pose2(x, y, wrap_angle(h + weights.heading * heading))
        return Estimate(pose, Covariance3(c.xx, 0.0, c.yy, 0.0, 0.0, variance))
    left_over = (1.0 - weights.position) * math.hypot(*offset)
    p = max(weights.nominal_sigma_m, left_over) ** 2
    pose = Pose2(x + weights.position * offset[0], y + weights.position * offset[1], h)
    return Estimate(pose, Covariance3(p, 0.0, p, 0.0, 0.0, c.hh))
