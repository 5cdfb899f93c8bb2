"""The access control of a router of ROS 2, enforced by a Zenoh router: the bridge and the nodes of
robots pass, and nobody else."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pytest
from support.buses import wait_until
from support.keys import OPERATOR, R1, R2, ROUTER, secured_team, shown_by
from support.processes import eventually
from support.routers import open_router

from cpcbl_launch.run.ros2.command import router_access
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import parse_team
from cpcbl_transport.ros2.messages import ODOMETRY, POSE, TRANSFORMS, MessageTypes
from cpcbl_transport.ros2.names import Distribution
from cpcbl_transport.ros2.node import NodeSettings, RosNode, open_node
from cpcbl_transport.ros2.publisher import RosPublisher
from cpcbl_transport.ros2.qos import LATCHED, STATIC_TRANSFORMS
from cpcbl_transport.ros2.subscription import Received
from cpcbl_transport.security import Identity

TEAM = """
name = "lab"
[ros2]
domain = 7
[robots.r1]
source = "external"
ros2 = { map_frame = "r1/map" }
"""


class Stand(NamedTuple):
    """A router of ROS 2, its bridge, a node of a robot, and one whom nobody has let in."""

    bridge: RosNode
    robot: RosNode
    other: RosNode  # of the same robot
    stranger: RosNode


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    keys, where, stack = secured_team(tmp_path), free_endpoint("tls"), ExitStack()

    def name(identity: Identity) -> list[str]:
        return [str(identity)]

    control = router_access(parse_team(TEAM), name(OPERATOR), name(R1))
    guards = {"access_control": control}
    with stack:
        stack.enter_context(open_router("tests", [where], (), guards, shown_by(keys, ROUTER)))

        def node(identity: Identity, own: str) -> RosNode:
            credentials = shown_by(keys, identity)
            settings = NodeSettings(connect=(where,), name=own, domain=7, credentials=credentials)
            return stack.enter_context(open_node(settings))

        yield Stand(node(OPERATOR, "bridge"), node(R1, "r1"), node(R1, "other"), node(R2, "r2"))


TYPES = MessageTypes(Distribution.JAZZY)


def publish(publisher: RosPublisher, number: float = 0.0) -> None:
    """A message, which a number tells apart where it has a place for one."""
    message = TYPES.new(publisher.type_name)
    if publisher.type_name != TRANSFORMS:
        message.pose.pose.position.x = number
    publisher.publish(message)


def numbers(came: list[Received]) -> set[float]:
    return {received.message.pose.pose.position.x for received in came}


def test_the_bridge_and_the_nodes_of_robots_hear_each_other(stand: Stand) -> None:
    odometry, static, poses, maps = (list[Received]() for _ in range(4))
    publish(stand.robot.publisher("r1/tf_static", TRANSFORMS, LATCHED))
    publish(stand.bridge.publisher("r1/tf_static", TRANSFORMS, LATCHED))
    stand.bridge.subscribe("r1/odom", ODOMETRY, odometry.append)
    stand.bridge.subscribe("r1/tf_static", TRANSFORMS, static.append, STATIC_TRANSFORMS)
    stand.robot.subscribe("r1/amcl_pose", POSE, poses.append)
    stand.other.subscribe("r1/tf_static", TRANSFORMS, maps.append, STATIC_TRANSFORMS)
    out = stand.bridge.publisher("r1/amcl_pose", POSE)
    wheels = stand.robot.publisher("r1/odom", ODOMETRY)
    wait_until(lambda: out.matching and wheels.matching)
    publish(out, 1.0)
    publish(wheels, 2.0)
    assert eventually(lambda: numbers(poses) == {1.0} and numbers(odometry) == {2.0})
    assert eventually(lambda: len(static) == len(maps) == 2)  # of before, and its own
    assert eventually(lambda: {"bridge", "other"} <= {e.node for e in stand.robot.endpoints()})
    assert eventually(lambda: {"r1", "other"} <= {e.node for e in stand.bridge.endpoints()})


def test_nobody_else_gives_poses_and_the_bridge_gives_nothing_else(stand: Stand) -> None:
    poses, odometry = list[Received](), list[Received]()
    stand.other.subscribe("r1/amcl_pose", POSE, poses.append)
    stand.other.subscribe("r1/odom", ODOMETRY, odometry.append)
    out = stand.bridge.publisher("r1/amcl_pose", POSE)
    wheels = stand.robot.publisher("r1/odom", ODOMETRY)
    false_pose = stand.robot.publisher("r1/amcl_pose", POSE)
    false_odometry = stand.bridge.publisher("r1/odom", ODOMETRY)
    wait_until(lambda: out.matching and wheels.matching and false_pose.matching)
    publish(false_pose, 3.0)
    publish(false_odometry, 4.0)
    publish(out, 1.0)
    publish(wheels, 2.0)  # after what the same node must not
    assert eventually(lambda: bool(poses and odometry))
    assert numbers(poses) == {1.0}
    assert numbers(odometry) == {2.0}


def test_a_stranger_neither_hears_nor_is_heard(stand: Stand) -> None:
    odometry, overheard = list[Received](), list[Received]()
    stand.bridge.subscribe("r1/odom", ODOMETRY, odometry.append)
    stand.stranger.subscribe("r1/odom", ODOMETRY, overheard.append)
    false, wheels = (node.publisher("r1/odom", ODOMETRY) for node in (stand.stranger, stand.robot))
    wait_until(lambda: wheels.matching)
    for _ in range(20):
        publish(false, 3.0)
        publish(wheels, 2.0)
        time.sleep(0.01)
    stand.stranger.close()
    publish(wheels, 5.0)
    assert eventually(lambda: 5.0 in numbers(odometry))
    assert numbers(odometry) == {2.0, 5.0}
    assert not overheard
    assert not [e for e in stand.stranger.endpoints() if e.node in ("bridge", "r1")]
    assert "r2" not in {e.node for e in stand.bridge.endpoints()}
