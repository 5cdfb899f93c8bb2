"""What is said of topics that are not heard: one line, with the cause and the remedy."""

from typing import TypeVar

import msgspec
import pytest

from cpcbl_transport.ros2.graph import (
    EndpointTable,
    Interest,
    NodeContext,
    graph_findings,
)
from cpcbl_transport.ros2.names import NO_TYPE_HASH, Layout
from cpcbl_transport.ros2.qos import DEFAULT, LATCHED, SENSOR_DATA, QosProfile
from cpcbl_transport.ros2.tokens import Endpoint, Entity

ODOMETRY, HASH = "nav_msgs/msg/Odometry", "RIHS01_" + "3c" * 32
OTHER_HASH = "RIHS01_" + "ab" * 32
HERE = NodeContext(layout=Layout.RMW_ZENOH, domain=0, session="own", router="tcp/pi:7447")
BEHIND_DDS = msgspec.structs.replace(HERE, layout=Layout.ROS2DDS)
DRIVER = Endpoint(
    layout=Layout.RMW_ZENOH,
    entity=Entity.PUBLISHER,
    session="theirs",
    domain=0,
    namespace="/r1",
    node="driver",
    topic="r1/odom",
    type_name=ODOMETRY,
    type_hash=HASH,
    qos=DEFAULT,
)
ON_DDS = msgspec.structs.replace(DRIVER, layout=Layout.ROS2DDS, domain=None, node="")


def listening(qos: QosProfile = SENSOR_DATA, messages: int = 1) -> Interest:
    return Interest(
        entity=Entity.SUBSCRIPTION,
        topic="r1/odom",
        type_name=ODOMETRY,
        qos=qos,
        type_hashes=frozenset({HASH, NO_TYPE_HASH}),
        messages=messages,
    )


Changed = TypeVar("Changed", Endpoint, Interest)


def changed(one: Changed, **fields: object) -> Changed:
    return msgspec.structs.replace(one, **fields)


@pytest.mark.parametrize("endpoint", [DRIVER, changed(DRIVER, type_hash=NO_TYPE_HASH)])
def test_a_topic_that_is_heard_gives_no_line(endpoint: Endpoint) -> None:
    assert graph_findings([listening()], [endpoint], HERE) == []


NODE = changed(DRIVER, entity=Entity.NODE, topic="", type_name="", type_hash="", qos=None)
SILENT: list[tuple[str, list[Endpoint], str]] = [
    (
        "another type hash",
        [changed(DRIVER, type_hash=OTHER_HASH)],
        "r1/odom: /r1/driver publishes nav_msgs/msg/Odometry with type hash RIHS01_abababababab…,"
        " known are RIHS01_3c3c3c3c3c3c…, none (as in Humble)",
    ),
    (
        "another type",
        [changed(DRIVER, type_name="geometry_msgs/msg/PoseStamped")],
        "r1/odom: /r1/driver publishes it as geometry_msgs/msg/PoseStamped, and this node has"
        " nav_msgs/msg/Odometry",
    ),
    (
        "another domain",
        [changed(DRIVER, domain=5)],
        "r1/odom: /r1/driver publishes it in domain 5, and this node is in domain 0: set domain = 5"
        " (ROS_DOMAIN_ID)",
    ),
    (
        "a near name",
        [changed(DRIVER, topic="r1/odometry")],
        "r1/odom: nobody publishes it; nav_msgs/msg/Odometry is published on r1/odometry",
    ),
    (
        "the same type under quite another name",
        [changed(DRIVER, topic="base_driver/wheels")],
        "r1/odom: nobody publishes it; nav_msgs/msg/Odometry is published on base_driver/wheels",
    ),
    (
        "a near name of another type",
        [changed(DRIVER, topic="r1/odo", type_name="std_msgs/msg/String")],
        "r1/odom: nobody publishes it; there is r1/odo, of another type",
    ),
    ("nobody", [NODE], "r1/odom: nobody publishes it"),
]


@pytest.mark.parametrize(
    ("endpoints", "line"), [row[1:] for row in SILENT], ids=[row[0] for row in SILENT]
)
def test_a_topic_that_is_not_heard_has_one_line(endpoints: list[Endpoint], line: str) -> None:
    assert graph_findings([listening()], endpoints, HERE) == [line]


