"""Robots of the demonstration as ROS 2 has them: what they sense in a simulated run, recorded, and
played to real processes over the team's bus or as messages of ROS 2."""

import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from msgspec.structs import replace

from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.run.ros2.building import build_message
from cpcbl_launch.run.ros2.planar import Fields, header_fields, pose_fields
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path
from cpcbl_team.config import Team
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.decoding import decode_by_key
from cpcbl_transport.messages import encode
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.node import RosNode
from cpcbl_transport.ros2.publisher import RosPublisher

SensorMessage = Odometry | Sightings
S_NS = 1_000_000_000


class Sensed(NamedTuple):
    """What a robot sensed, in a run whose time begins with 0."""

    robot: str
    message: SensorMessage


def demo_file(folder: Path, more: str = "") -> Path:
    """A team file of the demonstration whose robots have drivers of their own."""
    text = builtin_path("demo").read_text()
    head = "[defaults.collaboration]"
    assert head in text
    text = text.replace(head, f'{more}\n[defaults]\nsource = "external"\n{head}')
    path = folder / "demo.toml"
    path.write_text(text)
    return path


def recorded_drive(team: Team, seed: int, duration_s: float) -> tuple[list[Sensed], Recorder]:
    """All inputs of a simulated run, in the order in which they came, and the run."""
    found: list[Sensed] = []

    def watch(bus: Bus) -> None:
        def on_input(key: str, payload: bytes) -> None:
            message = decode_by_key(key, payload)
            assert isinstance(message, Odometry | Sightings)
            found.append(Sensed(key.split("/")[1], message))

        bus.subscribe("in/**", on_input)

    _, recorder = simulate(team, seed, duration_s, watch=watch)
    return found, recorder


def shifted(message: SensorMessage, by_ns: int) -> SensorMessage:
    """The same at another time."""
    if isinstance(message, Odometry):
        times = {"from_ns": message.from_ns + by_ns, "stamp_ns": message.stamp_ns + by_ns}
        return replace(message, **times)
    return replace(message, stamp_ns=message.stamp_ns + by_ns)


class Player(Protocol):
    """Gives a robot what it sensed."""

    def play(self, robot: str, message: SensorMessage) -> None: ...


class BusDrivers:
    """Drivers on the team's own bus."""

    def __init__(self, bus: Bus, robots: Iterable[str]) -> None:
        self.publishers: dict[tuple[str, type], Publisher] = {
            (name, topic.carries): bus.publisher(topic.at(robot=name), topic.qos)
            for name in robots
            for topic in (topics.IN_ODOMETRY, topics.IN_SIGHTINGS)
            if topic.carries is not None
        }

    def play(self, robot: str, message: SensorMessage) -> None:
        self.publishers[robot, type(message)].put(encode(message))


class RosDrivers:
    """Nodes of ROS 2: odometry from a pose far from the origin, and detections with names."""

    def __init__(self, node: RosNode, robots: Iterable[str]) -> None:
        self._node = node
        names = list(robots)
        self._odometry = {n: node.publisher(f"{n}/odom", types.ODOMETRY) for n in names}
        self._detections = {
            n: node.publisher(f"{n}/detections_3d", types.DETECTIONS) for n in names
        }
        self._poses = {name: Pose2(-7.0, 4.0, 2.8) for name in names}
        self._begun: set[str] = set()

    def play(self, robot: str, message: SensorMessage) -> None:
        if isinstance(message, Sightings):
            fields = detection_fields(message)
            self._put(self._detections[robot], types.DETECTIONS, fields)
            return
        if robot not in self._begun:
            self._begun.add(robot)
            self._put_pose(robot, message.from_ns, (0.0, 0.0))
        seconds = (message.stamp_ns - message.from_ns) * 1e-9
        self._poses[robot] = step(self._poses[robot], message.distance_m, message.turn_rad)
        velocity = message.distance_m / seconds, message.turn_rad / seconds
        self._put_pose(robot, message.stamp_ns, velocity)

    def _put_pose(self, robot: str, stamp_ns: int, velocity: tuple[float, float]) -> None:
        fields = odometry_fields(self._poses[robot], stamp_ns, velocity)
        self._put(self._odometry[robot], types.ODOMETRY, fields)

    def _put(self, publisher: RosPublisher, kind: str, fields: Fields) -> None:
        publisher.publish(build_message(self._node.types, kind, fields))


def odometry_fields(pose: Pose2, stamp_ns: int, velocity: tuple[float, float]) -> Fields:
    """nav_msgs/Odometry of a robot."""
    return {
        "header": header_fields(stamp_ns, "odom"),
        "child_frame_id": "base_footprint",
        "pose": {"pose": pose_fields(pose)},
        "twist": {"twist": {"linear": {"x": velocity[0]}, "angular": {"z": velocity[1]}}},
    }


def detection_fields(seen: Sightings) -> Fields:
    """vision_msgs/Detection3DArray in the robot's frame."""
    header = header_fields(seen.stamp_ns, "base_link")
    found = [{"header": header, "results": [_result(one)]} for one in seen.sightings]
    return {"header": header, "detections": found}


def _result(one: Sighting) -> Fields:
    assert one.range_m is not None
    assert one.bearing_rad is not None
    x, y = one.range_m * math.cos(one.bearing_rad), one.range_m * math.sin(one.bearing_rad)
    return {
        "hypothesis": {"class_id": one.id, "score": 1.0},
        "pose": {"pose": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}},
    }


def play_in_real_time(
    drive: Iterable[Sensed],
    player: Player,
    begin_ns: int,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Plays a drive that begins at a Unix time: each input when its time has come."""
    for robot, message in drive:
        message = shifted(message, begin_ns)
        while (wait_ns := message.stamp_ns - time.time_ns()) > 0:
            time.sleep(wait_ns * 1e-9)
            if over():
                return
        player.play(robot, message)


def shifted_truth(recorder: Recorder, by_ns: int) -> dict[str, Floats]:
    """Rows of seconds, x, y, heading of a simulated run at another time."""
    by = np.array([by_ns * 1e-9, 0.0, 0.0, 0.0])
    return {name: rows + by for name, rows in recorder.simulated_truth().items()}
