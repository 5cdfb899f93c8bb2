"""A robot's pose as an output, at its own rate, while somebody subscribes."""

import msgspec

from cpcbl_agents.robot import NEVER_NS, Robot
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.json_messages import encode_json
from cpcbl_transport.messages import encode


class PoseOutput:
    """Publishes the pose, binary and as JSON, each only if it has subscribers."""

    def __init__(self, robot: Robot, bus: Bus, rate_hz: float, start_ns: int) -> None:
        self._robot, self._interval_ns = robot, int(1e9 / rate_hz)
        key, qos = topics.POSE.at(robot=robot.name), topics.POSE.qos
        self._as_binary = bus.publisher(key, qos)
        self._as_json = bus.publisher(topics.json_key(key), qos)
        self._due_ns = self._sent_ns = start_ns
        self._has_subscribers = False
        self.unconfirmed = ""
        """What is not confirmed about the pose, unless the robot is lost."""

    @property
    def next_ns(self) -> int:
        """When the next pose is due. Without a subscriber never: the robot looks for one whenever
        it works."""
        return self._due_ns if self._has_subscribers else NEVER_NS

    def step(self, now_ns: int) -> None:
        """Publishes the pose if it is due, wanted, and newer than the last one."""
        if now_ns < self._due_ns or self._robot.sensing.is_finished:
            return
        as_binary, as_json = self._as_binary.matching, self._as_json.matching
        self._has_subscribers = as_binary or as_json
        if not self._has_subscribers:
            self._due_ns = now_ns + self._interval_ns
            return
        self._due_ns = max(self._due_ns + self._interval_ns, now_ns + self._interval_ns // 2)
        pose = self._robot.pose(now_ns)
        if self.unconfirmed and not pose.lost:
            pose = msgspec.structs.replace(pose, unconfirmed=self.unconfirmed)
        if pose.stamp_ns <= self._sent_ns:
            return
        self._sent_ns = pose.stamp_ns
        if as_binary:
            self._as_binary.put(encode(pose))
        if as_json:
            self._as_json.put(encode_json(pose))
