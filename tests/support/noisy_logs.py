"""What tests of the baselines share: robots whose noise is known exactly."""

from cpcbl_team.config import OdometrySettings, SensorSettings

ROBOTS = ("1", "2", "3")
KINDS = ("dead_reckoning", "solo_ekf", "centralized_ekf")
SENSOR = SensorSettings(range_share=0.05, range_floor_m=0.02, bearing_sigma_deg=2.0)
# Noise of turns by the way only: noise by the turn would itself be a turn, and so count twice.
ODOMETRY = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.08,
    turn_sigma_rad_per_sqrt_rad=0.0,
    turn_sigma_rad_per_sqrt_m=0.08,
)
