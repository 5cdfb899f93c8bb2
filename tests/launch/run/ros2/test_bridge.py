"""The bridge between two Zenoh sessions: what passes, what is refused, and what it says."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest
from support.processes import eventually
from support.ros2 import MS, OPTICAL, camera_info, lab, message, odometry, pose_stamped, static
from support.routers import open_router

from cpcbl_launch.run.ros2.bridge import TeamBridge
from cpcbl_launch.run.ros2.command import node_settings
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import InitialPose, Odometry, Position
from cpcbl_transport import topics
from cpcbl_transport.decoding import decode_by_key
from cpcbl_transport.messages import Pose, encode
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.names import topic_key
from cpcbl_transport.ros2.node import NodeSettings, RosNode, open_node
from cpcbl_transport.ros2.publisher import RosPublisher
from cpcbl_transport.ros2.qos import LATCHED, STATIC_TRANSFORMS
from cpcbl_transport.ros2.subscription import Received
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

ORIGIN = Pose2(0.0, 0.0, 0.0)


class Stand(NamedTuple):
    """A bridge, the team's side of it, and that of the robots."""

    bridge: TeamBridge
    bus: ZenohBus
    robots: RosNode
    endpoint: str
    inputs: list[Any]  # what came on in/**
    heard: dict[str, list[Any]]  # messages of ROS 2 by topic

    def counts(self) -> dict[tuple[str, str], int]:
        return dict(self.bridge.refusals.counts)

    def send(self, publisher: RosPublisher, message: Any, robot: int = 0) -> None:
        """Publishes a message until the bridge has heard it: the first of a topic may be lost."""
        inputs, topic = self.bridge.robots[robot].inputs, publisher.topic
        assert inputs is not None
        before = inputs.counts.get(topic, 0)
        until_it(lambda: publisher.publish(message), lambda: inputs.counts.get(topic, 0) > before)


def until_it(act: Callable[[], None], has_worked: Callable[[], bool]) -> None:
    """Acts, and again where nothing has come of it after some time."""
    for _ in range(20):
        act()
        if eventually(has_worked, within_s=2.0):
            return
    raise AssertionError("nothing has come of it")


def settings_of_nodes(team: Team, endpoint: str) -> tuple[NodeSettings, NodeSettings]:
    """The settings of the bridge's node, and those of the robots' node in the same layout."""
    assert team.ros2 is not None
    ours = node_settings(team.ros2, [endpoint])
    return ours, NodeSettings(connect=(endpoint,), name="robots", layout=ours.layout)


@contextmanager
def stand(team: Team, now_ns: Callable[[], int] = time.time_ns) -> Iterator[Stand]:
    endpoint = free_endpoint()
    ours, of_robots = settings_of_nodes(team, endpoint)
    with (
        open_router(team.name, [endpoint]),
        open_bus(team.name, [endpoint]) as own,
        open_bus(team.name, [endpoint]) as bus,
        open_node(ours) as node,
        open_node(of_robots) as robots,
    ):
        inputs: list[Any] = []
        bus.subscribe("in/**", lambda key, payload: inputs.append(decode_by_key(key, payload)))
        heard: dict[str, list[Any]] = {}

        def on_message(received: Received) -> None:
            heard.setdefault(received.topic, []).append(received.message)

        for topic, kind in (
            ("r1/amcl_pose", types.POSE),
            ("r1/tf", types.TRANSFORMS),
            ("diagnostics", types.DIAGNOSTICS),
            ("cpcbl/markers", types.MARKERS),
        ):
            robots.subscribe(topic, kind, on_message)
        bridge = TeamBridge(team, list(team.robots), node, own, now_ns)
        yield Stand(bridge, bus, robots, endpoint, inputs, heard)


def test_odometry_goes_in_and_a_pose_comes_out_with_its_transform() -> None:
    with stand(lab()) as own:
        publisher = own.robots.publisher("r1/odom", types.ODOMETRY)
        begin_ns = time.time_ns()
        poses = [Pose2(5.0 + 0.02 * i, 1.0, 0.3) for i in range(20)]
        own.send(publisher, odometry(begin_ns, poses[0]))
        for i, pose in enumerate(poses[1:], 1):
            publisher.publish(odometry(begin_ns + 10 * MS * i, pose))
        assert eventually(lambda: len(own.inputs) >= 19)
        assert sum(piece.distance_m for piece in own.inputs) == pytest.approx(
            19 * 0.02 * math.cos(0.3)
        )
        assert all(isinstance(piece, Odometry) for piece in own.inputs)
        stamp_ns = begin_ns + 10 * MS * 15
        robot = own.bus.publisher(topics.POSE.at(robot="r1"), topics.POSE.qos)
        assert eventually(lambda: robot.matching)
        its = encode(Pose("r1", stamp_ns, 1.0, 2.0, 0.5, None))
        until_it(lambda: robot.put(its), lambda: own.heard.keys() >= {"r1/tf", "r1/amcl_pose"})
        (transform,) = own.heard["r1/tf"][0].transforms
        angle = 2.0 * math.atan2(transform.transform.rotation.z, transform.transform.rotation.w)
        shift = transform.transform.translation
        assert (Pose2(shift.x, shift.y, angle) @ poses[15]) == pytest.approx((1.0, 2.0, 0.5))
        robot.put(encode(Pose("r1", stamp_ns, 1.0, 2.0, 0.5, None, lost="kidnapped")))
        own.bridge.look()
        assert eventually(lambda: "diagnostics" in own.heard and "cpcbl/markers" in own.heard)
        assert len(own.heard["r1/amcl_pose"]) == 1  # nothing of a lost robot
        assert not own.counts()


