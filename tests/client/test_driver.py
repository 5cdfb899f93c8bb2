"""`Driver` and `poses` on the bus in memory: what is sent, what is raised, what is said."""

import logging
import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.buses import MS, SECOND, Subscription

import cpcbl_client
from cpcbl_client import Driver, InputError, Sighting, odometry_from_pose, poses
from cpcbl_client.connection import Reminder
from cpcbl_client.team import read_team
from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import ZERO3, Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sightings
from cpcbl_team.motion import move
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Frame, Pose, encode

NOW = 1_700_000_000 * SECOND
TEAM = """
name = "lab"
[map.landmarks]
door = { x_m = 2.0, y_m = 0.2 }
[types.real]
source = "external"
[robots.r1]
type = "real"
[robots.r2]
"""


class Stand:
    """A driver on a bus in memory, whose clock the test sets."""

    def __init__(self, path: Path) -> None:
        self.hub = hub = MemoryHub()
        self.now_ns, self.bus = NOW, hub.session()
        self.ear = Subscription(self.bus, "in/r1/*")
        self.driver = Driver(path, "r1", bus=hub.session(), clock=lambda: self.now_ns)

    def after(self, elapsed_ns: int) -> Driver:
        self.now_ns += elapsed_ns
        return self.driver

    @property
    def last(self) -> Any:
        return self.ear.messages[-1]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "team.toml").write_text(TEAM)
    return tmp_path / "team.toml"


@pytest.fixture
def stand(path: Path) -> Iterator[Stand]:
    made = Stand(path)
    with made.driver:
        yield made


def test_pieces_of_odometry_join(stand: Stand) -> None:
    stand.after(100 * MS).odometry(0.02, 0.0)
    assert stand.last == Odometry(NOW, NOW + 100 * MS, 0.02, 0.0)
    stand.after(90 * MS).odometry(distance_m=0.02, turn_rad=0.1, duration_s=0.1)
    assert stand.last == Odometry(NOW + 100 * MS, NOW + 190 * MS, 0.02, 0.1)
    stand.after(SECOND).odometry(0.02, 0.0, 0.1)  # after a pause it is as long as it says
    assert stand.last == Odometry(NOW + 1090 * MS, NOW + 1190 * MS, 0.02, 0.0)
    stand.driver.odometry(1, 0, stamp_ns=NOW + 1250 * MS)
    assert stand.last == Odometry(NOW + 1190 * MS, NOW + 1250 * MS, 1.0, 0.0)


def test_every_input_is_the_message_of_its_topic(stand: Stand) -> None:
    driver, seen = stand.driver, Sighting("door", 2.0, 0.1)
    driver.sighting("door", range_m=2, bearing_rad=0.1)
    assert stand.last == Sightings(NOW, (seen,))
    driver.sightings([seen, Sighting("r2", 1.0)], stamp_ns=NOW - 5)
    assert stand.last == Sightings(NOW - 5, (seen, Sighting("r2", 1.0)))
    driver.position(1, 2, sigma_m=0.5)
    assert stand.last == Position(NOW, 1.0, 2.0, (0.25, 0.0, 0.25))
    driver.initial_pose(1, 2, 0.5, sigma_m=0.5, heading_sigma_rad=0.25)
    assert stand.last == InitialPose(NOW, 1.0, 2.0, 0.5, (0.25, 0.0, 0.25, 0.0, 0.0, 0.0625))
    driver.frame(b"a picture")
    assert stand.last == Frame(NOW, b"a picture")


