"""Liveliness tokens: how nodes, publishers and subscriptions of ROS 2 are found on Zenoh.

- rmw_zenoh: `@ros2_lv/<domain>/<session>/<node>/<entity>/<NN|MP|MS|SS|SC>/<enclave>/<namespace>/
  <node name>[/<topic>/<type>/<hash>/<qos>]`, in which `%` stands for a slash.
- zenoh-bridge-ros2dds: `@/<session>/@ros2_lv[/<MP|MS>/<key>/<type>/<qos>]`, in which `§` stands for
  a slash; without more it is the bridge itself.

Sources: rmw_zenoh's liveliness_utils.cpp, zenoh-plugin-ros2dds' liveliness_mgt.rs.
"""

from enum import StrEnum

import msgspec

from cpcbl_transport.ros2.names import NO_TYPE_HASH, Layout, dds_type, ros_type
from cpcbl_transport.ros2.qos import (
    QosProfile,
    format_rmw_zenoh,
    format_ros2dds,
    parse_rmw_zenoh,
    parse_ros2dds,
)

ADMIN_SPACE = "@ros2_lv"
RMW_ZENOH_TOKENS = f"{ADMIN_SPACE}/**"
ROS2DDS_TOKENS = f"@/*/{ADMIN_SPACE}/**"
LONGEST_TOKEN = 2_000


class Entity(StrEnum):
    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"
    BRIDGE = "bridge"  # zenoh-bridge-ros2dds itself


class Endpoint(msgspec.Struct, frozen=True, kw_only=True):
    """What one token says."""

    layout: Layout
    entity: Entity
    session: str
    """The id of the Zenoh session that it belongs to (hexadecimal)."""
    domain: int | None = None  # none behind a bridge for DDS
    node_id: str = "0"
    entity_id: str = "0"
    enclave: str = "/"
    namespace: str = "/"
    node: str = ""
    topic: str = ""  # without its leading slash
    type_name: str = ""
    type_hash: str = ""
    qos: QosProfile | None = None

    @property
    def full_node_name(self) -> str:
        """`/r1/driver`; what a bridge for DDS announces has the bridge's session instead."""
        if self.layout is Layout.ROS2DDS:
            return f"the DDS bridge {self.session}"
        return f"{self.namespace.rstrip('/')}/{self.node}"


def format_token(endpoint: Endpoint) -> str:
    """The token that announces an endpoint in its layout."""
    if endpoint.layout is Layout.ROS2DDS:
        return _format_ros2dds(endpoint)
    head = [
        *(ADMIN_SPACE, str(endpoint.domain), endpoint.session, endpoint.node_id),
        *(endpoint.entity_id, str(endpoint.entity), _mangle(endpoint.enclave)),
        *(_mangle(endpoint.namespace), _mangle(endpoint.node)),
    ]
    if endpoint.entity is Entity.NODE:
        return "/".join(head)
    assert endpoint.qos is not None, "only nodes and bridges have no quality of service"
    kind = dds_type(endpoint.type_name)
    topic, qos = f"%{_mangle(endpoint.topic)}", format_rmw_zenoh(endpoint.qos)
    return "/".join([*head, topic, kind, endpoint.type_hash or NO_TYPE_HASH, qos])


def parse_token(key: str) -> Endpoint | None:
    """What a token says; None for what is no token of either layout."""
    if len(key) > LONGEST_TOKEN:
        return None
    parts = key.split("/")
    if not all(parts):
        return None
    if parts[0] == "@":
        return _parse_ros2dds(parts)
    return _parse_rmw_zenoh(parts) if parts[0] == ADMIN_SPACE else None


def _parse_rmw_zenoh(parts: list[str]) -> Endpoint | None:
    if len(parts) < 9 or not (parts[1].isascii() and parts[1].isdigit() and len(parts[1]) < 6):
        return None
    entity = _ENTITIES.get(parts[5])
    if entity is None:
        return None
    endpoint = Endpoint(
        layout=Layout.RMW_ZENOH,
        entity=entity,
        session=parts[2],
        domain=int(parts[1]),
        node_id=parts[3],
        entity_id=parts[4],
        enclave=_demangle(parts[6]),
        namespace=_demangle(parts[7]),
        node=_demangle(parts[8]),
    )
    if entity is Entity.NODE:
        return endpoint if len(parts) == 9 else None
    if len(parts) != 13:
        return None
    topic, kind, type_hash, text = parts[9:]
    qos = parse_rmw_zenoh(text)
    if qos is None:
        return None
    return msgspec.structs.replace(
        endpoint,
        topic=_demangle(topic).removeprefix("/"),
        type_name=ros_type(_demangle(kind)),
        type_hash=type_hash,
        qos=qos,
    )


_ENTITIES = {str(entity): entity for entity in Entity if entity is not Entity.BRIDGE}


def _format_ros2dds(endpoint: Endpoint) -> str:
    head = f"@/{endpoint.session}/{ADMIN_SPACE}"
    if endpoint.entity is Entity.BRIDGE:
        return head
    assert endpoint.qos is not None, "only nodes and bridges have no quality of service"
    key, kind = endpoint.topic.replace("/", "§"), endpoint.type_name.replace("/", "§")
    return (
        f"{head}/{endpoint.entity}/{key}/{kind}/{format_ros2dds(endpoint.qos, endpoint.type_hash)}"
    )


def _parse_ros2dds(parts: list[str]) -> Endpoint | None:
    if len(parts) < 3 or parts[2] != ADMIN_SPACE:
        return None
    if len(parts) == 3:
        return Endpoint(layout=Layout.ROS2DDS, entity=Entity.BRIDGE, session=parts[1])
    entity = _ENTITIES.get(parts[3])
    if entity not in (Entity.PUBLISHER, Entity.SUBSCRIPTION) or len(parts) != 7:
        return None  # services and actions
    parsed = parse_ros2dds(parts[6])
    if parsed is None:
        return None
    qos, type_hash = parsed
    return Endpoint(
        layout=Layout.ROS2DDS,
        entity=entity,
        session=parts[1],
        topic=parts[4].replace("§", "/"),
        type_name=parts[5].replace("§", "/"),
        type_hash=type_hash,
        qos=qos,
    )


def _mangle(name: str) -> str:
    return name.replace("/", "%") or "%"


def _demangle(name: str) -> str:
    return name.replace("%", "/")
