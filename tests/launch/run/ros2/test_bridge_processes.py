"""The bridge as a process: a team that hears ROS 2 alone, and restarts of routers."""

import math
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import count
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from support.key_commands import keys
from support.processes import command_line, eventually
from support.programs import Program, programs
from support.ros2 import odometry, pose_stamped
from support.ros2_robots import (
    BusDrivers,
    Player,
    RosDrivers,
    Sensed,
    demo_file,
    play_in_real_time,
    recorded_drive,
    shifted_truth,
)

from cpcbl_launch.reporting.metrics import pose_errors
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import find_team, load_team
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry
from cpcbl_transport import topics
from cpcbl_transport.decoding import decode_by_key
from cpcbl_transport.messages import Refusal
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.node import NodeSettings, RosNode, open_node
from cpcbl_transport.ros2.subscription import Received
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

ROS2 = '[ros2]\n[defaults.ros2]\ndetections_3d = "detections_3d"\n'
TEAM = """
name = "lab"
[map.landmarks]
door = {{ x_m = 3.0, y_m = 0.0 }}
gate = {{ x_m = 0.0, y_m = 3.0 }}
[transport]
listen = ["{team}"]
connect = ["{team}"]
{more}
[ros2]
connect = ["{ros}"]
[robots.r1]
source = "external"
start = {{ x_m = 0.0, y_m = 0.0 }}
"""


class Outcome(NamedTuple):
    """Of one run: the RMSE of each robot (m), and what came on topics of ROS 2, by topic."""

    rmse_m: dict[str, float]
    heard: dict[str, int]
    findings: list[str]


@contextmanager
def team_running(path: Path, folder: Path, seconds: float) -> Iterator[None]:
    """`cpcbl-team up` beside the test, which ends it, and well."""
    words = ["up", str(path), "--duration", str(seconds), "--json", "--logs", str(folder / "logs")]
    with (folder / "up.out").open("w") as output:
        up = subprocess.Popen([*PROGRAM, *words], stdout=output, stderr=subprocess.STDOUT)
    try:
        yield
    finally:
        up.send_signal(signal.SIGINT)
        up.wait(timeout=30)


def played(folder: Path, drive: list[Sensed], run: Recorder, by_ros2: bool) -> Outcome:
    """The demonstration's robots as processes, which get their inputs in one of both ways."""
    folder.mkdir()
    path, endpoint = demo_file(folder, ROS2 if by_ros2 else ""), free_endpoint()
    path.write_text(path.read_text() + f'\n[transport]\nlisten = ["{endpoint}"]\n')
    team, heard = load_team(path), dict[str, int]()
    settings = NodeSettings(connect=(endpoint,), name="robots")
    with (
        team_running(path, folder, 120.0),
        open_bus(team.name, [endpoint]) as bus,
        open_node(settings) if by_ros2 else nullcontext() as node,
    ):
        recorder = Recorder(bus)
        player: Player
        if node is None:
            player = BusDrivers(bus, team.robots)
        else:
            player = RosDrivers(node, team.robots)
            count_outputs(node, list(team.robots), heard)
        wait_for_robots(bus, list(team.robots))
        if node is not None:
            assert eventually(lambda: "/cpcbl_bridge" in nodes_of(node))
        begin_ns = time.time_ns() + 300_000_000
        play_in_real_time(drive, player, begin_ns)
        until_s = 1e-9 * begin_ns + 1e-9 * drive[-1].message.stamp_ns - 0.3
        assert eventually(lambda: all(latest_s(recorder, name) > until_s for name in team.robots))
        findings = [] if node is None else node.findings()
    truth, rmse_m = shifted_truth(run, begin_ns), {}
    for name in team.robots:
        errors = pose_errors(recorder.samples(name, truth[name], begin_ns * 1e-9))
        rmse_m[name] = float(np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean()))
    return Outcome(rmse_m, heard, findings)


def latest_s(recorder: Recorder, name: str) -> float:
    stamps_ns = recorder.trajectory(name).stamps_ns
    return float(stamps_ns[-1]) * 1e-9 if len(stamps_ns) else 0.0


def wait_for_robots(bus: ZenohBus, names: list[str]) -> None:
    """Until all robots know their poses and somebody takes their odometry."""
    publishers = [bus.publisher(topics.IN_ODOMETRY.at(robot=n), topics.Qos.INPUT) for n in names]
    assert eventually(lambda: len(bus.tokens(topics.ALIVE.at())) >= len(names))
    assert eventually(lambda: all(publisher.matching for publisher in publishers))
    for publisher in publishers:
        publisher.close()