def test_bad_input_moves_nothing_is_counted_and_the_bridge_goes_on() -> None:
    with stand(lab()) as own:
        publisher = own.robots.publisher("r1/odom", types.ODOMETRY)
        now_ns = time.time_ns()
        zero = odometry(now_ns + 2 * MS, ORIGIN)
        zero.pose.pose.orientation.w = 0.0
        for bad in (
            odometry(now_ns, Pose2(math.nan, 0.0, 0.0)),
            odometry(now_ns + MS, ORIGIN, covariance=math.nan),
            zero,
            odometry(now_ns, ORIGIN, frame="base_footprint"),
            odometry(now_ns, ORIGIN, frame="map"),
            odometry(0, ORIGIN),
            odometry(now_ns - 3_200_000 * MS, ORIGIN),
        ):
            own.send(publisher, bad)
        key = topic_key(*_place(), "r1/odom", types.ODOMETRY, _hash(own.robots))
        with open_bus("", [own.endpoint]) as anybody:  # keys are whole ones
            raw = anybody.publisher(key, topics.Qos.INPUT)
            assert eventually(lambda: raw.matching)
            for garbage in (b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 700, b"{}"):
                raw.put(garbage)
        infos = own.robots.publisher("r1/camera_info", types.CAMERA_INFO)
        own.send(infos, camera_info(k=[0.0] * 9, p=[0.0] * 12, header=_header(now_ns)))
        for i in range(3):
            publisher.publish(odometry(now_ns + 100 * MS * i, Pose2(0.01 * i, 0.0, 0.0)))
        assert eventually(lambda: len(own.inputs) == 2)
        assert {reason: n for (topic, reason), n in own.counts().items() if "odom" in topic} == {
            "not_finite": 2,
            "zero_quaternion": 1,
            "wrong_frame": 1,
            "frame_loop": 1,
            "wrong_clock": 2,
        }
        camera_info_refused = "r1/camera_info", "unusable_camera_info"
        assert eventually(lambda: own.counts().get(camera_info_refused) == 1)
        lines = "\n".join(own.bridge.refusals.lines())
        assert "frame 'odom' expected, 'base_footprint' came" in lines
        assert "stamps differ by 3,200 s: use_sim_time?" in lines


def test_a_bag_that_begins_again_begins_anew() -> None:
    with stand(lab()) as own:
        publisher = own.robots.publisher("r1/odom", types.ODOMETRY)
        now_ns = time.time_ns()
        for start_ns in (now_ns, now_ns - 5000 * MS):
            for i in range(4):
                pose = Pose2(1.0 + 0.01 * i, 0.0, 0.0)
                own.send(publisher, odometry(start_ns + 100 * MS * i, pose, (0.1, 0.0)))
        assert eventually(lambda: len(own.inputs) == 6)
        assert own.counts() == {("r1/odom", "clock_back"): 1}
        assert sum(piece.distance_m for piece in own.inputs) == pytest.approx(0.06)


def test_simulated_time_comes_back_as_it_went_in() -> None:
    now_ns = time.time_ns()
    with stand(lab(("[ros2]", "[ros2]\nsim_time = true")), lambda: now_ns) as own:
        publisher = own.robots.publisher("r1/odom", types.ODOMETRY)
        robot = own.bus.publisher(topics.POSE.at(robot="r1"), topics.POSE.qos)
        assert eventually(lambda: robot.matching)
        for i in range(10):  # seconds since the simulation's start, at half of real time
            now_ns += 200 * MS
            own.send(publisher, odometry(12_000 * MS + 100 * MS * i, Pose2(0.01 * i, 0.0, 0.0)))
        assert eventually(lambda: len(own.inputs) == 9)
        newest_ns = own.inputs[-1].stamp_ns
        assert abs(now_ns - newest_ns) < 1000 * MS
        pose = encode(Pose("r1", newest_ns, 1.0, 2.0, 0.5, None))
        until_it(lambda: robot.put(pose), lambda: "r1/amcl_pose" in own.heard)
        stamp = own.heard["r1/amcl_pose"][0].header.stamp
        assert (stamp.sec, stamp.nanosec) == (12, 900_000_000)


