"""Keys, tokens, quality of service and attachments of ROS 2: captured ones, and any other."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpcbl_transport.ros2 import names, qos, tokens
from cpcbl_transport.ros2.attachment import (
    Attachment,
    decode_attachment,
    encode_attachment,
    gid_of,
)
from cpcbl_transport.ros2.names import NO_TYPE_HASH, Layout, RosNameError
from cpcbl_transport.ros2.qos import (
    LATCHED,
    SENSOR_DATA,
    Durability,
    History,
    Liveliness,
    QosProfile,
    Reliability,
)
from cpcbl_transport.ros2.tokens import Endpoint, Entity

# Captured by dora-rs from a publisher with rmw_zenoh_cpp 0.1.8 of Humble (dora-rs/dora,
# libraries/extensions/ros2-bridge/tests/fixtures/rmw_zenoh)
TOKEN = (
    "@ros2_lv/0/9ca0f8facf84ffb1e6bfa4f2500889f0/0/3/MP/%/%/_ros2cli_712/%chatter/"
    "std_msgs::msg::dds_::String_/TypeHashNotSupported/:1:,1:,:,:,,"
)
ATTACHMENT = bytes.fromhex("d80000000000000034dae10162f8c41810f07168d3856ce9f689254cbed6252151")

NUMBERS = st.integers(0, 2**40)
PROFILES = st.builds(
    QosProfile,
    reliability=st.sampled_from(Reliability),
    durability=st.sampled_from(Durability),
    history=st.sampled_from(History),
    depth=NUMBERS,
    deadline_ns=NUMBERS | st.just(qos.INFINITE_NS),
    lifespan_ns=NUMBERS | st.just(qos.INFINITE_NS),
    liveliness=st.sampled_from(Liveliness),
    lease_ns=NUMBERS | st.just(qos.INFINITE_NS),
)
WORDS = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True)
TOPICS = st.lists(WORDS, min_size=1, max_size=4).map("/".join)
TYPES = st.sampled_from(["nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"])
HASHES = st.sampled_from([NO_TYPE_HASH, "RIHS01_" + "0123456789abcdef" * 4])


def test_the_captured_token_is_read_and_written() -> None:
    endpoint = tokens.parse_token(TOKEN)
    assert endpoint == Endpoint(
        layout=Layout.RMW_ZENOH,
        entity=Entity.PUBLISHER,
        session="9ca0f8facf84ffb1e6bfa4f2500889f0",
        domain=0,
        entity_id="3",
        node="_ros2cli_712",
        topic="chatter",
        type_name="std_msgs/msg/String",
        type_hash=NO_TYPE_HASH,
        qos=LATCHED,
    )
    assert tokens.format_token(endpoint) == TOKEN
    key = names.rmw_zenoh_key(0, endpoint.topic, endpoint.type_name, endpoint.type_hash)
    assert key == "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"


def test_the_captured_attachment_is_read_and_written_with_the_gid_of_its_token() -> None:
    attachment = decode_attachment(ATTACHMENT)
    assert attachment == Attachment(216, 1_784_824_452_167_621_172, gid_of(TOKEN))
    assert encode_attachment(attachment) == ATTACHMENT


@pytest.mark.parametrize(
    "data", [b"", ATTACHMENT[:-1], ATTACHMENT + b"\0", ATTACHMENT[:16] + b"\x0f" + ATTACHMENT[17:]]
)
def test_what_is_no_attachment_of_rmw_zenoh_is_none(data: bytes) -> None:
    assert decode_attachment(data) is None


@pytest.mark.parametrize(
    ("profile", "text"),
    [
        (qos.DEFAULT, "::,10:,:,:,,"),
        (LATCHED, ":1:,1:,:,:,,"),
        (SENSOR_DATA, "2::,5:,:,:,,"),
        (QosProfile(history=History.KEEP_ALL, depth=42), "::2,:,:,:,,"),
        (QosProfile(depth=42, deadline_ns=1_500_000_000), "::,:1,500000000:,:,,"),
    ],
)
def test_texts_of_rmw_zenoh(profile: QosProfile, text: str) -> None:
    assert qos.format_rmw_zenoh(profile) == text
    assert qos.parse_rmw_zenoh(text) == profile


def test_texts_of_the_dds_bridge_are_those_of_its_own_tests() -> None:
    """Reliable is 1, transient local is 1, keep last is 0: another order than in ROS 2."""
    assert qos.format_ros2dds(qos.DEFAULT) == ":1:0:0,10"
    assert qos.format_ros2dds(LATCHED, "RIHS01_ab") == ":1:1:0,1:typehash=RIHS01_ab;"
    assert qos.parse_ros2dds("K:::") == (
        QosProfile(reliability=Reliability.BEST_EFFORT, depth=1),
        "",
    )
    assert qos.parse_ros2dds(":::0,3") == (
        QosProfile(reliability=Reliability.BEST_EFFORT, depth=3),
        "",
    )


@given(PROFILES)
def test_any_profile_is_read_as_it_was_written(profile: QosProfile) -> None:
    assert qos.parse_rmw_zenoh(qos.format_rmw_zenoh(profile)) == profile


@given(
    st.sampled_from([Entity.PUBLISHER, Entity.SUBSCRIPTION, Entity.NODE]),
    st.tuples(TOPICS, TOPICS, WORDS, TYPES, HASHES, PROFILES),
)
def test_any_token_of_rmw_zenoh_is_read_as_it_was_written(
    entity: Entity, parts: tuple[Any, ...]
) -> None:
    topic, namespace, node, kind, type_hash, profile = parts
    named = {"topic": topic, "type_name": kind, "type_hash": type_hash, "qos": profile}
    endpoint = Endpoint(
        layout=Layout.RMW_ZENOH,
        entity=entity,
        session="ab12",
        domain=42,
        node_id="1",
        entity_id="17",
        namespace=f"/{namespace}",
        node=node,
        **({} if entity is Entity.NODE else named),
    )
    assert tokens.parse_token(tokens.format_token(endpoint)) == endpoint


@given(TOPICS, TYPES, st.booleans(), st.integers(1, 1000), HASHES)
def test_any_token_of_the_dds_bridge_is_read_as_it_was_written(
    topic: str, kind: str, latched: bool, depth: int, type_hash: str
) -> None:
    durability = Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE
    endpoint = Endpoint(
        layout=Layout.ROS2DDS,
        entity=Entity.PUBLISHER,
        session="ab12",
        topic=topic,
        type_name=kind,
        type_hash=type_hash if type_hash.startswith("RIHS") else "",
        qos=QosProfile(durability=durability, depth=depth),
    )
    token = tokens.format_token(endpoint)
    assert token.startswith(f"@/ab12/@ros2_lv/MP/{topic.replace('/', '§')}/")
    assert tokens.parse_token(token) == endpoint


@given(
    st.text(alphabet="@ros2_lv/%§:,0123456789MPNSabc·²", max_size=80).map(
        lambda tail: f"@ros2_lv/{tail}"
    )
    | st.tuples(st.integers(0, len(TOKEN) - 1), st.text(max_size=3)).map(
        lambda change: TOKEN[: change[0]] + change[1] + TOKEN[change[0] + 1 :]
    )
)
def test_any_text_is_a_token_or_none(text: str) -> None:
    endpoint = tokens.parse_token(text)
    assert endpoint is None or isinstance(endpoint, Endpoint)


@pytest.mark.parametrize(
    "token",
    [
        "@ros2_lv/0/a/0/0/NN/%/%",  # without a name
        "@ros2_lv/x/a/0/0/NN/%/%/node",
        "@ros2_lv/0/a/0/0/XX/%/%/node",
        TOKEN.removesuffix(":1:,1:,:,:,,") + "::,99999999999999999999999:,:,:,,",
        TOKEN.removesuffix(":1:,1:,:,:,,") + "9::,:,:,:,,",
        TOKEN + "/more",
        "@/a/@ros2_lv/MP/r1§odom/nav_msgs§msg§Odometry",
        "@/a/@ros2_lv/SS/r1§spin/std_srvs§srv§Empty",
        "@ros2_lv/" + "a" * 3000,
    ],
)
def test_what_is_no_token_of_a_topic_is_none(token: str) -> None:
    assert tokens.parse_token(token) is None


@pytest.mark.parametrize(
    "topic", ["", "/", "r1/*", "**", "r1//odom", "1r", "r1/odom/", "a b", "a$*"]
)
def test_a_topic_with_a_wildcard_or_an_empty_part_is_refused(topic: str) -> None:
    with pytest.raises(RosNameError, match="topic"):
        names.topic_name(topic)


def test_names_of_types() -> None:
    assert names.type_name("nav_msgs/Odometry") == "nav_msgs/msg/Odometry"
    assert names.dds_type("nav_msgs/msg/Odometry") == "nav_msgs::msg::dds_::Odometry_"
    assert names.ros_type("nav_msgs::msg::dds_::Odometry_") == "nav_msgs/msg/Odometry"
    assert names.ros_type("Odometry") == ""
    for bad in ("Odometry", "nav_msgs/*", "nav_msgs/srv/GetMap", "Nav/msg/Odometry"):
        with pytest.raises(RosNameError, match="message type"):
            names.type_name(bad)


def test_policies_by_which_dds_delivers_nothing() -> None:
    offered = QosProfile(reliability=Reliability.BEST_EFFORT)
    both = QosProfile(durability=Durability.TRANSIENT_LOCAL)
    assert qos.incompatible_policies(offered, both) == ["reliability", "durability"]
    assert qos.incompatible_policies(offered, SENSOR_DATA) == []
    assert qos.incompatible_policies(LATCHED, qos.DEFAULT) == []