def nodes_of(node: RosNode) -> set[str]:
    return {endpoint.full_node_name for endpoint in node.endpoints() if endpoint.type_name}


def count_outputs(node: RosNode, names: list[str], heard: dict[str, int]) -> None:
    def note(topic: str) -> None:
        heard[topic] = heard.get(topic, 0) + 1

    wanted = [("diagnostics", types.DIAGNOSTICS), ("cpcbl/markers", types.MARKERS)]
    for name in names:
        wanted += [(f"{name}/amcl_pose", types.POSE), (f"{name}/tf", types.TRANSFORMS)]
    for topic, kind in wanted:
        node.subscribe(topic, kind, lambda received: note(received.topic))


def test_a_team_that_hears_ros_2_alone_localizes_and_gives_its_poses_back(tmp_path: Path) -> None:
    drive, run = recorded_drive(find_team(Path("demo")), 3, 6.0)
    outcome = played(tmp_path / "ros2", drive, run, by_ros2=True)
    # The observer stands and has no odometry, so it has no transform either.
    assert [line.partition(":")[0] for line in outcome.findings] == ["observer/tf"]
    for name, rmse_m in outcome.rmse_m.items():
        assert rmse_m < 0.5, name  # alone: nobody helps yet
        assert outcome.heard[f"{name}/amcl_pose"] > 20, name
        assert (f"{name}/tf" in outcome.heard) is (name != "observer"), name
    assert outcome.heard["diagnostics"] > 3
    assert outcome.heard["cpcbl/markers"] > 6


@pytest.mark.long
def test_through_the_bridge_robots_are_as_accurate_as_without_it(tmp_path: Path) -> None:
    drive, run = recorded_drive(find_team(Path("demo")), 1, 20.0)
    bus = played(tmp_path / "bus", drive, run, by_ros2=False)
    ros2 = played(tmp_path / "ros2", drive, run, by_ros2=True)
    for name, rmse_m in bus.rmse_m.items():
        assert ros2.rmse_m[name] == pytest.approx(rmse_m, rel=0.15, abs=0.005), name


@pytest.mark.thorough
def test_the_bridge_survives_the_restarts_of_both_routers(tmp_path: Path) -> None:
    team, ros = free_endpoint(), free_endpoint()
    path = tmp_path / "team.toml"
    path.write_text(TEAM.format(team=team, ros=ros, more=""))
    team_router = (*PROGRAM, "router", str(path))
    ros_router = (*PROGRAM, "router", str(path), "--listen", ros)
    bridge = (*PROGRAM, "bridge", "ros2", str(path))
    with programs(tmp_path, bridge=bridge, team=team_router) as running:
        own = running["bridge"]
        with programs(tmp_path, ros=ros_router):
            assert pass_odometry(team, ros)
        with programs(tmp_path, ros=ros_router):
            assert pass_odometry(team, ros)
            stop(running["team"])
            assert eventually(lambda: "lost the router" in own.said)
            with programs(tmp_path, again=team_router):
                assert pass_odometry(team, ros)
                stop(own)
                assert own.process.returncode == 130  # Ctrl-C ends it at once
    assert "Traceback" not in own.said


def stop(program: Program) -> None:
    program.process.send_signal(signal.SIGINT)
    program.process.wait(timeout=30)


def pass_odometry(team: str, ros: str) -> bool:
    """Whether odometry of r1 comes through the bridge, between two routers."""
    with open_bus("lab", [team]) as bus, open_node(NodeSettings(connect=(ros,))) as node:
        came: list[Odometry] = []

        def on_input(key: str, payload: bytes) -> None:
            message = decode_by_key(key, payload)
            assert not isinstance(message, Refusal)
            if isinstance(message, Odometry):
                came.append(message)

        bus.subscribe(topics.IN_ODOMETRY.at(robot="r1"), on_input)
        publisher = node.publisher("r1/odom", types.ODOMETRY)
        n = 0

        def has_come() -> bool:
            nonlocal n
            n += 1
            publisher.publish(odometry(time.time_ns(), Pose2(0.001 * n, 0.0, 0.0)))
            return bool(came)

        return eventually(has_come)


