"""Quality of service of ROS 2, and the two texts in which Zenoh's tokens carry it.

Sources: rmw/types.h (the numbers), rmw_zenoh's liveliness_utils.cpp and qos.cpp (its text and its
defaults), and zenoh-plugin-ros2dds' liveliness_mgt.rs.
"""

from enum import IntEnum

import msgspec

S_NS = 1_000_000_000
INFINITE_NS = 2**63 - 1
"""RMW_DURATION_INFINITE: 9223372036 s and 854775807 ns."""
DEFAULT_DEPTH = 42
"""What rmw_zenoh takes where a profile names no depth."""


class Reliability(IntEnum):
    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class Durability(IntEnum):
    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class History(IntEnum):
    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2
    UNKNOWN = 3


class Liveliness(IntEnum):
    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_NODE = 2
    MANUAL_BY_TOPIC = 3
    UNKNOWN = 4
    BEST_AVAILABLE = 5


class QosProfile(msgspec.Struct, frozen=True, kw_only=True):
    """A profile of ROS 2; as it stands here it is the default of rclcpp and rclpy, of depth 10."""

    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE
    history: History = History.KEEP_LAST
    depth: int = 10
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: Liveliness = Liveliness.AUTOMATIC
    lease_ns: int = INFINITE_NS

    @property
    def transient_local(self) -> bool:
        """Whether late subscribers get the last messages that were published before."""
        return self.durability is Durability.TRANSIENT_LOCAL

    @property
    def reliable(self) -> bool:
        return self.reliability is not Reliability.BEST_EFFORT


DEFAULT = QosProfile()
SENSOR_DATA = QosProfile(reliability=Reliability.BEST_EFFORT, depth=5)
"""What a subscription should ask for: publishers of either reliability match it."""
LATCHED = QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1)
"""For /tf_static and maps: whoever comes late gets the last message."""
STATIC_TRANSFORMS = QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=100)
"""Of a subscription to /tf_static: as tf2 has it."""

_RMW_ZENOH_DEFAULT = QosProfile(depth=DEFAULT_DEPTH)


def format_rmw_zenoh(qos: QosProfile) -> str:
    """The last part of a token of rmw_zenoh; empty fields are its defaults. The default profile of
    depth 10 is `::,10:,:,:,,`."""
    default = _RMW_ZENOH_DEFAULT
    return ":".join(
        (
            _unless(qos.reliability, default.reliability),
            _unless(qos.durability, default.durability),
            f"{_unless(qos.history, default.history)},{_unless(qos.depth, default.depth)}",
            _format_duration(qos.deadline_ns),
            _format_duration(qos.lifespan_ns),
            f"{_unless(qos.liveliness, default.liveliness)},{_format_duration(qos.lease_ns)}",
        )
    )


def parse_rmw_zenoh(text: str) -> QosProfile | None:
    """The profile in the last part of a token of rmw_zenoh; None if it is none."""
    parts = [part.split(",") for part in text.split(":")]
    if [len(part) for part in parts] != [1, 1, 2, 2, 2, 3]:
        return None
    (reliability,), (durability,), (history, depth), deadline, lifespan, (kind, *lease) = parts
    default = _RMW_ZENOH_DEFAULT
    try:
        return QosProfile(
            reliability=Reliability(_number(reliability, default.reliability)),
            durability=Durability(_number(durability, default.durability)),
            history=History(_number(history, default.history)),
            depth=_number(depth, default.depth),
            deadline_ns=_parse_duration(deadline),
            lifespan_ns=_parse_duration(lifespan),
            liveliness=Liveliness(_number(kind, default.liveliness)),
            lease_ns=_parse_duration(lease),
        )
    except ValueError:
        return None


# The numbers of CycloneDDS, in which the bridge writes: another order than that of ROS 2
_DDS_RELIABILITY = {0: Reliability.BEST_EFFORT, 1: Reliability.RELIABLE}
_DDS_DURABILITY = dict(enumerate([Durability.VOLATILE, *[Durability.TRANSIENT_LOCAL] * 3]))
_DDS_HISTORY = {0: History.KEEP_LAST, 1: History.KEEP_ALL}
_HASH_KEY = "typehash="


def format_ros2dds(qos: QosProfile, type_hash: str = "") -> str:
    """The last part of a token of zenoh-bridge-ros2dds, for a type without keys. With a type hash
    (ROS 2 from Iron on) it is the user data of the DDS endpoint: `:1:0:0,10:typehash=RIHS01_...;`.
    """
    keep_all = qos.history is History.KEEP_ALL
    user_data = f":{_HASH_KEY}{type_hash};" if type_hash.startswith("RIHS") else ""
    return f":{int(qos.reliable)}:{int(qos.transient_local)}:{int(keep_all)},{qos.depth}{user_data}"


def parse_ros2dds(text: str) -> tuple[QosProfile, str] | None:
    """The profile and the type hash (or an empty text) in the last part of a token of
    zenoh-bridge-ros2dds; None if it is none. What is absent is DDS's default."""
    keyless, *rest = text.split(":", 4)
    if keyless not in ("", "K") or len(rest) < 3:
        return None
    reliability, durability, history = rest[:3]
    kind, comma, depth = history.partition(",")
    try:
        if history and not comma:
            return None
        qos = QosProfile(
            reliability=_DDS_RELIABILITY[_number(reliability, 0)],
            durability=_DDS_DURABILITY[_number(durability, 0)],
            history=_DDS_HISTORY[_number(kind, 0)],
            depth=_number(depth, 1, least=-1),
        )
    except (ValueError, KeyError):
        return None
    fields = "".join(rest[3:]).split(";")
    found = (field[len(_HASH_KEY) :] for field in fields if field.startswith(_HASH_KEY))
    return qos, next(found, "")


def incompatible_policies(offered: QosProfile, requested: QosProfile) -> list[str]:
    """The policies of DDS by which a subscription that requests this gets nothing from a publisher
    that offers that: `reliability`, `durability`. Unknown policies are none."""
    policies = []
    if (
        offered.reliability is Reliability.BEST_EFFORT
        and requested.reliability is Reliability.RELIABLE
    ):
        policies.append("reliability")
    if (
        offered.durability is Durability.VOLATILE
        and requested.durability is Durability.TRANSIENT_LOCAL
    ):
        policies.append("durability")
    return policies


def _unless(value: int, default: int) -> str:
    return "" if value == default else str(int(value))


def _format_duration(duration_ns: int) -> str:
    s, ns = divmod(duration_ns, S_NS)
    default_s, default_ns = divmod(INFINITE_NS, S_NS)
    return f"{_unless(s, default_s)},{_unless(ns, default_ns)}"


def _parse_duration(parts: list[str]) -> int:
    default_s, default_ns = divmod(INFINITE_NS, S_NS)
    return _number(parts[0], default_s) * S_NS + _number(parts[1], default_ns)


def _number(text: str, default: int, least: int = 0) -> int:
    """Raises ValueError for what is no number of at most 20 digits."""
    if not text:
        return int(default)
    if len(text) > 20 or not text.isascii():
        raise ValueError(text[:20])
    number = int(text)
    if number < least or text.strip("-0123456789"):
        raise ValueError(text)
    return number
