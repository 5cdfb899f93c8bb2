"""The bridge of a team's robots to ROS 2: their topics on one side, the team's bus on the other."""

import logging
import time
from collections.abc import Callable, Collection
from functools import partial

from cpcbl_launch.reporting.frames import main_frame
from cpcbl_launch.run.ros2.diagnostics_out import (
    bridge_diagnostic,
    diagnostics_message,
    robot_diagnostic,
)
from cpcbl_launch.run.ros2.markers_out import helpers, markers_message
from cpcbl_launch.run.ros2.refused import RefusalLog
from cpcbl_launch.run.ros2.robot_inputs import InputTopic, RobotInputs, has_tags
from cpcbl_launch.run.ros2.robot_outputs import Output, RobotOutputs
from cpcbl_launch.run.ros2.stamps import SimulatedStamps, StampMap, UnixStamps
from cpcbl_team.config import Field, Team
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import Pose, Status
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.node import RosNode
from cpcbl_transport.ros2.subscription import Received as RosReceived

log = logging.getLogger(__name__)

DIAGNOSTICS_S = 1.0
FINDINGS_S = 5.0  # between two looks at what is not heard
FIRST_FINDINGS_S = 3.0  # so long the others take to be seen
HELP_S = 2.0  # so long a line shows who helped whom
FRESH_S = 3.0
MARKERS_LAST = 3.0  # intervals of markers


class RobotBridge:
    """One robot. Messages of both sides come on threads of their own."""

    def __init__(
        self,
        name: str,
        team: Team,
        node: RosNode,
        bus: Bus,
        stamps: StampMap,
        now_ns: Callable[[], int],
        refusals: RefusalLog,
    ) -> None:
        self.name = name
        self.pose: Pose | None = None
        self.status: Status | None = None
        self.pose_s = self.status_s = time.monotonic()
        self.helpers: dict[str, float] = {}  # when each teammate last helped it
        self._received: dict[str, int] = {}
        is_driven = team.robots[name].source == "external"
        self.inputs = None
        if is_driven:
            self.inputs = RobotInputs(name, team, bus, stamps, now_ns, refusals)
        self._outputs = RobotOutputs(name, team, node, self.inputs)
        for row in self.inputs.topics() if self.inputs is not None else ():
            on_message = partial(self._on_message, row)
            qos, optional = row.qos, row.is_optional
            node.subscribe(row.topic, row.type_name, on_message, qos, is_optional=optional)
        Subscriber(bus, Pose, self._on_pose, robot=name)
        Subscriber(bus, Status, self._on_status, robot=name)

    def _on_message(self, row: InputTopic, received: RosReceived) -> None:
        assert self.inputs is not None
        self.inputs.on_message(row, received.message)
        if row.type_name == types.ODOMETRY:
            self._outputs.on_odometry()

    def _on_pose(self, received: Received[Pose]) -> None:
        self.pose, self.pose_s = received.message, time.monotonic()
        self._outputs.on_pose(received.message)

    def _on_status(self, received: Received[Status]) -> None:
        self.status, self.status_s = received.message, time.monotonic()
        self._received, latest = helpers(self._received, received.message)
        self.helpers |= dict.fromkeys(latest, self.status_s)

    def findings(self) -> list[str]:
        """What of this robot does not come or is not taken."""
        return [] if self.inputs is None else self.inputs.findings()


class TeamBridge:
    """The bridge of some robots of a team, or of all."""

    def __init__(
        self,
        team: Team,
        robots: Collection[str],
        node: RosNode,
        bus: Bus,
        now_ns: Callable[[], int],
    ) -> None:
        """`now_ns`: the team's time."""
        assert team.ros2 is not None
        self._team, self._ros2, self._node = team, team.ros2, node
        self._is_whole = len(robots) == len(team.robots)
        self._now_ns, self.refusals = now_ns, RefusalLog()
        simulated = SimulatedStamps()  # one simulation has one clock
        self.robots = [
            RobotBridge(
                name,
                team,
                node,
                bus,
                simulated if team.ros2.sim_time else UnixStamps(),
                now_ns,
                self.refusals,
            )
            for name in robots
        ]
        self._diagnostics = self._output(self._ros2.diagnostics, types.DIAGNOSTICS)
        self._markers = self._output(self._ros2.markers, types.MARKERS)
        now_s = time.monotonic()
        self._markers_s = self._diagnostics_s = now_s
        self._findings_s = now_s + FIRST_FINDINGS_S
        self._findings: list[str] = []

    def _output(self, topic: str, type_name: str) -> Output | None:
        if not topic:
            return None
        return Output(self._node, self._ros2.topic("", topic), type_name)

    def look(self) -> None:
        """Publishes what is due and says what is not heard; to be called several times a second."""
        now_s = time.monotonic()
        if now_s >= self._findings_s:
            self._findings_s = now_s + FINDINGS_S
            self.look_for_findings()
        if self._diagnostics is not None and now_s >= self._diagnostics_s:
            self._diagnostics_s = now_s + DIAGNOSTICS_S
            self._diagnostics.put(self._diagnostics_fields(now_s))
        if self._markers is not None and now_s >= self._markers_s:
            self._markers_s = now_s + 1.0 / self._ros2.markers_rate_hz
            self._markers.put(self._marker_fields(now_s))

    @property
    def findings(self) -> list[str]:
        """What was found at the last look, one line each."""
        return self._findings

    def look_for_findings(self) -> None:
        """Looks for what is not heard, and logs what is new."""
        lines = self._node.findings()
        for robot in self.robots:
            lines += robot.findings()
        self._tell(lines + self._unread_tags())

    def _unread_tags(self) -> list[str]:
        """Detections that are published, although no tag has a meaning."""
        if has_tags(self._team):
            return []
        topics = {e.topic for e in self._node.endpoints() if e.type_name == types.APRIL_TAGS}
        return [
            f"{topic}: is not read, because the team file has no tags: add markers or ros2.tags"
            for topic in sorted(topics)
        ]

    def _tell(self, lines: list[str]) -> None:
        """Logs what is new, and that all is well again."""
        known = {_without_numbers(line) for line in self._findings}
        for line in lines:
            if _without_numbers(line) not in known:
                log.warning("%s", line)
        if self._findings and not lines:
            log.info("all topics are heard")
        self._findings = lines

    def _diagnostics_fields(self, now_s: float) -> types.Message:
        statuses = [
            robot_diagnostic(robot.name, robot.status, now_s - robot.status_s)
            for robot in self.robots
        ]
        refused = self.refusals.lines()
        own = "" if self._is_whole else ",".join(robot.name for robot in self.robots)
        statuses.append(bridge_diagnostic(own, [*self._findings, *refused]))
        return diagnostics_message(statuses, self._now_ns())

    def _marker_fields(self, now_s: float) -> types.Message:
        poses = {
            robot.name: robot.pose
            for robot in self.robots
            if robot.pose is not None and now_s - robot.pose_s < FRESH_S
        }
        helps = [
            (helper, robot.name)
            for robot in self.robots
            for helper, at_s in robot.helpers.items()
            if now_s - at_s < HELP_S
        ]
        lasting_s = MARKERS_LAST / self._ros2.markers_rate_hz
        shown = main_frame({name: pose.frame for name, pose in poses.items()})
        poses = {name: pose for name, pose in poses.items() if pose.frame == shown}
        field, frame = (Field(), shown) if shown else (self._team.map, self._ros2.field_frame)
        return markers_message(poses, helps, field, frame, lasting_s)


def _without_numbers(line: str) -> str:
    return "".join(c for c in line if not c.isdigit())
