"""A run as Foxglove's protobuf messages, which Foxglove, Rerun and others show without our code.

Poses are in the frame `field`; each robot has a frame `robot/<name>`, a simulated one also
`truth/<name>`. Of Foxglove's messages only Odometry has a covariance. Ellipses, trails and true
poses are not as many as poses.
"""

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import Message as Protobuf
from google.protobuf.timestamp_pb2 import Timestamp

from cpcbl_launch.reporting.events import Event, EventLog
from cpcbl_launch.reporting.frames import FrameOrigins
from cpcbl_launch.reporting.metrics import ellipse_of
from cpcbl_launch.reporting.recorded_file import CAMERAS
from cpcbl_launch.reporting.statuses import current_help
from cpcbl_team.config import Team
from cpcbl_team.frames import frame_text
from cpcbl_transport.messages import (
    AnnotatedFrame,
    LandmarkEstimate,
    Message,
    Status,
    Track,
    Truths,
)

FIELD = frame_text("")
SCENE_NS, TRAIL_NS, TRUTH_NS = 200_000_000, 1_000_000_000, 100_000_000  # between two of a robot
TRAIL_LENGTH = 30
HELP_SHOWN = Duration(seconds=2)
PALETTE = ("56b4e9", "f0a830", "35c99c", "e58fc3", "8fd3f5", "a99df0", "d6bf7a")
MARK, LOST = "c5d0da", "ff5d66"
LEVELS = {"good": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}


class FoxgloveMessage(NamedTuple):
    """A message of Foxglove's, and the topic on which it is."""

    topic: str
    message: Protobuf


class _Robot:
    """What is known of a robot, and when its parts were shown last."""

    def __init__(self, colour: str) -> None:
        self.colour = colour
        self.track: Track | None = None
        self.trail: deque[Point3] = deque(maxlen=TRAIL_LENGTH)
        self.scene_ns = self.trail_ns = -SCENE_NS


