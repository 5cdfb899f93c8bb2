"""A robot's and a field's settings: typed, defaulted, with the unit in the name.

These are the tables of a team file; unknown keys are refused where the file is read.
"""

import math
from typing import Annotated, Literal

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]

Variant = Literal["joint", "oval", "circular", "weighted"]
Fusion = Literal["split-ci", "naive"]
Direction = Literal["one-way", "both-ways"]
Gives = Literal["both", "range", "bearing", "none"]
Source = Literal["simulated", "mrclam", "external"]
Security = Literal["none", "mtls"]
Sensing = Literal["sightings", "camera"]
Side = Literal["front", "left", "back", "right"]
Bands = tuple[str, str]  # names of colours, the upper one first
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
"""How many markers a family has: 0, 1, ..."""
LIKE_MIRRORED: dict[MarkerFamily, frozenset[int]] = {"aruco_4x4_50": frozenset({8, 9, 17, 47})}
"""Markers that are their own mirror image: one cannot tell whether they are seen in a mirror."""


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the team file."""


class OdometryNoise(Table, frozen=True, kw_only=True):
    """How odometry errs: white noise whose variance grows with the way and the turn."""

    distance_sigma_m_per_sqrt_m: NotNegative = 0.05
    distance_sigma_m_per_sqrt_rad: NotNegative = 0.0
    """Wheels that turn on the spot slip to and fro."""
    turn_sigma_rad_per_sqrt_rad: NotNegative = 0.05
    turn_sigma_rad_per_sqrt_m: NotNegative = 0.05
    crawl_sigma_m_per_sqrt_s: NotNegative = 0.0
    """While it drives at `least_speed_m_s`, the variance of its way grows with time, by this at
    least: in their dead zone motors do as they like."""


class OdometrySettings(OdometryNoise, frozen=True, kw_only=True):
    """Odometry of one robot: how it is corrected, then its noise."""

    distance_scale: Positive = 1.0
    distance_loss_m_per_rad: NotNegative = 0.0
    """true distance = distance_scale x reported - distance_loss_m_per_rad x |reported turn|, but no
    less than none: wheels that are told to drive a curve do not reach their speed."""
    least_speed_m_s: NotNegative = 0.0
    """A robot that is told to drive slower drives this fast (before that loss): motors have a dead
    zone, and odometry that is made of commands does not know of it."""
    turn_scale: Positive = 1.0
    turn_bias_rad_per_m: float = 0.0
    """true turn = turn_scale x reported + turn_bias_rad_per_m x true distance."""
    delay_s: NotNegative = 0.0
    """The motion follows the stamp by so much."""
    rate_hz: Positive = 20.0
    moves: bool = True
    """False for a robot that stands still and reports no odometry."""
    timeout_s: Positive = 0.5
    """Without odometry for longer, the pose's variances grow with the time."""
    gap_speed_m_s: NotNegative = 0.3
    """So far (m, and rad) the pose may have changed after a second of that, twice as far after
    four."""


class SensorSettings(Table, frozen=True, kw_only=True):
    """What a robot's landmark and teammate sensor can do, and how it errs."""

    range_share: NotNegative = 0.03
    """Standard deviation of a range as a share of it."""
    range_floor_m: NotNegative = 0.01
    bearing_sigma_deg: NotNegative = 2.0
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0.0, le=360.0)] = 100.0
    max_range_m: Positive = 8.0
    """Nothing is seen beyond."""
    max_range_for_range_m: Positive = 1000.0
    """Beyond, only the bearing of an object is good enough to be used."""
    rate_hz: Positive = 10.0
    delay_s: float = 0.0
    """Stamps are so much later than the exposure."""
    range_scale: Positive = 1.0
    """true range = range_scale x reading - range_bias_m."""
    range_bias_m: float = 0.0
    robot_range_bias_m: float = 0.0
    """For sightings of teammates, instead of `range_bias_m`."""
    range_is_depth: bool = False
    """Readings are depths along the optical axis, as from an object's height in a picture: each is
    divided by cos(bearing reading - optical_axis_deg) before scale and bias."""
    optical_axis_deg: float = 0.0
    bearing_scale: Positive = 1.0
    """true bearing = bearing_scale x reading - bearing_bias_deg."""
    bearing_bias_deg: float = 0.0
    correlation_s: NotNegative = 0.0
    """Time constant with which errors to the same object fade; 0: each reading errs anew. What is
    seen again before that counts for less."""
    sees_landmarks: bool = True
    sees_robots: bool = True

    def range_sigma_m(self, range_m: float) -> float:
        return math.hypot(self.range_share * range_m, self.range_floor_m)

    @property
    def bearing_sigma_rad(self) -> float:
        return math.radians(self.bearing_sigma_deg)


