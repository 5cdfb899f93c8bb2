"""THE table of topics: every key, what it carries, how often, with which quality of service.

A key stands below its team's `namespace`. The publisher's tier is part of the key and
a robot subscribes only to tiers better than its own, so that nothing flows uphill: Zenoh itself
drops it at the sender. Who may say and hear a topic are columns too; a secured router holds
everybody to them (`security`). This module does not know the bus.
"""

from enum import Enum, StrEnum
from typing import NamedTuple

from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sightings
from cpcbl_transport.messages import (
    LARGEST_FRAME,
    LARGEST_PAYLOAD,
    Drive,
    Frame,
    Join,
    Look,
    Message,
    Status,
    Track,
    Truths,
)


class Treatment(NamedTuple):
    """How the bus treats a message."""

    priority: str  # before or after what else waits for the same link
    when_full: str  # what a put does when the link's queue is full: DROP or BLOCK
    reliable: bool  # on links that can lose messages
    express: bool  # sent without waiting for others to share its batch


class Qos(Enum):
    """The ways to treat a topic. Highest priority first; its row of the table has the reason.

    DATA is what Zenoh assumes: a message of another priority, or that blocks, costs 2 to 4 bytes
    more. So what robots tell each other is DATA and everything else stands around it. Nothing is
    express: it costs 2 bytes more, is no faster (batches form only where a link is busy), and on a
    busy processor messages were lost.
    """

    COMMAND = Treatment("INTERACTIVE_HIGH", "BLOCK", reliable=True, express=False)
    FRESH = Treatment("DATA", "DROP", reliable=False, express=False)
    INPUT = Treatment("DATA_LOW", "BLOCK", reliable=True, express=False)
    FRAME = Treatment("DATA_LOW", "DROP", reliable=False, express=False)
    TELEMETRY = Treatment("BACKGROUND", "DROP", reliable=False, express=False)


class Role(StrEnum):
    """What a member of a team is, as its certificate says."""

    ROBOT = "robot"
    OBSERVER = "observer"  # helps a team while it runs, and is no part of it
    FIELD = "field"  # the simulated one
    OPERATOR = "operator"  # people: live tables, recordings
    ROUTER = "router"  # relays what all others say


class Who(NamedTuple):
    """Who may say, or hear, a topic."""

    role: Role
    own: str = ""
    """The <name> of the key that must be its own; empty: any will do."""


def _helpers(own: str = "") -> tuple[Who, ...]:
    """Robots and observers, each under its own name, or under any."""
    return Who(Role.ROBOT, own), Who(Role.OBSERVER, own)


class Topic(NamedTuple):
    """One row of the table."""

    key: str  # <name> is filled in by `at`, or by `*` for a subscription
    carries: type[Message] | None
    rate: str
    qos: Qos
    reason: str
    said_by: tuple[Who, ...] = ()  # where names are certified; nobody, unless stated
    heard_by: tuple[Who, ...] = ()  # besides operators, who hear everything
    largest: int = LARGEST_PAYLOAD  # payload that is read at all

    def at(self, **names: object) -> str:
        """The key with these names; `*` for each that is left out."""
        chunks = []
        for chunk in self.key.split("/"):
            name = chunk.strip("<>")
            chunks.append(str(names.get(name, "*")) if chunk.startswith("<") else chunk)
        return "/".join(chunks)

    def names(self, key: str) -> dict[str, str] | None:
        """The names in a key of this topic, None for any other key: the inverse of `at`."""
        mine, chunks = self.key.split("/"), key.split("/")
        if len(mine) != len(chunks):
            return None
        pairs = list(zip(mine, chunks, strict=True))
        if any(own != chunk for own, chunk in pairs if not own.startswith("<")):
            return None
        return {own.strip("<>"): chunk for own, chunk in pairs if own.startswith("<")}


def namespace(team: str) -> str:
    """What stands before all keys of a team, by its name."""
    return f"cpcbl/{team}"


