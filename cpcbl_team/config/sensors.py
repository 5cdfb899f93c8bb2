"""Odometry and sensors of one robot: how readings are corrected, and the noise that remains.

A model is what a guest tells the simulated field, so the names of its fields belong to the wire and
must not change. A reader of models ignores keys that it does not know and fills in those that are
missing, so a new key never separates a guest from an older field. The settings add what only the
robot itself needs; the reader of a team file refuses keys that it does not know.
"""

import math
from typing import Annotated

import msgspec

from cpcbl_team.config.table import NotNegative, Positive, Share


class OdometryNoise(msgspec.Struct, frozen=True, kw_only=True):
    """White noise whose variance grows with the distance and with the turn."""

    distance_sigma_m_per_sqrt_m: NotNegative = 0.05
    distance_sigma_m_per_sqrt_rad: NotNegative = 0.0
    """Wheels slip while the robot turns on the spot."""
    turn_sigma_rad_per_sqrt_rad: NotNegative = 0.05
    turn_sigma_rad_per_sqrt_m: NotNegative = 0.05
    crawl_sigma_m_per_sqrt_s: NotNegative = 0.0
    """The least noise of the distance while the robot drives at `least_speed_m_s`. It grows with
    the root of the time, because motors in their dead zone do not keep a speed."""


class OdometryModel(OdometryNoise, frozen=True, kw_only=True):
    """The wheels: their noise, and how what they report differs from what they do."""

    distance_scale: Positive = 1.0
    distance_loss_m_per_rad: NotNegative = 0.0
    """true distance = distance_scale x reported - distance_loss_m_per_rad x |reported turn|, but
    not less than 0: wheels that are commanded to drive a curve do not reach their speed."""
    least_speed_m_s: NotNegative = 0.0
    """The dead zone of the motors: a robot that is commanded to drive more slowly drives at this
    speed (before that loss). Odometry that is computed from commands does not measure it."""
    turn_scale: Positive = 1.0
    turn_bias_rad_per_m: float = 0.0
    """true turn = turn_scale x reported + turn_bias_rad_per_m x true distance."""
    delay_s: NotNegative = 0.0
    """The motion happens this much later than its time stamp."""
    rate_hz: Positive = 20.0
    moves: bool = True
    """False for a robot that stands still and reports no odometry."""


class OdometrySettings(OdometryModel, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Odometry of one robot: its correction, its noise, and what is done without it."""

    timeout_s: Positive = 0.5
    """If odometry is missing, the robot is assumed to drive on as before, but for no longer."""
    distance_scale_sigma: Share = 0.0
    """The sigma of `distance_scale`, as a share of it: how far it may differ on another day. 0: the
    robot takes it for exact until it finds that it is wrong."""
    turn_scale_sigma: Share = 0.0
    gap_speed_m_s: NotNegative = 0.3
    """The sigma that the pose (m, and rad) gains in a second without odometry: with the time while
    the robot is assumed to drive on, then with its root, and there more if it drove fast."""


class SensorModel(msgspec.Struct, frozen=True, kw_only=True):
    """The sensor of landmarks and teammates: ranges and bearings in the robot's frame."""

    range_share: NotNegative = 0.03
    """The sigma of a range as a share of it."""
    range_floor_m: NotNegative = 0.01
    bearing_sigma_deg: NotNegative = 2.0
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0.0, le=360.0)] = 100.0
    max_range_m: Positive = 8.0
    """The sensor sees nothing that is farther away."""
    rate_hz: Positive = 10.0
    delay_s: float = 0.0
    """Time stamps are this much later than the measurement."""
    range_scale: Positive = 1.0
    """true range = range_scale x reading - range_bias_m."""
    range_bias_m: float = 0.0
    robot_range_bias_m: float = 0.0
    """The bias for sightings of teammates, in place of `range_bias_m`."""
    range_is_depth: bool = False
    """Readings are depths along the optical axis, as from an object's height in an image. Each is
    divided by cos(bearing reading - optical_axis_deg) before scale and bias."""
    optical_axis_deg: float = 0.0
    bearing_scale: Positive = 1.0
    """true bearing = bearing_scale x reading - bearing_bias_deg."""
    bearing_bias_deg: float = 0.0
    correlation_s: NotNegative = 0.0
    """The time constant with which errors to the same object fade; 0: errors are independent.
    An object that is seen again before that counts for less."""


class SensorSettings(SensorModel, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The sensor, and what the robot uses of it."""

    max_range_for_range_m: Positive = 1000.0
    """Of an object that is farther away only the bearing is good enough to be used."""
    bearing_bias_sigma_deg: NotNegative = 0.0
    """The sigma of `bearing_bias_deg`: how far the sensor may be turned on another day. 0: the
    robot takes its mounting for exact until it finds that it is not. Of a camera whose images the
    robot reads itself, `camera.yaw_sigma_deg` says this."""
    sees_landmarks: bool = True
    sees_robots: bool = True

    @property
    def bearing_sigma_rad(self) -> float:
        return math.radians(self.bearing_sigma_deg)


class PositionSensorModel(msgspec.Struct, frozen=True, kw_only=True):
    """A sensor that measures the position in the field's frame, such as differential GPS."""

    sigma_m: Positive = 0.02
    rate_hz: Positive = 5.0
    delay_s: NotNegative = 0.0
    """Time stamps are this much later than the measurement."""


class PositionSensor(PositionSensorModel, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The sensor as a team file has it."""
