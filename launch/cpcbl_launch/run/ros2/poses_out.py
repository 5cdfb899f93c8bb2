"""A robot's pose as ROS 2 has it: where AMCL publishes it, as odometry, and as a transform.

By REP 105 the robot is in the tree `map -> odom -> base_link`, and localization publishes the first
transform alone: it computes it from the pose and from odometry at the same time.
"""

from cpcbl_launch.run.ros2.odometry_in import TrackPoint
from cpcbl_launch.run.ros2.planar import (
    Fields,
    covariance_36,
    header_fields,
    pose_fields,
    transform_fields,
)
from cpcbl_team.geometry import Pose2
from cpcbl_transport.messages import Pose

UNKNOWN = 1e6  # m^2, rad^2: of a pose without a covariance


def pose_message(pose: Pose, ros_ns: int, field_frame: str) -> Fields:
    """geometry_msgs/PoseWithCovarianceStamped, as AMCL publishes it."""
    return {"header": header_fields(ros_ns, field_frame), "pose": _with_covariance(pose)}


def odometry_message(
    pose: Pose, ros_ns: int, frames: tuple[str, str], velocity: tuple[float, float]
) -> Fields:
    """nav_msgs/Odometry of the pose. `frames`: the field's and the robot's; `velocity`: of the
    robot's odometry, m/s and rad/s."""
    field_frame, base_frame = frames
    twist = {"linear": {"x": velocity[0]}, "angular": {"z": velocity[1]}}
    return {
        "header": header_fields(ros_ns, field_frame),
        "child_frame_id": base_frame,
        "pose": _with_covariance(pose),
        "twist": {"twist": twist},
    }


def field_from_odometry(pose: Pose, at: TrackPoint) -> Pose2:
    """The transform field -> odometry at the time of both."""
    field_from_base = Pose2(pose.x_m, pose.y_m, pose.heading_rad)
    return field_from_base @ at.odometry_from_base.inverse()


def transform_message(
    pose: Pose, at: TrackPoint, frames: tuple[str, str], tolerance_s: float
) -> Fields:
    """tf2_msgs/TFMessage with field -> odometry, stamped `tolerance_s` ahead. `frames`: the
    field's and that of odometry."""
    stamp_ns = at.ros_ns + int(tolerance_s * 1e9)
    transform = field_from_odometry(pose, at)
    return {"transforms": [transform_fields(transform, *frames, stamp_ns)]}


def odometry_transform_message(at: TrackPoint, frames: tuple[str, str]) -> Fields:
    """tf2_msgs/TFMessage with odometry -> robot, for a driver that publishes none."""
    return {"transforms": [transform_fields(at.odometry_from_base, *frames, at.ros_ns)]}


def _with_covariance(pose: Pose) -> Fields:
    planar = Pose2(pose.x_m, pose.y_m, pose.heading_rad)
    numbers = (UNKNOWN, 0.0, UNKNOWN, 0.0, 0.0, UNKNOWN)
    if pose.covariance is not None:
        (xx, xy, xh), (_, yy, yh), (_, _, hh) = pose.covariance
        numbers = (xx, xy, yy, xh, yh, hh)
    return {"pose": pose_fields(planar), "covariance": covariance_36(*numbers)}
