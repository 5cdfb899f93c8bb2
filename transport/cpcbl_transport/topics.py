"""The table of topics: every key, what it carries, how often, with which quality of service.

Every key begins with the `namespace` of its team. The publisher's tier is part of the key, and a
robot subscribes only to better tiers than its own, so Zenoh drops at the sender what would flow to
a better robot. The table also says who may publish and who may subscribe; a secured router enforces
that (`security`). This module does not know the bus.
"""

import re
from enum import Enum, StrEnum
from functools import lru_cache
from typing import NamedTuple

from cpcbl_team.inputs import (
    Belief,
    Fix,
    InitialPose,
    LandmarkBelief,
    Odometry,
    Position,
    Sightings,
)
from cpcbl_transport import messages
from cpcbl_transport.messages import LARGEST_FRAME, LARGEST_PAYLOAD, Message

JSON_CHUNK = "/json"
IN_FRAME_MARK = "~"  # in the chunk of a tier, before the name of the frame that it is in
ANY_TIER = "any"  # in its place: for robots that are in worse frames, to which all tiers are better


class QosProfile(NamedTuple):
    """How the bus transports a message."""

    priority: str  # before or after the other messages that wait for the same link
    when_full: str  # what a put does when the link's queue is full: DROP or BLOCK
    reliable: bool  # on links that can lose messages


class Qos(Enum):
    """The profiles in use, highest priority first; the table gives the reason of each choice.

    DATA is Zenoh's default: a message of another priority, or one that blocks, costs 2 to 4 bytes
    more. So messages between robots are DATA, and everything else has a priority around it. Nothing
    is express (sent at once, without waiting for other messages of the same batch): it costs 2
    bytes more and is no faster, for batches form only where a link is busy, and on a busy processor
    messages were lost.
    """

    COMMAND = QosProfile("INTERACTIVE_HIGH", "BLOCK", reliable=True)
    FRESH = QosProfile("DATA", "DROP", reliable=False)
    INPUT = QosProfile("DATA_LOW", "BLOCK", reliable=True)
    FRAME = QosProfile("DATA_LOW", "DROP", reliable=False)
    TELEMETRY = QosProfile("BACKGROUND", "DROP", reliable=False)


class Role(StrEnum):
    """What a member of a team is, as its certificate says."""

    ROBOT = "robot"
    OBSERVER = "observer"  # helps a running team as a guest
    FIELD = "field"  # the simulated one
    OPERATOR = "operator"  # people: live tables, recordings
    GATEWAY = "gateway"  # speaks for drivers and consumers that have no Zenoh
    BRIDGE = "bridge"  # speaks for robots that run ROS 2
    ROUTER = "router"  # relays the messages of all others


class Permission(NamedTuple):
    """Members of this role may publish, or subscribe to, a topic."""

    role: Role
    own: str = ""
    """The placeholder of the key that must be the member's own name; empty: any name is allowed."""


_MEMBERS = Permission(Role.ROBOT), Permission(Role.OBSERVER)
_OWNER = Permission(Role.ROBOT, "robot"), Permission(Role.OBSERVER, "robot")
_OBSERVER = Permission(Role.ROBOT, "observer"), Permission(Role.OBSERVER, "observer")
_GUEST = (Permission(Role.OBSERVER, "robot"),)
_FIELD = (Permission(Role.FIELD),)
_BRIDGE = (Permission(Role.BRIDGE),)
_GATEWAY = (Permission(Role.GATEWAY), *_BRIDGE)
_READERS = (*_MEMBERS, *_GATEWAY)
_SENSING = (*_OWNER, *_FIELD, *_GATEWAY)  # the robot's own driver, or the simulated field


class Topic(NamedTuple):
    """One row of the table."""

    key: str  # `at` fills in each <placeholder>, or `*` for a subscription
    carries: type[Message] | None  # None: the key of a liveliness token
    qos: Qos
    publishers: tuple[Permission, ...] = _OWNER  # where names are certified
    subscribers: tuple[Permission, ...] = _OWNER  # and operators, who may subscribe to everything
    largest: int = LARGEST_PAYLOAD  # a larger payload is refused unread (bytes)
    also_json: bool = False  # whoever wants JSON subscribes to `json_key`

    def at(self, **names: object) -> str:
        """The key with these names; `*` for each that is left out."""
        return _fill(self.key, **names)

    def keys(self, **names: object) -> tuple[str, ...]:
        """All keys with these names: that of `at`, and the one under which it is sent as JSON."""
        key = self.at(**names)
        return (key, json_key(key)) if self.also_json else (key,)

    def names(self, key: str) -> dict[str, str] | None:
        """The names in a key of this topic, None for any other key: the inverse of `at`."""
        found = _pattern(self.key).fullmatch(key)
        return found.groupdict() if found else None


def json_key(key: str) -> str:
    """The key under which the messages of another key are sent as JSON."""
    return key + JSON_CHUNK


def tier_chunk(tier: int | str, frame: str) -> str:
    """The tier of a key, with the frame in which it is; that of the field has no name."""
    return f"{tier}{IN_FRAME_MARK}{frame}" if frame else str(tier)


def tier_and_frame(chunk: str) -> tuple[str, str]:
    """The inverse of `tier_chunk`."""
    tier, _, frame = chunk.partition(IN_FRAME_MARK)
    return tier, frame


@lru_cache(maxsize=4096)
def tier_and_frame_of(key: str) -> tuple[str, str]:
    """The tier and the frame in a key of help; empty for any other key."""
    found = (topic.names(key) for topic in (BELIEF, FIX, LANDMARK))
    names = next(filter(None, found), None)
    return ("", "") if names is None else tier_and_frame(names["tier"])


