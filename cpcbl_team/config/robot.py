"""What one robot has: its filter, odometry, sensors, collaboration and cameras."""

import math
from typing import Annotated, Literal

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Variant = Literal["joint", "oval", "circular", "weighted"]
Fusion = Literal["split-ci", "naive"]
Direction = Literal["one-way", "both-ways"]


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the team file. Its fields are the keys that the file may set."""


class Weights(Table, frozen=True, kw_only=True):
    """Static weights of the sensor against the estimate, for `weighted` (paper, section 3)."""

    position: Share = 0.1
    heading: Share = 0.5
    nominal_sigma_m: Positive = 0.15
    """The position sigma that a `weighted` robot announces just after an update, because it has no
    estimate of it."""
    nominal_heading_sigma_deg: Positive = 4.0


class LocalizerSettings(Table, frozen=True, kw_only=True):
    """The variant of the filter, its timers, its gate and the limits of being lost."""

    variant: Variant = "joint"
    alternate: bool | None = None
    """One update a cycle, heading or position in turn. Default: true for all variants but
    `joint`."""
    minimum_interval_s: NotNegative = 0.0
    """The least time between two updates of the same type (paper, section 3)."""
    object_interval_s: NotNegative = 0.0
    """The least time between two uses of the same object, whose errors are correlated."""
    bearing_for_position: bool = True
    self_calibration: bool = False
    """Estimate the scales of odometry and the bias of bearings while driving. `weighted` does
    not, because it does not know the accuracy of its pose."""
    paper_uncertainty: bool = False
    """As printed in the paper, the uncertainty of a position constraint does not contain that of
    the heading (resolution a)."""
    weights: Weights = Weights()
    gate_probability: Annotated[float, msgspec.Meta(gt=0.5, lt=1.0)] = 0.999
    """The share of correct measurements that the gate accepts."""
    lost_position_sigma_m: Positive = 2.0
    lost_heading_sigma_deg: Positive = 60.0
    lost_window: Annotated[int, msgspec.Meta(ge=4)] = 20
    """The robot is lost if more than `lost_share` of its last `lost_window` innovations were
    rejected."""
    lost_share: Share = 0.6

    @property
    def learns(self) -> bool:
        """Whether the robot calibrates itself."""
        return self.self_calibration and self.variant != "weighted"

    @property
    def alternates(self) -> bool:
        """Whether heading and position are updated in separate cycles."""
        return self.variant != "joint" if self.alternate is None else self.alternate


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

    @property
    def bearing_sigma_rad(self) -> float:
        return math.radians(self.bearing_sigma_deg)


class PositionSensor(Table, frozen=True, kw_only=True):
    """A sensor that measures the position in the field's frame, such as differential GPS."""

    sigma_m: Positive = 0.02
    rate_hz: Positive = 5.0
    delay_s: NotNegative = 0.0
    """Time stamps are this much later than the measurement."""


class BudgetSettings(Table, frozen=True, kw_only=True):
    """What a robot may spend on fixes and beliefs; 0 means no limit."""

    bytes_per_s: NotNegative = 0.0
    """With Zenoh's own bytes, without those of TCP/IP. It holds over any 10 s; below 50 B/s,
    over the time in which 500 bytes are earned."""
    messages_per_minute: NotNegative = 0.0
    """It holds over any minute; with 2.5 the robot sends at most 3 messages in any 72 s."""
    match_share: NotNegative = 1.0
    """The robot's weight when `match.messages` are divided among the robots."""
    urgent_share: Share = 0.2
    """The part of every budget that is reserved for teammates that are lost."""


class TrustSettings(Table, frozen=True, kw_only=True):
    """How a robot detects teammates whose messages are wrong (docs/trust.md)."""

    enabled: bool = True
    limit: Positive = 30.0
    """The sum of NIS beyond the usual at which there is a dispute: three clear contradictions."""
    readmit_s: NotNegative = 5.0
    """A sender is used again after its messages were right for this time."""
    clock_ahead_s: NotNegative = 0.1
    """Help is refused if the clock of its sender is further ahead than this."""
    clock_behind_s: Positive = 0.4
    """Help is refused if all of it arrives later than this after its time stamp."""


class CollaborationSettings(Table, frozen=True, kw_only=True):
    """Active and passive collaboration of one robot."""

    passive: bool = True
    active: bool = True
    fusion: Fusion = "split-ci"
    direction: Direction = "one-way"
    tier_width: Annotated[float, msgspec.Meta(gt=1.0)] = math.sqrt(2.0)
    """The ratio of the position sigma from one tier to the next."""
    tier_hysteresis: Annotated[float, msgspec.Meta(ge=1.0)] = 1.1
    """A robot leaves its tier only when sigma is beyond the tier's edge by this factor."""
    best_tier: Annotated[int, msgspec.Meta(ge=0, le=15)] = 0
    """The best tier that the robot announces, however accurate its estimate is: for sensors whose
    errors it cannot notice."""
    budget: BudgetSettings = BudgetSettings()
    trust: TrustSettings = TrustSettings()
    least_value: NotNegative = 0.05
    """The information gain (nats) from which on a fix is sent: the logarithm of the factor by which
    the ellipse of the receiver's position shrinks."""
    least_use: NotNegative = 0.05
    """The information gain (nats) from which on the beliefs of a teammate in sight are subscribed
    to."""
    belief_rate_hz: Positive = 5.0
    """The highest rate at which beliefs are sent."""
    belief_share: NotNegative = 0.5
    """A belief is sent when the receivers' extrapolation of the last one is off by this share of
    sigma."""
    belief_silence_s: NotNegative = 1.0
    """The longest time between two beliefs of a robot to whose beliefs somebody subscribes."""
    fix_interval_s: NotNegative = 0.0
    """The least time between two fixes for the same teammate."""
    max_age_s: Positive = 1.5
    """A teammate's belief that is older than this is not used."""
    after_s: NotNegative = 0.0
    """Collaboration begins this long after the start, to show its effect."""