class FoxgloveRun:
    """Makes Foxglove's messages of a run, message by message in the order of their times."""

    def __init__(self, team: Team) -> None:
        self._team = team
        self._robots: dict[str, _Robot] = {}
        self._events = EventLog()
        self._truth_ns = -TRUTH_NS
        self._origins = FrameOrigins()
        for name in sorted(team.robots):
            self._robot(name)

    def map(self, at_ns: int) -> FoxgloveMessage:
        """The landmarks and walls, which do not move."""
        stamp, field = _stamp(at_ns), self._team.map
        entities = [
            SceneEntity(
                timestamp=stamp,
                frame_id=FIELD,
                id=f"landmark/{name}",
                cylinders=[_disc(mark.x_m, mark.y_m, 0.15, 0.15, 0.0, 0.3, _colour(MARK))],
                texts=[_text(name, mark.x_m, mark.y_m, MARK)],
            )
            for name, mark in field.landmarks.items()
        ]
        entities += [
            SceneEntity(
                timestamp=stamp,
                frame_id=FIELD,
                id=f"wall/{name}",
                lines=[_line([Point3(x=x, y=y) for x, y in (wall.from_m, wall.to_m)], 0.05, MARK)],
            )
            for name, wall in field.walls.items()
        ]
        return FoxgloveMessage("/map", SceneUpdate(entities=entities))

    def messages_for(self, at_ns: int, message: Message) -> Iterator[FoxgloveMessage]:
        """What is to be shown of a message."""
        yield from map(_log, self._events.events(at_ns, message))
        match message:
            case Track():
                self._origins.note_track(message)
                yield from self._of_track(at_ns, message)
            case Status():
                yield from self._of_status(at_ns, message)
            case Truths():
                self._origins.note_truths(message)
                if at_ns - self._truth_ns >= TRUTH_NS:
                    self._truth_ns = at_ns
                    yield from _of_truths(at_ns, message)
                    yield from self._of_origins(at_ns)
            case AnnotatedFrame() if message.image:
                image = CompressedImage(
                    timestamp=_stamp(at_ns),
                    frame_id=_frame(message.robot),
                    data=message.image,
                    format="jpeg",
                )
                yield FoxgloveMessage(f"{CAMERAS}{message.robot}", image)

    def _robot(self, name: str) -> _Robot:
        if name not in self._robots:
            self._robots[name] = _Robot(PALETTE[len(self._robots) % len(PALETTE)])
        return self._robots[name]

    def _of_origins(self, at_ns: int) -> Iterator[FoxgloveMessage]:
        """Where the frames that robots began are, as far as the truth tells. Of others there is no
        transform: nobody knows how they lie to each other."""
        found = [
            FrameTransform(
                timestamp=_stamp(at_ns),
                parent_frame_id=FIELD,
                child_frame_id=frame,
                translation=pose.position,
                rotation=pose.orientation,
            )
            for frame, origin in self._origins.field_from_frame.items()
            if frame and (pose := _pose(*origin))
        ]
        if found:
            yield FoxgloveMessage("/tf", FrameTransforms(transforms=found))

    def _of_track(self, at_ns: int, track: Track) -> Iterator[FoxgloveMessage]:
        robot, stamp, frame = self._robot(track.robot), _stamp(at_ns), frame_text(track.frame)
        if robot.track is not None and robot.track.frame != track.frame:
            robot.trail.clear()  # of another frame
        robot.track = track
        pose, at = _pose(track.x_m, track.y_m, track.heading_rad), f"/robots/{track.robot}"
        yield FoxgloveMessage(
            "/tf", FrameTransforms(transforms=[_transform(stamp, track.robot, pose, frame)])
        )
        yield FoxgloveMessage(f"{at}/pose", PoseInFrame(timestamp=stamp, frame_id=frame, pose=pose))
        uncertain = Odometry(
            timestamp=stamp, frame_id=frame, body_frame_id=_frame(track.robot), pose=pose
        )
        if track.covariance is not None:
            uncertain.pose_covariance.extend(_covariance_6x6(*track.covariance))
        yield FoxgloveMessage(f"{at}/odometry", uncertain)
        if at_ns - robot.scene_ns >= SCENE_NS:
            robot.scene_ns = at_ns
            yield FoxgloveMessage(
                f"{at}/scene", SceneUpdate(entities=[_robot_entity(stamp, track, robot)])
            )
        if at_ns - robot.trail_ns >= TRAIL_NS:
            robot.trail_ns = at_ns
            robot.trail.append(Point3(x=track.x_m, y=track.y_m))
            trail = _line(list(robot.trail), 0.03, robot.colour, 0.6)
            entity = SceneEntity(timestamp=stamp, frame_id=frame, id="trail", lines=[trail])
            yield FoxgloveMessage(f"{at}/trail", SceneUpdate(entities=[entity]))

    def _of_status(self, at_ns: int, status: Status) -> Iterator[FoxgloveMessage]:
        arrows = [
            arrow
            for helper, helped, topic in current_help(status)
            if (arrow := self._help_entity(at_ns, helper, helped, topic)) is not None
        ]
        if arrows:
            yield FoxgloveMessage("/help", SceneUpdate(entities=arrows))
        if status.places:
            found = [self._place_entity(at_ns, status, place) for place in status.places]
            at = f"/robots/{status.robot}/places"
            yield FoxgloveMessage(at, SceneUpdate(entities=found))

    def _place_entity(self, at_ns: int, status: Status, place: LandmarkEstimate) -> SceneEntity:
        """A disc of 3 sigma for a landmark that a robot finds itself."""
        major, minor, turn = ellipse_of(*place.covariance)
        colour, at = self._robot(status.robot).colour, (place.x_m, place.y_m)
        return SceneEntity(
            timestamp=_stamp(at_ns),
            frame_id=frame_text(status.frame),
            id=f"landmark/{place.landmark}",
            cylinders=[_disc(*at, 3.0 * major, 3.0 * minor, turn, 0.02, _colour(colour, 0.4))],
            texts=[_text(place.landmark, *at, colour)],
        )

    def _help_entity(self, at_ns: int, helper: str, helped: str, topic: str) -> SceneEntity | None:
        """A line with a head from a helper to the robot that it helps."""
        robot, other = self._robot(helper), self._robot(helped)
        if robot.track is None or other.track is None or robot.track.frame != other.track.frame:
            return None
        x, y, to_x, to_y = robot.track.x_m, robot.track.y_m, other.track.x_m, other.track.y_m
        turned, head = math.atan2(to_y - y, to_x - x), 0.25
        barbs = [
            Point3(x=to_x - head * math.cos(turned + s), y=to_y - head * math.sin(turned + s))
            for s in (0.4, -0.4)
        ]
        tip = Point3(x=to_x, y=to_y)
        return SceneEntity(
            timestamp=_stamp(at_ns),
            frame_id=frame_text(robot.track.frame),
            id=f"{helper} helps {helped} by {topic}",
            lifetime=HELP_SHOWN,
            lines=[_line([Point3(x=x, y=y), tip, barbs[0], barbs[1], tip], 0.02, robot.colour)],
        )