def test_a_robot_starts_its_bridge_and_ends_it(tmp_path: Path) -> None:
    team, ros = free_endpoint(), free_endpoint()
    path = tmp_path / "team.toml"
    path.write_text(TEAM.format(team=team, ros=ros, more=""))
    with programs(
        tmp_path,
        team=(*PROGRAM, "router", str(path)),
        ros=(*PROGRAM, "router", str(path), "--listen", ros),
        robot=(*PROGRAM, "robot", str(path), "r1"),
    ) as running:
        with open_node(NodeSettings(connect=(ros,))) as node:
            assert eventually(robot_hears(node, running["robot"]))
            assert eventually(robot_goes_where_rviz_says(node, robot_hears(node, running["robot"])))
        assert "node cpcbl_bridge_r1 in ROS 2" in running["robot"].said


def robot_hears(node: RosNode, robot: Program) -> Callable[[], bool]:
    """Publishes odometry of r1 each time that it is called; whether its process takes some."""
    publisher, counter = node.publisher("r1/odom", types.ODOMETRY), count(1)

    def is_heard() -> bool:
        pose = Pose2(0.001 * next(counter), 0.0, 0.0)
        publisher.publish(odometry(time.time_ns(), pose))
        return "r1: first odometry" in robot.said

    return is_heard


def robot_goes_where_rviz_says(node: RosNode, drive: Callable[[], bool]) -> Callable[[], bool]:
    """Whether the pose of r1 is the one that somebody gives it once."""
    poses: list[tuple[float, float]] = []

    def note(received: Received) -> None:
        position = received.message.pose.pose.position
        poses.append((position.x, position.y))

    node.subscribe("r1/amcl_pose", types.POSE, note)
    rviz, sent = node.publisher("r1/initialpose", types.POSE), list[int]()

    def is_there() -> bool:
        drive()
        if poses and rviz.matching and not sent:
            assert math.hypot(*poses[-1]) < 0.5  # its start
            sent.append(time.time_ns())
            rviz.publish(pose_stamped(sent[0], Pose2(2.0, 1.0, 0.5), 0.3))
        return bool(sent) and math.dist(poses[-1], (2.0, 1.0)) < 0.5

    return is_there


@pytest.mark.thorough
def test_the_bridge_of_a_secured_team_has_a_certificate_of_its_own(tmp_path: Path) -> None:
    team, ros = free_endpoint("tls"), free_endpoint()
    path = tmp_path / "team.toml"
    text = TEAM.format(team=team, ros=ros, more='security = "mtls"')
    path.write_text(text + '[robots.r2]\nsource = "external"\n')
    keys(path)
    assert (tmp_path / "keys" / "bridge" / "private.key").exists()
    with (
        programs(
            tmp_path,
            team=(*PROGRAM, "router", str(path)),
            plain=(*PROGRAM, "router", "--config", str(plain_router(tmp_path, ros))),
            robot=(*PROGRAM, "robot", str(path), "r1", "--parent", str(os.getpid())),
            bridge=(*PROGRAM, "bridge", "ros2", str(path)),
        ) as running,
        open_node(NodeSettings(connect=(ros,))) as node,
    ):
        has_come = robot_hears(node, running["robot"])
        assert eventually(has_come)
        heard: dict[str, int] = {}
        count_outputs(node, ["r1"], heard)
        assert eventually(lambda: has_come() and "r1/amcl_pose" in heard)


def plain_router(folder: Path, endpoint: str) -> Path:
    """The configuration of a router of ROS 2, which knows nothing of the team."""
    path = folder / "router.json5"
    path.write_text(f'{{mode: "router", listen: {{endpoints: ["{endpoint}"]}}}}')
    return path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("connect", "connec"), "ros2.connec: unknown key; did you mean 'connect'?"),
        (('["{ros}"]', '["rmw:7447"]'), "ros2.connect: 'rmw:7447': no endpoint"),
        (
            ("[robots.r1]", '[robots.r1]\nros2 = {{ map_frame = "m", tf_static = "" }}'),
            "map_frame: no",
        ),
        (("[robots.r1]", '[robots.r1]\nros2 = {{ odometry_frame = "map" }}'), "odometry_frame: is"),
        (('["{ros}"]', '["tls/a:1"]'), "ros2.connect: 'tls/a:1': needs certificates"),
    ],
)
def test_check_names_the_key(tmp_path: Path, change: tuple[str, str], said: str) -> None:
    path = tmp_path / "team.toml"
    head, _, tail = TEAM.partition("[ros2]")
    path.write_text(f"{head}[ros2]{tail.replace(*change)}".format(team="tcp/a:1", ros="b", more=""))
    done = command_line("check", path)
    assert done.returncode == 2
    assert said in done.stderr + done.stdout
