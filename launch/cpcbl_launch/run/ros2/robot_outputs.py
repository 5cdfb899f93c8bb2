"""What the team gives to the topics of one robot in ROS 2: its pose and its transforms."""

from collections.abc import Callable

from cpcbl_launch.run.ros2.building import build_message
from cpcbl_launch.run.ros2.odometry_in import TrackPoint
from cpcbl_launch.run.ros2.planar import Fields, transform_fields
from cpcbl_launch.run.ros2.poses_out import (
    odometry_message,
    odometry_transform_message,
    pose_message,
    transform_message,
)
from cpcbl_launch.run.ros2.robot_inputs import RobotInputs
from cpcbl_team.config import Team
from cpcbl_team.geometry import Pose2
from cpcbl_transport.messages import Pose
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.node import RosNode
from cpcbl_transport.ros2.qos import DEFAULT, LATCHED, QosProfile

TRANSFORM_NS = 20_000_000  # between two transforms odometry -> robot


class Output:
    """One topic of ROS 2 that takes dictionaries."""

    def __init__(
        self,
        node: RosNode,
        topic: str,
        type_name: str,
        qos: QosProfile = DEFAULT,
        is_exclusive: bool = False,
    ) -> None:
        self._types, self._type_name = node.types, type_name
        self._publisher = node.publisher(topic, type_name, qos, is_exclusive)

    def put(self, fields: Fields) -> None:
        """Publishes a message with these fields."""
        self._publisher.publish(build_message(self._types, self._type_name, fields))


class RobotOutputs:
    """The pose of one robot as it comes. A lost robot's pose is not to be used, so nothing of it is
    published, and Nav2 stops when the last transform has become old."""

    def __init__(self, name: str, team: Team, node: RosNode, inputs: RobotInputs | None) -> None:
        """`inputs`: its odometry, if this bridge has it; without it there is no transform."""
        assert team.ros2 is not None
        self._ros2, self._inputs = ros2, inputs = team.ros2, inputs
        settings = team.robots[name]
        self._keys = keys = settings.ros2
        self._delay_ns = int(settings.odometry.delay_s * 1e9)

        def output(
            topic: str, type_name: str, qos: QosProfile = DEFAULT
        ) -> Callable[[Fields], None]:
            if not topic:
                return lambda fields: None
            is_pose = type_name != types.TRANSFORMS
            return Output(node, ros2.topic(name, topic), type_name, qos, is_pose).put

        has_odometry = inputs is not None and settings.odometry.moves
        self._pose = output(keys.pose, types.POSE)
        self._odometry = output(keys.pose_odometry, types.ODOMETRY)
        self._transforms = output(keys.tf if has_odometry else "", types.TRANSFORMS)
        self._transform_ns = 0
        self._map_frame = keys.map_frame or ros2.field_frame
        if self._map_frame != ros2.field_frame:
            of_map = output(keys.tf_static, types.TRANSFORMS, LATCHED)
            here = transform_fields(Pose2(0.0, 0.0, 0.0), ros2.field_frame, self._map_frame, 0)
            of_map({"transforms": [here]})

    def on_pose(self, pose: Pose) -> None:
        """Publishes a pose, and the transform that belongs to it."""
        if pose.lost:
            return
        at, frames, velocity = self._odometry_at(pose.stamp_ns - self._delay_ns)
        if at is None and self._ros2.sim_time:
            return  # its time in the simulation is not known
        ros_ns = pose.stamp_ns - self._delay_ns if at is None else at.ros_ns
        field_frame = pose.frame or self._map_frame
        self._pose(pose_message(pose, ros_ns, field_frame))
        if self._keys.pose_odometry:
            base_frame = frames[1] or "base_link"
            self._odometry(odometry_message(pose, ros_ns, (field_frame, base_frame), velocity))
        if at is None:
            return
        tolerance_s = self._ros2.transform_tolerance_s
        self._transforms(transform_message(pose, at, (field_frame, frames[0]), tolerance_s))

    def on_odometry(self) -> None:
        """Publishes odometry -> robot of the newest odometry, if asked for."""
        if not self._keys.republish_odometry_tf or self._inputs is None:
            return
        with self._inputs.lock:
            newest = self._inputs.odometry.track.newest
            frames = self._inputs.odometry.frame, self._inputs.odometry.base_frame
        if newest is not None and newest.team_ns - self._transform_ns >= TRANSFORM_NS:
            self._transform_ns = newest.team_ns
            self._transforms(odometry_transform_message(newest, frames))

    def _odometry_at(
        self, team_ns: int
    ) -> tuple[TrackPoint | None, tuple[str, str], tuple[float, float]]:
        """Odometry at a time, its frames, and the robot's velocity."""
        if self._inputs is None:
            return None, ("", ""), (0.0, 0.0)
        with self._inputs.lock:
            odometry = self._inputs.odometry
            at, velocity = odometry.track.at(team_ns), odometry.track.velocity()
            return at, (odometry.frame, odometry.base_frame), velocity
