"""All that a localizer knows at one time. Immutable: a copy is a checkpoint."""

from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Belief, Odometry
from cpcbl_team.self_calibration import Anchors, Learned

_NONE: Mapping[str, Any] = MappingProxyType({})


def added(counts: Mapping[str, int], **more: int) -> Mapping[str, int]:
    """The counts with these more of each reason."""
    total = {reason: counts.get(reason, 0) + n for reason, n in more.items() if n}
    return {**counts, **total}


class Evidence(NamedTuple):
    """One thing seen (or told) lately, kept for finding the robot again when it is lost."""

    stamp_ns: int
    odometry_from_robot: Pose2  # dead reckoning at that time
    source: str
    x: float  # of the object in the field; of the robot itself, for a fix
    y: float
    range_m: float | None
    bearing_rad: float | None
    range_sigma_m: float
    bearing_sigma_rad: float
    place_sigma_m: float  # of (x, y); zero for what is on the map
    told: bool  # by a teammate


class Memory(NamedTuple):
    """What only changes when something is seen or told."""

    position_ns: int | None = None  # last update of the type
    heading_ns: int | None = None
    heading_is_latest: bool = False
    objects_ns: Mapping[str, int] = _NONE  # last use of each object
    teammates: Mapping[str, Belief] = _NONE
    innovations: tuple[bool, ...] = ()  # accepted or not, the latest last
    evidence: tuple[Evidence, ...] = ()
    lost: str = ""  # the reason, empty when the robot knows where it is
    widened_ns: int = 0
    sought_ns: int = -1  # the newest evidence with which it sought itself in vain
    counts: Mapping[str, int] = _NONE
    learned: Learned = Learned()
    anchors: Anchors | None = None

    def counted(self, *reasons: str) -> "Memory":
        if not reasons:
            return self
        return self._replace(counts=added(self.counts, **Counter(reasons)))


class State(NamedTuple):
    """The localizer's state at `stamp_ns`."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2 = Pose2(0.0, 0.0, 0.0)
    motion: Odometry | None = None  # the piece of odometry that is being driven
    odometry_ns: int = 0  # until when odometry is known
    memory: Memory = Memory()
