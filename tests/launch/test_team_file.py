"""Team files: layers, what comes built in, and errors that name file, key and fix in one line."""

import math
from pathlib import Path

import pytest
from support.team_texts import ROBOT, robots, team

from cpcbl_launch.team.file import TeamFileError, builtin_path, load_team, save_resolved
from cpcbl_team.config import RobotSettings

LAYERS = """
[defaults]
speed_m_s = 0.1
waypoints_m = [[1.0, 1.0], [2.0, 2.0]]
[defaults.sensor]
range_share = 0.1
max_range_m = 11.0
rate_hz = 5.0
[defaults.localizer]
variant = "oval"
[types.fast]
speed_m_s = 0.9
sensor = { max_range_m = 22.0, rate_hz = 6.0 }
localizer = { weights = { position = 0.3 } }
[robots.plain]
start = { x_m = 0.0, y_m = 0.0 }
[robots.fast]
type = "fast"
start = { x_m = 1.0, y_m = 0.0 }
sensor = { rate_hz = 7.0 }
localizer = { weights = { heading = 0.4 } }
waypoints_m = [[3.0, 3.0]]
"""


def test_a_robot_without_a_type_has_the_defaults_of_the_file() -> None:
    plain = robots(LAYERS)["plain"]
    assert plain.speed_m_s == 0.1
    assert plain.localizer.variant == "oval"
    assert (plain.sensor.range_share, plain.sensor.max_range_m) == (0.1, 11.0)
    assert plain.sensor.bearing_sigma_deg == RobotSettings().sensor.bearing_sigma_deg
    assert plain.odometry == RobotSettings().odometry


def test_a_type_goes_over_the_defaults_and_the_robot_over_both_at_any_depth() -> None:
    fast = robots(LAYERS)["fast"]
    assert fast.speed_m_s == 0.9
    assert (fast.sensor.range_share, fast.sensor.max_range_m, fast.sensor.rate_hz) == (
        0.1,
        22.0,
        7.0,
    )
    assert fast.localizer.variant == "oval"
    assert (fast.localizer.weights.position, fast.localizer.weights.heading) == (0.3, 0.4)


def test_a_list_replaces_a_list() -> None:
    assert robots(LAYERS)["fast"].waypoints_m == ((3.0, 3.0),)
    assert robots(LAYERS)["plain"].waypoints_m == ((1.0, 1.0), (2.0, 2.0))


def test_layers_of_one_robot_leave_the_others_alone() -> None:
    alone = LAYERS[: LAYERS.index("[robots.fast]")]
    assert robots(alone)["plain"] == robots(LAYERS)["plain"]


@pytest.mark.parametrize(
    ("name", "members", "source"),
    [
        ("demo", {"navigator", "observer", "scout", "patrol"}, "simulated"),
        ("mrclam", {"1", "2", "3", "4", "5"}, "mrclam"),
    ],
)
def test_the_built_in_teams_load(name: str, members: set[str], source: str) -> None:
    loaded = load_team(builtin_path(name))
    assert loaded.name == name
    assert set(loaded.robots) == members
    assert {robot.source for robot in loaded.robots.values()} == {source}


@pytest.mark.parametrize("name", ["demo", "mrclam"])
def test_a_resolved_team_comes_back_as_it_was(tmp_path: Path, name: str) -> None:
    loaded, path = load_team(builtin_path(name)), tmp_path / "team.json"
    save_resolved(loaded, path)
    assert load_team(path) == loaded


def test_all_parts_of_a_file_come_back_as_they_were(tmp_path: Path) -> None:
    whole = team(
        LAYERS.replace("x_m = 1.0", "known = false, x_m = 1.0")
        + """
[map.landmarks]
oak = { x_m = 1.0, y_m = 2.0, gives = "bearing" }
[map.walls]
north = { from_m = [0.0, 5.0], to_m = [9.0, 5.0], gives = "range" }
[transport]
listen = ["tcp/0.0.0.0:7447", "udp/[::]:7448"]
connect = ["ws/router.example:7447"]
guards = { fix_rate_hz = 44.0, largest_help_bytes = 100 }
[simulation]
step_rate_hz = 100
noise = 0
"""
    )
    path = tmp_path / "team.json"
    save_resolved(whole, path)
    assert load_team(path) == whole
    assert whole.map.walls["north"].gives == "range"
    assert whole.simulation.noise == 0.0


@pytest.mark.parametrize(
    "content",
    ["", "{", '{"name": "t"}', '{"name": "t", "robots": {}, "robot": {}}', '{"name": 3}'],
)
def test_a_damaged_resolved_team_is_one_line_with_the_files_name(
    tmp_path: Path, content: str
) -> None:
    path = tmp_path / "team.json"
    path.write_text(content)
    with pytest.raises(TeamFileError) as caught:
        load_team(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_robot_that_is_not_simulated_needs_no_start() -> None:
    assert robots('[robots.r1]\nsource = "external"')["r1"].start is None


def test_guards_that_are_off_may_have_any_rate() -> None:
    off = team(f"[transport.guards]\nenabled = false\nfix_rate_hz = 0.1{ROBOT}")
    assert not off.transport.guards.enabled


def test_whole_numbers_are_numbers() -> None:
    start = robots("[robots.r1]\nstart = { x_m = 1, y_m = -2, heading_deg = 90 }")["r1"].start
    assert start is not None
    assert (start.x_m, start.y_m, start.heading_deg) == (1.0, -2.0, 90.0)


def test_the_map_has_bounds_and_walls_have_directions() -> None:
    field = team(
        f"""{ROBOT}
[map.landmarks.oak]
x_m = -1.0
y_m = 2.0
[map.walls.north]
from_m = [0.0, 5.0]
to_m = [9.0, 14.0]
"""
    ).map
    assert field.bounds() == (-1.0, 2.0, 9.0, 14.0)
    assert field.walls["north"].direction_rad == pytest.approx(math.pi / 4.0)


def test_videos_and_folders_are_found_beside_the_team_file(tmp_path: Path) -> None:
    frames = {"film": "film.avi", "shots": "../shots", "device": "0", "dev": "/dev/video2"}
    frames |= {"stream": "rtsp://10.0.0.7/a", "driver": "", "root": "/films/a.avi"}
    text = "".join(
        f'[robots.{name}]\nsource = "external"\ncamera = {{ frames = "{where}" }}\n'
        for name, where in frames.items()
    )
    path = tmp_path / "team.toml"
    path.write_text(f'name = "t"\n{text}')
    found = {name: robot.camera.frames for name, robot in load_team(path).robots.items()}
    beside = {"film": str(tmp_path / "film.avi"), "shots": str(tmp_path / "../shots")}
    assert found == {**frames, **beside}


def test_simulated_frames_are_the_fields() -> None:
    with pytest.raises(TeamFileError, match=r"robots\.r1\.camera\.frames: .*; remove the key"):
        team(f'{ROBOT}sensing = "camera"\ncamera = {{ frames = "0" }}')
