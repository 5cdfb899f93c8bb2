"""Names of topics and types of ROS 2, and the keys of their messages on Zenoh.

- rmw_zenoh: `<domain>/<topic>/<package>::msg::dds_::<Type>_/<type hash>`; Humble has no hashes and
  writes `TypeHashNotSupported`.
- zenoh-bridge-ros2dds: `<topic>` alone, below the namespace that the bridge adds.

Sources: rmw_zenoh's liveliness_utils.cpp (`TopicInfo`), zenoh-plugin-ros2dds' README.
"""

import re
from enum import StrEnum

from cpcbl_team.errors import InputError

NO_TYPE_HASH = "TypeHashNotSupported"
LARGEST_DOMAIN = 232  # DDS has no more ports


class Layout(StrEnum):
    """How the robots' ROS 2 is on Zenoh."""

    RMW_ZENOH = "rmw_zenoh"
    ROS2DDS = "ros2dds"


class Distribution(StrEnum):
    """The distributions of ROS 2 whose messages are known."""

    HUMBLE = "humble"
    JAZZY = "jazzy"
    KILTED = "kilted"
    LYRICAL = "lyrical"
    ROLLING = "rolling"

    @property
    def has_type_hashes(self) -> bool:
        """Whether its keys carry hashes of types: from Iron on."""
        return self is not Distribution.HUMBLE


class RosNameError(InputError):
    """A name that ROS 2 does not allow; the text says which and how to write it."""


_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_TYPE = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")


def topic_name(text: str) -> str:
    """A topic without its leading slash: `r1/odom`. Raises RosNameError for what is no name of a
    topic: a wildcard of Zenoh in it would reach the topics of others."""
    name = text.removeprefix("/")
    if not _NAME.fullmatch(name):
        raise RosNameError(
            f"topic {text!r}: is no name of ROS 2; write words of letters, digits and _ with /"
            " between them, such as 'r1/odom'"
        )
    return name


def node_name(text: str) -> str:
    """The name of a node. Raises RosNameError."""
    if "/" in text or not _NAME.fullmatch(text):
        raise RosNameError(
            f"node {text!r}: is no name of ROS 2; write letters, digits and _, such as"
            " 'cpcbl_bridge'"
        )
    return text


def namespace_name(text: str) -> str:
    """A namespace with its leading slash; `/` alone is the root. Raises RosNameError."""
    return "/" if text in ("", "/") else f"/{topic_name(text)}"


def type_name(text: str) -> str:
    """A message type in full, `nav_msgs/msg/Odometry`, also from the short form
    `nav_msgs/Odometry`. Raises RosNameError."""
    package, slash, name = text.partition("/")
    full = f"{package}/msg/{name}" if slash and "/" not in name else text
    if not _TYPE.fullmatch(full):
        raise RosNameError(
            f"type {text!r}: is no message type of ROS 2; write it as 'nav_msgs/msg/Odometry'"
        )
    return full


def dds_type(name: str) -> str:
    """`nav_msgs/msg/Odometry` as DDS and rmw_zenoh write it: `nav_msgs::msg::dds_::Odometry_`."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type(dds: str) -> str:
    """The reverse of `dds_type`; empty for what is no such name."""
    package, _, rest = dds.partition("::")
    kind, _, short = rest.partition("::dds_::")
    if not (package and kind and short.endswith("_") and len(short) > 1):
        return ""
    return f"{package}/{kind}/{short[:-1]}"


def rmw_zenoh_key(domain: int, topic: str, name: str, type_hash: str) -> str:
    """The key under which rmw_zenoh publishes a topic; with `*` as hash, of every definition."""
    return f"{domain}/{topic}/{dds_type(name)}/{type_hash}"


def type_hash_of_key(key: str) -> str:
    """The type hash at the end of a key of rmw_zenoh."""
    return key.rpartition("/")[2]


def topic_key(layout: Layout, domain: int, topic: str, name: str, type_hash: str) -> str:
    """The key of a topic's messages in a layout. A bridge for DDS has no domain in its keys."""
    if layout is Layout.ROS2DDS:
        return topic
    return rmw_zenoh_key(domain, topic, name, type_hash)
