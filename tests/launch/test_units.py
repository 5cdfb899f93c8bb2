"""What `check` says of numbers in another unit, of nearly right keys, and of all faults."""

from pathlib import Path

import pytest
from support.processes import command_line

LAB = """
name = "lab"
[map.landmarks]
door = { x_m = 2.0, y_m = 0.2 }
oak = { x_m = 4.0, y_m = 2.0 }
[vision]
marker_m = 0.16
[defaults]
source = "external"
sensor = { range_share = 0.04, bearing_sigma_deg = 2.0, delay_s = 0.04 }
[robots.r1]
start = { x_m = 1.0, y_m = 1.0, heading_deg = 90.0 }
[robots.r2]
"""
IN_ANOTHER_UNIT = [
    ("range_share = 0.04", "range_share = 4.0", "sensor.range_share", "percent, write 0.04"),
    ("deg = 2.0", "deg = 0.035", "sensor.bearing_sigma_deg", "radians, write 2.005"),
    ("delay_s = 0.04", "delay_s = 40.0", "sensor.delay_s", "milliseconds, write 0.04"),
    ("marker_m = 0.16", "marker_m = 160", "vision.marker_m", "millimetres, write 0.16"),
    ("heading_deg = 90.0", "heading_deg = 1.5708", "start.heading_deg", "radians, write 90"),
    ("x_m = 4.0", "x_m = 4000.0", "map.landmarks.oak", "millimetres, write 4 and"),
]
FAULTY = """
nam = 3
[map.landmarks]
door = { x = 2.0, y_m = 0.2 }
[transport]
router = "tcp/10.0.0.1:7447"
[defaults]
source = "extern"
sensor = { range_sigma_m = 0.1, bearing_sigma_rad = 0.035, fov = 40 }
[robots.r1]
type = "a"
start = { x_m = "1", y_m = 1e308, theta = 1.5708 }
"""
FAULTS = [
    ("robots.r1.start.y_m", "at most 1e+06 (count from an origin near the field)"),
    ("nam", "'name'"),
    ("map.landmarks.door.x", "'x_m' (metres)"),
    ("transport.router", "'connect'"),
    ("defaults.source", "did you mean 'external'? use one of simulated, mrclam, external"),
    ("defaults.sensor.range_sigma_m", "'range_floor_m' (metres) or 'range_share'"),
    ("defaults.sensor.bearing_sigma_rad", "'bearing_sigma_deg' (degrees)"),
    ("defaults.sensor.fov", "'field_of_view_deg'"),
    ("robots.r1.start.x_m", "expected a number, got a text"),
    ("robots.r1.start.theta", "'heading_deg' (degrees)"),
    ("robots.r1.type", "no type 'a'"),
]


def check(path: Path, text: str) -> list[str]:
    """What `check` says on standard error of a file with this text, a line each."""
    path.write_text(text)
    return command_line("check", path).stderr.splitlines()


def test_usual_numbers_are_not_remarked_upon(tmp_path: Path) -> None:
    assert check(tmp_path / "team.toml", LAB) == []


@pytest.mark.parametrize(("good", "bad", "key", "said"), IN_ANOTHER_UNIT, ids=lambda x: str(x))
def test_a_number_in_another_unit_is_a_warning_with_the_likely_one(
    good: str, bad: str, key: str, said: str, tmp_path: Path
) -> None:
    (line,) = check(tmp_path / "team.toml", LAB.replace(good, bad))
    assert "warning: " in line
    assert key in line
    assert said in line


def test_the_same_number_of_several_robots_is_said_once(tmp_path: Path) -> None:
    (line,) = check(tmp_path / "team.toml", LAB.replace("0.04,", "4.0,", 1))
    assert "robots.r1.sensor.range_share (and 1 more)" in line


@pytest.mark.parametrize("change", [("door = {", "# {"), ("[defaults]", "[unused]")])
def test_a_team_that_sees_no_landmark_is_warned(change: tuple[str, str], tmp_path: Path) -> None:
    blind = LAB.replace("[robots.r2]", "[robots.r2]\nsensor.sees_landmarks = false")
    if change[0] == "[defaults]":
        text = blind.replace("[robots.r1]", "[robots.r1]\nsensor.sees_landmarks = false")
    else:
        text = LAB.replace(*change).replace("oak = {", "# {")
    (line,) = check(tmp_path / "team.toml", text)
    assert "warning: map.landmarks: no robot sees a landmark" in line


def test_cameras_recognize_landmarks_by_their_colours(tmp_path: Path) -> None:
    cameras = LAB.replace('source = "external"', 'source = "external"\nsensing = "camera"')
    (line,) = check(tmp_path / "team.toml", cameras)
    assert line.endswith("give the landmarks their colours")


def test_all_faults_are_said_at_once_each_in_a_line(tmp_path: Path) -> None:
    path = tmp_path / "team.toml"
    lines = check(path, f'name = "lab"\n{FAULTY}')
    assert len(lines) == len(FAULTS)
    for line, (key, said) in zip(lines, FAULTS, strict=True):
        assert line.startswith(f"cpcbl-team: {path}: {key}: ")
        assert said in line


def test_of_many_faults_the_first_ones_are_said(tmp_path: Path) -> None:
    lines = check(tmp_path / "team.toml", "\n".join(f"k{i} = 1" for i in range(600)))
    assert len(lines) == 20
    assert lines[-1].endswith("and 583 more faults")  # with name and robots, which are missing
