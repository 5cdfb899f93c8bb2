"""What a robot's sensors can measure, and how they err."""

import math
from typing import Annotated

import msgspec

from cpcbl_team.config.table import NotNegative, Positive, Table


class SensorSettings(Table, frozen=True, kw_only=True):
    """The sensor of landmarks and teammates: ranges and bearings in the robot's frame."""

    range_share: NotNegative = 0.03
    """The sigma of a range as a share of it."""
    range_floor_m: NotNegative = 0.01
    bearing_sigma_deg: NotNegative = 2.0
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0.0, le=360.0)] = 100.0
    max_range_m: Positive = 8.0
    """The sensor sees nothing that is farther away."""
    max_range_for_range_m: Positive = 1000.0
    """Of an object that is farther away only the bearing is good enough to be used."""
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
    sees_landmarks: bool = True
    sees_robots: bool = True

    def range_sigma_m(self, range_m: float) -> float:
        """The sigma of a range (both in metres)."""
        return math.hypot(self.range_share * range_m, self.range_floor_m)

    @property
    def bearing_sigma_rad(self) -> float:
        return math.radians(self.bearing_sigma_deg)


class PositionSensor(Table, frozen=True, kw_only=True):
    """A sensor that measures the position in the field's frame, such as differential GPS."""

    sigma_m: Positive = 0.02
    rate_hz: Positive = 5.0
    delay_s: NotNegative = 0.0
    """Time stamps are this much later than the measurement."""
