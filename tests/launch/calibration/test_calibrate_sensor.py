"""`calibrate sensor` finds how eyes err against known poses, and whether they know it."""

import csv
import json
import math
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from support.processes import command_line

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_agents.vision.camera import Camera
from cpcbl_launch.calibration.camera_accuracy import (
    AccuracyRow,
    CameraAccuracy,
    CameraObservations,
    camera_observations,
    dataset_from_pictures,
    dataset_from_recordings,
    measure_camera_accuracy,
    observer_name,
    read_poses,
)
from cpcbl_launch.calibration.logs import ground_truth
from cpcbl_launch.calibration.team_tables import CAMERA_SIGMAS, TablePath, edit_team, sensor_tables
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.simulation.camera.render import Light, Scene, SceneRobot, render
from cpcbl_launch.team.file import load_team, parse_team
from cpcbl_team.config import CameraSettings, Landmark, RobotSettings, Team
from cpcbl_team.errors import InputError
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import AnnotatedFrame, Truth, Truths, encode

TEAM = """name = "lab"
[map.landmarks]
a = { x_m = 0.0, y_m = 0.0, colours = ["red", "blue"] }
b = { x_m = 5.0, y_m = 0.0, colours = ["blue", "yellow"] }
c = { x_m = 5.0, y_m = 4.0, colours = ["yellow", "green"] }
d = { x_m = 0.0, y_m = 4.0, colours = ["green", "red"] }

[types.eye]
sensing = "camera" # not simulated
source = "external"
[types.eye.camera]
tilt_deg = 5.0 # by a ruler

[robots.eye]
type = "eye"
[robots.mate]
source = "external"
markers = { front = 1, left = 2, back = 3, right = 4 }
"""
LAB = parse_team(TEAM)
LONGER, ASIDE_DEG = 1.03, 1.5  # the true lens, and where it is truly mounted
PICTURES = 40


