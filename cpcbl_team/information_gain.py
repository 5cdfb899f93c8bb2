"""What help is worth before it is sent: how much it would shrink a teammate's covariance.

The helper knows of its teammate no more than the tier that it announces, and what it has told it
before. Worth is in nats: the logarithm of the factor by which the ellipse of the position shrinks,
half that of the determinants (as in the mutual information of Gaussians), and of that by which the
sigma of the heading does, where that is told too.
"""

import math
from typing import NamedTuple

from cpcbl_team.collaboration import LOWEST_TIER, TIER_ZERO_SIGMA_M, carried
from cpcbl_team.config import CollaborationSettings, Fusion
from cpcbl_team.estimate import SMALLEST_VARIANCE, Covariance3, Estimate
from cpcbl_team.fusion import best_weight
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.inputs import Belief, Fix

LOST_SIGMA_M = 2.0
DRIFT_SHARE = 0.1  # of its way: what a teammate's position loses between two fixes


LOST_HEADING_SIGMA_RAD = math.pi / math.sqrt(3.0)  # any is as likely
USUAL_HEADING_SIGMA_RAD = math.radians(10.0)  # no tier tells of it
HEADING_DRIFT_RAD_PER_SQRT_M = 0.1  # what a teammate's heading loses on its way, as a random walk


class Turned(NamedTuple):
    """A teammate after the last heading that it was sent: where that was, how well it knew it."""

    x_m: float
    y_m: float
    variance: float


class Helped(NamedTuple):
    """A teammate after the last fix that it was sent: where it was seen, how well it knew that."""

    x_m: float
    y_m: float
    covariance: Covariance2
    turned: Turned | None = None


def sigma_range_m(tier: int, settings: CollaborationSettings) -> tuple[float, float]:
    """The least and the greatest position sigma that a robot of this tier may have."""
    width, slack = settings.tier_width, settings.tier_hysteresis
    least = TIER_ZERO_SIGMA_M * width ** (tier - 1) / slack
    if tier == LOWEST_TIER:
        return least, max(LOST_SIGMA_M, least)
    return (0.0 if tier <= settings.best_tier else least), TIER_ZERO_SIGMA_M * width**tier * slack


def expected(
    tier: int, helped: Helped | None, x_m: float, y_m: float, settings: CollaborationSettings
) -> Covariance2:
    """What the position covariance of a teammate at (x, y) is likely to be.

    Its tier bounds it; within these bounds it is what the last fix left and its way has added.
    """
    least, most = sigma_range_m(tier, settings)
    if helped is None:
        variance = (most if tier == LOWEST_TIER else math.sqrt(max(least, 0.5 * most) * most)) ** 2
        return Covariance2(variance, 0.0, variance)
    way = math.hypot(x_m - helped.x_m, y_m - helped.y_m)
    doubt = (DRIFT_SHARE * way) ** 2
    xx, xy, yy = helped.covariance
    grown = _not_exact(Covariance2(xx + doubt, xy, yy + doubt))
    sigma = math.sqrt(0.5 * (grown.xx + grown.yy))
    return grown.scaled((min(max(sigma, least), most) / sigma) ** 2)


def expected_heading(tier: int, turned: Turned | None, fix: Fix) -> float:
    """What the heading's variance (rad^2) of a teammate that is seen there is likely to be.

    A lost one's is unknown. Another's is what is usual, or what the last heading that it was told
    left and its way has added: so its heading is told while that is news. A robot that stands seems
    to move by the sensor's noise; that is no way.
    """
    if tier == LOWEST_TIER:
        return LOST_HEADING_SIGMA_RAD**2
    usual = USUAL_HEADING_SIGMA_RAD**2
    if turned is None:
        return usual
    xx, _, yy = fix.sensor_covariance
    way = math.hypot(fix.x_m - turned.x_m, fix.y_m - turned.y_m)
    way = max(0.0, way - 2.0 * math.sqrt(xx + yy))
    return min(turned.variance + HEADING_DRIFT_RAD_PER_SQRT_M**2 * way, usual)


def merged_heading(prior: float, fix: Fix, fusion: Fusion) -> float:
    """The heading's variance after that of a fix, as the teammate merges it; see `merged`."""
    prior += SMALLEST_VARIANCE
    fresh, dependent = fix.heading_sensor_variance, fix.heading_observer_variance
    fresh += SMALLEST_VARIANCE
    if fusion == "naive":
        return 1.0 / (1.0 / prior + 1.0 / (fresh + dependent))

    def after(weight: float) -> float:
        return 1.0 / (weight / prior + 1.0 / (fresh + dependent / (1.0 - weight)))

    return min(prior, best_weight(after)[1])