class PositionSensor(Table, frozen=True, kw_only=True):
    """A sensor that tells the position on the field, such as differential GPS."""

    sigma_m: Positive = 0.02
    rate_hz: Positive = 5.0
    delay_s: NotNegative = 0.0
    """Stamps are so much later than the measurement."""


class CameraSettings(Table, frozen=True, kw_only=True):
    """A camera, and where it is on its robot.

    A pinhole with OpenCV's distortion; the robot's frame is x forward, y left, z up, from the floor
    below its centre. Yaw is to the left, tilt down, roll clockwise as the camera sees it.
    """

    frames: str = ""
    """A device's number, a URL (RTSP, HTTP), a video file or a folder of pictures, relative to the
    team file; empty: they come as messages, `in/<robot>/frame`."""
    width_px: Annotated[int, msgspec.Meta(ge=16, le=8192)] = 640
    height_px: Annotated[int, msgspec.Meta(ge=16, le=8192)] = 480
    fx_px: Positive = 400.0
    fy_px: Positive = 400.0
    cx_px: float = 319.5
    cy_px: float = 239.5
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3."""
    x_m: float = 0.0
    y_m: float = 0.0
    mounted_m: Positive = 0.2
    """Height of the lens above the floor."""
    yaw_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    edge_sigma_px: Positive = 0.4
    """How well the edge of a blob, or the corner of a marker, is found."""
    tilt_sigma_deg: NotNegative = 0.2
    """How well tilt is known, as the floor is not even: what foot points are worth."""
    yaw_sigma_deg: NotNegative = 0.1
    """How well the direction is known: added to the sigma of every bearing."""
    focal_share: NotNegative = 0.005
    """How well the focal length is known, as a share of it: added to the sigma of every range."""

    @property
    def live(self) -> bool:
        """Whether frames come from a device or a URL; not played, not as messages."""
        where = self.frames
        return where.isdecimal() or "://" in where or where.startswith("/dev/")


class Colour(Table, frozen=True, kw_only=True):
    """Thresholds of one colour in OpenCV's 8-bit HSV, from and to, both in."""

    hue: tuple[int, int]
    """0 to 179, half degrees; from more than to: through red."""
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
    """Of both bands."""
    foot_m: NotNegative = 0.0
    """Height of the lower band's lower edge above the floor."""


class VisionSettings(Table, frozen=True, kw_only=True):
    """What the team's cameras look for."""

    colours: dict[str, Colour] = msgspec.field(default_factory=COLOURS.copy)
    """The colours that a file names are used in place of these."""
    landmark: Cylinder = Cylinder()
    """The shape of coloured landmarks."""
    mast: Cylinder = Cylinder(radius_m=0.04, height_m=0.16, foot_m=0.25)
    """The shape of robots' colour bands, above their centre."""
    family: MarkerFamily = "aruco_4x4_50"
    marker_m: Positive = 0.12
    """Side of a marker's black square."""
    marker_mounted_m: Positive = 0.12
    """Height of a marker's centre above the floor; markers stand upright."""
    marker_distance_m: Positive = 0.12
    """From the robot's centre to each of its markers."""


class Weights(Table, frozen=True, kw_only=True):
    """Static weights of sensor against estimate for `weighted` (paper, section 3)."""

    position: Share = 0.1
    heading: Share = 0.5
    nominal_sigma_m: Positive = 0.15
    """Quality that a `weighted` robot claims just after an update; it has no estimate of it."""
    nominal_heading_sigma_deg: Positive = 4.0