ALIVE = Topic(
    "alive/<tier>/<robot>/<incarnation>",
    None,
    "at a change of tier",
    Qos.COMMAND,
    "a liveliness token: the bus tells when it comes and goes; presence, not health",
    said_by=_helpers("robot"),
    heard_by=_helpers(),
)
BELIEF = Topic(
    "belief/<tier>/<robot>",
    Belief,
    "5 Hz while a worse robot listens",
    Qos.FRESH,
    "the next one is better than a late one",
    said_by=_helpers("robot"),
    heard_by=_helpers(),
)
FIX = Topic(
    "fix/<robot>/<tier>/<observer>",
    Fix,
    "each sighting of a worse robot that listens",
    Qos.FRESH,
    "the next one is better than a late one",
    said_by=_helpers("observer"),
    heard_by=_helpers("robot"),
)
STATUS = Topic(
    "status/<robot>",
    Status,
    "1 Hz",
    Qos.TELEMETRY,
    "for people; must never delay a fix",
    said_by=_helpers("robot"),
    heard_by=_helpers("robot"),
)
TRACK = Topic(
    "track/<robot>",
    Track,
    "10 Hz while somebody records",
    Qos.TELEMETRY,
    "for reports; costs nothing when nobody listens",
    said_by=_helpers("robot"),
    heard_by=_helpers("robot"),
)
_SENSING = (*_helpers("robot"), Who(Role.FIELD))  # its own driver, or the simulated field
IN_ODOMETRY = Topic(
    "in/<robot>/odometry",
    Odometry,
    "the driver's",
    Qos.INPUT,
    "a lost piece of odometry is a lost piece of the way",
    said_by=_SENSING,
    heard_by=_helpers("robot"),
)
IN_SIGHTINGS = Topic(
    "in/<robot>/sightings",
    Sightings,
    "the driver's",
    Qos.INPUT,
    "inputs are not dropped",
    said_by=_SENSING,
    heard_by=_helpers("robot"),
)
IN_POSITION = Topic(
    "in/<robot>/position",
    Position,
    "the driver's",
    Qos.INPUT,
    "inputs are not dropped",
    said_by=_SENSING,
    heard_by=_helpers("robot"),
)
IN_FRAME = Topic(
    "in/<robot>/frame",
    Frame,
    "the camera's",
    Qos.FRAME,
    "the next frame is better than a late one",
    said_by=_SENSING,
    heard_by=_helpers("robot"),
    largest=LARGEST_FRAME,
)
LOOK = Topic(
    "look/<robot>",
    Look,
    "2 Hz while somebody looks",
    Qos.TELEMETRY,
    "for people; costs nothing when nobody looks",
    said_by=_helpers("robot"),
    heard_by=_helpers("robot"),
    largest=LARGEST_FRAME,
)
DRIVE = Topic(
    "field/drive/<robot>",
    Drive,
    "10 Hz, simulation only",
    Qos.COMMAND,
    "a late command is a collision",
    said_by=_helpers("robot"),
    heard_by=(Who(Role.FIELD),),
)
JOIN = Topic(
    "field/join/<robot>",
    Join,
    "2 Hz of a guest, simulation only",
    Qos.COMMAND,
    "without it the field takes the guest's body away; a field that restarts hears it again",
    said_by=(Who(Role.OBSERVER, "robot"),),
    heard_by=(Who(Role.FIELD),),
)
TRUTH = Topic(
    "field/truth",
    Truths,
    "every step, simulation only",
    Qos.TELEMETRY,
    "for reports only",
    said_by=(Who(Role.FIELD),),
)

TOPICS = (
    *(ALIVE, BELIEF, FIX, STATUS, TRACK),
    *(IN_ODOMETRY, IN_SIGHTINGS, IN_POSITION, IN_FRAME, LOOK),
    *(DRIVE, JOIN, TRUTH),
)
INPUTS = (IN_ODOMETRY, IN_SIGHTINGS, IN_POSITION, IN_FRAME)
COLLABORATION = (Belief, Fix)