def _of_truths(at_ns: int, truths: Truths) -> Iterator[FoxgloveMessage]:
    stamp = _stamp(at_ns)
    poses = {t.robot: _pose(t.x_m, t.y_m, t.heading_rad) for t in truths.robots}
    transforms = [_transform(stamp, name, pose, FIELD, "truth") for name, pose in poses.items()]
    yield FoxgloveMessage("/tf", FrameTransforms(transforms=transforms))
    there = PosesInFrame(timestamp=stamp, frame_id=FIELD, poses=poses.values())
    yield FoxgloveMessage("/truth/poses", there)


def _robot_entity(stamp: Timestamp, track: Track, robot: _Robot) -> SceneEntity:
    """The robot with its name, and the ellipse of 3 sigma where it states a covariance."""
    colour = LOST if track.lost else robot.colour
    entity = SceneEntity(timestamp=stamp, frame_id=frame_text(track.frame), id="robot")
    x, y, heading = track.x_m, track.y_m, track.heading_rad
    outline = [
        Point3(x=x + r * math.cos(heading + a), y=y + r * math.sin(heading + a))
        for r, a in ((0.25, 0.0), (0.2, 2.45), (0.08, math.pi), (0.2, -2.45), (0.25, 0.0))
    ]
    entity.lines.append(_line(outline, 0.04, colour))
    entity.texts.append(_text(f"{track.robot} · {track.tier}", x, y, colour))
    if track.covariance is not None:
        major, minor, turned = ellipse_of(*track.covariance[:3])
        area = _colour(colour, 0.25)
        entity.cylinders.append(_disc(x, y, 3.0 * major, 3.0 * minor, turned, 0.01, area))
    return entity


def _covariance_6x6(
    xx: float, xy: float, yy: float, xh: float, yh: float, hh: float
) -> Iterator[float]:
    """Rows of x, y, z, and rotations about x, y, z, of a robot that stays in the plane."""
    rows = ((xx, xy, xh), (xy, yy, yh), (xh, yh, hh))
    places = {0: 0, 1: 1, 5: 2}
    for row in range(6):
        for column in range(6):
            is_planar = row in places and column in places
            yield rows[places[row]][places[column]] if is_planar else 0.0


def _log(event: Event) -> FoxgloveMessage:
    line = Log(
        timestamp=_stamp(event.at_ns),
        level=LEVELS[event.severity],
        message=event.words,
        name=event.robot,
    )
    return FoxgloveMessage("/log", line)


def _stamp(at_ns: int) -> Timestamp:
    seconds, nanos = divmod(at_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def _frame(robot: str) -> str:
    return f"robot/{robot}"


def _pose(x_m: float, y_m: float, heading_rad: float) -> Pose:
    turned = Quaternion(z=math.sin(0.5 * heading_rad), w=math.cos(0.5 * heading_rad))
    return Pose(position=Vector3(x=x_m, y=y_m), orientation=turned)


def _transform(
    stamp: Timestamp, robot: str, pose: Pose, frame: str, kind: str = "robot"
) -> FrameTransform:
    return FrameTransform(
        timestamp=stamp,
        parent_frame_id=frame,
        child_frame_id=f"{kind}/{robot}",
        translation=pose.position,
        rotation=pose.orientation,
    )


def _colour(code: str, opacity: float = 1.0) -> Color:
    red, green, blue = (int(code[i : i + 2], 16) / 255.0 for i in (0, 2, 4))
    return Color(r=red, g=green, b=blue, a=opacity)


def _line(points: list[Point3], wide_m: float, code: str, opacity: float = 1.0) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        pose=_pose(0.0, 0.0, 0.0),
        thickness=wide_m,
        points=points,
        color=_colour(code, opacity),
    )


def _disc(
    x: float, y: float, major_m: float, minor_m: float, turned: float, high_m: float, colour: Color
) -> CylinderPrimitive:
    """A flat ellipse with these semi-axes."""
    size = Vector3(x=2.0 * major_m, y=2.0 * minor_m, z=high_m)
    pose = _pose(x, y, turned)
    return CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=colour)


def _text(words: str, x: float, y: float, code: str) -> TextPrimitive:
    pose = Pose(position=Vector3(x=x, y=y, z=0.4), orientation=Quaternion(w=1.0))
    return TextPrimitive(pose=pose, billboard=True, font_size=0.2, color=_colour(code), text=words)
