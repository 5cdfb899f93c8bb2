"""Robots that help each other: active fixes, passive landmarks, and tiers of quality.

Active: "I see you there": position only, as in the paper, and the heading too where it was seen
(by a teammate's marker; beyond the paper).
Passive: a teammate whose belief I was told is one more landmark, with its own uncertainty.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_team.config import CollaborationSettings, SensorSettings
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.gaussian import Covariance2, sighting_gaussian
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Belief, Fix, Sighting
from cpcbl_team.sensors import sighting_fault, sighting_sigmas

TIER_ZERO_SIGMA_M = 0.01
LOWEST_TIER = 15  # also that of a robot that is lost
BELIEF_SERVES_BACK_NS = 500_000_000
"""A belief also says where its robot was so long before: who sees a teammate asks for its belief,
and what was seen meanwhile shall not be lost."""
_SERVES_BACK_S = BELIEF_SERVES_BACK_NS * 1e-9


class Place(NamedTuple):
    """Where an object is in the field, and how well that is known."""

    x: float
    y: float
    covariance: Covariance2


def fix_for(
    robot: str,
    observer: str,
    stamp_ns: int,
    estimate: Estimate,
    sighting: Sighting,
    sensor: SensorSettings,
) -> Fix | None:
    """The active observation of `robot` by `observer`, or None without a good range and bearing.

    The sighting as a Gaussian (equations 1-2) is rotated into the field's frame and compounded
    with the observer's pose covariance before it is sent: J C J^T, J the Jacobian of compounding.
    A heading that was seen is the observer's plus the one in its frame, as are their variances.
    """
    range_m, bearing = sighting.range_m, sighting.bearing_rad
    if range_m is None or bearing is None or sighting_fault(sighting):
        return None
    if range_m > sensor.max_range_for_range_m:
        return None
    pose, covariance = estimate.pose, estimate.covariance
    seen = sighting_gaussian(range_m, bearing, *sighting_sigmas(sighting, sensor))
    x, y = pose.transform(seen.x, seen.y)
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    own = seen.covariance
    rotated = Covariance2(
        c * c * own.xx - 2.0 * c * s * own.xy + s * s * own.yy,
        c * s * (own.xx - own.yy) + (c * c - s * s) * own.xy,
        s * s * own.xx + 2.0 * c * s * own.xy + c * c * own.yy,
    )
    lever = (1.0, 0.0, pose.y - y, 0.0, 1.0, x - pose.x, 0.0, 0.0, 0.0)
    observer_part = covariance.transformed(lever).position()
    fix = Fix(robot, observer, stamp_ns, x, y, rotated, observer_part)
    heading, heading_sigma = sighting.heading_rad, sighting.heading_sigma_rad
    if heading is None or heading_sigma is None:
        return fix
    return replace(
        fix,
        heading_rad=wrap_angle(pose.heading + heading),
        heading_sensor_variance=heading_sigma * heading_sigma,
        heading_observer_variance=covariance.hh,
    )


def without_heading(fix: Fix) -> Fix:
    """The fix as of a robot whose heading was not seen."""
    return replace(
        fix, heading_rad=None, heading_sensor_variance=0.0, heading_observer_variance=0.0
    )


def carried(belief: Belief, at_ns: int) -> Pose2:
    """Where a belief has its robot at another time: along its speed and turn rate."""
    age = (at_ns - belief.stamp_ns) * 1e-9
    pose = Pose2(belief.x_m, belief.y_m, belief.heading_rad)
    return step(pose, belief.speed_m_s * age, belief.turn_rate_rad_s * age)


def placed(beliefs: Iterable[Belief], at_ns: int, settings: CollaborationSettings) -> Place | None:
    """A teammate as a landmark at the time of a sighting, by what it said at the nearest time.

    It is carried along its speed and turn rate; a third of that way is added to its sigma, for it
    may have stopped or turned. None when all that it said is too old, or of too long after.
    """
    ages = (((at_ns - b.stamp_ns) * 1e-9, b) for b in beliefs)
    usable = [(a, b) for a, b in ages if -_SERVES_BACK_S <= a <= settings.max_age_s]
    if not usable:
        return None
    age, belief = min(usable, key=lambda told: abs(told[0]))
    pose = carried(belief, at_ns)
    covariance = Covariance3(*belief.covariance)
    lever = (1.0, 0.0, belief.y_m - pose.y, 0.0, 1.0, pose.x - belief.x_m, 0.0, 0.0, 1.0)
    xx, xy, yy, *_ = covariance.transformed(lever)
    doubt = (belief.speed_m_s * age / 3.0) ** 2
    return Place(pose.x, pose.y, Covariance2(xx + doubt, xy, yy + doubt))


def tier_of(sigma_m: float, width: float) -> int:
    """The tier of a position sigma: 0 up to 1 cm, then one more for every factor of `width`."""
    if sigma_m <= TIER_ZERO_SIGMA_M:
        return 0
    tier = math.ceil(math.log(sigma_m / TIER_ZERO_SIGMA_M) / math.log(width) - 1e-9)
    return min(tier, LOWEST_TIER)


def next_tier(
    present: int | None, sigma_m: float, lost: bool, settings: CollaborationSettings
) -> int:
    """The tier to announce: kept while sigma stays near it, the lowest at once when lost, never
    better than the configured best."""
    if lost:
        return LOWEST_TIER
    if present is None or present == LOWEST_TIER:
        return max(settings.best_tier, tier_of(sigma_m, settings.tier_width))
    best = tier_of(sigma_m / settings.tier_hysteresis, settings.tier_width)
    worst = tier_of(sigma_m * settings.tier_hysteresis, settings.tier_width)
    return max(settings.best_tier, min(max(present, best), worst))


def hears(own: int, other: int, settings: CollaborationSettings) -> bool:
    """Whether a robot of tier `own` listens to one of tier `other`."""
    return other < own or settings.direction == "both-ways"


def tiers_heard(own: int, settings: CollaborationSettings) -> range:
    """The tiers that a robot listens to: all better than its own, or all there are."""
    return range(LOWEST_TIER + 1 if settings.direction == "both-ways" else own)
