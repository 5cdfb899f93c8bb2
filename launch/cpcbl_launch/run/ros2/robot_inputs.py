"""What one robot's topics of ROS 2 give to the team: each message is read, and goes on as an input
or is counted as refused. No message ends the bridge."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from cpcbl_launch.run.ros2 import positions_in, sensors_in
from cpcbl_launch.run.ros2.odometry_in import OdometryInput
from cpcbl_launch.run.ros2.planar import stamp_of
from cpcbl_launch.run.ros2.refused import BadMessage, RefusalLog, Refused
from cpcbl_launch.run.ros2.stamps import StampMap
from cpcbl_launch.run.ros2.transforms_in import CameraMounting, MovingFrames
from cpcbl_team.config import CameraSettings, Team
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sightings
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.messages import Frame, SensorInput, encode, refusal
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.qos import SENSOR_DATA, STATIC_TRANSFORMS, QosProfile
from cpcbl_transport.topics import topic_of

if TYPE_CHECKING:  # it needs OpenCV
    from cpcbl_launch.run.ros2.tags_in import TagInput

log = logging.getLogger(__name__)

SILENT_S = 5.0
LATE_S = 0.5
Taken = SensorInput | Refused | None
Take = Callable[[Any, int, int], Taken]


class InputTopic(NamedTuple):
    """One topic of a robot: what it carries, and what makes an input of a message, its time in the
    team and its own stamp (ns)."""

    topic: str
    type_name: str
    take: Take
    is_optional: bool = False  # it may be silent

    @property
    def qos(self) -> QosProfile:
        """What its subscription asks for."""
        return STATIC_TRANSFORMS if self.type_name == types.TRANSFORMS else SENSOR_DATA


class RobotInputs:
    """The inputs of one robot. Its messages may come on any thread."""

    def __init__(
        self,
        name: str,
        team: Team,
        bus: Bus,
        stamps: StampMap,
        now_ns: Callable[[], int],
        refusals: RefusalLog,
    ) -> None:
        """`stamps` maps the robot's stamps to the team's time, which is `now_ns`."""
        self._name, self._team, self._bus = name, team, bus
        self._stamps, self._now_ns, self._refusals = stamps, now_ns, refusals
        self._settings = settings = team.robots[name]
        assert team.ros2 is not None
        self._ros2 = team.ros2
        self.lock = threading.Lock()
        """Of the odometry and the stamps."""
        self._tag_lock = threading.Lock()
        topic = team.ros2.topic(name, settings.ros2.odometry)
        self.map_frame = settings.ros2.map_frame or team.ros2.field_frame
        """What the tree of this robot calls the field's frame."""
        note = partial(refusals.add, topic)
        self.odometry = OdometryInput(settings.ros2, self.map_frame, note)
        self._tags: TagInput | None = None
        self._names = team.map.names
        self._names |= frozenset(team.robots) - {name}
        note = partial(refusals.add, team.ros2.topic(name, settings.ros2.tf_static))
        self._mounting = CameraMounting(name, settings.camera, note)
        self._publishers: dict[type[SensorInput], Publisher] = {}
        if settings.ros2.initial_pose:  # one comes, and it must not be before its publisher
            self._publisher(InitialPose)
        self.counts: dict[str, int] = {}
        """Messages by topic."""
        self._arrived_s: dict[str, float] = {}
        self._frame_ns = 0
        self._has_failed: set[str] = set()
        self._begun_s = time.monotonic()

    # The topics ---------------------------------------------------------------------------------

    def topics(self) -> list[InputTopic]:
        """The topics to subscribe to, each with the function that takes its messages."""
        keys, own = self._settings.ros2, self._settings
        rows = [
            InputTopic(keys.odometry, types.ODOMETRY, self._take_odometry),
            InputTopic(keys.ranges, types.RANGE, self._take_range),
            InputTopic(keys.detections_3d, types.DETECTIONS, self._take_detections_3d),
            InputTopic(keys.position, types.POSE, self._take_position),
            InputTopic(keys.initial_pose, types.POSE, self._take_initial_pose, True),
            InputTopic(keys.tf_static, types.TRANSFORMS, self._take_transforms, True),
        ]
        if self._ros2.datum is not None:
            rows.append(InputTopic(keys.navsat, types.NAV_SAT_FIX, self._take_fix))
        if own.sensing == "camera":
            rows += [
                InputTopic(keys.image, types.IMAGE, self._take_image),
                InputTopic(keys.compressed_image, types.COMPRESSED_IMAGE, self._take_jpeg),
            ]
        elif keys.detections:
            rows += [
                InputTopic(keys.detections, types.APRIL_TAGS, self._take_tags),
                InputTopic(keys.camera_info, types.CAMERA_INFO, self._take_camera_info),
            ]
        found = [row for row in rows if row.topic and self._is_wanted(row)]
        return [row._replace(topic=self._ros2.topic(self._name, row.topic)) for row in found]

    def _is_wanted(self, row: InputTopic) -> bool:
        """Whether the team file gives the topic a meaning."""
        if row.type_name == types.ODOMETRY:
            return self._settings.odometry.moves
        is_of_tags = row.type_name in (types.APRIL_TAGS, types.CAMERA_INFO)
        return has_tags(self._team) or not is_of_tags

    def on_message(self, row: InputTopic, message: Any) -> None:
        """Takes a message of a topic. Raises nothing: nobody can show it every message."""
        topic = row.topic
        self.counts[topic] = self.counts.get(topic, 0) + 1
        self._arrived_s[topic] = time.monotonic()
        try:
            taken = self._input_of(row, message)
        except Exception as error:
            if topic not in self._has_failed:
                log.exception("%s: a message could not be used", topic)
            self._has_failed.add(topic)
            taken = Refused(BadMessage.UNREADABLE, f"{type(error).__name__}: {error}")
        if isinstance(taken, Refused):
            self._refusals.add(topic, taken)
        elif taken is not None:
            self._put(taken)

    def _input_of(self, row: InputTopic, message: Any) -> Taken:
        now_ns = self._now_ns()
        if row.type_name == types.TRANSFORMS:
            return row.take(message, now_ns, 0)
        ros_ns = stamp_of(message.header)
        if row.is_optional and (self._ros2.sim_time or ros_ns == 0):
            # A person means now; a clock of RViz must not move that of the simulation
            return row.take(message, now_ns, ros_ns)
        with self.lock:
            team_ns = self._stamps.team_ns(ros_ns, now_ns)
            if isinstance(team_ns, Refused):
                return team_ns
            if row.type_name == types.ODOMETRY:
                return row.take(message, team_ns, ros_ns)
        return row.take(message, team_ns, ros_ns)

    def _put(self, message: SensorInput) -> None:
        """Publishes an input. What the robot would refuse is passed on, so that it counts it."""
        if reason := refusal(message, self._now_ns()):
            text = f"the robot refuses it: {reason.replace('_', ' ')}"
            self._refusals.add(f"in/{self._name}", Refused(BadMessage.UNSUPPORTED, text))
        self._publisher(type(message)).put(encode(message))

    def _publisher(self, kind: type[SensorInput]) -> Publisher:
        if kind not in self._publishers:
            topic = topic_of(kind)
            self._publishers[kind] = self._bus.publisher(topic.at(robot=self._name), topic.qos)
        return self._publishers[kind]

    # One function for each type -----------------------------------------------------------------

    def _take_odometry(self, message: Any, team_ns: int, ros_ns: int) -> Odometry | Refused | None:
        return self.odometry.take(message, team_ns, ros_ns)

    def _take_camera_info(self, message: Any, team_ns: int, ros_ns: int) -> Refused | None:
        with self._tag_lock:
            return self._tag_input().take_camera_info(message)

    def _take_tags(self, message: Any, team_ns: int, ros_ns: int) -> Sightings | Refused | None:
        with self._tag_lock:
            return _if_any(self._tag_input().take(message, team_ns))

    def _tag_input(self) -> "TagInput":
        if self._tags is None:
            from cpcbl_launch.run.ros2.tags_in import TagInput

            topic = self._ros2.topic(self._name, self._settings.ros2.detections)
            note = partial(self._refusals.add, topic)
            self._tags = TagInput(self._name, self._team, note, self._mounted)
        return self._tags

    def _take_detections_3d(
        self, message: Any, team_ns: int, ros_ns: int
    ) -> Sightings | Refused | None:
        topic = self._ros2.topic(self._name, self._settings.ros2.detections_3d)
        note = partial(self._refusals.add, topic)
        names, settings = self._names, self._settings
        frame, base_frame = str(message.header.frame_id).strip("/"), self.odometry.base_frame
        if "optical" in frame:
            self._mounting.camera(frame, base_frame)  # only to compare
        base_from_frame = self._mounting.base_from(frame, base_frame)
        found = sensors_in.sightings_of_detections(
            message, team_ns, settings, names, note, base_from_frame
        )
        return _if_any(found)

    def _take_transforms(self, message: Any, team_ns: int, ros_ns: int) -> None:
        with self.lock:
            frame = self.odometry.frame or self._settings.ros2.odometry_frame
            moving = MovingFrames(self.map_frame, frame, self.odometry.base_frame)
        self._mounting.take(message, moving)

    def _mounted(self, frame: str) -> CameraSettings:
        """The camera whose messages are of this frame."""
        return self._mounting.camera(frame, self.odometry.base_frame)

    def _take_initial_pose(self, message: Any, team_ns: int, ros_ns: int) -> InitialPose | Refused:
        frames = {frame.strip("/") for frame in (self._ros2.field_frame, self.map_frame)}
        return positions_in.initial_pose_of(message, team_ns, frames)

    def _take_range(self, message: Any, team_ns: int, ros_ns: int) -> Sightings | Refused:
        return sensors_in.sightings_of_range(message, team_ns, self._names)

    def _take_position(self, message: Any, team_ns: int, ros_ns: int) -> Position | Refused:
        frame = self._ros2.field_frame
        return positions_in.position_of_pose(message, team_ns, frame, self._sigma_m)

    def _take_fix(self, message: Any, team_ns: int, ros_ns: int) -> Position | Refused:
        assert self._ros2.datum is not None
        return positions_in.position_of_fix(message, team_ns, self._ros2.datum, self._sigma_m)

    @property
    def _sigma_m(self) -> float | None:
        own = self._settings.position_sensor
        return None if own is None else own.sigma_m

    def _take_jpeg(self, message: Any, team_ns: int, ros_ns: int) -> Frame | Refused | None:
        self._mounted(str(message.header.frame_id))
        too_soon = self._is_too_soon(team_ns)
        return None if too_soon else sensors_in.frame_of_compressed(message, team_ns)

    def _take_image(self, message: Any, team_ns: int, ros_ns: int) -> Frame | Refused | None:
        self._mounted(str(message.header.frame_id))  # only to compare: the robot has the team file
        return None if self._is_too_soon(team_ns) else sensors_in.frame_of_image(message, team_ns)

    def _is_too_soon(self, team_ns: int) -> bool:
        """Whether an image follows the last one faster than the robot looks."""
        if 0 <= team_ns - self._frame_ns < 0.8e9 / self._settings.sensor.rate_hz:
            return True
        self._frame_ns = team_ns
        return False

    # What is wrong ------------------------------------------------------------------------------

    def findings(self) -> list[str]:
        """What does not come or is not taken, as lines for people."""
        now_s, found = time.monotonic(), []
        if now_s - self._begun_s > SILENT_S:
            for row in self.topics():
                arrived_s = self._arrived_s.get(row.topic)
                if arrived_s is not None and not row.is_optional and now_s - arrived_s > SILENT_S:
                    found.append(f"{row.topic}: nothing for {now_s - arrived_s:.0f} s")
        found += self._mounting.findings
        if any(not publisher.matching for publisher in self._publishers.values()):
            text = "does `cpcbl-team robot` run for it, with the same team name and router?"
            found.append(f"no robot {self._name} takes inputs: {text}")
        with self.lock:
            lag_s = self._stamps.lag_s()
        if abs(lag_s) > LATE_S:
            where = "behind" if lag_s > 0.0 else "ahead of"
            fix = "set the clocks of both machines (docs/deployment.md)"
            found.append(f"{self._name}: stamps are {abs(lag_s):.1f} s {where} this machine; {fix}")
        if self._tags is not None:
            with self._tag_lock:
                found += [f"{self._name}: {problem}" for problem in self._tags.problems]
        return found


def has_tags(team: Team) -> bool:
    """Whether a robot carries markers, or a landmark has a tag."""
    return bool(team.ros2 and team.ros2.tags) or any(r.markers for r in team.robots.values())


def _if_any(found: Sightings | Refused) -> Sightings | Refused | None:
    """Without sightings there is nothing to publish."""
    return None if isinstance(found, Sightings) and not found.sightings else found
