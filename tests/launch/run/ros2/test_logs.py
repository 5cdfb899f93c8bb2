"""A real log (UTIAS MRCLAM) as a recording of ROS 2 (rosbag2): a team that hears it through the
bridge's inputs has the figures of one whose drivers are on the team's own bus, and, but for the
order of what comes at one time, those of `evaluate`. `make test-long CPCBL_MRCLAM=FOLDER`."""

import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import pytest
from msgspec.structs import replace
from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.ros2 import message_types
from support.ros2_robots import BusDrivers, detection_fields, odometry_fields

from cpcbl_agents.sources.mrclam import MrclamSource
from cpcbl_launch.lab.evaluation import evaluate_log
from cpcbl_launch.reporting.recorder import Recorder, Report, variants_of
from cpcbl_launch.run.logged_team import LoggedTeam, builtin_for, load_logged_team, with_duration
from cpcbl_launch.run.ros2.building import build_message
from cpcbl_launch.run.ros2.refused import RefusalLog
from cpcbl_launch.run.ros2.robot_inputs import InputTopic, RobotInputs
from cpcbl_launch.run.ros2.stamps import UnixStamps
from cpcbl_launch.simulation.in_process import robot_nodes, run_nodes
from cpcbl_launch.team.file import load_team
from cpcbl_team.config import Ros2Settings, Team
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.definitions import APRILTAG_AND_VISION

pytestmark = [pytest.mark.log, pytest.mark.timeout(3600)]
NEVER_NS = 2**62


def as_messages(inputs: Iterator[Odometry | Sightings]) -> Iterator[tuple[str, int, bytes]]:
    """Type, time of recording (ns) and bytes of each message of one robot."""
    own, pose, until_ns = message_types(), Pose2(3.0, -2.0, 1.0), -1
    for one in inputs:
        if isinstance(one, Sightings):
            found = build_message(own, types.DETECTIONS, detection_fields(one))
            yield types.DETECTIONS, one.stamp_ns, own.encode(found)
            continue
        seconds = (one.stamp_ns - one.from_ns) * 1e-9
        velocity = one.distance_m / seconds, one.turn_rad / seconds
        if one.from_ns != until_ns:
            fields = odometry_fields(pose, one.from_ns, velocity)
            yield (
                types.ODOMETRY,
                one.from_ns,
                own.encode(build_message(own, types.ODOMETRY, fields)),
            )
        pose, until_ns = step(pose, one.distance_m, one.turn_rad), one.stamp_ns
        fields = odometry_fields(pose, one.stamp_ns, velocity)
        yield types.ODOMETRY, one.stamp_ns, own.encode(build_message(own, types.ODOMETRY, fields))


def write_bag(path: Path, logged: LoggedTeam) -> None:
    """The log as a rosbag2."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in APRILTAG_AND_VISION.items():
        store.register(get_types_from_msg(text, name))
    with Writer(path, version=9) as bag:
        for name in logged.team.robots:
            source = MrclamSource(Path(logged.team.data), name)
            topics = {types.ODOMETRY: f"/{name}/odom", types.DETECTIONS: f"/{name}/detections_3d"}
            connections = {
                kind: bag.add_connection(topic, kind, typestore=store)
                for kind, topic in topics.items()
            }
            for kind, stamp_ns, payload in as_messages(iter(source.poll(logged.end_ns))):
                bag.write(connections[kind], stamp_ns, payload)


class Player:
    """Gives a team what was recorded, each message when its time has come."""

    waiting = False

    def __init__(self, recorded: Iterable[tuple[int, Callable[[], None]]]) -> None:
        self._recorded, self._next, self.now_ns = list(recorded), 0, 0

    @property
    def next_ns(self) -> int:
        is_over = self._next == len(self._recorded)
        return NEVER_NS if is_over else self._recorded[self._next][0]

    def step(self, now_ns: int) -> None:
        self.now_ns = now_ns
        while self.next_ns <= now_ns:
            self._next += 1
            self._recorded[self._next - 1][1]()


def drivers(logged: LoggedTeam, hub: MemoryHub) -> Player:
    """The log's inputs on the team's own bus."""
    player, team = BusDrivers(hub.session(), logged.team.robots), logged.team
    found = [
        (one.stamp_ns, partial(player.play, name, one))
        for name in team.robots
        for one in MrclamSource(Path(team.data), name).poll(logged.end_ns)
    ]
    return Player(sorted(found, key=lambda row: row[0]))


def bridge(path: Path, team: Team, hub: MemoryHub, refusals: RefusalLog) -> Player:
    """The messages of a rosbag2 to the bridge's inputs."""
    rows: dict[str, tuple[RobotInputs, InputTopic]] = {}
    with Reader(path) as bag:
        recorded = [(c.topic, c.msgtype, at, raw) for c, at, raw in bag.messages()]

    def give(topic: str, kind: str, raw: bytes) -> None:
        inputs, row = rows[topic]
        inputs.on_message(row, message_types().decode(kind, raw))

    player = Player((at, partial(give, topic, kind, raw)) for topic, kind, at, raw in recorded)
    for name in team.robots:
        stamps, bus = UnixStamps(), hub.session()
        inputs = RobotInputs(name, team, bus, stamps, lambda: player.now_ns, refusals)
        rows |= {f"/{row.topic.strip('/')}": (inputs, row) for row in inputs.topics()}
    return player


def with_external_robots(team: Team) -> Team:
    """The team with drivers of its own, and with the bridge."""
    robots = {
        name: replace(
            robot, source="external", ros2=replace(robot.ros2, detections_3d="detections_3d")
        )
        for name, robot in team.robots.items()
    }
    return replace(team, robots=robots, ros2=Ros2Settings())


def rmse_m(logged: LoggedTeam, player: Player, team: Team, hub: MemoryHub) -> dict[str, float]:
    """The position RMSE of each robot, and of the team."""
    recorder = Recorder(hub.session())
    nodes = [player, *robot_nodes(team, hub, logged.start_ns)]
    run_nodes(nodes, logged.start_ns, logged.end_ns)
    return figures(recorder.report(variants_of(team), logged.truth))


def figures(report: Report) -> dict[str, float]:
    found = {name: robot.position_rmse_m for name, robot in report.robots.items()}
    found["team"] = report.team.position_rmse_m
    assert None not in found.values()
    return {name: value for name, value in found.items() if value is not None}


@pytest.mark.parametrize(
    ("name", "duration_s"),
    [("MRCLAM2", 300.0), ("MRCLAM4", 300.0), ("MRCLAM6", 300.0), ("MRCLAM4", None)],
)
def test_a_recorded_log_gives_the_figures_of_evaluate(
    name: str, duration_s: float | None, tmp_path: Path
) -> None:
    folder = Path(os.environ["CPCBL_MRCLAM"]) / name
    logged = with_duration(load_logged_team(load_team(builtin_for(folder)), folder), duration_s)
    write_bag(tmp_path / "bag", logged)
    team, hub, refusals = with_external_robots(logged.team), MemoryHub(), RefusalLog()
    by_ros2 = rmse_m(logged, bridge(tmp_path / "bag", team, hub, refusals), team, hub)
    assert {reason for _, reason in refusals.counts} <= {"unknown_name"}  # barcodes of nobody
    hub = MemoryHub()
    assert by_ros2 == pytest.approx(rmse_m(logged, drivers(logged, hub), team, hub), rel=1e-6)
    expected = figures(evaluate_log(logged).report)
    assert by_ros2["team"] == pytest.approx(expected["team"], rel=0.06)
