"""A recording holds what was said, and only that; `up --record` makes one."""

from pathlib import Path

import numpy as np
import pytest
from support.buses import SECOND, saw, standing
from support.logs import write_log
from support.processes import cpcbl_team
from support.simulated import simulate_recorded

from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Tagged, Truth, Truths, encode

TEAM = Team(name="one", robots={"r1": RobotSettings(source="external")})
FRAME = saw(SECOND, Sighting("oak", 2.0, None), Sighting("elm", None, -0.5))
SAID: list[tuple[str, Tagged]] = [
    ("in/r1/odometry", standing(SECOND)),
    ("in/r1/sightings", FRAME),
    ("in/r1/initial_pose", InitialPose(SECOND, 1.0, 2.0, 0.5, (0.01, 0.0, 0.01, 0.0, 0.0, 0.02))),
    ("in/r1/position", Position(SECOND, 1.0, 2.0, (0.01, 0.0, 0.01))),
    ("field/truth", Truths(SECOND, (Truth("r1", 1.0, 2.0, 0.5),))),
]


def record(path: Path, *payloads: tuple[str, bytes]) -> None:
    hub = MemoryHub()
    speaker = hub.session()
    with Recording(path, TEAM, hub.session()):
        for key, payload in payloads:
            speaker.publisher(key, topics.Qos.INPUT).put(payload)


def test_what_was_said_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record(path, *((key, encode(message)) for key, message in SAID))
    recorded = read_recording(path)
    assert recorded.team == TEAM
    assert recorded.inputs == {"r1": [message for _, message in SAID[:4]]}
    assert recorded.truth["r1"] == pytest.approx(np.array([[1.0, 1.0, 2.0, 0.5]]))


def test_what_cannot_be_used_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    key = "in/r1/odometry"
    bad = (
        b"",
        b"garbage",
        encode(Odometry(0, SECOND, float("nan"), 0.0)),
        encode(Odometry(-2 * SECOND, -SECOND, 0.0, 0.0)),
        encode(Sightings(2**64 - 1, ())),
    )
    good = encode(standing(SECOND))
    record(path, *((key, payload) for payload in bad), (key, good), ("field/drive/r1", good))
    assert read_recording(path).inputs == {"r1": [standing(SECOND)]}


def test_nothing_is_written_after_the_end(tmp_path: Path) -> None:
    path, hub = tmp_path / "run.mcap", MemoryHub()
    publisher = hub.session().publisher("in/r1/odometry", topics.Qos.INPUT)
    with Recording(path, TEAM, hub.session()):
        assert publisher.matching
    assert not publisher.matching
    publisher.put(encode(standing(SECOND)))
    assert read_recording(path).inputs == {}


def test_recording_does_not_change_a_run(tmp_path: Path) -> None:
    team, path = load_team(builtin_path("demo")), tmp_path / "demo.mcap"
    alone, _ = simulate(team, 3, 4.0)
    watched, recorder = simulate_recorded(team, 3, 4.0, path)
    assert watched == alone
    recorded = read_recording(path)
    assert recorded.team == team
    for name, rows in recorder.simulated_truth().items():
        assert recorded.truth[name] == pytest.approx(rows)
    kinds = {type(item) for item in recorded.inputs["navigator"]}
    assert kinds == {Odometry, Sightings}
    assert {type(item) for item in recorded.inputs["observer"]} == {Sightings}


@pytest.mark.thorough
def test_up_records_its_run(tmp_path: Path) -> None:
    path = tmp_path / "up.mcap"
    ran = cpcbl_team("up", "demo", "--duration", 4, "--speed", 2, "--record", path, "--json")
    assert ran.returncode == 0, ran.stderr
    recorded = read_recording(path)
    assert recorded.truth.keys() == recorded.team.robots.keys()
    assert sum(isinstance(item, Odometry) for item in recorded.inputs["patrol"]) > 40
    for rows in recorded.truth.values():
        assert len(rows) > 100
        assert (np.diff(rows[:, 0]) > 0.0).all()


def test_a_replayed_log_is_not_recorded_and_that_is_said(tmp_path: Path) -> None:
    write_log(tmp_path, ("1",), seconds=6.0)
    path = tmp_path / "log.mcap"
    ran = cpcbl_team(
        "up",
        "mrclam",
        "--data",
        tmp_path,
        "--duration",
        4,
        "--speed",
        4,
        "--record",
        path,
        "--json",
    )
    assert ran.returncode == 0, ran.stderr
    assert "without the inputs of 1" in ran.stderr
    assert read_recording(path).inputs == {}