class LocalizerSettings(Table, frozen=True, kw_only=True):
    """How evidence becomes a pose."""

    variant: Variant = "joint"
    alternate: bool | None = None
    """One update a cycle, heading or position in turn. Default: all variants but `joint`."""
    minimum_interval_s: NotNegative = 0.0
    """Least time between two updates of the same type (paper, section 3)."""
    object_interval_s: NotNegative = 0.0
    """Least time between two uses of the same object: its errors are correlated."""
    bearing_for_position: bool = True
    self_calibration: bool = False
    """Learn the scales of odometry and the bearing bias while driving. `weighted` never does: it
    does not know how well it knows its place."""
    paper_uncertainty: bool = False
    """As printed: without the heading's share in a position's uncertainty (resolution a)."""
    weights: Weights = Weights()
    gate_probability: Annotated[float, msgspec.Meta(gt=0.5, lt=1.0)] = 0.999
    lost_position_sigma_m: Positive = 2.0
    lost_heading_sigma_deg: Positive = 60.0
    lost_window: Annotated[int, msgspec.Meta(ge=4)] = 20
    """Lost when more than `lost_share` of the last so many innovations were rejected."""
    lost_share: Share = 0.6

    @property
    def learns(self) -> bool:
        return self.self_calibration and self.variant != "weighted"

    @property
    def alternates(self) -> bool:
        return self.variant != "joint" if self.alternate is None else self.alternate


class BudgetSettings(Table, frozen=True, kw_only=True):
    """What a robot may spend on fixes and beliefs; 0: as much as it likes."""

    bytes_per_s: NotNegative = 0.0
    """With Zenoh's own bytes, without those of TCP/IP; holds over any 10 s, below
    50 B/s over the time in which 500 bytes are earned."""
    messages_per_minute: NotNegative = 0.0
    """Holds over any minute; 2.5: at most 3 in any 72 s."""
    match_share: NotNegative = 1.0
    """Its weight when `match.messages` are divided among the robots."""
    urgent_share: Share = 0.2
    """The part of every budget that is kept for teammates that are lost."""


class TrustSettings(Table, frozen=True, kw_only=True):
    """How a teammate is found that says what is not so."""

    enabled: bool = True
    limit: Positive = 30.0
    """By how much it may surprise: three clear contradictions (summed NIS beyond the usual)."""
    readmit_s: NotNegative = 5.0
    """It is believed again when it was right for so long."""
    clock_ahead_s: NotNegative = 0.1
    """Help is refused that is stamped by a clock further ahead,"""
    clock_behind_s: Positive = 0.4
    """or by one that is behind, or so late, by more."""


class CollaborationSettings(Table, frozen=True, kw_only=True):
    """Who helps whom, and how much is believed."""

    passive: bool = True
    active: bool = True
    fusion: Fusion = "split-ci"
    direction: Direction = "one-way"
    tier_width: Annotated[float, msgspec.Meta(gt=1.0)] = math.sqrt(2.0)
    """Ratio of position sigma from one tier to the next."""
    tier_hysteresis: Annotated[float, msgspec.Meta(ge=1.0)] = 1.1
    """A tier is left only when sigma is beyond its edge by this factor."""
    best_tier: Annotated[int, msgspec.Meta(ge=0, le=15)] = 0
    """No better tier is announced, however certain the robot is: for sensors that err unseen."""
    budget: BudgetSettings = BudgetSettings()
    trust: TrustSettings = TrustSettings()
    least_value: NotNegative = 0.05
    """What a fix must be worth (nats): the logarithm of the factor by which the ellipse of the
    helped robot's position shrinks. Less is not sent."""
    least_use: NotNegative = 0.05
    """The same for the beliefs of a teammate in sight; for less they are not subscribed to."""
    belief_rate_hz: Positive = 5.0
    """At most."""
    belief_share: NotNegative = 0.5
    """A belief is sent when what listeners make of the last one is off by this share of sigma."""
    belief_silence_s: NotNegative = 1.0
    """The longest silence of a robot whose belief is listened to."""
    fix_interval_s: NotNegative = 0.0
    """Least time between two fixes for the same teammate."""
    max_age_s: Positive = 1.5
    """A teammate's belief older than this is not used."""
    after_s: NotNegative = 0.0
    """Collaboration begins so long after the start: for showing what it is worth."""


