"""A simulated team whose odometry and sensors err, for tests of calibrations."""

from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import (
    Field,
    Landmark,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)

SECONDS = 90.0
PLACES = [(0.0, 0.0), (9.0, 0.0), (9.0, 5.0), (0.0, 5.0), (4.5, -1.0), (4.5, 6.0)]
MAP = Field(landmarks={f"m{i}": Landmark(x_m=x, y_m=y) for i, (x, y) in enumerate(PLACES)})
WORSE = RobotSettings(
    start=Start(x_m=1.5, y_m=1.0),
    waypoints_m=((7.5, 1.0), (7.5, 4.0), (1.5, 4.0), (1.5, 1.0)),
    odometry=OdometrySettings(
        distance_scale=0.93,
        distance_loss_m_per_rad=0.06,
        turn_scale=0.95,
        turn_bias_rad_per_m=-0.04,
        delay_s=0.21,
        distance_sigma_m_per_sqrt_m=0.05,
        turn_sigma_rad_per_sqrt_rad=0.1,
        turn_sigma_rad_per_sqrt_m=0.03,
        distance_sigma_m_per_sqrt_rad=0.03,
    ),
    sensor=SensorSettings(
        field_of_view_deg=100.0,
        max_range_m=12.0,
        range_share=0.04,
        range_floor_m=0.03,
        bearing_sigma_deg=1.0,
        delay_s=0.04,
        range_scale=1.03,
        range_bias_m=0.05,
        robot_range_bias_m=0.15,
        bearing_bias_deg=-0.7,
        bearing_scale=0.97,
        range_is_depth=True,
        optical_axis_deg=3.0,
        correlation_s=0.6,
    ),
)
BETTER = RobotSettings(
    start=Start(x_m=7.0, y_m=3.5),
    waypoints_m=((2.0, 3.5), (2.0, 1.5), (4.5, 2.5), (7.0, 1.5), (7.0, 3.5)),
    odometry=OdometrySettings(
        distance_scale=1.06,
        turn_scale=1.1,
        distance_sigma_m_per_sqrt_m=0.02,
        turn_sigma_rad_per_sqrt_rad=0.03,
        turn_sigma_rad_per_sqrt_m=0.06,
    ),
    sensor=SensorSettings(
        field_of_view_deg=180.0,
        max_range_m=12.0,
        range_share=0.01,
        range_floor_m=0.05,
        delay_s=-0.03,
        range_scale=0.97,
        range_bias_m=-0.1,
        robot_range_bias_m=0.0,
        bearing_bias_deg=1.5,
    ),
)
STANDING = RobotSettings(
    start=Start(x_m=4.5, y_m=5.0, heading_deg=-90.0),
    odometry=OdometrySettings(moves=False),
    sensor=SensorSettings(field_of_view_deg=180.0, max_range_m=12.0, bearing_bias_deg=0.5),
)
TEAM = with_overrides(  # without help: where they drive does not depend on how help is routed
    Team(name="trio", robots={"a": WORSE, "b": BETTER, "c": STANDING}, map=MAP),
    Overrides(collaboration="none"),
)
