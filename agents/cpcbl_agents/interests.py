"""What a robot announces on the bus, and what it subscribes to."""

from typing import NamedTuple

from cpcbl_team.frames import FIELD


class Interests(NamedTuple):
    """What a robot announces and subscribes to."""

    tier: int
    neighbours: frozenset[str]
    """Teammates seen not long ago, and possible guests: the robot watches their tiers."""
    sources: frozenset[tuple[str, int]]
    """Teammates, with their tiers, whose beliefs are useful to this robot."""
    landmarks: frozenset[tuple[str, int]] = frozenset()
    """Landmarks, with the tiers in which their places are useful to this robot."""
    frame: str = FIELD
    """The frame of all these tiers."""
    keys: frozenset[str] = frozenset()
    """Of help in better frames."""