@pytest.mark.parametrize(
    ("call", "arguments", "said"),
    [
        ("sighting", {"name": "door", "bearing_rad": 45.0}, "bearing_rad=45: looks like degrees"),
        ("initial_pose", {"x_m": 0.0, "y_m": 0.0, "heading_rad": 90.0}, "looks like degrees"),
        ("sighting", {"name": "door", "range_m": 2000.0}, "range_m=2000: looks like mm"),
        (
            "odometry",
            {"distance_m": 20.0, "turn_rad": 0.0},
            "distance_m=20 in 0.1 s: looks like mm",
        ),
        ("odometry", {"distance_m": 0.0, "turn_rad": 5.0}, "looks like degrees; write radians"),
        *(
            ("sighting", {"name": "door", "range_m": 2.0, "stamp_ns": stamp}, said)
            for stamp, said in (
                (NOW // SECOND, "looks like seconds"),
                (NOW // MS, "looks like milliseconds"),
                (NOW // 1000, "looks like microseconds"),
                (300 * SECOND, "a clock since the start"),
                (NOW - 2 * 86_400 * SECOND, "is -2 days from this machine's clock"),
                (NOW * 1e-9, "write whole nanoseconds"),
                (10**30, "days from this machine's clock"),
            )
        ),
    ],
)
def test_a_wrong_unit_raises_and_is_not_sent(
    stand: Stand, call: str, arguments: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError, match=said.replace("+", r"\+")):
        getattr(stand.after(100 * MS), call)(**arguments)
    assert not stand.ear.samples


def test_what_a_sensor_may_deliver_does_not_end_a_driver(stand: Stand) -> None:
    for value in (math.nan, math.inf, -1.0, 0.0):
        stand.driver.sighting("door", range_m=value if value < 1000.0 else -value)
    stand.after(SECOND).odometry(math.nan, 0.0)
    assert len(stand.ear.samples) == 5


def test_an_unknown_object_is_said_once(stand: Stand, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(3):
        stand.driver.sighting("Door", range_m=2.0)
    (record,) = caplog.records
    assert "no landmark, wall or robot 'Door'" in record.getMessage()
    assert "did you mean 'door'?" in record.getMessage()


def test_a_second_driver_of_a_robot_is_noticed_by_both(
    stand: Stand, path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("cpcbl_client.connection.CHECK_S", 0.0)
    with Driver(path, "r1", bus=stand.hub.session(), clock=lambda: NOW) as second:
        for driver in (stand.driver, second, stand.driver, second):
            driver.sighting("door", range_m=2.0)
    said = [record.getMessage() for record in caplog.records]
    assert said == ["another program publishes on in/r1/sightings too: stop one of the drivers"] * 2


def test_odometry_over_too_long_a_time_is_said(
    stand: Stand, caplog: pytest.LogCaptureFixture
) -> None:
    stand.after(12 * SECOND).odometry(0.0, 0.0)
    assert "odometry over 12.0 s: the robot refuses it" in caplog.text


@pytest.mark.parametrize(
    ("text", "robot", "said"),
    [
        (TEAM, "r3", "no robot 'r3'; there are r1, r2"),
        (TEAM, "r2", "robots.r2.source: is 'simulated'"),
        ("name =", "r1", "not TOML"),
        ("[robots.r1]", "r1", "missing required field `name`"),
        (TEAM.replace("lab", "a lab"), "r1", "name"),
        (TEAM + '[transport]\nconect = ["tcp/1:2"]', "r1", "conect"),
    ],
)
def test_a_team_file_that_cannot_serve_is_one_line(
    path: Path, text: str, robot: str, said: str
) -> None:
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        Driver(path, robot, bus=MemoryHub().session())
    assert said in str(raised.value)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_missing_file_and_an_unknown_robot_are_named(tmp_path: Path, path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: No such file"):
        Driver(tmp_path / "none.toml", "r1", bus=MemoryHub().session())
    with pytest.raises(InputError, match="no robot 'r11'; did you mean 'r1'"):
        poses(path, "r11", bus=MemoryHub().session())


def test_a_team_is_reached_as_its_file_says(path: Path) -> None:
    assert read_team(path).team.transport.connect == ("tcp/127.0.0.1:7447",)
    path.write_text(f'{TEAM}[transport]\nsecurity = "mtls"\nkeys = "own"\n')
    transport = read_team(path).team.transport
    assert transport.connect == ("tls/127.0.0.1:7447",)
    assert transport.keys == str(path.parent / "own")
    path.write_text(f'{TEAM}[transport]\nconnect = ["tcp/10.0.0.1:7447"]\n')
    assert read_team(path).team.transport.connect == ("tcp/10.0.0.1:7447",)


def test_a_consumer_gets_the_newest_pose(path: Path) -> None:
    hub = MemoryHub()
    robot = hub.session().publisher(topics.POSE.at(robot="r1"), topics.POSE.qos)
    stream = poses(path, "r1", bus=hub.session())

    def told(stamp_ns: int) -> Pose:
        return Pose("r1", stamp_ns, 1.0, 2.0, 0.5, None)

    begun = threading.Timer(0.2, lambda: robot.put(encode(told(1))))
    begun.start()
    assert next(stream) == told(1)
    begun.join()
    for n in (2, 3, 4):
        robot.put(encode(told(n)))
    robot.put(b"garbage")
    assert next(stream) == told(4)
    stream.close()  # type: ignore[attr-defined]
    assert not robot.matching


@pytest.mark.parametrize("turn", [0.0, 0.3, -2.0])
@pytest.mark.parametrize("distance", [0.5, -0.5])
def test_the_odometry_between_two_poses_leads_from_one_to_the_other(
    distance: float, turn: float
) -> None:
    before, none = Pose2(1.0, 2.0, 3.0), OdometryNoise()
    after = move(Estimate(before, ZERO3), distance, turn, none).pose
    found = odometry_from_pose(before, after)
    assert found == pytest.approx((distance, turn))


def test_what_lasts_is_said_again_and_its_end_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = [0.0]
    monkeypatch.setattr("cpcbl_client.connection.time.monotonic", lambda: now[0])
    reminder = Reminder(after_s=3.0)
    for _ in range(160):
        reminder.warn("lost")
        now[0] += 0.1
    assert [r.getMessage() for r in caplog.records] == ["lost", "lost"]
    reminder.over("back")
    reminder.over("back")
    assert [r.getMessage() for r in caplog.records] == ["lost", "lost", "back"]
    assert {r.levelno for r in caplog.records} == {logging.WARNING}


def test_the_package_says_what_it_offers() -> None:
    assert all(hasattr(cpcbl_client, name) for name in cpcbl_client.__all__)
