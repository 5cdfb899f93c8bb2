"""Detection3DArray and Range as sightings, Image and CompressedImage as frames of a camera."""

import math
from collections.abc import Callable, Collection
from typing import Any

import msgspec

from cpcbl_launch.run.ros2.planar import Floats
from cpcbl_launch.run.ros2.refused import BadMessage, Refused, is_finite
from cpcbl_team.config import CameraSettings, RobotSettings
from cpcbl_team.errors import nearest_name
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport.messages import LARGEST_FRAME, Frame

MOST_DETECTIONS = 200
JPEG_QUALITY = 95
NEAREST_M = 0.01
CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4}
Note = Callable[[Refused], None]


def sightings_of_detections(
    message: Any,
    stamp_ns: int,
    settings: RobotSettings,
    names: Collection[str],
    note: Note,
    base_from_frame: Floats | None = None,
) -> Sightings | Refused:
    """A vision_msgs/Detection3DArray: the class of each detection names a landmark or a robot, and
    its position is in the robot's frame, or in the optical frame of the robot's camera. Of any
    other frame `base_from_frame` (4, 4) says where it is on the robot, if that is known."""
    frame = str(message.header.frame_id)
    kind = settings.ros2.detections_3d_frame
    is_optical = kind == "camera" or (kind == "by_name" and "optical" in frame)
    is_placed = kind == "by_name" and base_from_frame is not None
    if (
        not (is_optical or is_placed)
        and kind == "by_name"
        and not _is_base(frame, settings.ros2.base_frame)
    ):
        text = f"frame {frame!r} is neither the robot's nor an optical one; set detections_3d_frame"
        return Refused(BadMessage.WRONG_FRAME, text)
    if len(message.detections) > MOST_DETECTIONS:
        text = f"{len(message.detections)} detections; at most {MOST_DETECTIONS}"
        return Refused(BadMessage.BAD_DETECTION, text)
    robot_from_frame = _rotation(settings.camera) if is_optical else _UNTURNED
    offset = (settings.camera.x_m, settings.camera.y_m) if is_optical else (0.0, 0.0)
    if is_placed and base_from_frame is not None:
        ahead, left = base_from_frame[:2].tolist()
        robot_from_frame = (tuple(ahead[:3]), tuple(left[:3]))
        offset = ahead[3], left[3]
    found = []
    for detection in message.detections:
        seen = _sighting(detection, robot_from_frame, offset, names)
        if isinstance(seen, Sighting):
            found.append(seen)
        else:
            note(seen)
    return Sightings(stamp_ns, tuple(found))


def sightings_of_range(message: Any, stamp_ns: int, names: Collection[str]) -> Sightings | Refused:
    """A sensor_msgs/Range to the object that its frame_id names. Infinite is nothing in range
    (REP 117)."""
    name, range_m = str(message.header.frame_id).strip("/"), float(message.range)
    if name not in names:
        return _unknown(name, names)
    if math.isnan(range_m):
        return Refused(BadMessage.NOT_FINITE, "the range is not a number")
    if not float(message.min_range) <= range_m <= float(message.max_range) or range_m <= 0.0:
        text = f"{range_m:g} m is not from min_range {float(message.min_range):g} to max_range"
        return Refused(BadMessage.OUT_OF_RANGE, f"{text} {float(message.max_range):g} m")
    variance = float(getattr(message, "variance", 0.0))  # since Jazzy; 0: unknown
    if not math.isfinite(variance) or variance < 0.0:
        return Refused(BadMessage.NOT_A_COVARIANCE, f"variance {variance:g}")
    sigma_m = math.sqrt(variance) if variance > 0.0 else None
    return Sightings(stamp_ns, (Sighting(name, range_m, None, sigma_m),))


def frame_of_compressed(message: Any, stamp_ns: int) -> Frame | Refused:
    """A sensor_msgs/CompressedImage (JPEG or PNG) as it is."""
    image = bytes(message.data)
    if not image.startswith((b"\xff\xd8", b"\x89PNG")):
        text = f"format {str(message.format)[:32]!r} is neither JPEG nor PNG"
        return Refused(BadMessage.WRONG_ENCODING, text)
    return _bounded(Frame(stamp_ns, image))


