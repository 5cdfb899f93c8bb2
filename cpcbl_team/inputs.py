"""What a robot's filter is told: odometry, sightings, and what teammates say.

All are immutable, stamped with the time at which the thing was *measured* (`stamp_ns`), and are
the same structs that travel on the wire. Metres and radians.
"""

from typing import Annotated

import msgspec

NAME_PATTERN = r"^[A-Za-z0-9_.-]{1,32}$"
Name = Annotated[str, msgspec.Meta(pattern=NAME_PATTERN)]


class Odometry(msgspec.Struct, frozen=True, array_like=True, tag="odometry"):
    """Differential odometry: what the wheels say happened from `from_ns` to `stamp_ns`."""

    from_ns: int
    stamp_ns: int
    distance_m: float
    turn_rad: float


class Sighting(msgspec.Struct, frozen=True, array_like=True):
    """One object in the robot's frame. `range_m` to a wall is the perpendicular distance, its
    bearing the direction of that perpendicular. A sigma that is left out is the sensor model's.

    `heading_rad`: where a teammate looks, in the robot's frame, if that was seen; with its sigma.
    """

    id: Name
    range_m: float | None = None
    bearing_rad: float | None = None
    range_sigma_m: float | None = None
    bearing_sigma_rad: float | None = None
    heading_rad: float | None = None
    heading_sigma_rad: float | None = None


class Sightings(msgspec.Struct, frozen=True, array_like=True, tag="sightings"):
    """Everything seen at one time (one frame)."""

    stamp_ns: int
    sightings: tuple[Sighting, ...]


class Position(msgspec.Struct, frozen=True, array_like=True, tag="position"):
    """What a position sensor says (differential GPS, ultra-wide band), in the field's frame.

    `covariance` is xx, xy, yy in m^2.
    """

    stamp_ns: int
    x_m: float
    y_m: float
    covariance: tuple[float, float, float]


class Belief(msgspec.Struct, frozen=True, array_like=True, tag="belief"):
    """A robot's pose Gaussian in the field's frame, for passive use by teammates.

    `covariance` is xx, xy, yy, xh, yh, hh (m^2, m rad, rad^2). Speed and turn rate let a listener
    place the robot at the time of its sighting.
    """

    robot: Name
    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    covariance: tuple[float, float, float, float, float, float]
    speed_m_s: float = 0.0
    turn_rate_rad_s: float = 0.0


class Fix(msgspec.Struct, frozen=True, array_like=True, tag="fix"):
    """Active observation: where `observer` saw `robot`, in the field's frame.

    The two parts of the covariance (xx, xy, yy; m^2) stay apart: the sensor's part is fresh noise,
    the observer's own pose error is the same in every fix that it sends. So do the two parts of the
    variance (rad^2) of the heading, which is None where it was not seen.
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


class Told(msgspec.Struct, frozen=True, array_like=True, tag="told"):
    """This robot's belief has left it: from now on a teammate's may hold the same information."""

    stamp_ns: int


Input = Odometry | Sightings | Position | Belief | Fix | Told
