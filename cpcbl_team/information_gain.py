"""The information gain of help: by how much a message would shrink the receiver's covariance.

Gains are in nats: the logarithm of the factor by which the 1 sigma ellipse of the position shrinks
(half the logarithm of the ratio of determinants, the mutual information of Gaussians), and of the
factor by which the sigma of the heading shrinks. A sender does not know the receiver's covariance.
It predicts it from the tier that the receiver announces and from the last fix that it sent.

A gain says whether a message is worth its bytes now. Messages that compete for one budget are
ordered by their effective age, which also takes into account how long the removed error (m) stays
away, and how fast the variances of the other teammates grow.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

from cpcbl_team.config import CollaborationSettings, Fusion
from cpcbl_team.estimate import SMALLEST_VARIANCE, Covariance3, Estimate
from cpcbl_team.fusion import best_weight
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.inputs import Belief, Fix
from cpcbl_team.measurements import extrapolated, nearest_belief, position_by_belief
from cpcbl_team.tiers import LOWEST_TIER, TIER_ZERO_SIGMA_M

LOST_SIGMA_M = 2.0
DRIFT_SHARE = 0.1  # position sigma that a teammate gains between two fixes, per metre driven
LOST_HEADING_SIGMA_RAD = math.pi / math.sqrt(3.0)  # of a uniform distribution
USUAL_HEADING_SIGMA_RAD = math.radians(10.0)  # assumed: a tier describes the position only
HEADING_DRIFT_RAD_PER_SQRT_M = 0.1  # heading sigma that a teammate gains, a random walk
HEADING_WAY_M = 1.0  # over which a heading's error is counted as one of the position
MISLEADING_SIGMAS = 3.0  # by which a belief of before is wrong
UNKNOWN_AGE_S = 60.0  # since the last help for a teammate, as long as there was none


class HeadingMemory(NamedTuple):
    """Where a teammate was at the last heading that it was sent, and its variance (rad^2) then."""

    x_m: float
    y_m: float
    variance: float


class FixMemory(NamedTuple):
    """Where a teammate was at the last fix that it was sent, and its covariance (m^2) then."""

    x_m: float
    y_m: float
    covariance: Covariance2
    heading: HeadingMemory | None = None


def sigma_limits_m(tier: int, settings: CollaborationSettings) -> tuple[float, float]:
    """The least and the greatest position sigma that a robot of this tier can have."""
    width, slack = settings.tier_width, settings.tier_hysteresis
    least = TIER_ZERO_SIGMA_M * width ** (tier - 1) / slack
    if tier == LOWEST_TIER:
        return least, max(LOST_SIGMA_M, least)
    return (0.0 if tier <= settings.best_tier else least), TIER_ZERO_SIGMA_M * width**tier * slack


def predicted_teammate_covariance(
    tier: int, last_fix: FixMemory | None, x_m: float, y_m: float, settings: CollaborationSettings
) -> Covariance2:
    """The predicted position covariance (m^2) of a teammate at (x, y). It is that after the last
    fix plus the drift since then, within the limits of its tier."""
    least, most = sigma_limits_m(tier, settings)
    if last_fix is None:
        variance = (most if tier == LOWEST_TIER else math.sqrt(max(least, 0.5 * most) * most)) ** 2
        return Covariance2(variance, 0.0, variance)
    distance = math.hypot(x_m - last_fix.x_m, y_m - last_fix.y_m)
    drift = (DRIFT_SHARE * distance) ** 2
    xx, xy, yy = last_fix.covariance
    grown = _regularized(Covariance2(xx + drift, xy, yy + drift))
    sigma = math.sqrt(0.5 * (grown.xx + grown.yy))
    return grown.scaled((min(max(sigma, least), most) / sigma) ** 2)


def predicted_teammate_heading_variance(
    tier: int, last_heading: HeadingMemory | None, fix: Fix
) -> float:
    """The predicted heading variance (rad^2) of a teammate that `fix` observes.

    It is that after the last heading that it was sent plus the drift since then, at most the usual
    one. The heading of a lost teammate is unknown. Sensor noise lets a robot that stands seem to
    move, so two sigmas of it are subtracted from the distance.
    """
    if tier == LOWEST_TIER:
        return LOST_HEADING_SIGMA_RAD**2
    usual = USUAL_HEADING_SIGMA_RAD**2
    if last_heading is None:
        return usual
    xx, _, yy = fix.sensor_covariance
    distance = math.hypot(fix.x_m - last_heading.x_m, fix.y_m - last_heading.y_m)
    distance = max(0.0, distance - 2.0 * math.sqrt(xx + yy))
    return min(last_heading.variance + HEADING_DRIFT_RAD_PER_SQRT_M**2 * distance, usual)


def merged_heading_variance(prior: float, fix: Fix, fusion: Fusion) -> float:
    """The heading variance (rad^2) of a teammate after it merged `fix`; see `merged_covariance`."""
    prior, fresh = prior + SMALLEST_VARIANCE, fix.heading_sensor_variance + SMALLEST_VARIANCE
    dependent = fix.heading_observer_variance
    if fusion == "naive":
        return 1.0 / (1.0 / prior + 1.0 / (fresh + dependent))

    def after(weight: float) -> float:
        return 1.0 / (weight / prior + 1.0 / (fresh + dependent / (1.0 - weight)))

    return min(prior, best_weight(after)[1])


def heading_information_gain(prior: float, after: float) -> float:
    """The information gain (nats) from one variance of the heading (rad^2) to another."""
    return 0.5 * math.log((prior + SMALLEST_VARIANCE) / max(after, SMALLEST_VARIANCE))


def merged_covariance(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2, fusion: Fusion
) -> Covariance2:
    """The covariance of a teammate after it merged a fix with these two parts of its covariance.

    Split covariance intersection treats all of the prior as dependent, so the second fix of the
    same observer gains little.
    """
    prior, fresh = _regularized(prior), _regularized(fresh)
    if fusion == "naive":
        return _fused(prior, fresh + dependent)
    weight, _ = best_weight(lambda w: _determinant(prior, fresh, dependent, w))
    after = _fused(prior.scaled(1.0 / weight), fresh + dependent.scaled(1.0 / (1.0 - weight)))
    return after if after.determinant() < prior.determinant() else prior


def _determinant(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2, weight: float
) -> float:
    """|A| |B| / |A + B|, as of (A^-1 + B^-1)^-1; A = prior / w, B = fresh + dependent / (1 - w)."""
    k, m = 1.0 / weight, 1.0 / (1.0 - weight)
    (pxx, pxy, pyy), (fxx, fxy, fyy), (dxx, dxy, dyy) = prior, fresh, dependent
    axx, axy, ayy = k * pxx, k * pxy, k * pyy
    bxx, bxy, byy = fxx + m * dxx, fxy + m * dxy, fyy + m * dyy
    both = (axx + bxx) * (ayy + byy) - (axy + bxy) ** 2
    return (axx * ayy - axy * axy) * (bxx * byy - bxy * bxy) / both


def information_gain(prior: Covariance2, after: Covariance2) -> float:
    """The information gain (nats) from `prior` to `after`. Nothing is gained below
    `SMALLEST_VARIANCE`."""
    left = max(after.determinant(), SMALLEST_VARIANCE**2)
    return 0.5 * math.log(_regularized(prior).determinant() / left)


def removed_variance(prior: Covariance2, after: Covariance2, heading_variance: float) -> float:
    """The variance (m^2) that a fix removes when it changes a teammate's covariance from `prior` to
    `after`, and also removes this variance of its heading (rad^2)."""
    removed = prior.xx + prior.yy - after.xx - after.yy + HEADING_WAY_M**2 * heading_variance
    return max(0.0, removed)


class Need(NamedTuple):
    """By how much a teammate's variance (m^2) grew in the time since this robot last helped it."""

    grown: float
    age_s: float
    stamp_ns: int
    """When the teammate was seen so."""


