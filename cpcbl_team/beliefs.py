"""Passive collaboration: a teammate whose belief was received is one more landmark.

Its position has the uncertainty of its belief, extrapolated to the time of the sighting.
"""

from collections.abc import Iterable
from typing import NamedTuple

from cpcbl_team.config import CollaborationSettings
from cpcbl_team.estimate import Covariance3
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Belief

BELIEF_VALID_BEFORE_NS = 500_000_000
"""A belief is also used for sightings of up to this time before it: a robot subscribes to a
teammate's beliefs when it sees it, and what it saw before the first one came must not be lost."""


class ObjectPosition(NamedTuple):
    """The position of an object in the field's frame (m), and its covariance (m^2)."""

    x: float
    y: float
    covariance: Covariance2


def extrapolated(belief: Belief, at_ns: int) -> Pose2:
    """The pose of a belief's robot at another time, by its speed and turn rate."""
    age = (at_ns - belief.stamp_ns) * 1e-9
    pose = Pose2(belief.x_m, belief.y_m, belief.heading_rad)
    return step(pose, belief.speed_m_s * age, belief.turn_rate_rad_s * age)


def nearest_belief(
    beliefs: Iterable[Belief], at_ns: int, settings: CollaborationSettings
) -> tuple[float, Belief] | None:
    """The belief nearest to a time, and its age then (s); None if all are too old, or too late."""
    before_s = BELIEF_VALID_BEFORE_NS * 1e-9
    ages = (((at_ns - b.stamp_ns) * 1e-9, b) for b in beliefs)
    usable = [(age, b) for age, b in ages if -before_s <= age <= settings.max_age_s]
    return min(usable, key=lambda pair: abs(pair[0])) if usable else None


def teammate_at(
    beliefs: Iterable[Belief], at_ns: int, settings: CollaborationSettings
) -> ObjectPosition | None:
    """The position of a teammate at the time of a sighting, from its belief nearest to that time.

    A third of the extrapolated distance is added to its sigma, because it may have stopped or
    turned. None if all of its beliefs are too old, or too late.
    """
    nearest = nearest_belief(beliefs, at_ns, settings)
    if nearest is None:
        return None
    age, belief = nearest
    pose = extrapolated(belief, at_ns)
    covariance = Covariance3(*belief.covariance)
    jacobian = (1.0, 0.0, belief.y_m - pose.y, 0.0, 1.0, pose.x - belief.x_m, 0.0, 0.0, 1.0)
    xx, xy, yy, *_ = covariance.transformed(jacobian)
    growth = (belief.speed_m_s * age / 3.0) ** 2
    return ObjectPosition(pose.x, pose.y, Covariance2(xx + growth, xy, yy + growth))