def is_json_key(key: str) -> bool:
    """Whether messages under this key are JSON."""
    return key.endswith(JSON_CHUNK)


@lru_cache(maxsize=4096)
def _fill(template: str, /, **names: object) -> str:
    """The key of a template; a robot asks for few keys, but at every step."""
    return re.sub(r"<(\w+)>", lambda found: str(names.get(found[1], "*")), template)


@lru_cache
def _pattern(template: str) -> re.Pattern[str]:
    return re.compile(re.sub(r"<(\w+)>", r"(?P<\1>[^/]*)", template))


def namespace(team: str) -> str:
    """The first chunks of all keys of a team."""
    return f"cpcbl/{team}"


# THE table. Above each row: how often it is sent, and the reason of its quality of service.

# At a change of tier. A liveliness token: the bus reports when it appears and disappears; it shows
# presence, not health
ALIVE = Topic("alive/<tier>/<robot>/<incarnation>", None, Qos.COMMAND, subscribers=_MEMBERS)
# At a change of frame, in a team whose frame is agreed: so teammates know in which frames help may
# come, and whose. A liveliness token
FRAME = Topic("frame/<frame>/<robot>/<incarnation>", None, Qos.COMMAND, subscribers=_MEMBERS)
# Twice in the life of a process: at its start (still), and when its robot has moved (moved). A
# liveliness token, which the router repeats as long as it lives: a robot that is started again
# after it has moved is not at its start
RAN = Topic("ran/<robot>/<how>/<incarnation>", None, Qos.COMMAND)
# 5 Hz while a worse robot subscribes. The next one is better than a late one
BELIEF = Topic("belief/<tier>/<robot>", Belief, Qos.FRESH, subscribers=_MEMBERS)
# Each sighting of a worse robot that subscribes. The next one is better than a late one
FIX = Topic("fix/<robot>/<tier>/<observer>", Fix, Qos.FRESH, publishers=_OBSERVER)
# 1 Hz while a robot subscribes that sees the landmark and knows its place worse: once it has taken
# the place it subscribes to better tiers alone. The next one is as good as a late one
LANDMARK = Topic(
    "landmark/<landmark>/<tier>/<robot>", LandmarkBelief, Qos.FRESH, subscribers=_MEMBERS
)
# 1 Hz. For people; it must never delay a fix
STATUS = Topic(
    "status/<robot>",
    messages.Status,
    Qos.TELEMETRY,
    subscribers=(*_OWNER, *_BRIDGE),
    also_json=True,
)
# 10 Hz while somebody records. For reports; it costs nothing without a subscriber
TRACK = Topic("track/<robot>", messages.Track, Qos.TELEMETRY)
# `pose_rate_hz` (10 Hz) while somebody subscribes. For the robot's own software, and for everybody
# in the team; the next one is better than a late one
POSE = Topic("pose/<robot>", messages.Pose, Qos.TELEMETRY, subscribers=_READERS, also_json=True)
# At the driver's rate, binary or JSON. Inputs are not dropped: a lost piece of odometry is a lost
# piece of the way
IN_ODOMETRY = Topic("in/<robot>/odometry", Odometry, Qos.INPUT, publishers=_SENSING)
IN_SIGHTINGS = Topic("in/<robot>/sightings", Sightings, Qos.INPUT, publishers=_SENSING)
IN_POSITION = Topic("in/<robot>/position", Position, Qos.INPUT, publishers=_SENSING)
# Whenever somebody sets the pose of a robot. It must arrive: the person sees whether it has
IN_INITIAL_POSE = Topic("in/<robot>/initial_pose", InitialPose, Qos.INPUT, publishers=_SENSING)
# At the camera's rate. The next frame is better than a late one
IN_FRAME = Topic(
    "in/<robot>/frame", messages.Frame, Qos.FRAME, publishers=_SENSING, largest=LARGEST_FRAME
)
# 2 Hz while somebody subscribes. For people; it costs nothing without a subscriber
LOOK = Topic("look/<robot>", messages.AnnotatedFrame, Qos.TELEMETRY, largest=LARGEST_FRAME)
# 10 Hz, simulation only. A late command is a collision
DRIVE = Topic("field/drive/<robot>", messages.Drive, Qos.COMMAND, subscribers=_FIELD)
# 2 Hz of a guest, simulation only. Without it the field removes the guest; a restarted field needs
# it again
JOIN = Topic(
    "field/join/<robot>", messages.Join, Qos.COMMAND, publishers=_GUEST, subscribers=_FIELD
)
# Every step, simulation only. For reports only
TRUTH = Topic("field/truth", messages.Truths, Qos.TELEMETRY, publishers=_FIELD, subscribers=())

TOPICS = (
    *(ALIVE, FRAME, RAN, BELIEF, FIX, LANDMARK, STATUS, TRACK, POSE),
    *(IN_ODOMETRY, IN_SIGHTINGS, IN_POSITION, IN_INITIAL_POSE, IN_FRAME, LOOK),
    *(DRIVE, JOIN, TRUTH),
)
INPUTS = (IN_ODOMETRY, IN_SIGHTINGS, IN_POSITION, IN_INITIAL_POSE, IN_FRAME)
"""The last part of each key is the tag of its message."""
COLLABORATION = (Belief, Fix, LandmarkBelief)
_BY_TYPE: dict[type[object], Topic] = {
    topic.carries: topic for topic in TOPICS if topic.carries is not None
}


def topic_of(kind: type[object]) -> Topic:
    """The one topic that carries messages of this type."""
    return _BY_TYPE[kind]