def need_of(prior: Covariance2, last_fix: FixMemory | None, age_s: float, stamp_ns: int) -> Need:
    """The need of a teammate that has this covariance now."""
    left = 0.0 if last_fix is None else last_fix.covariance.xx + last_fix.covariance.yy
    return Need(max(0.0, prior.xx + prior.yy - left), age_s, stamp_ns)


def effective_age_s(removed: float, age_s: float, needs: Collection[Need]) -> float:
    """The age (s) of the last help at which a usual message would remove as much error over time as
    one that removes this variance (m^2) now does.

    Let a variance grow by q in a second, and a message cost c. A message each T seconds then costs
    q T / 2 + c / T, which is least where c = q T^2 / 2. So a message is due when the variance that
    it removes, times its age, has reached 2 c (the index of Whittle). The price c is the same for
    all messages. It is given by the interval T of a usual message, which removes the mean growth q
    of all `needs`; any other message is due when removed * age = q T^2. The root of removed * age /
    q is therefore called the effective age: that of a usual message is its age. With a fixed
    interval all messages are usual.
    """
    grown, ages = sum(n.grown for n in needs), sum(n.age_s for n in needs)
    return math.sqrt(removed * age_s * ages / grown) if grown > 0.0 else age_s


def _regularized(c: Covariance2) -> Covariance2:
    """The covariance with the smallest variance added, so that it has an inverse."""
    return Covariance2(c.xx + SMALLEST_VARIANCE, c.xy, c.yy + SMALLEST_VARIANCE)