def test_a_second_publisher_of_an_exclusive_topic_is_named() -> None:
    other = changed(DRIVER, namespace="/", node="amcl")
    for is_exclusive in (True, False):
        own = changed(listening(), entity=Entity.PUBLISHER, is_exclusive=is_exclusive)
        line = "r1/odom: /amcl publishes it too; one of both must stop (is AMCL still running?)"
        assert graph_findings([own], [other], HERE) == ([line] if is_exclusive else [])


def test_nobody_need_publish_an_optional_topic() -> None:
    own = changed(listening(messages=0), is_optional=True)
    two = [DRIVER, changed(DRIVER, node="other")]
    assert graph_findings([own], [NODE], HERE) == graph_findings([own], two, HERE) == []
    (line,) = graph_findings([own], [changed(DRIVER, type_hash=OTHER_HASH)], HERE)
    assert "known are" in line


def test_a_node_of_its_own_counts_for_nothing() -> None:
    (alone, unpublished) = graph_findings([listening()], [changed(DRIVER, session="own")], HERE)
    assert alone.startswith("no node of ROS 2 is seen at tcp/pi:7447")
    assert unpublished == "r1/odom: nobody publishes it"


def test_the_other_layout_is_named() -> None:
    wrong, where = graph_findings([listening()], [ON_DDS], HERE)
    assert wrong == (
        'layout is "rmw_zenoh", but only zenoh-bridge-ros2dds are seen: set layout = "ros2dds"'
    )
    assert where.endswith('publishes it in the layout "ros2dds": set layout = "ros2dds"')
    (both,) = graph_findings([listening()], [DRIVER, ON_DDS], HERE)
    assert both.startswith("zenoh-bridge-ros2dds is here too")
    assert graph_findings([listening()], [DRIVER, ON_DDS], BEHIND_DDS) == []


def test_what_is_published_but_does_not_arrive_is_said() -> None:
    (line,) = graph_findings([listening(messages=0)], [DRIVER], HERE)
    assert line == "r1/odom: /r1/driver publishes it, but nothing came yet"


def test_two_publishers_of_one_topic_are_said() -> None:
    other = changed(DRIVER, node="gazebo", namespace="/")
    (line,) = graph_findings([listening()], [DRIVER, other], HERE)
    assert line == "r1/odom: has 2 publishers, and all are heard: /r1/driver, /gazebo"


def test_incompatible_quality_of_service_is_said_where_it_matters() -> None:
    best_effort = changed(DRIVER, qos=SENSOR_DATA)
    assert graph_findings([listening(DEFAULT)], [best_effort], HERE) == []  # Zenoh delivers
    (line,) = graph_findings([listening(DEFAULT)], [changed(ON_DDS, qos=SENSOR_DATA)], BEHIND_DDS)
    assert "QoS incompatible" in line
    assert "(reliability)" in line
    assert line.endswith("DDS delivers nothing")
    (line,) = graph_findings([listening(LATCHED)], [DRIVER], HERE)
    assert "(durability)" in line
    assert line.endswith("what was published before is not delivered")


def test_subscribers_that_cannot_understand_a_published_topic_are_said() -> None:
    own = msgspec.structs.replace(
        listening(), entity=Entity.PUBLISHER, qos=DEFAULT, type_hashes=frozenset({HASH})
    )
    reader = changed(DRIVER, entity=Entity.SUBSCRIPTION, node="rviz")
    assert graph_findings([own], [reader], HERE) == []
    (line,) = graph_findings([own], [changed(reader, type_hash=NO_TYPE_HASH)], HERE)
    assert line == (
        "r1/odom: /r1/rviz subscribes to nav_msgs/msg/Odometry with type hash none (as in Humble),"
        " known are RIHS01_3c3c3c3c3c3c…"
    )
    (line,) = graph_findings([own], [changed(reader, domain=3)], HERE)
    assert line == "r1/odom: /r1/rviz subscribes to it in domain 3, and this node is in domain 0"


def test_a_table_of_endpoints_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cpcbl_transport.ros2.graph.MOST_ENDPOINTS", 2)
    table = EndpointTable()
    for token in ("a", "b", "c", "b"):
        table.update(token, DRIVER, present=True)
    assert (len(table.all()), table.refused) == (2, 1)
    table.update("a", DRIVER, present=False)
    table.update("a", DRIVER, present=False)
    table.update("c", DRIVER, present=True)
    assert (len(table.all()), table.refused) == (2, 1)