def heading_worth(prior: float, after: float) -> float:
    """Nats gained from one variance of the heading to another."""
    return 0.5 * math.log((prior + SMALLEST_VARIANCE) / max(after, SMALLEST_VARIANCE))


def merged(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2, fusion: Fusion
) -> Covariance2:
    """The covariance after evidence with a fresh and a dependent part, as the teammate merges it.

    By split covariance intersection all of the prior is taken as dependent: what was told once is
    worth little the second time.
    """
    prior, fresh = _not_exact(prior), _not_exact(fresh)
    if fusion == "naive":
        return _product(prior, fresh + dependent)
    weight, _ = best_weight(lambda w: _determinant(prior, fresh, dependent, w))
    after = _product(prior.scaled(1.0 / weight), fresh + dependent.scaled(1.0 / (1.0 - weight)))
    return after if after.determinant() < prior.determinant() else prior


def _determinant(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2, weight: float
) -> float:
    """|A| |B| / |A + B|, as of (A^-1 + B^-1)^-1; A = prior / w, B = fresh + dependent / (1 - w)."""
    k, m = 1.0 / weight, 1.0 / (1.0 - weight)
    axx, axy, ayy = k * prior.xx, k * prior.xy, k * prior.yy
    bxx, bxy = fresh.xx + m * dependent.xx, fresh.xy + m * dependent.xy
    byy = fresh.yy + m * dependent.yy
    both = (axx + bxx) * (ayy + byy) - (axy + bxy) ** 2
    return (axx * ayy - axy * axy) * (bxx * byy - bxy * bxy) / both


def worth(prior: Covariance2, after: Covariance2) -> float:
    """Nats gained from `prior` to `after`; beyond what is called exact nothing is gained."""
    left = max(after.determinant(), SMALLEST_VARIANCE**2)
    return 0.5 * math.log(_not_exact(prior).determinant() / left)


def _not_exact(c: Covariance2) -> Covariance2:
    """What is called exact has a variance too: an inverse."""
    return Covariance2(c.xx + SMALLEST_VARIANCE, c.xy, c.yy + SMALLEST_VARIANCE)


def _product(a: Covariance2, b: Covariance2) -> Covariance2:
    """(A^-1 + B^-1)^-1."""
    return (a.inverse() + b.inverse()).inverse()


def use_of(fix: Fix, tier: int, estimate: Estimate, settings: CollaborationSettings) -> float:
    """What the belief of a teammate of this tier is worth to the robot that sees it (nats).

    `fix` is where the robot sees the teammate. The sighting tells of the position and, by its
    bearing, of the heading (of a teammate at the same place it tells nothing); what both tell is
    counted for the one that gains more.
    """
    prior = estimate.covariance.position()
    sensor, sigma = Covariance2(*fix.sensor_covariance), sum(sigma_range_m(tier, settings)) / 2.0
    theirs = Covariance2(sigma * sigma, 0.0, sigma * sigma)
    position = worth(prior, merged(prior, sensor, theirs, settings.fusion))
    dx, dy = fix.x_m - estimate.pose.x, fix.y_m - estimate.pose.y
    direction = math.atan2(dy, dx)
    across = _not_exact(sensor + theirs + prior).along(-math.sin(direction), math.cos(direction))
    heading = 0.5 * math.log1p(estimate.covariance.hh * (dx * dx + dy * dy) / across)
    return max(position, heading)


def staleness(copy: Belief | None, now: Belief) -> float:
    """By how many sigma listeners err who carry `copy` along to the time of `now`: of the position,
    or twice the logarithm of the ratio of the sigmas. Infinite without a copy."""
    if copy is None:
        return math.inf
    pose = carried(copy, now.stamp_ns)
    before, after = (
        Covariance3(*copy.covariance).position(),
        Covariance3(*now.covariance).position(),
    )
    before, after = _not_exact(before), _not_exact(after)
    off = math.sqrt(after.mahalanobis_squared(now.x_m - pose.x, now.y_m - pose.y))
    ratio = 0.5 * math.log(after.determinant() / before.determinant())
    return max(off, abs(ratio))
