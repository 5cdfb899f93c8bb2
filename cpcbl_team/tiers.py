"""Tiers: the position sigma of a robot on a logarithmic scale, which decides who helps whom.

A robot accepts help from better tiers only. A plain comparison of sigmas would let two robots help
each other in turn and count the same information again and again, so a robot keeps its tier until
sigma is clearly outside of it.
"""

import math

from cpcbl_team.config import CollaborationSettings

TIER_ZERO_SIGMA_M = 0.01
LOWEST_TIER = 15  # also that of a robot that is lost


def tier_of(sigma_m: float, width: float) -> int:
    """The tier of a position sigma: 0 up to 1 cm, then one more for each factor of `width`."""
    if sigma_m <= TIER_ZERO_SIGMA_M:
        return 0
    tier = math.ceil(math.log(sigma_m / TIER_ZERO_SIGMA_M) / math.log(width) - 1e-9)
    return min(tier, LOWEST_TIER)


def next_tier(
    present: int | None, sigma_m: float, lost: bool, settings: CollaborationSettings
) -> int:
    """The tier to announce: the present one while sigma stays near its limits, the lowest (15) if
    the robot is lost, and never one better than `best_tier`."""
    if lost:
        return LOWEST_TIER
    if present is None or present == LOWEST_TIER:
        return max(settings.best_tier, tier_of(sigma_m, settings.tier_width))
    best = tier_of(sigma_m / settings.tier_hysteresis, settings.tier_width)
    worst = tier_of(sigma_m * settings.tier_hysteresis, settings.tier_width)
    return max(settings.best_tier, min(max(present, best), worst))


def accepted_tiers(own: int, settings: CollaborationSettings) -> range:
    """The tiers from which a robot accepts help: all better than its own, or every tier with both
    directions."""
    return range(LOWEST_TIER + 1 if settings.direction == "both-ways" else own)
