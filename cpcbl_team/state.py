"""All that a localizer knows at one time. Immutable: a copy is a checkpoint."""

from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Belief, Odometry, Sighting
from cpcbl_team.self_calibration import Anchors, Learned
from cpcbl_team.trust import Voice

FIX = "fix:"  # marks the source of an active fix, apart from seeing that teammate
_NONE: Mapping[str, Any] = MappingProxyType({})


class Evidence(NamedTuple):
    """One thing seen (or told) lately, kept for finding the robot again when it is lost."""

    stamp_ns: int
    odometry_from_robot: Pose2  # dead reckoning at that time
    source: str
    x: float  # of the object in the field; of the robot itself, for a fix
    y: float
    range_m: float | None
    bearing_rad: float | None
    range_sigma_m: float  # for a fix: of (x, y), as far as it is the sensor's
    bearing_sigma_rad: float  # for a fix: of the heading, as far as it is the sensor's
    place_sigma_m: float  # of (x, y), as far as it is a teammate's; zero for what is on the map
    told: bool  # by a teammate
    heading_rad: float | None = None  # of the robot itself, if a fix told it;
    place_sigma_rad: float = 0.0  # its sigma, as far as it is a teammate's


class Glance(NamedTuple):
    """Landmarks seen at one time, of which evidence is made when the robot is lost."""

    stamp_ns: int
    odometry_from_robot: Pose2  # dead reckoning at that time
    pose: Pose2  # as it was believed: ranges err by what they should have been
    sightings: tuple[Sighting, ...]


class Updates(NamedTuple):
    """What every update changes: its timers, window and counts."""

    position_ns: int | None = None  # last update of the type
    heading_ns: int | None = None
    heading_is_latest: bool = False
    objects_ns: Mapping[str, int] = _NONE  # last use of each object
    agreed_ns: int = 0  # last one that was accepted whole
    innovations: int = 1  # accepted or not; see `recovery.innovated`
    accepted: int = 0  # observations since the start
    gated: int = 0


class Memory(msgspec.Struct, frozen=True, gc=False):
    """What few cycles change."""

    teammates: Mapping[str, tuple[Belief, ...]] = _NONE
    glances: tuple[Glance, ...] = ()
    evidence: tuple[Evidence, ...] = ()  # of all else
    noted: frozenset[str] = frozenset()  # the sources of which no more is needed yet,
    noted_until_ns: int = 0  # until then
    lost: str = ""  # the reason, empty when the robot knows where it is
    widened_ns: int = 0
    sought_ns: int = -1  # the newest evidence with which it sought itself in vain
    events: Mapping[str, int] = _NONE  # number of each other thing that is counted
    learned: Learned = Learned()
    anchors: Anchors | None = None
    voices: Mapping[str, Voice] = _NONE  # how teammates, and the robot's own eyes, stand
    turned_rad: float = 0.0  # by the wheels since the start, of a robot that learns
    told_ns: int = -(2**61)  # when a teammate last said anything

    def counted(self, *events: str) -> "Memory":
        return replace(self, events=Counter(self.events) + Counter(events)) if events else self


class State(NamedTuple):
    """The localizer's state at `stamp_ns`."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2 = Pose2(0.0, 0.0, 0.0)
    motion: Odometry | None = None  # the piece of odometry that is being driven
    odometry_ns: int = 0  # until when odometry is known
    memory: Memory = Memory()
    updates: Updates = Updates()

    @property
    def counts(self) -> Mapping[str, int]:
        """How often each thing has happened that has happened at all."""
        counts = {"accepted": self.updates.accepted, "gated": self.updates.gated}
        return {name: n for name, n in {**counts, **self.memory.events}.items() if n}
