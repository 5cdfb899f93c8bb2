"""Pictures with a table of what is in them: what is found and missed of it, and by how much."""

import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmarks.pictures import TruthLine, main, measure, picture_set
from msgspec.structs import replace
from support.benchmarks import refusal_of, run_benchmark

from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.markers import MarkerDetector
from cpcbl_launch.reporting.files import read_csv
from cpcbl_launch.simulation.camera.render import Light, Scene, SceneRobot, render
from cpcbl_launch.team.file import load_team, parse_team
from cpcbl_team.config import MarkerFamily
from cpcbl_team.geometry import Pose2

TEAM = """
name = "t"
[map.landmarks]
mark = { x_m = 2.0, y_m = 0.5, colours = ["yellow", "blue"] }
[robots.eye]
source = "external"
sensing = "camera"
[robots.mate]
source = "external"
markers = { front = 1, left = 2, back = 3, right = 4 }
"""
COLUMNS = TruthLine.__struct_fields__
SETS = ("duckiebot", "frc-speaker", "frc-amp", "nao")


def picture(*robots: SceneRobot, landmarks: bool = True) -> Pixels:
    """From the field's origin, along x."""
    team = parse_team(TEAM)
    scene = Scene.of(team) if landmarks else Scene.of(team).without_landmarks()
    camera, random = Camera(team.robots["eye"].camera), np.random.default_rng(1)
    return render(scene, camera, Pose2(0.0, 0.0, 0.0), robots, Light(), random)


@pytest.fixture
def own_set(tmp_path: Path) -> Path:
    (tmp_path / "own.toml").write_text(TEAM)
    both = picture(SceneRobot("mate", 1.5, -0.4, 3.0))
    cv2.imwrite(str(tmp_path / "both.png"), both)
    cv2.imwrite(str(tmp_path / "none.png"), picture(landmarks=False))
    cv2.imwrite(str(tmp_path / "cut.png"), both[:100])
    table = tmp_path / "own.csv"
    bearing = math.degrees(math.atan2(-0.4, 1.5))
    table.write_text(
        "picture,viewer,id,range_m,bearing_deg,heading_deg\n"
        f"both.png,eye,mate,{math.hypot(1.5, 0.4)},{bearing},{math.degrees(3.0)}\n"
        "none.png,eye,mark,2.06,,\n"
        "cut.png,eye,mate,,,\n"
    )
    return table


def test_found_missed_unexpected_and_refused_are_distinguished(own_set: Path) -> None:
    result = measure(str(own_set), own_set.parent)
    mate, mark = result.lines
    assert (mate.picture, mate.id, mate.found) == ("both.png", "mate", True)
    assert mate.range_error_m == pytest.approx(0.0, abs=0.03)
    assert mate.bearing_error_deg == pytest.approx(0.0, abs=0.5)
    assert mate.heading_error_deg == pytest.approx(0.0, abs=3.0)
    assert (mark.picture, mark.found, mark.range_error_m) == ("none.png", False, None)
    assert result.unexpected == (("both.png", "mark"),)
    assert result.refused == {"cut.png": "frame_wrong_size"}


def test_unexpected_detections_are_in_the_same_order_each_time(own_set: Path) -> None:
    own_set.write_text("picture,viewer,id,range_m,bearing_deg,heading_deg\nboth.png,eye,,,,\n")
    found = measure(str(own_set), own_set.parent).unexpected
    assert found == (("both.png", "mark"), ("both.png", "mate"))


@pytest.mark.thorough
def test_the_benchmark_shows_and_writes(own_set: Path, tmp_path: Path) -> None:
    shown = run_benchmark("pictures", own_set, own_set.parent, "--output", tmp_path)
    assert shown.returncode == 0, shown.stderr
    assert "found 1 of 2" in shown.stdout
    assert "within three stated σ: range 1 of 1, bearing 1 of 1, heading 1 of 1" in shown.stdout
    assert "unusable pictures: frame_wrong_size (cut.png)" in shown.stdout
    assert (tmp_path / "pictures-own.json").exists()


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("nobody", "", "duckiebot"),
        ("x.csv", "a,b\n", "its columns are picture,viewer,id"),
        ("x.csv", ",".join(COLUMNS) + "\np,eye,mate,far,,\n", "line 2"),
        ("x.csv", ",".join(COLUMNS) + "\np,ear,mate,,,\n", "no robot ear"),
        ("x.csv", ",".join(COLUMNS) + "\np.png,eye,mate,,,\n", "p.png"),
    ],
)
def test_an_unreadable_set_is_one_line(tmp_path: Path, name: str, text: str, said: str) -> None:
    if text:
        (tmp_path / "x.toml").write_text(TEAM)
        (tmp_path / "x.csv").write_text(text)
        name = str(tmp_path / name)
    assert said in refusal_of(main, name, tmp_path, "--output", tmp_path).splitlines()[-1]


@pytest.mark.parametrize("name", SETS)
def test_built_in_sets_are_complete(name: str) -> None:
    path = picture_set(name)
    team, lines = load_team(path.with_suffix(".toml")), read_csv(path, TruthLine)
    assert lines
    assert {line.viewer for line in lines} <= team.robots.keys()
    named = team.robots.keys() | team.map.landmarks.keys()
    assert {line.id for line in lines if line.id} <= named


@pytest.mark.parametrize("family", ["apriltag_36h11", "aruco_4x4_50"])
def test_only_an_apriltag_that_is_upside_down_is_read_as_upright(family: MarkerFamily) -> None:
    team = parse_team(TEAM)
    team = replace(team, vision=replace(team.vision, family=family))
    camera, random = Camera(team.robots["eye"].camera), np.random.default_rng(1)
    with_stand = SceneRobot("mate", 1.0, 0.0, math.pi)  # its marker turns into itself
    upright = render(
        Scene.of(team).without_landmarks(),
        camera,
        Pose2(0.0, 0.0, 0.0),
        [with_stand],
        Light(),
        random,
    )
    markers = MarkerDetector("eye", team, camera)
    (mark,) = markers.detections(upright).found
    half, (x, y) = 34, np.round(mark.outline.mean(axis=0)).astype(int)
    turned = upright.copy()
    window = slice(y - half, y + half + 1), slice(x - half, x + half + 1)
    turned[window] = upright[window][::-1, ::-1]
    detections = markers.detections(turned)
    if family == "aruco_4x4_50":
        assert not detections.found
        assert [one.reason for one in detections.ambiguities] == ["upside_down"]
        return
    (again,) = detections.found
    assert again.sighting.id == "mate"
    assert again.sighting.range_m == pytest.approx(mark.sighting.range_m, rel=0.02)


@pytest.mark.pictures
@pytest.mark.parametrize(
    ("name", "found", "off_share"),
    [
        ("duckiebot", 15, 0.06),
        ("frc-speaker", 10, 0.06),
        ("frc-amp", 2, 0.06),
        ("nao", 3, 0.1),
    ],
)
def test_real_pictures(name: str, found: int, off_share: float) -> None:
    folder = name.partition("-")[0]
    result = measure(name, Path(os.environ["CPCBL_PICTURES"]) / folder)
    assert not result.unexpected
    assert not result.refused
    assert sum(line.found for line in result.lines) >= found
    for line in result.lines:
        if line.range_error_m is not None and line.range_m is not None:
            assert abs(line.range_error_m) <= off_share * line.range_m