# Cameras, and what they look for: coloured cylinders and markers ----------------------------------

Side = Literal["front", "left", "back", "right"]
MarkerFamily = Literal[
    "aruco_4x4_50",
    "aruco_5x5_50",
    "aruco_6x6_50",
    "apriltag_16h5",
    "apriltag_25h9",
    "apriltag_36h11",
]
MARKERS: dict[MarkerFamily, int] = {
    "aruco_4x4_50": 50,
    "aruco_5x5_50": 50,
    "aruco_6x6_50": 50,
    "apriltag_16h5": 30,
    "apriltag_25h9": 35,
    "apriltag_36h11": 587,
}
"""The number of markers in a family: 0, 1, ..."""
LIKE_MIRRORED: dict[MarkerFamily, frozenset[int]] = {"aruco_4x4_50": frozenset({8, 9, 17, 47})}
"""Markers that equal their own mirror image, so that a marker seen in a mirror looks like them."""


class CameraSettings(Table, frozen=True, kw_only=True):
    """A camera and its mounting, `robot_from_camera`.

    The camera is a pinhole with OpenCV's distortion. The robot's frame is x forward, y left, z up,
    from the floor below its centre. Yaw is to the left, tilt is down, roll is clockwise as the
    camera sees it.
    """

    frames: str = ""
    """A device's number, a URL (RTSP, HTTP), a video file or a folder of images, relative to the
    team file; empty: images come as messages on `in/<robot>/frame`."""
    width_px: Annotated[int, msgspec.Meta(ge=16, le=8192)] = 640
    height_px: Annotated[int, msgspec.Meta(ge=16, le=8192)] = 480
    fx_px: Positive = 400.0
    fy_px: Positive = 400.0
    cx_px: float = 319.5
    cy_px: float = 239.5
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's k1, k2, p1, p2, k3."""
    x_m: float = 0.0
    y_m: float = 0.0
    mounted_m: Positive = 0.2
    """The height of the lens above the floor."""
    yaw_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    edge_sigma_px: Positive = 0.4
    """The accuracy with which the edge of a band, or the corner of a marker, is found."""
    tilt_sigma_deg: NotNegative = 0.2
    """The accuracy of the tilt, because floors are not even; it limits ranges from foot points."""
    yaw_sigma_deg: NotNegative = 0.1
    """The accuracy of the yaw; it is added to the sigma of every bearing."""
    focal_share: NotNegative = 0.005
    """The accuracy of the focal length as a share; it is added to the sigma of every range."""

    @property
    def live(self) -> bool:
        """Whether images come from a device or a URL, and not from files or messages."""
        where = self.frames
        return where.isdecimal() or "://" in where or where.startswith("/dev/")


class Colour(Table, frozen=True, kw_only=True):
    """Lower and upper limits of one colour in OpenCV's 8-bit HSV, both included."""

    hue: tuple[int, int]
    """0 to 179, in half degrees; a lower limit above the upper one spans red."""
    saturation: tuple[int, int] = (80, 255)
    value: tuple[int, int] = (40, 255)


COLOURS = {
    "red": Colour(hue=(172, 8)),
    "orange": Colour(hue=(10, 20)),
    "yellow": Colour(hue=(23, 35)),
    "green": Colour(hue=(50, 75)),
    "cyan": Colour(hue=(83, 98)),
    "blue": Colour(hue=(105, 122)),
    "pink": Colour(hue=(145, 168)),
}


class Cylinder(Table, frozen=True, kw_only=True):
    """The shape of a coloured landmark or mast: two bands of the same height, one on the other."""

    radius_m: Positive = 0.05
    height_m: Positive = 0.4
    """The height of both bands together."""
    foot_m: NotNegative = 0.0
    """The height of the lower band's lower edge above the floor."""


class VisionSettings(Table, frozen=True, kw_only=True):
    """What the team's cameras look for."""

    colours: dict[str, Colour] = msgspec.field(default_factory=COLOURS.copy)
    """The colours that a file names replace all built-in ones."""
    landmark: Cylinder = Cylinder()
    """The shape of coloured landmarks."""
    mast: Cylinder = Cylinder(radius_m=0.04, height_m=0.16, foot_m=0.25)
    """The shape of robots' colour bands, above their centre."""
    family: MarkerFamily = "aruco_4x4_50"
    marker_m: Positive = 0.12
    """The side of a marker's black square."""
    marker_mounted_m: Positive = 0.12
    """The height of a marker's centre above the floor; markers stand upright."""
    marker_distance_m: Positive = 0.12
    """The distance from the robot's centre to each of its markers."""