def _fused(a: Covariance2, b: Covariance2) -> Covariance2:
    """(A^-1 + B^-1)^-1."""
    return (a.inverse() + b.inverse()).inverse()


def information_gain_of_belief(
    fix: Fix, tier: int, estimate: Estimate, settings: CollaborationSettings
) -> float:
    """The information gain (nats) of a teammate's belief for the robot that sees the teammate.

    `fix` is where the robot sees the teammate, and `tier` is the teammate's. Together with its
    belief the sighting constrains the position and, by its bearing, the heading. The larger of the
    two gains counts.
    """
    prior, sensor = estimate.covariance.position(), Covariance2(*fix.sensor_covariance)
    teammate = _teammate_covariance(tier, settings)
    position = information_gain(prior, merged_covariance(prior, sensor, teammate, settings.fusion))
    return max(position, heading_information_gain_of_belief(fix, tier, estimate, settings))


def heading_information_gain_of_belief(
    fix: Fix, tier: int, estimate: Estimate, settings: CollaborationSettings
) -> float:
    """The same for the heading alone, by the bearing: none if both are at the same point."""
    prior, sensor = estimate.covariance.position(), Covariance2(*fix.sensor_covariance)
    teammate = _teammate_covariance(tier, settings)
    dx, dy = fix.x_m - estimate.pose.x, fix.y_m - estimate.pose.y
    direction = math.atan2(dy, dx)
    across = -math.sin(direction), math.cos(direction)
    variance = _regularized(sensor + teammate + prior).along(*across)
    return 0.5 * math.log1p(estimate.covariance.hh * (dx * dx + dy * dy) / variance)


def _teammate_covariance(tier: int, settings: CollaborationSettings) -> Covariance2:
    """The position covariance (m^2) that a robot assumes of a teammate of this tier."""
    sigma = sum(sigma_limits_m(tier, settings)) / 2.0
    return Covariance2(sigma * sigma, 0.0, sigma * sigma)


def staleness(copy: Belief | None, now: Belief) -> float:
    """The error, in sigmas, of receivers that extrapolate their `copy` to the time of `now`.

    It is the error of the position, or twice the logarithm of the ratio of the sigmas if that is
    larger. It is infinite without a copy.
    """
    if copy is None:
        return math.inf
    pose = extrapolated(copy, now.stamp_ns)
    before, after = (
        _regularized(Covariance3(*belief.covariance).position()) for belief in (copy, now)
    )
    off = math.sqrt(after.mahalanobis_squared(now.x_m - pose.x, now.y_m - pose.y))
    ratio = 0.5 * math.log(after.determinant() / before.determinant())
    return max(off, abs(ratio))


def misleads(copy: Belief, now: Belief, settings: CollaborationSettings) -> bool:
    """Whether receivers still use their `copy` at the time of `now`, and are wrong: a robot that
    stood has driven off, or one that drove has turned, by more than they allow for."""
    if nearest_belief((copy,), now.stamp_ns, settings) is None:
        return False
    x, y, covariance = position_by_belief(copy, now.stamp_ns)
    off_squared = _regularized(covariance).mahalanobis_squared(now.x_m - x, now.y_m - y)
    return off_squared > MISLEADING_SIGMAS * MISLEADING_SIGMAS
