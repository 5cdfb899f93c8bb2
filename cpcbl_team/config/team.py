"""A team: its robots and what they share."""

import math
from typing import Annotated, Literal

import msgspec

from cpcbl_team.config.camera import CameraSettings, Side, VisionSettings
from cpcbl_team.config.collaboration import CollaborationSettings
from cpcbl_team.config.field import (
    Bands,
    Field,
    Landmark,
    LandmarkPosition,
    SimulationSettings,
)
from cpcbl_team.config.localizer import LocalizerSettings
from cpcbl_team.config.recording import RecordingSettings
from cpcbl_team.config.ros2 import Ros2RobotSettings, Ros2Settings
from cpcbl_team.config.sensors import OdometrySettings, PositionSensor, SensorSettings
from cpcbl_team.config.table import NotNegative, Positive, Table
from cpcbl_team.inputs import Name

Security = Literal["none", "mtls"]
Source = Literal["simulated", "mrclam", "external"]
Sensing = Literal["sightings", "camera"]


class GuardSettings(Table, frozen=True, kw_only=True):
    """Limits in the router on what one robot sends, so that it cannot flood the others."""

    enabled: bool = True
    fix_rate_hz: Positive = 100.0
    """Of fixes for one teammate. The router drops a fix that follows the last one sooner than
    1 / rate, and messages come unevenly, so this must be at least twice the sensor's rate."""
    belief_rate_hz: Positive = 50.0
    """Of the beliefs of one robot, and of the places of landmarks that it tells."""
    largest_help_bytes: Annotated[int, msgspec.Meta(ge=1)] = 256
    """The largest payload of a fix or belief."""
    largest_bytes: Annotated[int, msgspec.Meta(ge=1)] = 65_536
    """The largest payload of any other message; robots refuse larger ones too."""
    largest_frame_bytes: Annotated[int, msgspec.Meta(ge=1)] = 1_048_576
    """The largest payload of a camera's image, plain or annotated."""
    frame_rate_hz: Positive = 120.0
    """Of images for one robot; at least twice the camera's rate."""
    tokens_per_s: Positive = 50.0
    """How often the liveliness tokens of a member may change. One with more is refused for 3 s."""
    sessions_per_member: Annotated[int, msgspec.Meta(ge=1)] = 64
    """With keys: the sessions of one certificate."""
    sessions_per_address: Annotated[int, msgspec.Meta(ge=1)] = 1000
    """Without keys: the sessions of one address."""


class TransportSettings(Table, frozen=True, kw_only=True):
    """The team's Zenoh router."""

    listen: tuple[str, ...] = ()
    """The endpoints at which `up` opens its router; default: a free port of 127.0.0.1."""
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """The endpoints at which a robot looks for the router."""
    guards: GuardSettings = GuardSettings()
    security: Security = "none"
    """mtls: every link is mutual TLS, and a certificate permits only what its owner may do."""
    keys: Annotated[str, msgspec.Meta(min_length=1)] = "keys"
    """The folder of the keys that `cpcbl-team keys` makes, relative to the team file."""

    @property
    def secured(self) -> bool:
        return self.security == "mtls"

    @property
    def usual(self) -> tuple[str, ...]:
        """The endpoints of this machine's router, unless the file names others."""
        return ("tls/127.0.0.1:7447",) if self.secured else ("tcp/127.0.0.1:7447",)


class GatewaySettings(Table, frozen=True, kw_only=True):
    """The door for drivers and consumers without Zenoh: JSON over HTTP and WebSocket."""

    host: Annotated[str, msgspec.Meta(min_length=1)] = "127.0.0.1"
    """The address at which it listens; 0.0.0.0 for all of this machine."""
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 8447
    tokens: Annotated[str, msgspec.Meta(min_length=1)] = "gateway-tokens.json"
    """The file of the robots' tokens, relative to the team file; it is made where it is absent."""
    rate_hz: Annotated[float, msgspec.Meta(ge=1.0)] = 250.0
    """The most messages a second for one robot."""
    clients: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 64
    """The most connections at a time."""


class StartModel(msgspec.Struct, frozen=True, kw_only=True):
    """The stated pose at the start, in the field's frame. The simulated field draws the true one
    around it. It is a model as those of `sensors` are."""

    x_m: float
    y_m: float
    heading_deg: float = 0.0
    sigma_m: NotNegative = 0.05
    heading_sigma_deg: NotNegative = 3.0


