"""What a guest tells the simulated field about itself: the model by which the field simulates it.

The structs of this file belong to the wire, not to the team file. They hold only what a simulated
field needs. A reader ignores keys that it does not know and fills in those that are missing, so a
new key of the team file never separates a guest from an older field. The names are written as text
and must not change. `cpcbl_team.config` explains each value.
"""

from typing import Annotated

import msgspec

from cpcbl_team.config import RobotSettings
from cpcbl_team.config.robot import NotNegative, Positive


class StartModel(msgspec.Struct, frozen=True, kw_only=True):
    """The stated start. The field draws the true pose around it, as it does for all robots."""

    x_m: float
    y_m: float
    heading_deg: float = 0.0
    sigma_m: NotNegative = 0.05
    heading_sigma_deg: NotNegative = 3.0


class SensorModel(msgspec.Struct, frozen=True, kw_only=True):
    """The sensor for landmarks and teammates."""

    range_share: NotNegative = 0.03
    range_floor_m: NotNegative = 0.01
    bearing_sigma_deg: NotNegative = 2.0
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0.0, le=360.0)] = 100.0
    max_range_m: Positive = 8.0
    rate_hz: Positive = 10.0
    delay_s: float = 0.0
    range_scale: Positive = 1.0
    range_bias_m: float = 0.0
    robot_range_bias_m: float = 0.0
    range_is_depth: bool = False
    optical_axis_deg: float = 0.0
    bearing_scale: Positive = 1.0
    bearing_bias_deg: float = 0.0
    correlation_s: NotNegative = 0.0


class OdometryModel(msgspec.Struct, frozen=True, kw_only=True):
    """The wheels: their noise, and how what they report differs from what they do."""

    distance_sigma_m_per_sqrt_m: NotNegative = 0.05
    distance_sigma_m_per_sqrt_rad: NotNegative = 0.0
    turn_sigma_rad_per_sqrt_rad: NotNegative = 0.05
    turn_sigma_rad_per_sqrt_m: NotNegative = 0.05
    crawl_sigma_m_per_sqrt_s: NotNegative = 0.0
    distance_scale: Positive = 1.0
    distance_loss_m_per_rad: NotNegative = 0.0
    least_speed_m_s: NotNegative = 0.0
    turn_scale: Positive = 1.0
    turn_bias_rad_per_m: float = 0.0
    delay_s: NotNegative = 0.0
    rate_hz: Positive = 20.0
    moves: bool = True


class PositionSensorModel(msgspec.Struct, frozen=True, kw_only=True):
    """A sensor of the position on the field, such as differential GPS."""

    sigma_m: Positive = 0.02
    rate_hz: Positive = 5.0
    delay_s: NotNegative = 0.0


class SimulatedRobotModel(msgspec.Struct, frozen=True, array_like=True):
    """All that the simulated field must know of a guest."""

    start: StartModel
    sensor: SensorModel = SensorModel()
    odometry: OdometryModel = OdometryModel()
    position_sensor: PositionSensorModel | None = None


def model_from_settings(settings: RobotSettings) -> SimulatedRobotModel | None:
    """The model of a simulated robot; None for a real one, or one without a stated start."""
    if settings.source != "simulated" or settings.start is None:
        return None
    return msgspec.convert(settings, SimulatedRobotModel, from_attributes=True)


def settings_from_model(model: SimulatedRobotModel) -> RobotSettings:
    """The settings by which the field simulates a guest; what it does not need has defaults."""
    return msgspec.convert(model, RobotSettings, from_attributes=True)
