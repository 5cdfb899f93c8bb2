"""Odometry of a robot: how its readings are corrected, and the noise that remains."""

from cpcbl_team.config.table import NotNegative, Positive, Table


class OdometryNoise(Table, frozen=True, kw_only=True):
    """White noise whose variance grows with the distance and with the turn."""

    distance_sigma_m_per_sqrt_m: NotNegative = 0.05
    distance_sigma_m_per_sqrt_rad: NotNegative = 0.0
    """Wheels slip while the robot turns on the spot."""
    turn_sigma_rad_per_sqrt_rad: NotNegative = 0.05
    turn_sigma_rad_per_sqrt_m: NotNegative = 0.05
    crawl_sigma_m_per_sqrt_s: NotNegative = 0.0
    """The least noise of the distance while the robot drives at `least_speed_m_s`. It grows with
    the root of the time, because motors in their dead zone do not keep a speed."""


class OdometrySettings(OdometryNoise, frozen=True, kw_only=True):
    """Odometry of one robot: its correction and its noise."""

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
    timeout_s: Positive = 0.5
    """If no odometry has come for longer, the variances of the pose grow with time."""
    gap_speed_m_s: NotNegative = 0.3
    """The sigma that the pose (m, and rad) gains in a second without odometry; it grows with the
    root of the time."""