class Start(StartModel, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The start of a robot. A robot without one searches for its pose."""

    known: bool = True
    """False: only the simulated field knows it, and the robot searches for its pose."""


class LocalizationSettings(Table, frozen=True, kw_only=True):
    """The settings that the filter of one robot needs."""

    localizer: LocalizerSettings = LocalizerSettings()
    sensor: SensorSettings = SensorSettings()
    position_sensor: PositionSensor | None = None
    odometry: OdometrySettings = OdometrySettings()
    collaboration: CollaborationSettings = CollaborationSettings()
    start: Start | None = None

    @property
    def turned_variance(self) -> float:
        """The variance (rad^2) of the sensor's direction where the filter cannot estimate it beside
        the pose; 0 where it does or learns it, and where uncertainties are the paper's."""
        rules = self.localizer
        is_estimated, is_weighted = rules.estimates_whole_pose, rules.variant == "weighted"
        if is_estimated or rules.learns or rules.paper_uncertainty or is_weighted:
            return 0.0
        return math.radians(self.sensor.bearing_bias_sigma_deg) ** 2


class RobotSettings(LocalizationSettings, frozen=True, kw_only=True):
    """One robot of a team: the keys of its type and its own, over the team's defaults."""

    source: Source = "simulated"
    sensing: Sensing = "sightings"
    """camera: the robot finds its sightings in images; otherwise they come as messages."""
    camera: CameraSettings = CameraSettings()
    markers: dict[Side, int] = msgspec.field(default_factory=dict)
    """The markers that it carries, by which teammates' cameras recognise it."""
    colours: Bands | None = None
    """Colour bands on a mast: they are visible from farther away, but without the heading."""
    waypoints_m: tuple[tuple[float, float], ...] = ()
    """Simulated robots drive loops through these points, and steer by their own estimates."""
    speed_m_s: NotNegative = 0.5
    pose_rate_hz: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 10.0
    """How often the robot publishes its pose (`pose/<robot>`) while somebody subscribes to it."""
    known_landmarks: dict[str, LandmarkPosition] = msgspec.field(default_factory=dict)
    """Where landmarks of `map.unsurveyed` stand, as this robot alone knows from the start."""
    ros2: Ros2RobotSettings = Ros2RobotSettings()
    """Its topics and frames in ROS 2, for a team with the table `ros2`."""


class MatchSettings(Table, frozen=True, kw_only=True):
    """A limit for a whole match, as in RoboCup: 1,200 messages a team."""

    messages: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Fixes and beliefs of all robots; 0: no limit. Each robot gets its share beforehand."""
    duration_s: Positive = 1200.0
    """The messages are earned evenly over this time."""


class GuestSettings(Table, frozen=True, kw_only=True):
    """Robots that are not in the file but may join the team while it runs, such as observers."""

    allowed: bool = True
    most: Annotated[int, msgspec.Meta(ge=1, le=100)] = 8
    """A robot, and the simulated field, accept this many at a time."""


class Team(Table, frozen=True, kw_only=True):
    """A team file with its layers merged."""

    name: Name
    robots: dict[str, RobotSettings]
    map: Field = Field()
    vision: VisionSettings = VisionSettings()
    transport: TransportSettings = TransportSettings()
    gateway: GatewaySettings | None = None
    """With this table `up` also starts the gateway."""
    ros2: Ros2Settings | None = None
    """With this table `up` and `robot` also start the bridge to ROS 2."""
    recording: RecordingSettings = RecordingSettings()
    match: MatchSettings = MatchSettings()
    simulation: SimulationSettings = SimulationSettings()
    guests: GuestSettings = GuestSettings()
    defaults: RobotSettings = RobotSettings()
    """The settings of a robot that the file does not name, with which a guest begins."""
    calibrated_on: tuple[str, ...] = ()
    """The logs from which `calibrate` estimated the robots' types. Results on these logs do not
    show how good a calibration is."""
    data: str = ""
    """The folder of the log, for robots whose source is `mrclam`."""

    @property
    def simulated(self) -> bool:
        """Whether the team needs a simulated field."""
        return any(robot.source == "simulated" for robot in self.robots.values())

    @property
    def real(self) -> tuple[str, ...]:
        """The robots with drivers of their own, and clocks that run as all others."""
        return tuple(name for name, robot in self.robots.items() if robot.source == "external")

    @property
    def cameras(self) -> tuple[str, ...]:
        """The robots that find their sightings in images."""
        return tuple(name for name, robot in self.robots.items() if robot.sensing == "camera")

    @property
    def renders(self) -> bool:
        """Whether the simulated field must render images."""
        return any(self.robots[name].source == "simulated" for name in self.cameras)

    def map_of(self, robot: str) -> Field:
        """The map as this robot knows it from the start."""
        known = self.robots[robot].known_landmarks
        if not known:
            return self.map
        unsurveyed = dict(self.map.unsurveyed)
        landmarks = dict(self.map.landmarks)
        for name, place in known.items():
            mark = unsurveyed.pop(name)
            position = msgspec.structs.asdict(place)
            landmarks[name] = Landmark(gives=mark.gives, colours=mark.colours, **position)
        return msgspec.structs.replace(self.map, landmarks=landmarks, unsurveyed=unsurveyed)

    def messages_per_s(self, robot: str) -> float | None:
        """The rate at which a robot earns its share of the match's messages; None: no limit."""
        if not self.match.messages:
            return None
        weights = {name: r.collaboration.budget.match_share for name, r in self.robots.items()}
        share = weights[robot] / (sum(weights.values()) or 1.0)
        return share * self.match.messages / self.match.duration_s
