"""The messages between the agents of one robot.

An agent is an object with `handle(message, now_ns) -> messages`. It knows neither bus nor clock, so
the same object runs live, in one process with others, and in replay.
"""

from typing import NamedTuple

from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.estimate import Estimate
from cpcbl_team.frames import FIELD
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import BeliefShared, InputsMended, LandmarkBelief, Sightings
from cpcbl_transport.messages import Help, Message


class Tick(NamedTuple):
    """Time has passed."""


class PoseEstimate(NamedTuple):
    """The filter's regular report: its estimate at a time."""

    stamp_ns: int
    estimate: Estimate
    lost: str  # why the robot is lost; empty while it is not
    speed_m_s: float
    turn_rate_rad_s: float


class FrameEstimate(NamedTuple):
    """The filter's estimate at the time of a frame; fixes are made of both. The frame's bearings
    are corrected by the bias that the robot knows, as the estimate is."""

    frame: Sightings
    estimate: Estimate
    lost: str
    sensor_factor: float = 1.0  # the sensor's variances are so many times those of the settings
    common: CommonErrors | None = None  # what may be left of the camera's constant errors


class LandmarkPlaces(NamedTuple):
    """The places of landmarks that are not on the team's map: as the robot itself found them or
    knew them before, and as teammates have said. They are in the robot's frame, or in a better
    one."""

    places: tuple[LandmarkBelief, ...]
    frame: str = FIELD


class FrameChanged(NamedTuple):
    """The robot's poses are in another frame from now on."""

    frame: str
    new_from_old: Pose2 | None  # None where the robot did not know its pose in the old one


class Presence(NamedTuple):
    """The tier that a teammate's liveliness token announces; None when the teammate is gone."""

    robot: str
    tier: int | None
    frame: str = FIELD  # in which its tier is


class TeammateFrame(NamedTuple):
    """The frame in which a teammate is; None when the teammate is gone."""

    robot: str
    frame: str | None


class UnknownRobot(NamedTuple):
    """A fix or belief came from a robot that is neither in the team file nor known as a guest."""

    robot: str


class BeliefSubscribers(NamedTuple):
    """Whether any teammate subscribes to this robot's beliefs at present."""

    present: bool


class LandmarkSubscribers(NamedTuple):
    """The landmarks whose places, as this robot knows them, a teammate wants to know."""

    landmarks: frozenset[str]


class FrameSubscribers(NamedTuple):
    """Whether anybody subscribes to this robot's annotated frames at present."""

    present: bool


class HelpSent(NamedTuple):
    """Help was passed to the bus; `size` is its bytes on the link, 0 if it was not sent because
    nobody subscribes."""

    message: Help
    size: int


BusEvent = (
    Presence
    | TeammateFrame
    | UnknownRobot
    | BeliefSubscribers
    | LandmarkSubscribers
    | FrameSubscribers
    | HelpSent
)
AgentMessage = (
    Message
    | Tick
    | PoseEstimate
    | FrameEstimate
    | LandmarkPlaces
    | FrameChanged
    | BeliefShared
    | InputsMended
    | BusEvent
)
