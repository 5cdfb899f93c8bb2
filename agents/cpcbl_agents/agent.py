"""What the agents of one robot say to each other.

An agent is an object with `handle(message, now_ns) -> messages`. It sees neither bus nor clock, so
the same object runs live, in one process with others, and in replay.
"""

from typing import NamedTuple

from cpcbl_team.estimate import Estimate
from cpcbl_team.inputs import Belief, Fix, Sightings, Told
from cpcbl_transport.messages import Message


class Tick(NamedTuple):
    """Time has passed."""


class Located(NamedTuple):
    """The filter's belief at a time. With `frame`: at the time of that frame, for fixes.

    Its bearings are without the bias that the robot has learned, as in the belief.
    """

    stamp_ns: int
    estimate: Estimate
    lost: str
    speed_m_s: float
    turn_rate_rad_s: float
    frame: Sightings | None = None


class Presence(NamedTuple):
    """The bus knows of a teammate: the tier that it announces; None when it is gone."""

    robot: str
    tier: int | None


class UnknownRobot(NamedTuple):
    """Help has come from somebody who is neither in the team file nor known as a guest."""

    robot: str


class BeliefSubscribers(NamedTuple):
    """Whether any teammate listens to this robot's beliefs at present."""

    present: bool


class FrameSubscribers(NamedTuple):
    """Whether anybody looks at what this robot's camera sees."""

    present: bool


class HelpSent(NamedTuple):
    """Help that has left this robot, and its bytes on the wire; 0: nobody listened, it has not."""

    message: Belief | Fix
    size: int


BusEvent = Presence | UnknownRobot | BeliefSubscribers | FrameSubscribers | HelpSent
AgentMessage = Message | Tick | Located | Told | BusEvent
