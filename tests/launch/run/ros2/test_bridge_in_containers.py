"""The bridge of a team in containers: nodes of ROS 2 outside give odometry, and get poses."""

import secrets
import time
from itertools import count
from pathlib import Path

import pytest
from support.docker import Composed, image
from support.processes import cpcbl_team, eventually
from support.ros2 import odometry

from cpcbl_launch.run.containers.docker import compose_program
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.geometry import Pose2
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.node import NodeSettings, open_node
from cpcbl_transport.ros2.subscription import Received

pytestmark = [pytest.mark.docker, pytest.mark.timeout(600)]

TEAM = """name = "{name}"
[ros2]
[robots.r1]
source = "external"
start = {{ x_m = 1.0, y_m = 2.0 }}
"""


def test_the_bridge_of_a_compose_file_gives_a_robot_its_odometry_and_its_pose_back(
    tmp_path: Path,
) -> None:
    file, compose = tmp_path / "team.toml", tmp_path / "compose.yaml"
    file.write_text(TEAM.format(name=f"ros{secrets.token_hex(3)}"))
    printed = cpcbl_team("compose", file, "--image", image("ros2"), "--output", compose)
    assert printed.returncode == 0, printed.stderr
    router = free_endpoint()
    published = router.removeprefix("tcp/")
    compose.write_text(compose.read_text().replace("127.0.0.1:7447:", f"{published}:"))
    project = Composed(compose_program(), f"cpcbl-test-{secrets.token_hex(3)}", compose)
    came: list[Received] = []
    try:
        project.up()
        with open_node(NodeSettings(connect=(router,), name="r1")) as node:
            node.subscribe("r1/amcl_pose", types.POSE, came.append)
            publisher, steps = node.publisher("r1/odom", types.ODOMETRY), count(1)

            def is_ahead() -> bool:
                pose = Pose2(0.01 * next(steps), 0.0, 0.0)
                publisher.publish(odometry(time.time_ns(), pose))
                return bool(came) and came[-1].message.pose.pose.position.x > 1.05

            assert eventually(is_ahead, 60.0), project.last_log_line("bridge")
    finally:
        project.down()