SIMULATED = (("[ros2]", "[ros2]\nsim_time = true"),)
BEHIND_DDS = (("[ros2]", '[ros2]\nlayout = "ros2dds"'),)


@pytest.mark.parametrize("changes", [(), SIMULATED, BEHIND_DDS])
def test_the_button_of_rviz_sets_the_pose(changes: tuple[tuple[str, str], ...]) -> None:
    with stand(lab(*changes)) as own:
        rviz = own.robots.publisher("r1/initialpose", types.POSE)
        assert eventually(lambda: rviz.matching)
        now_ns = time.time_ns()
        for stamp_ns in (now_ns, 0, 12_000 * MS if changes is SIMULATED else now_ns):
            rviz.publish(pose_stamped(stamp_ns, Pose2(1.0, 2.0, 0.5), 0.5))
        rviz.publish(pose_stamped(now_ns, Pose2(1.0, 2.0, 0.5), 0.5, frame="odom"))
        assert eventually(lambda: len(own.inputs) == 3 and bool(own.counts()))
        assert own.counts() == {("r1/initialpose", "wrong_frame"): 1}
        for given in own.inputs:
            assert isinstance(given, InitialPose)
            assert (given.x_m, given.y_m, given.heading_rad) == pytest.approx((1.0, 2.0, 0.5))
            assert now_ns <= given.stamp_ns <= time.time_ns()
        own.bridge.look_for_findings()
        assert "initialpose" not in "".join(own.bridge.findings)  # nobody need publish it


@pytest.mark.parametrize("changes", [(), BEHIND_DDS])
def test_static_transforms_that_came_before_the_bridge_count(
    changes: tuple[tuple[str, str], ...],
) -> None:
    places = {"transforms": [static("base_link", "camera", (0.4, 0.0, 0.3), OPTICAL)]}
    team = lab(("[robots.r2]", '[robots.r2]\nros2 = { map_frame = "r2/map" }'), *changes)
    endpoint = free_endpoint()
    ours, of_robots = settings_of_nodes(team, endpoint)
    with (
        open_router(team.name, [endpoint]),
        open_bus(team.name, [endpoint]) as bus,
        open_node(of_robots) as robots,
    ):
        robots.publisher("r1/tf_static", types.TRANSFORMS, LATCHED).publish(
            message(types.TRANSFORMS, **places)
        )
        with open_node(ours) as node:
            bridge = TeamBridge(team, list(team.robots), node, bus, time.time_ns)
            heard: list[Received] = []
            robots.subscribe("r2/tf_static", types.TRANSFORMS, heard.append, STATIC_TRANSFORMS)
            infos = robots.publisher("r1/camera_info", types.CAMERA_INFO)

            def findings() -> str:
                infos.publish(camera_info(header=_header(time.time_ns())))
                bridge.look_for_findings()
                return "\n".join(bridge.findings)

            assert eventually(lambda: "mounted at x_m = 0.400, y_m = 0.000" in findings())
            assert eventually(lambda: bool(heard))
            (own_map,) = heard[0].message.transforms
            assert (own_map.header.frame_id, own_map.child_frame_id) == ("map", "r2/map")
            assert own_map.transform.rotation.w == 1.0


def test_the_bridge_says_what_it_does_not_hear() -> None:
    position = '[robots.r2]\nros2 = { position = "gps/pose" }'
    with stand(lab(("[robots.r2]", position))) as own:
        own.robots.publisher("r1/odometry", types.ODOMETRY)  # the file has r1/odom
        own.robots.publisher("r2/odom", types.POSE)

        def lines() -> str:
            own.bridge.look_for_findings()
            return "\n".join(own.bridge.findings)

        assert eventually(lambda: "nav_msgs/msg/Odometry is published on r1/odometry" in lines())
        assert "r2/odom" in lines()
        gps = own.robots.publisher("r2/gps/pose", types.POSE)
        own.send(gps, pose_stamped(time.time_ns(), Pose2(1.0, 1.0, 0.0), 0.1), robot=1)
        assert eventually(lambda: any(isinstance(one, Position) for one in own.inputs))
        own.bridge.look()
        assert eventually(lambda: "diagnostics" in own.heard)
        (bridge,) = (s for s in own.heard["diagnostics"][-1].status if s.name == "cpcbl: bridge")
        assert bridge.level == 1
        assert any("r1/odometry" in value.value for value in bridge.values)


def _place() -> tuple[Any, int]:
    settings = NodeSettings(connect=())
    return settings.layout, settings.domain


def _hash(node: RosNode) -> str:
    return node.types.type_hash(types.ODOMETRY)


def _header(stamp_ns: int) -> dict[str, Any]:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "camera"}