def frame_of_image(message: Any, stamp_ns: int) -> Frame | Refused:
    """A sensor_msgs/Image as a JPEG."""
    import cv2  # only images need it
    import numpy as np

    encoding, data = str(message.encoding), np.asarray(message.data, np.uint8)
    channels = CHANNELS.get(encoding)
    if channels is None:
        known = ", ".join(CHANNELS)
        return Refused(BadMessage.WRONG_ENCODING, f"encoding {encoding[:32]!r}; use one of {known}")
    width, height, step = int(message.width), int(message.height), int(message.step)
    if step < width * channels or data.size != step * height or not width * height:
        text = f"{data.size} bytes are no {width} x {height} pixels of {encoding} in rows of {step}"
        return Refused(BadMessage.WRONG_SIZE, text)
    rows = data.reshape(height, step)[:, : width * channels]
    pixels = np.ascontiguousarray(rows).reshape(height, width, channels)
    if encoding.startswith("rgb"):
        code = cv2.COLOR_RGB2BGR if channels == 3 else cv2.COLOR_RGBA2BGR
        pixels = np.asarray(cv2.cvtColor(pixels, code), np.uint8)
    elif channels == 1:  # the robot's detector needs three
        pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR), np.uint8)
    _, jpeg = cv2.imencode(".jpg", pixels[..., :3], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return _bounded(Frame(stamp_ns, jpeg.tobytes()))


def _bounded(frame: Frame) -> Frame | Refused:
    if len(msgspec.msgpack.encode(frame)) >= LARGEST_FRAME:
        text = f"an image of {len(frame.image)} bytes; at most {LARGEST_FRAME}"
        return Refused(BadMessage.WRONG_SIZE, text)
    return frame


# Detection3D -------------------------------------------------------------------------------------

Row = tuple[float, float, float]
_UNTURNED: tuple[Row, Row] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def _is_base(frame: str, base_frame: str) -> bool:
    known = (base_frame.strip("/"), "base_link", "base_footprint")
    return frame.strip("/").rpartition("/")[2] in known or frame.strip("/") == known[0]


def _rotation(camera: CameraSettings) -> tuple[Row, Row]:
    """The first two rows of the rotation from the camera's optical frame to the robot's."""
    angles = (math.radians(a) for a in (camera.yaw_deg, camera.tilt_deg, camera.roll_deg))
    (cy, sy), (ct, st), (cr, sr) = ((math.cos(a), math.sin(a)) for a in angles)
    # yaw about z, tilt about y, roll about x; then x, y, z of the camera are -y, -z, x
    ahead = (cy * ct, cy * st * sr - sy * cr, cy * st * cr + sy * sr)
    left = (sy * ct, sy * st * sr + cy * cr, sy * st * cr - cy * sr)
    return (-ahead[1], -ahead[2], ahead[0]), (-left[1], -left[2], left[0])


def _sighting(
    detection: Any, rows: tuple[Row, Row], offset: tuple[float, float], names: Collection[str]
) -> Sighting | Refused:
    if not len(detection.results):
        return Refused(BadMessage.BAD_DETECTION, "a detection without a result")
    best = max(detection.results, key=lambda result: float(result.hypothesis.score))
    name = str(best.hypothesis.class_id)
    if name not in names:
        return _unknown(name, names)
    position = best.pose.pose.position
    point = float(position.x), float(position.y), float(position.z)
    covariance = [float(n) for n in best.pose.covariance]
    if not is_finite((*point, *covariance)):
        return Refused(BadMessage.NOT_FINITE, f"the pose of {name} is not finite")
    x, y = (
        o + sum(a * b for a, b in zip(row, point, strict=True))
        for row, o in zip(rows, offset, strict=True)
    )
    range_m = math.hypot(x, y)
    if range_m < NEAREST_M:
        text = f"{name} is at the robot itself: has the detector filled its pose in?"
        return Refused(BadMessage.BAD_DETECTION, text)
    bearing = math.atan2(y, x)
    if not any(covariance):
        return Sighting(name, range_m, bearing)
    of_plane = _planar_covariance(covariance, rows)
    along, across = (x / range_m, y / range_m), (-y / range_m, x / range_m)
    variances = [_along(of_plane, way) for way in (along, across)]
    if min(variances) <= 0.0:
        text = f"the covariance of {name} is none: its diagonal must be positive, or all of it 0"
        return Refused(BadMessage.NOT_A_COVARIANCE, text)
    range_sigma, across_sigma = map(math.sqrt, variances)
    return Sighting(name, range_m, bearing, range_sigma, across_sigma / range_m)


def _planar_covariance(c: list[float], rows: tuple[Row, Row]) -> Row:
    """xx, xy, yy in the robot's frame of the position in a 6 x 6 covariance."""

    def product(a: Row, b: Row) -> float:
        return sum(a[i] * c[6 * i + j] * b[j] for i in range(3) for j in range(3))

    return product(rows[0], rows[0]), product(rows[0], rows[1]), product(rows[1], rows[1])


def _along(covariance: Row, way: tuple[float, float]) -> float:
    xx, xy, yy = covariance
    return way[0] * way[0] * xx + 2.0 * way[0] * way[1] * xy + way[1] * way[1] * yy


def _unknown(name: str, names: Collection[str]) -> Refused:
    near = nearest_name(name, names)
    hint = f"did you mean {near!r}?" if near else "add it to the map"
    return Refused(BadMessage.UNKNOWN_NAME, f"no landmark or robot {name[:32]!r}; {hint}")