class Start(Table, frozen=True, kw_only=True):
    """Where a robot starts, in the field's frame. Without one it finds itself."""

    known: bool = True
    """False: only the simulated field knows it, the robot finds itself."""
    x_m: float
    y_m: float
    heading_deg: float = 0.0
    sigma_m: NotNegative = 0.05
    heading_sigma_deg: NotNegative = 3.0


class Landmark(Table, frozen=True, kw_only=True):
    """A point that is known beforehand."""

    x_m: float
    y_m: float
    gives: Gives = "both"
    colours: Bands | None = None
    """Of a cylinder with two bands, the upper one first: what a camera knows it by."""


class Wall(Table, frozen=True, kw_only=True):
    """A straight surface from one point to another."""

    from_m: tuple[float, float]
    to_m: tuple[float, float]
    gives: Gives = "both"

    @property
    def direction_rad(self) -> float:
        return math.atan2(self.to_m[1] - self.from_m[1], self.to_m[0] - self.from_m[0])


class Field(Table, frozen=True, kw_only=True):
    """Everything that is known of the field before the robots start."""

    landmarks: dict[str, Landmark] = {}
    walls: dict[str, Wall] = {}

    def bounds(self) -> tuple[float, float, float, float]:
        """(least x, least y, greatest x, greatest y) of what is on the map; zeros if empty."""
        points = [(p.x_m, p.y_m) for p in self.landmarks.values()]
        points += [end for wall in self.walls.values() for end in (wall.from_m, wall.to_m)]
        if not points:
            return 0.0, 0.0, 0.0, 0.0
        xs, ys = [p[0] for p in points], [p[1] for p in points]
        return min(xs), min(ys), max(xs), max(ys)


class LocalizationSettings(Table, frozen=True, kw_only=True):
    """All that one robot's mathematics needs."""

    localizer: LocalizerSettings = LocalizerSettings()
    sensor: SensorSettings = SensorSettings()
    position_sensor: PositionSensor | None = None
    odometry: OdometrySettings = OdometrySettings()
    collaboration: CollaborationSettings = CollaborationSettings()
    start: Start | None = None


class RobotSettings(LocalizationSettings, frozen=True, kw_only=True):
    """One robot of a team: a robot type's keys and its own, over the team's defaults."""

    source: Source = "simulated"
    sensing: Sensing = "sightings"
    """camera: sightings are found in frames; else they come as such."""
    camera: CameraSettings = CameraSettings()
    markers: dict[Side, int] = {}
    """The markers that it carries, by side: what teammates' cameras know it by."""
    colours: Bands | None = None
    """Colour bands on a mast: the same from farther away, without the heading."""
    waypoints_m: tuple[tuple[float, float], ...] = ()
    """Simulated robots drive loops through these by their own estimates."""
    speed_m_s: NotNegative = 0.5


class GuardSettings(Table, frozen=True, kw_only=True):
    """What the router lets in from one robot, so that a faulty one cannot flood the others."""

    enabled: bool = True
    fix_rate_hz: Positive = 100.0
    """Fixes for one teammate. What comes sooner than 1 / rate after the last one is dropped, so
    leave room for messages that come unevenly: twice the frame rate or more."""
    belief_rate_hz: Positive = 50.0
    largest_help_bytes: Annotated[int, msgspec.Meta(ge=1)] = 256
    """Payload of a fix or belief."""
    largest_bytes: Annotated[int, msgspec.Meta(ge=1)] = 65_536
    """Payload of anything else; robots refuse what is larger."""
    largest_frame_bytes: Annotated[int, msgspec.Meta(ge=1)] = 1_048_576
    """Payload of a camera's frame, plain or annotated."""


