"""Messages of ROS 2: their classes, their type hashes, and their bytes (CDR).

The work is that of `rosbags`, which is imported late: it takes 0.2 s. A message is
a dataclass of rosbags with the fields of its definition; arrays of numbers are numpy arrays (which
may not be written to after decoding), other sequences are lists.

A decoded message has the right form, not necessarily plausible values: numbers may be NaN.
"""

import struct
from collections.abc import Mapping
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Any

from cpcbl_team.errors import DependencyError
from cpcbl_transport.ros2.definitions import APRILTAG_AND_VISION, new_message
from cpcbl_transport.ros2.names import NO_TYPE_HASH, Distribution, RosNameError, type_name

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

ODOMETRY = "nav_msgs/msg/Odometry"
APRIL_TAGS = "apriltag_msgs/msg/AprilTagDetectionArray"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
RANGE = "sensor_msgs/msg/Range"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
MARKERS = "visualization_msgs/msg/MarkerArray"

MESSAGE_TYPES = (
    *(ODOMETRY, APRIL_TAGS, CAMERA_INFO, IMAGE, COMPRESSED_IMAGE, RANGE, NAV_SAT_FIX, POSE),
    *(DETECTIONS, TRANSFORMS, DIAGNOSTICS, MARKERS),
)
"""The types that a bridge uses; every other one of the distribution can be used as well."""

LARGEST_BYTES = 1_000_000
LARGEST_IMAGE_BYTES = 64_000_000

Message = Any
"""A dataclass of rosbags."""


class PayloadRefusal(StrEnum):
    """Why a payload is no message."""

    TOO_LARGE = "too_large"
    NO_CDR = "no_cdr"  # its header is of another encoding
    CUT_SHORT = "cut_short"  # it ends before its type does, or a length in it is too great
    TOO_LONG = "too_long"  # it goes on after its type ends: of another definition
    BAD_TEXT = "bad_text"  # a text that is not UTF-8, or without its end
    UNKNOWN_HASH = "unknown_type_hash"
    NO_ATTACHMENT = "no_attachment"  # or one that is not rmw_zenoh's


class MessageTypes:
    """The messages of one distribution, and the other definitions that can be read."""

    def __init__(self, distribution: Distribution) -> None:
        """Raises DependencyError without the extra `ros2`."""
        self.distribution = distribution
        self._store = _store(_STORES[distribution])
        self._readers: dict[tuple[str, str], Typestore] = {}

    @property
    def classes(self) -> Mapping[str, Any]:
        """The class of each type: `classes["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=0.0)`."""
        return self._store.types

    def new(self, name: str, **fields: Any) -> Message:
        """A message of a type: these fields, and for all others zero or nothing (a quaternion is
        no rotation). Raises KeyError for a type that is not known, TypeError for a field."""
        message = new_message(self._store, name)
        for field, value in fields.items():
            if not hasattr(message, field):
                raise TypeError(f"{name} has no field {field!r}")
            setattr(message, field, value)
        return message

    def fields(self, name: str) -> list[tuple[str, Any]]:
        """The fields of a type and their description by rosbags (`rosbags.interfaces.Nodetype`)."""
        return list(self._store.fielddefs[name][1])

    def require(self, name: str) -> str:
        """The full name of a type of this distribution. Raises RosNameError for another one."""
        full = type_name(name)
        if full not in self._store.fielddefs:
            raise RosNameError(f"type {name!r}: {self.distribution} has no such message type")
        return full

    def type_hash(self, name: str) -> str:
        """The type hash in the keys of this distribution's messages."""
        if not self.distribution.has_type_hashes:
            return NO_TYPE_HASH
        return self._store.hash_rihs01(name)

    def readable_hashes(self, name: str) -> frozenset[str]:
        """The type hashes of all definitions of a type that `decode` knows. Humble's keys have
        none, which is read by Humble's definition."""
        return frozenset(_hashes(name))

    def encode(self, message: Message) -> bytes:
        """The CDR of a message, with its header."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))

    def decode(
        self, name: str, payload: bytes | memoryview, type_hash: str = ""
    ) -> Message | PayloadRefusal:
        """The message in a payload; or why there is none. Without a type hash it is read by this
        distribution's definition."""
        store = self._reader(name, type_hash)
        if store is None:
            return PayloadRefusal.UNKNOWN_HASH
        return _decode(store, name, payload)

    def _reader(self, name: str, type_hash: str) -> "Typestore | None":
        """Where the definition with this hash is; keeps none that is unknown."""
        if not type_hash:
            return self._store
        found = self._readers.get((name, type_hash))
        if found is None:
            own = type_hash == self.type_hash(name)
            found = self._store if own else _hashes(name).get(type_hash)
            if found is not None:
                self._readers[name, type_hash] = found
        return found


def _decode(store: "Typestore", name: str, payload: bytes | memoryview) -> Message | PayloadRefusal:
    from rosbags.serde import SerdeError

    if len(payload) < 4 or bytes(payload[:2]) not in (b"\x00\x00", b"\x00\x01"):
        return PayloadRefusal.NO_CDR
    try:
        return store.deserialize_cdr(memoryview(payload), name)
    except SerdeError as error:
        if isinstance(error.__cause__, UnicodeDecodeError) or "terminator" in str(error):
            return PayloadRefusal.BAD_TEXT
        return PayloadRefusal.TOO_LONG if "mismatch" in str(error) else PayloadRefusal.CUT_SHORT
    except (IndexError, OverflowError, struct.error):
        return PayloadRefusal.CUT_SHORT


def largest_payload(name: str) -> int:
    """How many bytes a payload of this type may have."""
    images = (IMAGE, COMPRESSED_IMAGE)
    return LARGEST_IMAGE_BYTES if name in images else LARGEST_BYTES


_STORES = {
    Distribution.HUMBLE: "ROS2_HUMBLE",
    Distribution.JAZZY: "ROS2_JAZZY",
    Distribution.KILTED: "ROS2_KILTED",
    Distribution.LYRICAL: "ROS2_LYRICAL",
    Distribution.ROLLING: "ROS2_LYRICAL",  # the newest that is known
}


@cache
def _store(name: str) -> "Typestore":
    """The definitions of one distribution, with those of `definitions`."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise DependencyError(
            "messages of ROS 2 need the package rosbags: pip install 'cpcbl-team[ros2]'"
        ) from error
    store = get_typestore(Stores[name])
    store.register(
        {
            kind: definition
            for name, text in APRILTAG_AND_VISION.items()
            for kind, definition in get_types_from_msg(text, name).items()
        }
    )
    return store


@cache
def _hashes(name: str) -> "dict[str, Typestore]":
    """The definitions of a type in all distributions, by their hash."""
    found: dict[str, Typestore] = {}
    for distribution in _STORES:
        store = _store(_STORES[distribution])
        if name in store.fielddefs:
            found[store.hash_rihs01(name)] = store
            if not distribution.has_type_hashes:
                found[NO_TYPE_HASH] = store
    return found
