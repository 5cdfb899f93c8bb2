"""The table of topics: every key, what it carries, how often, with which quality of service.

Every key begins with the `namespace` of its team. The publisher's tier is part of the key, and a
robot subscribes only to better tiers than its own, so Zenoh drops at the sender what would flow to
a better robot. The table also says who may publish and who may subscribe; a secured router enforces
that (`security`). This module does not know the bus.
"""

from enum import Enum, StrEnum
from functools import lru_cache
from typing import NamedTuple

from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sightings
from cpcbl_transport.messages import (
    LARGEST_FRAME,
    LARGEST_PAYLOAD,
    AnnotatedFrame,
    Drive,
    Frame,
    Join,
    Message,
    Status,
    Track,
    Truths,
)


class QosProfile(NamedTuple):
    """How the bus transports a message."""

    priority: str  # before or after the other messages that wait for the same link
    when_full: str  # what a put does when the link's queue is full: DROP or BLOCK
    reliable: bool  # on links that can lose messages
    express: bool  # sent at once, without waiting for other messages of the same batch


class Qos(Enum):
    """The profiles in use, highest priority first; each row of the table has the reason.

    DATA is Zenoh's default: a message of another priority, or one that blocks, costs 2 to 4 bytes
    more. So messages between robots are DATA, and everything else has a priority around it. Nothing
    is express: it costs 2 bytes more and is no faster (batches form only where a link is busy), and
    on a busy processor messages were lost.
    """

    COMMAND = QosProfile("INTERACTIVE_HIGH", "BLOCK", reliable=True, express=False)
    FRESH = QosProfile("DATA", "DROP", reliable=False, express=False)
    INPUT = QosProfile("DATA_LOW", "BLOCK", reliable=True, express=False)
    FRAME = QosProfile("DATA_LOW", "DROP", reliable=False, express=False)
    TELEMETRY = QosProfile("BACKGROUND", "DROP", reliable=False, express=False)


class Role(StrEnum):
    """What a member of a team is, as its certificate says."""

    ROBOT = "robot"
    OBSERVER = "observer"  # helps a running team as a guest
    FIELD = "field"  # the simulated one
    OPERATOR = "operator"  # people: live tables, recordings
    ROUTER = "router"  # relays the messages of all others


class Permission(NamedTuple):
    """Members of this role may publish, or subscribe to, a topic."""

    role: Role
    own: str = ""
    """The placeholder of the key that must be the member's own name; empty: any name is allowed."""


def _robots_and_observers(own: str = "") -> tuple[Permission, ...]:
    return Permission(Role.ROBOT, own), Permission(Role.OBSERVER, own)


class Topic(NamedTuple):
    """One row of the table."""

    key: str  # `at` fills in each <placeholder>, or `*` for a subscription
    carries: type[Message] | None  # None: the key of a liveliness token
    rate: str
    qos: Qos
    reason: str
    publishers: tuple[Permission, ...] = ()  # where names are certified
    subscribers: tuple[Permission, ...] = ()  # besides operators, who may subscribe to everything
    largest: int = LARGEST_PAYLOAD  # a larger payload is refused unread (bytes)

    def at(self, **names: object) -> str:
        """The key with these names; `*` for each that is left out."""
        return _filled(self.key, tuple(names.items()))

    def names(self, key: str) -> dict[str, str] | None:
        """The names in a key of this topic, None for any other key: the inverse of `at`."""
        template, chunks = self.key.split("/"), key.split("/")
        if len(template) != len(chunks):
            return None
        pairs = list(zip(template, chunks, strict=True))
        if any(own != chunk for own, chunk in pairs if not own.startswith("<")):
            return None
        return {own.strip("<>"): chunk for own, chunk in pairs if own.startswith("<")}


@lru_cache(maxsize=4096)
def _filled(template: str, names: tuple[tuple[str, object], ...]) -> str:
    """The key of a template; a robot asks for few keys, but at every step."""
    by_name = dict(names)
    chunks = []
    for chunk in template.split("/"):
        name = chunk.strip("<>")
        chunks.append(str(by_name.get(name, "*")) if chunk.startswith("<") else chunk)
    return "/".join(chunks)


def namespace(team: str) -> str:
    """The first chunks of all keys of a team."""
    return f"cpcbl/{team}"


