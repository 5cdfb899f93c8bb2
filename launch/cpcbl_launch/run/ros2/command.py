"""Runs the bridge of a team to ROS 2: its sessions on both sides, until it is stopped."""

import logging
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from cpcbl_agents.clock import Clock
from cpcbl_launch.run.gateway.command import RouterWatch
from cpcbl_launch.run.processes import bridge_identity
from cpcbl_launch.run.ros2.bridge import TeamBridge
from cpcbl_launch.run.ros2.robot_inputs import has_tags
from cpcbl_launch.team.requirements import require_opencv
from cpcbl_launch.team.ros2_checks import INPUTS, OUTPUTS, SHARED
from cpcbl_team.config import Ros2RobotSettings, Ros2Settings, Team
from cpcbl_team.errors import InputError
from cpcbl_transport.ros2.access import BridgeTopics, access_control_of_bridge
from cpcbl_transport.ros2.names import Distribution, Layout
from cpcbl_transport.ros2.node import NodeSettings, open_node
from cpcbl_transport.security import (
    CA,
    CERTIFICATE,
    PRIVATE_KEY,
    Credentials,
    link_of,
)
from cpcbl_transport.zenoh_bus import open_bus

log = logging.getLogger(__name__)

LOOK_S = 0.1
WAITING_S = 10.0


def run_bridge(
    team: Team,
    robots: Collection[str],
    connect: Sequence[str],
    clock: Clock,
    stop: Callable[[], bool],
) -> None:
    """Bridges these robots until `stop()`. `connect`: the team's router. Raises BusError when
    stopped before both routers answered, SecurityError without the keys of a secured team,
    DependencyError without the extra `ros2`, RosNameError for a topic that is none."""
    team = with_ros2(team)
    assert team.ros2 is not None
    if any(needs_opencv(team, name) for name in robots):
        require_opencv("robots.NAME.ros2: AprilTag detections and images")
    link = link_of(team, bridge_identity(robots), connect)
    settings = node_settings(team.ros2, connect, robots if len(robots) == 1 else ())
    where = ", ".join(settings.connect)
    with open_bus(team.name, link.endpoints, stop, link.credentials) as bus:
        log.info("connected to the team's router at %s", ", ".join(link.endpoints))
        with open_node(settings, stop, _Waiting(where).tell) as node:
            log.info(
                "node %s in ROS 2 at %s: %s, domain %d, layout %s",
                *(settings.name, where, settings.distribution, settings.domain, settings.layout),
            )
            bridge = TeamBridge(team, robots, node, bus, clock.now_ns)
            watch = RouterWatch(bus, ", ".join(link.endpoints))
            while not stop():
                bridge.look()
                watch.look()
                time.sleep(LOOK_S)
            for line in bridge.refusals.lines():
                log.info("%s", line)


def with_ros2(team: Team) -> Team:
    """The team, with the defaults of the table `ros2` where its file has none."""
    from msgspec.structs import replace

    return team if team.ros2 is not None else replace(team, ros2=Ros2Settings())


def needs_opencv(team: Team, name: str) -> bool:
    """Whether the bridge of a robot turns tags or images into inputs."""
    robot = team.robots[name]
    if robot.source != "external":
        return False
    if robot.sensing == "camera":
        return bool(robot.ros2.image)
    return bool(robot.ros2.detections) and has_tags(team)


def node_settings(
    ros2: Ros2Settings, team_connect: Sequence[str], own: Collection[str] = ()
) -> NodeSettings:
    """Where the bridge's node is. `own`: the one robot that it is for. Raises InputError for keys
    that are not there."""
    name = "_".join(["cpcbl_bridge", *own]).replace("-", "_").replace(".", "_")
    return NodeSettings(
        connect=ros2.connect or tuple(team_connect),
        name=name,
        domain=ros2.domain,
        distribution=Distribution(ros2.distribution),
        layout=Layout(ros2.layout),
        credentials=_credentials(ros2.keys),
    )


def router_access(team: Team, bridge: Sequence[str], nodes: Sequence[str]) -> dict[str, Any]:
    """The access control of the router of ROS 2, for these common names of certificates."""
    ros2 = with_ros2(team).ros2
    assert ros2 is not None
    read, own, shared = list[str](), list[str](), [ros2.diagnostics, ros2.markers]
    for name, robot in team.robots.items():
        own += _topics(ros2, name, robot.ros2, OUTPUTS)
        shared += _topics(ros2, name, robot.ros2, SHARED if robot.ros2.map_frame else ("tf",))
        if robot.source == "external":
            read += _topics(ros2, name, robot.ros2, (*INPUTS, "tf_static"))
    written = [topic.lstrip("/") for topic in (*own, *shared) if topic]
    topics = BridgeTopics(*(tuple(dict.fromkeys(part)) for part in (read, written, own)))
    return access_control_of_bridge(topics, Layout(ros2.layout), ros2.domain, bridge, nodes)


def _topics(
    ros2: Ros2Settings, robot: str, settings: Ros2RobotSettings, keys: Iterable[str]
) -> list[str]:
    """The topics of a robot that these keys name."""
    return [ros2.topic(robot, topic) for key in keys if (topic := getattr(settings, key))]


def _credentials(keys: str) -> Credentials | None:
    if not keys:
        return None
    paths = [Path(keys) / name for name in (CA, CERTIFICATE, PRIVATE_KEY)]
    for path in paths:
        if not path.is_file():
            raise InputError(f"ros2.keys: {path}: no such file; put it there, or empty the key")
    return Credentials(*map(str, paths))


class _Waiting:
    """Says from time to time that the router of ROS 2 does not answer."""

    def __init__(self, where: str) -> None:
        self._where, self._said_s = where, -WAITING_S

    def tell(self, reason: str) -> None:
        if time.monotonic() - self._said_s >= WAITING_S:
            self._said_s = time.monotonic()
            log.warning("no router of ROS 2 at %s yet%s", self._where, reason and f": {reason}")
