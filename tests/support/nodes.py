"""Two robots on a bus: `me`, which is worse localized, and its teammate `mate`."""

import math
from typing import Any

from cpcbl_team.config import Team
from cpcbl_team.estimate import Estimate
from cpcbl_team.inputs import Sighting
from cpcbl_team.tiers import tier_of
from cpcbl_transport import topics
from support.buses import (
    SECOND,
    TeamOnBus,
    robot_at,
    saw,
    team_of,
)

GOOD, POOR = 0.02, 0.3
NOW = 3 * SECOND
BELIEF_KEY = topics.BELIEF.at(tier=2, robot="mate")


def two_robots(me_sigma_m: float = POOR, mate_sigma_m: float = GOOD, **rules: Any) -> Team:
    """`me`, by default the worse one, sees `mate` two metres ahead."""
    return team_of(
        me=robot_at(sigma_m=me_sigma_m, **rules),
        mate=robot_at(2.0, 0.0, 180.0, sigma_m=mate_sigma_m, **rules),
    )


def only_me() -> TeamOnBus:
    """The robot `me` at NOW, which listens to its mate since it saw it; the test plays the mate."""
    stand = TeamOnBus(two_robots(), here=["me"])
    stand.announce("mate", 2)
    stand.stand_still(NOW / SECOND - 0.2)
    look(stand)
    stand.stand_still(0.2)
    return stand


def look(stand: TeamOnBus, *robots: str) -> None:
    """These robots, or all that are there, see each other."""
    for name, seen in (("me", "mate"), ("mate", "me")):
        if name in (robots or stand.robots):
            stand.sightings(name, saw(stand.now_ns, Sighting(seen, 2.0, 0.0)))
    stand.step()


def estimate(stand: TeamOnBus, robot: str = "me") -> Estimate:
    return stand.robots[robot].filter.timeline.state.estimate


def tier(stand: TeamOnBus, robot: str) -> int:
    return stand.robots[robot].collaboration.tier


def exchange(stand: TeamOnBus, seconds: float = 2.0) -> None:
    """Both robots stand and see each other at 5 Hz."""
    for _ in range(round(5 * seconds)):
        stand.stand_still(0.2)
        look(stand)


def helper(**rules: Any) -> TeamOnBus:
    """The robot `me`, which is good; the test plays its mate, which is poor."""
    stand = TeamOnBus(two_robots(GOOD, POOR, **rules), here=["me"])
    stand.announce("mate", tier_of(POOR, math.sqrt(2.0)))
    return stand
