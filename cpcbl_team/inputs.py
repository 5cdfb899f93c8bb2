"""The inputs of a robot's filter: odometry, sightings, positions, and the help of teammates.

All are immutable. Their `stamp_ns` is the time at which something was *measured*. They are also the
messages on the wire, so neither tags nor the order of fields may change. Metres and radians.
"""

from enum import StrEnum
from typing import Annotated

import msgspec

NAME_PATTERN = r"^[A-Za-z0-9_.-]{1,32}$"
Name = Annotated[str, msgspec.Meta(pattern=NAME_PATTERN)]


class Odometry(msgspec.Struct, frozen=True, array_like=True, tag="odometry"):
    """Differential odometry: the motion from `from_ns` to `stamp_ns`."""

    from_ns: int
    stamp_ns: int
    distance_m: float
    turn_rad: float


class Sighting(msgspec.Struct, frozen=True, array_like=True):
    """What the robot senses of one object, in the robot's frame.

    The range to a wall is the perpendicular distance, and its bearing is the direction of that
    perpendicular. The sensor model replaces a sigma that is None. `heading_rad` is the heading of a
    teammate in the robot's frame, if its marker shows it; it needs a sigma.
    """

    id: Name
    range_m: float | None = None
    bearing_rad: float | None = None
    range_sigma_m: float | None = None
    bearing_sigma_rad: float | None = None
    heading_rad: float | None = None
    heading_sigma_rad: float | None = None


class MarkerSighting(Sighting, frozen=True, array_like=True):
    """A sighting of a teammate by its markers. On the wire it is a `Sighting`.

    `heading_per_focal` (rad): by how much the heading is read too large if the true focal length is
    larger than the stated one, a unit of the logarithm of their ratio. `heading_per_centre` (rad):
    by how much if the principal point is one focal length to the left of the stated one.
    """

    heading_per_focal: float = 0.0
    heading_per_centre: float = 0.0


class SightingFault(StrEnum):
    """Why a sighting must not be used; the names of counts."""

    NOT_FINITE = "not_finite"
    IMPLAUSIBLE_NUMBER = "implausible_number"
    EMPTY_SIGHTING = "empty_sighting"
    RANGE_NOT_POSITIVE = "range_not_positive"
    BEARING_OUT_OF_RANGE = "bearing_out_of_range"
    HEADING_OUT_OF_RANGE = "heading_out_of_range"
    HEADING_WITHOUT_SIGMA = "heading_without_sigma"
    SIGMA_NOT_POSITIVE = "sigma_not_positive"


class Sightings(msgspec.Struct, frozen=True, array_like=True, tag="sightings"):
    """All sightings of one time."""

    stamp_ns: int
    sightings: tuple[Sighting, ...]


class Position(msgspec.Struct, frozen=True, array_like=True, tag="position"):
    """The position of the robot in the field's frame by its own position sensor (such as GPS).
    `covariance` is xx, xy, yy in m^2."""

    stamp_ns: int
    x_m: float
    y_m: float
    covariance: tuple[float, float, float]


class InitialPose(msgspec.Struct, frozen=True, array_like=True, tag="initial_pose"):
    """Where the robot is in the field's frame, as a person or a program says. It replaces what the
    robot believed until then.

    `covariance` is xx, xy, yy, xh, yh, hh (m^2, m rad, rad^2).
    """

    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    covariance: tuple[float, float, float, float, float, float]


class Belief(msgspec.Struct, frozen=True, array_like=True, tag="belief"):
    """A robot's estimate in the field's frame, for passive collaboration.

    `covariance` is xx, xy, yy, xh, yh, hh (m^2, m rad, rad^2). A receiver extrapolates the pose to
    the time of its sighting by speed and turn rate.
    """

    robot: Name
    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    covariance: tuple[float, float, float, float, float, float]
    speed_m_s: float = 0.0
    turn_rate_rad_s: float = 0.0


class HeadingBelief(Belief, frozen=True, array_like=True, tag="heading_belief"):
    """A belief that its receiver uses for its own heading alone. On the wire it is a `Belief`."""


class Fix(msgspec.Struct, frozen=True, array_like=True, tag="fix"):
    """Active collaboration: `observer` saw `robot` at this position in the field's frame.

    The covariance (xx, xy, yy; m^2) has two parts: the noise of this sighting, and the observer's
    own pose error, which all of its fixes have in common. The variance of the heading (rad^2) has
    the same parts. `heading_rad` is None if the observer did not see the heading.
    """

    robot: Name
    observer: Name
    stamp_ns: int
    x_m: float
    y_m: float
    sensor_covariance: tuple[float, float, float]
    observer_covariance: tuple[float, float, float]
    heading_rad: float | None = None
    heading_sensor_variance: float = 0.0
    heading_observer_variance: float = 0.0


class LandmarkBelief(msgspec.Struct, frozen=True, array_like=True, tag="landmark"):
    """Where a robot takes a landmark to be whose place is not on the map, in the field's frame.
    `covariance` is xx, xy, yy (m^2)."""

    robot: Name
    landmark: Name
    stamp_ns: int
    x_m: float
    y_m: float
    covariance: tuple[float, float, float]


class BeliefShared(msgspec.Struct, frozen=True, array_like=True, tag="told"):
    """What this robot knows was sent: teammates' estimates may depend on its own from now on."""

    stamp_ns: int


class InputsMended(msgspec.Struct, frozen=True, array_like=True, tag="mended"):
    """This robot's inputs were wrong from `since_ns` until now (0: nobody knows since when): they
    tell nothing of its calibration, and made teammates look wrong. They have turned its heading by
    `-turn_rad`, and may have moved its position by `position_sigma_m`."""

    stamp_ns: int
    turn_rad: float = 0.0
    position_sigma_m: float = 0.0
    since_ns: int = 0


class FrameChange(msgspec.Struct, frozen=True, array_like=True, tag="frame_change"):
    """The robot is in this state's frame from now on. What it knows from the frame that it leaves:
    counts, and landmarks that it found there, in its own frame (m) with their joint covariance
    (m^2), two rows a landmark."""

    stamp_ns: int
    accepted: int
    gated: int
    events: dict[str, int]
    landmarks: tuple[str, ...] = ()
    places_m: tuple[tuple[float, float], ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()


Input = (
    Odometry
    | Sightings
    | Position
    | InitialPose
    | Belief
    | Fix
    | LandmarkBelief
    | BeliefShared
    | InputsMended
    | FrameChange
)