ALIVE = Topic(
    "alive/<tier>/<robot>/<incarnation>",
    None,
    "at a change of tier",
    Qos.COMMAND,
    "a liveliness token: the bus reports when it appears and disappears; presence, not health",
    publishers=_robots_and_observers("robot"),
    subscribers=_robots_and_observers(),
)
BELIEF = Topic(
    "belief/<tier>/<robot>",
    Belief,
    "5 Hz while a worse robot subscribes",
    Qos.FRESH,
    "the next one is better than a late one",
    publishers=_robots_and_observers("robot"),
    subscribers=_robots_and_observers(),
)
FIX = Topic(
    "fix/<robot>/<tier>/<observer>",
    Fix,
    "each sighting of a worse robot that subscribes",
    Qos.FRESH,
    "the next one is better than a late one",
    publishers=_robots_and_observers("observer"),
    subscribers=_robots_and_observers("robot"),
)
STATUS = Topic(
    "status/<robot>",
    Status,
    "1 Hz",
    Qos.TELEMETRY,
    "for people; must never delay a fix",
    publishers=_robots_and_observers("robot"),
    subscribers=_robots_and_observers("robot"),
)
TRACK = Topic(
    "track/<robot>",
    Track,
    "10 Hz while somebody records",
    Qos.TELEMETRY,
    "for reports; costs nothing without a subscriber",
    publishers=_robots_and_observers("robot"),
    subscribers=_robots_and_observers("robot"),
)
_SENSING = (
    *_robots_and_observers("robot"),
    Permission(Role.FIELD),
)  # its own driver, or the simulated field
IN_ODOMETRY = Topic(
    "in/<robot>/odometry",
    Odometry,
    "the driver's",
    Qos.INPUT,
    "a lost piece of odometry is a lost piece of the way",
    publishers=_SENSING,
    subscribers=_robots_and_observers("robot"),
)
IN_SIGHTINGS = Topic(
    "in/<robot>/sightings",
    Sightings,
    "the driver's",
    Qos.INPUT,
    "inputs are not dropped",
    publishers=_SENSING,
    subscribers=_robots_and_observers("robot"),
)
IN_POSITION = Topic(
    "in/<robot>/position",
    Position,
    "the driver's",
    Qos.INPUT,
    "inputs are not dropped",
    publishers=_SENSING,
    subscribers=_robots_and_observers("robot"),
)
IN_FRAME = Topic(
    "in/<robot>/frame",
    Frame,
    "the camera's",
    Qos.FRAME,
    "the next frame is better than a late one",
    publishers=_SENSING,
    subscribers=_robots_and_observers("robot"),
    largest=LARGEST_FRAME,
)
LOOK = Topic(
    "look/<robot>",
    AnnotatedFrame,
    "2 Hz while somebody subscribes",
    Qos.TELEMETRY,
    "for people; costs nothing without a subscriber",
    publishers=_robots_and_observers("robot"),
    subscribers=_robots_and_observers("robot"),
    largest=LARGEST_FRAME,
)
DRIVE = Topic(
    "field/drive/<robot>",
    Drive,
    "10 Hz, simulation only",
    Qos.COMMAND,
    "a late command is a collision",
    publishers=_robots_and_observers("robot"),
    subscribers=(Permission(Role.FIELD),),
)
JOIN = Topic(
    "field/join/<robot>",
    Join,
    "2 Hz of a guest, simulation only",
    Qos.COMMAND,
    "without it the field removes the guest; a restarted field needs it again",
    publishers=(Permission(Role.OBSERVER, "robot"),),
    subscribers=(Permission(Role.FIELD),),
)
TRUTH = Topic(
    "field/truth",
    Truths,
    "every step, simulation only",
    Qos.TELEMETRY,
    "for reports only",
    publishers=(Permission(Role.FIELD),),
)

TOPICS = (
    *(ALIVE, BELIEF, FIX, STATUS, TRACK),
    *(IN_ODOMETRY, IN_SIGHTINGS, IN_POSITION, IN_FRAME, LOOK),
    *(DRIVE, JOIN, TRUTH),
)
INPUTS = (IN_ODOMETRY, IN_SIGHTINGS, IN_POSITION, IN_FRAME)
COLLABORATION = (Belief, Fix)


def topic_of(kind: type[object]) -> Topic:
    """The one topic that carries messages of this type."""
    (topic,) = (topic for topic in TOPICS if topic.carries is kind)
    return topic