class TransportSettings(Table, frozen=True, kw_only=True):
    """Where the team's Zenoh router is."""

    listen: tuple[str, ...] = ()
    """Endpoints at which `up` opens its router; default: a free port of 127.0.0.1."""
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints at which a robot looks for the router."""
    guards: GuardSettings = GuardSettings()
    security: Security = "none"
    """mtls: every link is mutual TLS, and each certificate may say only what its owner may."""
    keys: Annotated[str, msgspec.Meta(min_length=1)] = "keys"
    """Folder of the keys that `cpcbl-team keys` makes, relative to the team file."""

    @property
    def secured(self) -> bool:
        return self.security == "mtls"

    @property
    def usual(self) -> tuple[str, ...]:
        """Where the router of this machine is looked for, unless the file says otherwise."""
        return ("tls/127.0.0.1:7447",) if self.secured else ("tcp/127.0.0.1:7447",)


class MatchSettings(Table, frozen=True, kw_only=True):
    """A limit for a whole match, as in RoboCup: 1,200 messages a team."""

    messages: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Fixes and beliefs of all robots; 0: no limit. Each robot gets its share beforehand."""
    duration_s: Positive = 1200.0
    """They are earned evenly over this time."""


class GuestSettings(Table, frozen=True, kw_only=True):
    """Robots that are not in the file but may join the team while it runs, such as observers."""

    allowed: bool = True
    most: Annotated[int, msgspec.Meta(ge=1, le=100)] = 8
    """So many at a time are let in by a robot, and by the simulated field."""


class SimulationEvent(Table, frozen=True, kw_only=True):
    """Something that befalls the simulated field: one of its kinds."""

    at_s: NotNegative
    """From the field's start."""
    kidnap: str = ""
    """The robot that is carried away; its wheels do not notice."""
    to: tuple[float, float, float] | None = None
    """Where it is put down: x m, y m, heading deg."""
    hide_landmarks_s: NotNegative = 0.0
    """For so long nobody sees a landmark or wall."""


class Light(Table, frozen=True, kw_only=True):
    """How the simulated field's cameras see it."""

    brightness: Positive = 1.0
    gradient: Annotated[float, msgspec.Meta(ge=-2.0, le=2.0)] = 0.2
    """By how much the left of a picture is brighter than its right, as a share of the middle."""
    tint: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    """Factors of blue, green and red."""
    blur_px: NotNegative = 0.6
    """Standard deviation."""
    noise: NotNegative = 3.0
    """Standard deviation, of 255 grey levels."""


class SimulationSettings(Table, frozen=True, kw_only=True):
    """The simulated field."""

    step_rate_hz: Positive = 50.0
    noise: NotNegative = 1.0
    """True noise as a multiple of what the robots assume; 0 for none."""
    bump_radius_m: NotNegative = 0.15
    light: Light = Light()
    events: tuple[SimulationEvent, ...] = ()
    clocks_ahead_s: dict[str, float] = {}
    """How far a robot's clock is ahead of the field's, where it is not the same: what the robot
    senses is stamped by its own clock."""


class Team(Table, frozen=True, kw_only=True):
    """A team file with its layers merged."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_.-]{1,32}$")]
    robots: dict[str, RobotSettings]
    map: Field = Field()
    vision: VisionSettings = VisionSettings()
    transport: TransportSettings = TransportSettings()
    match: MatchSettings = MatchSettings()
    simulation: SimulationSettings = SimulationSettings()
    guests: GuestSettings = GuestSettings()
    defaults: RobotSettings = RobotSettings()
    """The file's layer below its robots: what a guest begins with too."""
    calibrated_on: tuple[str, ...] = ()
    """Logs from which `calibrate` took the robots' types: no measure of their worth."""
    data: str = ""
    """Folder of the log, for robots whose source is `mrclam`."""

    @property
    def simulated(self) -> bool:
        """Whether the team needs a simulated field."""
        return any(robot.source == "simulated" for robot in self.robots.values())

    @property
    def cameras(self) -> tuple[str, ...]:
        """The robots that see by a camera."""
        return tuple(name for name, robot in self.robots.items() if robot.sensing == "camera")

    @property
    def renders(self) -> bool:
        """Whether the simulated field must make pictures."""
        return any(self.robots[name].source == "simulated" for name in self.cameras)

    def messages_per_s(self, robot: str) -> float | None:
        """The rate at which a robot earns its share of the match's messages; None: no limit."""
        if not self.match.messages:
            return None
        weights = {name: r.collaboration.budget.match_share for name, r in self.robots.items()}
        share = weights[robot] / (sum(weights.values()) or 1.0)
        return share * self.match.messages / self.match.duration_s
