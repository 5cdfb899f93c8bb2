"""NavSatFix and PoseWithCovarianceStamped as positions in the field's frame."""

import math
from collections.abc import Collection
from typing import Any

from cpcbl_launch.run.ros2.planar import planar_pose
from cpcbl_launch.run.ros2.refused import BadMessage, Refused, is_finite
from cpcbl_team.config import Datum
from cpcbl_team.initial_pose import is_covariance
from cpcbl_team.inputs import InitialPose, Position

EQUATOR_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563  # WGS 84
FARTHEST_M = 50_000.0  # beyond, the plane is not the earth

RVIZ_COVARIANCE = 0.25, 0.0, 0.25, 0.0, 0.0, math.radians(15.0) ** 2
Covariance = tuple[float, float, float]


def position_of_pose(
    message: Any, stamp_ns: int, field_frame: str, sigma_m: float | None
) -> Position | Refused:
    """A geometry_msgs/PoseWithCovarianceStamped in the field's frame as a position. `sigma_m`: of a
    message without a covariance."""
    if (frame := message.header.frame_id.strip("/")) != field_frame.strip("/"):
        text = f"frame {field_frame!r} expected, {frame!r} came"
        return Refused(BadMessage.WRONG_FRAME, text)
    pose = planar_pose(message.pose.pose)
    if isinstance(pose, Refused):
        return pose
    c = [float(n) for n in message.pose.covariance]
    covariance = _covariance(c[0], 0.5 * (c[1] + c[6]), c[7], sigma_m)
    if isinstance(covariance, Refused):
        return covariance
    return Position(stamp_ns, pose.x, pose.y, covariance)


def initial_pose_of(message: Any, stamp_ns: int, frames: Collection[str]) -> InitialPose | Refused:
    """A geometry_msgs/PoseWithCovarianceStamped in one of the field's frames as a pose that
    somebody sets. A covariance of zeros, which programs send that have none, is that of RViz."""
    if (frame := message.header.frame_id.strip("/")) not in frames:
        text = f"frame {min(frames)!r} expected, {frame!r} came; set the fixed frame of RViz"
        return Refused(BadMessage.WRONG_FRAME, text)
    pose = planar_pose(message.pose.pose)
    if isinstance(pose, Refused):
        return pose
    c = [float(n) for n in message.pose.covariance]
    if not is_finite(c):
        return Refused(BadMessage.NOT_FINITE, "the covariance is not finite")
    xy, xh, yh = (0.5 * (c[i] + c[j]) for i, j in ((1, 6), (5, 30), (11, 31)))
    covariance = (c[0], xy, c[7], xh, yh, c[35]) if any(c) else RVIZ_COVARIANCE
    if not is_covariance(covariance):
        numbers = ", ".join(f"{n:g}" for n in covariance)
        return Refused(BadMessage.NOT_A_COVARIANCE, f"{numbers} is no covariance of x, y, heading")
    return InitialPose(stamp_ns, *pose, covariance)


def position_of_fix(
    message: Any, stamp_ns: int, datum: Datum, sigma_m: float | None
) -> Position | Refused:
    """A sensor_msgs/NavSatFix as a position. `sigma_m`: of a fix whose covariance is unknown."""
    if int(message.status.status) < 0:
        return Refused(BadMessage.NO_FIX, "the receiver has no fix")
    latitude, longitude = float(message.latitude), float(message.longitude)
    if not is_finite((latitude, longitude)):
        return Refused(BadMessage.NOT_FINITE, "latitude or longitude is not finite")
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        text = f"latitude {latitude:g}, longitude {longitude:g}: write degrees"
        return Refused(BadMessage.OUT_OF_RANGE, text)
    east, north = east_north(latitude, longitude, datum)
    if math.hypot(east, north) > FARTHEST_M:
        text = f"{math.hypot(east, north) * 1e-3:.0f} km from ros2.datum; correct one of them"
        return Refused(BadMessage.OUT_OF_RANGE, text)
    c = [float(n) for n in message.position_covariance]
    is_unknown = int(message.position_covariance_type) == 0
    of_east_north = _covariance(0.0, 0.0, 0.0, sigma_m) if is_unknown else None
    of_east_north = of_east_north or _covariance(c[0], c[1], c[4], sigma_m)
    if isinstance(of_east_north, Refused):
        return of_east_north
    cos, sin = math.cos(math.radians(datum.x_axis_deg)), math.sin(math.radians(datum.x_axis_deg))
    ee, en, nn = of_east_north
    rotated = (
        cos * cos * ee + 2.0 * cos * sin * en + sin * sin * nn,
        cos * sin * (nn - ee) + (cos * cos - sin * sin) * en,
        sin * sin * ee - 2.0 * cos * sin * en + cos * cos * nn,
    )
    return Position(stamp_ns, cos * east + sin * north, cos * north - sin * east, rotated)


def east_north(latitude_deg: float, longitude_deg: float, datum: Datum) -> tuple[float, float]:
    """Metres east and north of the datum, along the curvature of the ellipsoid at the middle of
    both latitudes: within 1 cm for fields of 2 km (Torge, Geodesy, section 4.1)."""
    middle = math.radians(0.5 * (latitude_deg + datum.latitude_deg))
    squared = FLATTENING * (2.0 - FLATTENING)
    w = math.sqrt(1.0 - squared * math.sin(middle) ** 2)
    along_meridian, across = EQUATOR_M * (1.0 - squared) / w**3, EQUATOR_M / w
    longitude = math.remainder(longitude_deg - datum.longitude_deg, 360.0)
    east = math.radians(longitude) * across * math.cos(middle)
    return east, math.radians(latitude_deg - datum.latitude_deg) * along_meridian


def _covariance(xx: float, xy: float, yy: float, sigma_m: float | None) -> Covariance | Refused:
    """A stated covariance (m^2), or that of `sigma_m` where none is stated."""
    if not is_finite((xx, xy, yy)):
        return Refused(BadMessage.NOT_FINITE, "the covariance is not finite")
    if xx == xy == yy == 0.0:
        if sigma_m is None:
            text = "no covariance; the driver must state it, or the table position_sensor sigma_m"
            return Refused(BadMessage.NOT_A_COVARIANCE, text)
        return sigma_m * sigma_m, 0.0, sigma_m * sigma_m
    if xx <= 0.0 or yy <= 0.0 or xy * xy > xx * yy:
        text = f"{xx:g}, {xy:g}, {yy:g} m^2 is no covariance"
        return Refused(BadMessage.NOT_A_COVARIANCE, text)
    return xx, xy, yy
