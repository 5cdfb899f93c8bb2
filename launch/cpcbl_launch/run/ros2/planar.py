"""Between messages of ROS 2, which are of space, and poses of the team, which are planar."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpcbl_launch.run.ros2.refused import BadMessage, Refused, is_finite
from cpcbl_team.geometry import Pose2

LEAST_NORM, MOST_NORM = 0.9, 1.1  # of a quaternion that is a rotation
S_NS = 1_000_000_000
Floats = NDArray[np.float64]
Fields = dict[str, Any]
"""A message that goes out: the fields that differ from their defaults."""


def stamp_of(header: Any) -> int:
    """The stamp of a header in ns."""
    return int(header.stamp.sec) * S_NS + int(header.stamp.nanosec)


def stamp_fields(stamp_ns: int) -> Fields:
    """builtin_interfaces/Time; a stamp before 1970 is 0."""
    sec, nanosec = divmod(max(0, stamp_ns), S_NS)
    return {"sec": sec, "nanosec": nanosec}


def header_fields(stamp_ns: int, frame: str) -> Fields:
    """std_msgs/Header."""
    return {"stamp": stamp_fields(stamp_ns), "frame_id": frame}


def yaw_of(quaternion: Any) -> float | Refused:
    """The heading (rad) of a rotation: where its x axis points, seen from above."""
    numbers = _rotation_numbers(quaternion)
    if isinstance(numbers, Refused):
        return numbers
    x, y, z, w = numbers
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def rotation_of(quaternion: Any) -> Floats | Refused:
    """The matrix (3, 3) of a rotation."""
    numbers = _rotation_numbers(quaternion)
    if isinstance(numbers, Refused):
        return numbers
    x, y, z, w = np.array(numbers) / math.hypot(*numbers)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def _rotation_numbers(quaternion: Any) -> tuple[float, float, float, float] | Refused:
    """x, y, z and w of a quaternion that is a rotation."""
    x, y, z, w = (float(getattr(quaternion, name)) for name in "xyzw")
    if not is_finite((x, y, z, w)):
        return Refused(BadMessage.NOT_FINITE, "the orientation is not finite")
    if not LEAST_NORM <= (norm := math.sqrt(x * x + y * y + z * z + w * w)) <= MOST_NORM:
        text = f"the orientation is no rotation: its quaternion has the length {norm:.3g}, not 1"
        return Refused(BadMessage.ZERO_QUATERNION, text)
    return x, y, z, w


def planar_pose(pose: Any) -> Pose2 | Refused:
    """geometry_msgs/Pose as a pose in the plane."""
    x, y, z = (float(getattr(pose.position, name)) for name in "xyz")
    if not is_finite((x, y, z)):
        return Refused(BadMessage.NOT_FINITE, "the position is not finite")
    yaw = yaw_of(pose.orientation)
    return yaw if isinstance(yaw, Refused) else Pose2(x, y, yaw)


def pose_fields(pose: Pose2) -> Fields:
    """geometry_msgs/Pose."""
    return {"position": {"x": pose.x, "y": pose.y}, "orientation": _about_z(pose.heading)}


def transform_fields(
    a_from_b: Pose2, a_frame: str, b_frame: str, stamp_ns: int, height_m: float = 0.0
) -> Fields:
    """geometry_msgs/TransformStamped."""
    translation = {"x": a_from_b.x, "y": a_from_b.y, "z": height_m}
    return {
        "header": header_fields(stamp_ns, a_frame),
        "child_frame_id": b_frame,
        "transform": {"translation": translation, "rotation": _about_z(a_from_b.heading)},
    }


def _about_z(angle: float) -> Fields:
    return {"x": 0.0, "y": 0.0, "z": math.sin(0.5 * angle), "w": math.cos(0.5 * angle)}


def covariance_36(xx: float, xy: float, yy: float, xh: float, yh: float, hh: float) -> list[float]:
    """A 6 x 6 covariance (row by row: x, y, z, roll, pitch, yaw) of a pose in the plane."""
    c = [0.0] * 36
    c[0], c[1], c[5] = xx, xy, xh
    c[6], c[7], c[11] = xy, yy, yh
    c[30], c[31], c[35] = xh, yh, hh
    return c