def photograph(folder: Path, camera: CameraSettings) -> Path:
    """Pictures of the lab by this camera, and where they were taken (CSV)."""
    random, scene = np.random.default_rng(1), Scene.of(LAB)
    rows: list[tuple[object, ...]] = [("file", "x_m", "y_m", "heading_deg", "robot")]
    for i in range(PICTURES):
        x, y = random.uniform(1.0, 4.0), random.uniform(0.8, 3.2)
        mark = LAB.map.landmarks["abcd"[i % 4]]
        heading = math.atan2(mark.y_m - y, mark.x_m - x) + random.uniform(-0.3, 0.3)
        away, aside = random.uniform(0.9, 2.5), heading + random.uniform(-0.4, 0.4)
        other = x + away * math.cos(aside), y + away * math.sin(aside), random.uniform(-3.0, 3.0)
        mate = SceneRobot("mate", *other)
        colour_mask = render(scene, Camera(camera), Pose2(x, y, heading), [mate], Light(), random)
        cv2.imwrite(str(folder / f"{i:02}.png"), colour_mask)
        rows.append((f"{i:02}.png", x, y, math.degrees(heading), ""))
        rows.append((f"{i:02}.png", *other[:2], math.degrees(other[2]), "mate"))
    with (folder / "poses.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder / "poses.csv"


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("honest")
    photograph(path, LAB.robots["eye"].camera)
    return path


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, camera = tmp_path_factory.mktemp("wrong"), LAB.robots["eye"].camera
    focal = LONGER * camera.fx_px
    photograph(path, replace(camera, fx_px=focal, fy_px=focal, yaw_deg=ASIDE_DEG))
    return path


def accuracy_of(folder: Path) -> CameraAccuracy:
    looked = dataset_from_pictures(folder, folder / "poses.csv", "eye", LAB)
    return measure_camera_accuracy(looked.observations)


def whole(seeing: CameraAccuracy, kind: str) -> AccuracyRow:
    (found,) = (a for a in seeing.agreements if a.kind == kind and a.to_m is None and not a.from_m)
    return found


@pytest.mark.thorough
def test_a_camera_as_the_file_says_is_found_right_and_honest(honest: Path) -> None:
    seeing = accuracy_of(honest)
    for kind in ("landmarks", "teammates"):
        found = whole(seeing, kind)
        assert found.sightings > 0.5 * PICTURES
        assert found.range_share is not None
        assert abs(found.range_share.bias) < 0.01
        assert found.range_share.sigma < 0.03
        assert found.bearing_deg is not None
        assert abs(found.bearing_deg.bias) < 0.1
        for error in (found.range_share, found.bearing_deg):
            assert error.inside_3_sigma is not None
            assert error.inside_3_sigma >= 0.98
    assert whole(seeing, "landmarks").heading_deg is None
    heading = whole(seeing, "teammates").heading_deg
    assert heading is not None
    assert abs(heading.bias) < 1.0
    assert seeing.sensor["range_scale"].value == pytest.approx(1.0, abs=0.01)
    assert "delay_s" not in seeing.sensor  # pictures do not tell it
    assert "correlation_s" not in seeing.sensor


@pytest.mark.thorough
def test_a_lens_that_is_longer_and_looks_aside_is_found(wrong: Path) -> None:
    seeing = accuracy_of(wrong)
    landmarks = whole(seeing, "landmarks")
    assert landmarks.range_share is not None
    assert landmarks.bearing_deg is not None
    assert landmarks.range_share.bias == pytest.approx(1.0 / LONGER - 1.0, abs=0.015)
    assert landmarks.bearing_deg.bias == pytest.approx(-ASIDE_DEG, abs=0.3)
    assert landmarks.bearing_deg.inside_3_sigma is not None
    assert landmarks.bearing_deg.inside_3_sigma > 0.98  # the camera's sigma of its yaw holds it
    bias = seeing.sensor["bearing_bias_deg"]
    assert bias.value == pytest.approx(-ASIDE_DEG, abs=0.05)
    assert bias.standard_error < 0.05
    scale = seeing.sensor["range_scale"].value
    three_m = scale * 3.0 / LONGER - seeing.sensor["range_bias_m"].value
    assert three_m == pytest.approx(3.0, abs=0.03)


# Sightings with known errors ----------------------------------------------------------------------


MARKS = {"a": Landmark(x_m=0.0, y_m=0.0), "b": Landmark(x_m=5.0, y_m=4.0)}


def simulated_observations(
    times: float, seconds: int = 200, stated_share: float = 1.0
) -> CameraObservations:
    """Sightings whose errors are `times` the stated sigmas; `stated_share` 0: none are stated."""
    random = np.random.default_rng(7)
    truth = np.column_stack(
        [
            np.arange(0.0, seconds, 0.5),
            *random.uniform(1.0, 4.0, (2, 2 * seconds)),
            np.zeros(2 * seconds),
        ]
    )
    truth[:, 3] = random.uniform(-3.0, 3.0)
    mate = np.column_stack([truth[:, 0], truth[:, 1:3] + 1.0, truth[:, 3] + 0.5])
    frames = []
    for at, x, y, heading in truth[2:-2].tolist():
        sightings = []
        own = {"mate": (x + 1.0, y + 1.0)} | {n: (m.x_m, m.y_m) for n, m in MARKS.items()}
        for name, (there_x, there_y) in own.items():
            range_m, bearing = (
                math.hypot(there_x - x, there_y - y),
                math.atan2(there_y - y, there_x - x),
            )
            sigma = 0.02 * range_m, 0.01
            errors = random.normal(0.0, times, 3) * (*sigma, 0.05)
            stated = sigma if stated_share else (None, None)
            turned = (bearing - heading + errors[1] + math.pi) % math.tau - math.pi
            facing = (0.5 + errors[2], 0.05) if name == "mate" else (None, None)
            sightings.append(Sighting(name, range_m + errors[0], turned, *stated, *facing))
        frames.append(Sightings(int(at * 1e9), tuple(sightings)))
    return camera_observations("eye", frames, ground_truth(MARKS, {"eye": truth, "mate": mate}))


@cache
def simulated_accuracy(times: float) -> CameraAccuracy:
    return measure_camera_accuracy([simulated_observations(times)])


@pytest.mark.parametrize("times", [0.5, 1.0, 2.0])
def test_how_errors_compare_with_what_is_stated(times: float) -> None:
    seeing = simulated_accuracy(times)
    assert seeing.times is not None
    assert seeing.times.value == pytest.approx(times, rel=0.12)
    assert seeing.times.standard_error < 0.1 * times
    for kind in ("landmarks", "teammates"):
        found = whole(seeing, kind)
        for error in (found.range_share, found.bearing_deg):
            assert error is not None
            assert error.times == pytest.approx(times, rel=0.12)
    assert (heading := whole(seeing, "teammates").heading_deg) is not None
    assert heading.times == pytest.approx(times, rel=0.12)
    assert heading.sigma == pytest.approx(times * math.degrees(0.05), rel=0.12)
    assert seeing.sensor["range_share"].value == pytest.approx(0.02 * times, rel=0.15)
    assert seeing.sensor["bearing_sigma_deg"].value == pytest.approx(0.573 * times, rel=0.15)


def test_spans_of_ranges_are_parts_of_the_whole() -> None:
    seeing = simulated_accuracy(1.0)
    parts = [a for a in seeing.agreements if a.kind == "landmarks"]
    assert sum(a.sightings for a in parts[1:]) == parts[0].sightings
    assert [(a.from_m, a.to_m) for a in parts[1:]] == [(0.0, 2.0), (2.0, 4.0), (4.0, None)]


@pytest.mark.parametrize(("times", "grown"), [(0.5, False), (1.0, False), (2.0, True)])
def test_stated_sigmas_grow_where_errors_are_larger(times: float, grown: bool) -> None:
    camera, (sensor_path, camera_path) = (
        CameraSettings(),
        (TablePath(("types", "eye", p)) for p in ("sensor", "camera")),
    )
    tables = sensor_tables(simulated_accuracy(times), camera, sensor_path, camera_path)
    assert (camera_path in tables) is grown
    team = parse_team(edit_team(TEAM, "lab", tables))
    for key in CAMERA_SIGMAS:
        before, after = getattr(camera, key), getattr(team.robots["eye"].camera, key)
        assert after == pytest.approx((times if grown else 1.0) * before, rel=0.13)
    assert team.robots["eye"].sensor.range_share == pytest.approx(0.02 * times, rel=0.15)
    assert team.robots["eye"].camera.tilt_deg == 5.0


def test_ranges_that_are_no_depths_are_written_as_such() -> None:
    table_path = TablePath(("types", "eye", "sensor"))
    depths = TEAM.replace(
        "[types.eye.camera]", "sensor = { range_is_depth = true }\n[types.eye.camera]"
    )
    assert parse_team(depths).robots["eye"].sensor.range_is_depth
    tables = sensor_tables(simulated_accuracy(1.0), CameraSettings(), table_path, table_path)
    assert not parse_team(edit_team(depths, "lab", tables)).robots["eye"].sensor.range_is_depth


def test_eyes_that_state_nothing_are_calibrated_too() -> None:
    seeing = measure_camera_accuracy([simulated_observations(1.0, stated_share=0.0)])
    assert seeing.times is None
    error = whole(seeing, "landmarks").range_share
    assert error is not None
    assert (error.times, error.inside_3_sigma) == (None, None)


def test_too_few_sightings_are_said() -> None:
    with pytest.raises(InputError, match="18 sightings with known truth; at least 40"):
        measure_camera_accuracy([simulated_observations(1.0, seconds=5)])


# Files --------------------------------------------------------------------------------------------


EYE = RobotSettings(source="external", sensing="camera")


def record(path: Path, log: CameraObservations, *names: str, **robots: RobotSettings) -> Team:
    """What robots of these names look at in a run of this team, all from the same places."""
    team = Team(name="lab", robots=robots)
    team = replace(team, map=replace(team.map, landmarks=MARKS))
    hub = MemoryHub()
    looks = {n: hub.session().publisher(f"look/{n}", topics.Qos.TELEMETRY) for n in names}
    truths = hub.session().publisher("field/truth", topics.Qos.TELEMETRY)
    with Recording(path, team, hub.session()):
        for at, *pose in log.log.truth.tolist():
            truths.put(encode(Truths(int(at * 1e9), tuple(Truth(n, *pose) for n in names))))
            mine = np.isclose(log.log.sightings[:, 0], at)
            found = tuple(
                Sighting("ab"[int(which)], r, b, sigma[0], sigma[1])
                for (_, which, r, b), sigma in zip(
                    log.log.sightings[mine].tolist(), log.stated[mine].tolist(), strict=True
                )
                if which < 2
            )
            for name in names:
                looks[name].put(encode(AnnotatedFrame(name, int(at * 1e9), b"", found)))
    return team


def test_looks_of_a_recording_are_sightings(tmp_path: Path) -> None:
    path, log = tmp_path / "run.mcap", simulated_observations(1.0, 30)
    team = record(path, log, "eye", eye=EYE)
    looked = dataset_from_recordings([path], None)
    assert looked.robots == ("eye",)
    (sights,) = looked.observations
    assert len(sights.log.sightings) == (log.log.sightings[:, 1] < 2).sum()
    assert measure_camera_accuracy(looked.observations).sensor[
        "range_scale"
    ].value == pytest.approx(1.0, abs=0.02)
    with pytest.raises(InputError, match=r"run\.mcap: no sightings of other"):
        dataset_from_recordings([path], "other")
    with pytest.raises(InputError, match="no recording of"):
        dataset_from_recordings([tmp_path], None)
    with Recording(tmp_path / "blind.mcap", team, MemoryHub().session()):
        pass
    with pytest.raises(LogError, match="holds no truth"):
        dataset_from_recordings([tmp_path / "blind.mcap"], None)


def test_like_cameras_are_pooled_and_unlike_ones_refused(tmp_path: Path) -> None:
    path, log = tmp_path / "run.mcap", simulated_observations(1.0, 30)
    at_a_device = replace(EYE, camera=CameraSettings(frames="0"))
    record(path, log, "one", "two", one=EYE, two=at_a_device)
    assert dataset_from_recordings([path], None).robots == ("one", "two")
    longer = replace(EYE, camera=CameraSettings(fx_px=500.0))
    record(path, log, "one", "two", one=EYE, two=longer)
    with pytest.raises(InputError, match=r"one, two: different cameras, .* by --robot"):
        dataset_from_recordings([path], None)
    assert dataset_from_recordings([path], "two").camera == longer.camera


def test_a_guests_camera_is_not_known(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record(path, simulated_observations(1.0, 30), "eye", "guest", eye=EYE)
    with pytest.raises(InputError, match=r"--robot guest: a guest of .*; with a camera: eye"):
        dataset_from_recordings([path], "guest")


def test_pictures_that_cannot_be_used_are_said(honest: Path, tmp_path: Path) -> None:
    head, *rows = (honest / "poses.csv").read_text().splitlines()
    first = [row for row in rows if row < "06"]
    for name in {row.partition(",")[0] for row in first}:
        (tmp_path / name).write_bytes((honest / name).read_bytes())
    (tmp_path / "00.png").write_bytes(b"")
    cv2.imwrite(str(tmp_path / "01.png"), np.zeros((480, 640, 3), np.uint8))
    (tmp_path / "poses.csv").write_text("\n".join((head, *first)))
    looked = dataset_from_pictures(tmp_path, tmp_path / "poses.csv", "eye", LAB)
    assert looked.notes[:2] == ("00.png: no picture", "01.png: frame_black")
    (tmp_path / "poses.csv").write_text("file,x_m,y_m,heading_deg\n00.png,1,1,0\n")
    with pytest.raises(InputError, match=r"no picture can be used: 00\.png: no picture"):
        dataset_from_pictures(tmp_path, tmp_path / "poses.csv", "eye", LAB)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no lines; its columns are file,x_m"),
        ("file,x_m\na.png,1\n", "its columns are file,x_m,y_m,heading_deg,robot"),
        ("file,x_m,y_m,heading_deg\na.png,1,one,2\n", "its columns are"),
        ("file,x_m,y_m,heading_deg,robot\na.png,1,1,2,nobody\n", "no robot 'nobody'.*eye, mate"),
    ],
)
def test_a_wrong_file_of_poses_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_poses(tmp_path / "poses.csv", LAB)


