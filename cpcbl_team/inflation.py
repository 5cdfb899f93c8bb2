"""Doubt: how an estimate becomes less certain when something contradicts it."""

import math
from typing import Final

from cpcbl_team.config import LocalizerSettings
from cpcbl_team.estimate import Covariance3, Estimate

LEVER_M: Final = 2.0  # over such a way an error of position has become one of heading


def inflate_covariance(estimate: Estimate, settings: LocalizerSettings) -> Estimate:
    """For a robot that rejects what it measures: its sigmas double, so that its gates open. They
    become 0.1 m and 0.1 rad at least, and the limits of being lost at most."""
    c = estimate.covariance
    position = 0.5 * (c.xx + c.yy)
    position_goal = min(max(4.0 * position, 0.01), settings.lost_position_sigma_m**2)
    heading_limit = 0.9 * math.radians(settings.lost_heading_sigma_deg)
    heading_goal = min(max(4.0 * c.hh, 0.01), heading_limit**2)
    p, h = max(position_goal - position, 0.0), max(heading_goal - c.hh, 0.0)
    return estimate._replace(covariance=c.plus(Covariance3(p, 0.0, p, 0.0, 0.0, h)))


def inflate_by_offset(
    estimate: Estimate, offset_m: float, offset_rad: float, settings: LocalizerSettings
) -> Estimate:
    """For a robot that followed a teammate whose reports were wrong by these offsets: its own
    estimate may be wrong by them."""
    most_m = settings.lost_position_sigma_m
    most_rad = 0.9 * math.radians(settings.lost_heading_sigma_deg)
    turn = max(offset_m / LEVER_M, offset_rad)
    p, h = min(offset_m, most_m) ** 2, min(turn, most_rad) ** 2
    grown = estimate.covariance.plus(Covariance3(p, 0.0, p, 0.0, 0.0, h))
    return estimate._replace(covariance=grown)


def inflate_to(estimate: Estimate, sigma_m: float, settings: LocalizerSettings) -> Estimate:
    """For a robot whose teammates contradict each other: its position is no more certain than this
    along any axis. What is added is shared, for it is an error of teammates."""
    c, most_m = estimate.covariance, settings.lost_position_sigma_m
    more = min(sigma_m, most_m) ** 2 - min(c.xx, c.yy)
    if more <= 0.0:
        return estimate
    added = Covariance3(more, 0.0, more, 0.0, 0.0, 0.0)
    return estimate._replace(covariance=c.plus(added), shared=estimate.shared.plus(added))
