"""What `check` warns of: teams that are valid and will disappoint."""

from pathlib import Path

import pytest
from support.processes import command_line
from typer.testing import CliRunner

from cpcbl_launch.app import build_app
from cpcbl_launch.team.checks import warnings
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import (
    Field,
    Gives,
    Landmark,
    LocalizerSettings,
    OdometrySettings,
    PositionSensor,
    RobotSettings,
    SensorSettings,
    Team,
    Variant,
)

MARKS = {"oak": Landmark(x_m=0.0, y_m=0.0), "elm": Landmark(x_m=4.0, y_m=0.0)}
RANGES = {n: Landmark(x_m=m.x_m, y_m=m.y_m, gives="range") for n, m in MARKS.items()}


def team_of(marks: dict[str, Landmark], robot: RobotSettings) -> Team:
    return Team(name="tests", map=Field(landmarks=marks), robots={"r1": robot})


THREE = RANGES | {"ash": Landmark(x_m=0.0, y_m=3.0, gives="range")}


@pytest.mark.parametrize("variant", ["circular", "weighted"])
def test_ranges_alone_give_these_variants_no_heading(variant: Variant) -> None:
    robot = RobotSettings(localizer=LocalizerSettings(variant=variant))
    (line,) = warnings(team_of(THREE, robot))
    assert line.startswith("robots.r1.localizer.variant: ")
    assert line.endswith("use variant joint")
    assert list(warnings(team_of(RANGES | {"elm": MARKS["elm"]}, robot))) == []
    for other in (RobotSettings(), RobotSettings(localizer=LocalizerSettings(variant="oval"))):
        assert list(warnings(team_of(THREE, other))) == []


@pytest.mark.parametrize("variant", ["oval", "circular", "weighted"])
def test_a_position_sensor_alone_gives_these_variants_no_heading(variant: Variant) -> None:
    def robot(chosen: Variant, sees_landmarks: bool, moves: bool = True) -> RobotSettings:
        return RobotSettings(
            localizer=LocalizerSettings(variant=chosen),
            sensor=SensorSettings(sees_landmarks=sees_landmarks),
            odometry=OdometrySettings(moves=moves),
            position_sensor=PositionSensor(),
        )

    (line,) = warnings(team_of(MARKS, robot(variant, False)))
    assert line.startswith(f"robots.r1.localizer.variant: {variant} never learns its heading")
    assert line.endswith("use variant joint")
    right = robot("joint", False), robot(variant, True), robot(variant, False, moves=False)
    assert [list(warnings(team_of(MARKS, r))) for r in right] == [[], [], []]


@pytest.mark.parametrize("variant", ["oval", "circular", "weighted"])
def test_these_variants_never_learn_how_far_a_sensor_is_turned(variant: Variant) -> None:
    def robot(chosen: Variant, sigma_deg: float) -> RobotSettings:
        sensor = SensorSettings(bearing_bias_sigma_deg=sigma_deg)
        return RobotSettings(localizer=LocalizerSettings(variant=chosen), sensor=sensor)

    (line,) = warnings(team_of(MARKS, robot(variant, 2.0)))
    assert line.startswith(f"robots.r1.sensor.bearing_bias_sigma_deg: {variant} never")
    right = robot("joint", 2.0), robot(variant, 0.0)
    assert [list(warnings(team_of(MARKS, r))) for r in right] == [[], []]


@pytest.mark.parametrize("gives", ["range", "bearing"])
def test_two_readings_at_a_time_determine_no_pose(gives: Gives) -> None:
    two = {n: Landmark(x_m=m.x_m, y_m=m.y_m, gives=gives) for n, m in MARKS.items()}
    (line,) = warnings(team_of(two, RobotSettings()))
    assert line.startswith("robots.r1: 2 readings at a time do not determine a pose")
    assert list(warnings(team_of(two | {"ash": MARKS["oak"]}, RobotSettings()))) == []


def test_one_object_determines_no_pose() -> None:
    one = {"oak": MARKS["oak"]}
    (line,) = warnings(team_of(one, RobotSettings()))
    assert "stays lost" in line
    blind = RobotSettings(sensor=SensorSettings(sees_landmarks=False))
    with_gps = RobotSettings(position_sensor=PositionSensor())
    assert list(warnings(team_of(one, blind))) == list(warnings(team_of(one, with_gps))) == []


def test_odometry_is_sent_more_often_than_its_timeout() -> None:
    slow = RobotSettings(odometry=OdometrySettings(rate_hz=1.0))
    (line,) = warnings(team_of(MARKS, slow))
    assert line.startswith("robots.r1.odometry.timeout_s: pieces of odometry last 1 s")
    standing = RobotSettings(odometry=OdometrySettings(rate_hz=1.0, moves=False))
    assert list(warnings(team_of(MARKS, standing))) == []


TEAMS = sorted(path.stem for path in builtin_path("demo").parent.glob("*.toml"))


@pytest.mark.parametrize("name", TEAMS)
def test_no_team_of_the_package_has_a_warning(name: str) -> None:
    assert list(warnings(load_team(builtin_path(name)))) == []


def test_check_prints_them_and_finds_the_team_good(tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    lines = (
        'name = "one"',
        "map.landmarks.oak = { x_m = 0.0, y_m = 0.0 }",
        "robots.r1.start = { x_m = 1.0, y_m = 0.0 }",
    )
    path.write_text("\n".join(lines))
    result = CliRunner().invoke(build_app(), ["check", str(path)])
    assert result.exit_code == 0, result.output
    assert "warning: robots.r1: one object on the map" in result.output


def test_check_says_unusual_numbers_beside_faults(tmp_path: Path) -> None:
    file = tmp_path / "team.toml"
    file.write_text(
        'name = "lab"\n[map.landmarks]\ndoor = { x_m = 2.0, y = 0.2 }\n'
        "desk = { x_m = 3.0, y_m = 1.0 }\n[vision]\nmarker_m = 160\n"
        '[robots.r1]\nsource = "extern"\nsensor.range_sigma_m = 0.1\nsensor.range_share = 4\n'
        "start = { x = 1.0, y_m = 1.0 }\n"
    )
    ran = command_line("check", file)
    assert ran.returncode == 2
    for key in ("door.y", "r1.source", "r1.sensor.range_sigma_m", "r1.start.x"):
        assert f"{key}: " in ran.stderr
    warned = [line for line in ran.stderr.splitlines() if "warning" in line]
    assert [line.split(": ")[2] for line in warned] == [
        "robots.r1.sensor.range_share",
        "vision.marker_m",
    ]


@pytest.mark.parametrize(
    "text", ["name = ", "robots = 3", "[robots.r1]\n'a.b' = 1\n[map]\nx = [1]"]
)
def test_check_of_a_file_that_leaves_no_team_says_its_faults_alone(
    text: str, tmp_path: Path
) -> None:
    file = tmp_path / "team.toml"
    file.write_text(text)
    ran = command_line("check", file)
    assert ran.returncode == 2
    assert "warning" not in ran.stderr
