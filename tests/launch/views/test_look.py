"""`cpcbl-team look`: through the eyes of a robot that runs, and of one that is shown pictures."""

import base64
import json
import re
import signal
import subprocess
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from support.processes import command_line, cpcbl_team, eventually

from cpcbl_agents.vision.camera import Camera
from cpcbl_agents.vision.pictures import read_header
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.simulation.camera.render import Light, Scene, SceneRobot, render
from cpcbl_launch.team.file import load_team
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sightings

TEAM = """
name = "looked"
[transport]
listen = ["{endpoint}"]
connect = ["{endpoint}"]
[defaults.odometry]
moves = false
[robots.looker]
sensing = "camera"
start = {{ x_m = 0.0, y_m = 0.0, sigma_m = 0.0, heading_sigma_deg = 0.0 }}
[robots.seen]
start = {{ x_m = 1.5, y_m = 0.3, heading_deg = -30.0, sigma_m = 0.0, heading_sigma_deg = 0.0 }}
markers = {{ front = 0, left = 1, back = 2, right = 3 }}
"""


@pytest.fixture
def team_file(tmp_path: Path) -> Path:
    path = tmp_path / "team.toml"
    path.write_text(TEAM.format(endpoint=free_endpoint()))
    return path


@pytest.fixture
def pictures(team_file: Path) -> Path:
    """A folder with a picture of the teammate, one of nobody, and a broken one."""
    team, folder = load_team(team_file), team_file.parent / "pictures"
    scene, camera = Scene.of(team), Camera(team.robots["looker"].camera)
    folder.mkdir()
    for name, robots in (("seen", [SceneRobot("seen", 1.5, 0.3, -0.5)]), ("nobody", [])):
        random = np.random.default_rng(1)
        pixels = render(scene, camera, Pose2(0.0, 0.0, 0.0), robots, Light(), random)
        cv2.imwrite(str(folder / f"{name}.png"), pixels)
    (folder / "broken.png").write_bytes((folder / "seen.png").read_bytes()[:-50])
    return folder


def test_eyes_are_shown_pictures(team_file: Path, pictures: Path) -> None:
    folder = team_file.parent / "looks"
    words = ("look", team_file, "looker", "--pictures", pictures, "--output", folder)
    ran = cpcbl_team(*words, "--json")
    assert ran.returncode == 0, ran.stderr
    broken, nobody, seen = json.loads(ran.stdout)
    assert broken["frame"] == "broken.png"
    assert broken["unclear"] == [["frame_truncated", []]]
    assert broken["picture"] == ""
    assert nobody["found"] == []
    (mate,) = seen["found"]
    assert mate["id"] == "seen"
    assert mate["range_m"] == pytest.approx(np.hypot(1.5, 0.3), abs=4.0 * mate["range_sigma_m"])
    bearing_deg = np.degrees(np.arctan2(0.3, 1.5))
    assert mate["bearing_deg"] == pytest.approx(bearing_deg, abs=4.0 * mate["bearing_sigma_deg"])
    assert sorted(folder.iterdir()) == [Path(p["picture"]) for p in (nobody, seen)]
    drawn, plain = cv2.imread(seen["picture"]), cv2.imread(str(pictures / "seen.png"))
    assert drawn is not None
    assert plain is not None
    assert np.abs(drawn.astype(int) - plain).max() > 100  # an outline and a label
    said = command_line(*words, "--count", 2).stdout
    for word in (
        "broken.png",
        "the end of the picture is missing (frame_truncated)",
        "nobody.png",
        "nothing",
        nobody["picture"],
    ):
        assert word in said
    assert "seen.png" not in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nobody",), ".*: team looked has no robot nobody; there are looker, seen"),
        (("seen",), 'look seen: has no camera in .*; set sensing = "camera"'),
        (("looker", "--pictures", "gone"), "--pictures gone: no such file or folder"),
        (("looker", "--pictures", "."), r"--pictures \.: no pictures"),
        (("looker", "--output", "/dev/null/x"), "--output /dev/null/x: "),
        (("looker", "--wait", "0.5"), r"no router at tcp/.* within 0\.5 s"),
    ],
)
def test_what_cannot_be_looked_at_is_one_line(
    team_file: Path, words: tuple[str, ...], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(team_file.parent)
    ran = command_line("look", team_file, *words)
    assert ran.returncode == 2
    assert not ran.stdout
    assert re.search(f"^cpcbl-team: {said}", ran.stderr.splitlines()[-1])


def test_a_running_robot_shows_what_it_sees_and_a_recording_holds_it(team_file: Path) -> None:
    folder, record = team_file.parent, team_file.parent / "run.mcap"
    words = ["up", str(team_file), "--duration", "60", "--record", str(record)]
    with subprocess.Popen([*PROGRAM, *words], stdout=subprocess.DEVNULL) as team:
        try:
            look = ("look", team_file, "looker", "--output", folder / "looks")
            ran = cpcbl_team(*look, "--count", 3, "--wait", 30, "--json")
            assert ran.returncode == 0, ran.stderr
            again = command_line(*look, "--wait", 30)
            assert len(re.findall(r"^seen +1\.5\d ", again.stdout, re.MULTILINE)) == 1
        finally:
            team.send_signal(signal.SIGINT)
            assert eventually(lambda: team.poll() is not None)
    detect_and_annotate = json.loads(ran.stdout)
    assert len(detect_and_annotate) == 3
    stamps = [int(one["frame"]) for one in detect_and_annotate]
    assert all(later - stamp >= 5e8 for stamp, later in pairwise(stamps))
    for one in detect_and_annotate:
        assert [found["id"] for found in one["found"]] == ["seen"]
        header = read_header(Path(one["picture"]).read_bytes())
        assert header is not None
        assert (header.width_px, header.height_px) == (640, 480)
    sightings = [s for s in read_recording(record).inputs["looker"] if isinstance(s, Sightings)]
    assert set(stamps) <= {frame.stamp_ns for frame in sightings}
    assert {s.id for frame in sightings for s in frame.sightings} == {"seen"}
    assert pictures_in_recording(record) == len(sightings)


def pictures_in_recording(path: Path) -> int:
    """How many pictures there are, each as Foxglove shows them."""
    count = 0
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages("picture/looker"):
            assert schema is not None
            assert (schema.name, schema.encoding) == ("foxglove.CompressedImage", "jsonschema")
            assert channel.message_encoding == "json"
            picture = json.loads(message.data)
            assert picture.keys() == json.loads(schema.data)["properties"].keys()
            time = picture["timestamp"]
            assert time["sec"] * 10**9 + time["nsec"] == message.log_time
            assert read_header(base64.b64decode(picture["data"])) is not None
            count += 1
    return count