def test_whose_camera_it_is() -> None:
    assert observer_name(LAB, None) == "eye"
    for robot in ("mate", "nobody"):
        with pytest.raises(InputError, match="with a camera: eye"):
            observer_name(LAB, robot)


# Command line -------------------------------------------------------------------------------------


def test_the_command_line_writes_a_team_that_it_can_check(wrong: Path, tmp_path: Path) -> None:
    team = tmp_path / "lab.toml"
    team.write_text(TEAM)
    options = [team, "--pictures", wrong, "--poses", wrong / "poses.csv", "--type", "eye"]
    ran = command_line("calibrate", "sensor", *options)
    assert ran.returncode == 0, ran.stderr
    assert max(len(line) for line in ran.stdout.splitlines()[:-1]) <= 80
    for word in ("landmarks", "teammates", "in 3 σ", "bearing_bias_deg", f"written: {team}"):
        assert word in ran.stdout
    assert "# by a ruler" in team.read_text()
    sensor = load_team(team).robots["eye"].sensor
    assert sensor.bearing_bias_deg == pytest.approx(-ASIDE_DEG, abs=0.05)
    assert command_line("check", team).returncode == 0
    shown = command_line("calibrate", "sensor", *options, "--json")
    assert json.loads(shown.stdout)["sensor"]["range_scale"]["value"] > 1.0


def test_a_wrong_option_is_one_line(honest: Path, tmp_path: Path) -> None:
    team = tmp_path / "lab.toml"
    team.write_text(TEAM)
    for arguments, words in (
        ([], "name recordings, or --pictures FOLDER --poses"),
        ([team, "--pictures", honest], "needs --poses"),
        (["--pictures", honest, "--poses", honest / "poses.csv"], "as the first argument"),
        (["run.mp4"], "run.mp4: no recording"),
    ):
        failed = command_line("calibrate", "sensor", *arguments)
        assert failed.returncode == 2
        (line,) = failed.stderr.splitlines()
        assert words in line
