"""Calibrated values as robot types of a team file, and the command `calibrate log`."""

import json
import math
from pathlib import Path

import pytest
from msgspec.structs import replace
from support.logs import write_log
from support.processes import command_line

from cpcbl_launch.calibration.between_days import ANOTHER_DAY, DayVariance, coverage_factor
from cpcbl_launch.calibration.statistics import (
    Estimate,
    decimals,
)
from cpcbl_launch.calibration.team_types import (
    INTERVAL_S,
    Calibration,
    RobotCalibration,
    calibrated_team,
)
from cpcbl_launch.team.file import TeamFileError, load_team, parse_team
from cpcbl_team.config import (
    OdometrySettings,
    SensorSettings,
)
from cpcbl_team.errors import InputError

FOUND = Calibration(
    ("log",),
    {
        "r1": RobotCalibration(
            {"distance_scale": Estimate(0.93456, 0.0108), "delay_s": Estimate(-0.004, 0.01)},
            {"range_share": Estimate(0.0412, 0.002), "range_floor_m": Estimate(0.0, 0.02)},
        )
    },
)
BASE = """
name = "base" # kept
[types.old]
speed_m_s = 0.3
sensor = { range_share = 0.5, max_range_m = 5.0 }
[robots.r1]
type = "old"
source = "external"
odometry = { distance_scale = 2.0, rate_hz = 5.0 }
[robots.r2]
type = "old"
source = "external"
"""


def type_text(
    found: Calibration, base: str, margin: float = 0.0, correction_margin: float = 0.0
) -> str:
    margins = {"margin": margin, "correction_margin": correction_margin}
    return calibrated_team(found, base, "team file", **margins)


def test_types_are_added_to_the_base_team_file() -> None:
    text = type_text(FOUND, BASE)
    team, before = parse_team(text), parse_team(BASE)
    assert text.startswith("# Calibrated by `cpcbl-team calibrate` from log.")
    assert "# kept" in text
    assert "distance_scale = 0.935 # ± 0.011" in text
    r1 = team.robots["r1"]
    found = OdometrySettings(distance_scale=0.935, delay_s=0.0, rate_hz=5.0)
    assert r1.odometry == replace(found, **ANOTHER_DAY)
    assert r1.sensor == SensorSettings(range_share=0.0412, range_floor_m=0.001, max_range_m=5.0)
    assert r1.speed_m_s == 0.3
    assert team.robots["r2"] == before.robots["r2"]
    assert "[types.robot-1" not in text


def test_what_a_robot_says_itself_does_not_go_before_what_was_calibrated() -> None:
    own = BASE.replace(
        "rate_hz = 5.0 }",
        """rate_hz = 5.0 }
sensor = { range_is_depth = true, max_range_m = 4.0 }
localizer = { self_calibration = true, object_interval_s = 3.0, variant = "oval" }""",
    )
    r1 = parse_team(type_text(FOUND, own)).robots["r1"]
    assert not r1.sensor.range_is_depth
    assert not r1.localizer.self_calibration
    assert r1.localizer.object_interval_s == INTERVAL_S
    assert (r1.sensor.max_range_m, r1.localizer.variant) == (4.0, "oval")


def test_a_type_that_others_have_is_not_overwritten() -> None:
    named = BASE.replace("old", "robot-r1")
    with pytest.raises(InputError, match=r"robots\.r2\.type: robot-r1: robot r1 gets a type"):
        type_text(FOUND, named)
    alone = named.split("[robots.r2]")[0]
    assert parse_team(type_text(FOUND, alone)).robots["r1"].speed_m_s == 0.3


def test_noise_is_written_as_of_another_day() -> None:
    sensor = {
        "range_scale": Estimate(0.9, 0.001),
        "range_share": Estimate(0.02, 0.001),
        "range_bias_m": Estimate(0.04, 0.001),
        "range_floor_m": Estimate(0.0, 0.001),
        "bearing_sigma_deg": Estimate(1.0, 0.1),
    }
    found = Calibration(("log",), {"r1": RobotCalibration({}, sensor, range_is_depth=True)})
    r1 = parse_team(type_text(found, BASE, margin=0.5, correction_margin=0.4)).robots["r1"].sensor
    assert r1.range_is_depth
    assert r1.range_share == pytest.approx(math.hypot(0.03, 0.04), abs=5e-4)
    assert r1.range_floor_m == pytest.approx(0.016, abs=5e-4)
    assert r1.bearing_sigma_deg == pytest.approx(1.5, abs=0.05)


def test_noise_holds_what_differs_between_days() -> None:
    """With several logs their differences count, not shares of the corrections."""
    sensor = {"range_bias_m": Estimate(0.5, 0.001), "range_floor_m": Estimate(0.03, 1e-6)}
    days = {"range": DayVariance(2, 0.01**2, 0.03**2)}
    found = Calibration(("a", "b"), {"r1": RobotCalibration({}, sensor, day_variances=days)})
    r1 = parse_team(type_text(found, BASE, correction_margin=0.4)).robots["r1"].sensor
    between = 0.01 * coverage_factor(1)
    assert r1.range_floor_m == pytest.approx(math.hypot(0.03, between), abs=1e-5)


def test_a_dead_zone_of_another_day_is_in_the_noise_of_crawling() -> None:
    odometry = {
        "least_speed_m_s": Estimate(0.02, 0.001),
        "distance_sigma_m_per_sqrt_m": Estimate(0.03, 0.001),
        "crawl_sigma_m_per_sqrt_s": Estimate(0.006, 0.0003),
    }
    found = Calibration(("log",), {"r1": RobotCalibration(odometry, {})})
    r1 = parse_team(type_text(found, BASE, margin=0.5, correction_margin=0.4)).robots["r1"].odometry
    for_two_s = 0.4 * 0.02 * math.sqrt(2.0)
    assert r1.crawl_sigma_m_per_sqrt_s == pytest.approx(math.hypot(0.009, for_two_s), abs=1e-4)
    assert r1.distance_sigma_m_per_sqrt_m == pytest.approx(0.045, abs=5e-4)


def test_a_calibrated_team_file_can_be_calibrated_again() -> None:
    once = type_text(FOUND, BASE)
    twice = type_text(FOUND, once)
    assert parse_team(twice).robots == parse_team(once).robots
    assert parse_team(twice).calibrated_on == ("log",)


def test_a_base_without_the_robots_is_refused() -> None:
    with pytest.raises(InputError, match="has none of the robots r1"):
        type_text(FOUND, 'name = "x"\n[robots.other]\nsource = "external"\n')
    with pytest.raises(TeamFileError):
        type_text(FOUND, "nonsense")


@pytest.mark.parametrize(
    ("standard_error", "places"), [(0.0108, 3), (0.0058, 3), (0.5, 1), (4.0, 0), (0.0, 4)]
)
def test_values_are_rounded_to_what_their_error_allows(standard_error: float, places: int) -> None:
    assert decimals(standard_error) == places


# Command line -----------------------------------------------------------------------------------


def test_calibrate_prints_json_and_says_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    write_log(tmp_path / "log", ("1",), seconds=30.0)
    type_text = tmp_path / "out.toml"
    ran = command_line("calibrate", tmp_path / "log", "--output", type_text, "--json")
    assert ran.returncode == 0, ran.stderr
    scale = json.loads(ran.stdout)["robots"]["1"]["odometry"]["turn_scale"]
    assert scale["value"] == pytest.approx(1.0, abs=0.02)
    assert load_team(type_text).robots["1"].source == "mrclam"
    for arguments, said in (
        ([tmp_path], "no MRCLAM log here"),
        ([tmp_path / "no.toml", tmp_path / "log"], "no.toml: no such file"),
        (["mrclam"], "calibrate mrclam: name logs after the team"),
    ):
        failed = command_line("calibrate", *arguments)
        assert failed.returncode == 2
        (line,) = failed.stderr.splitlines()
        assert said in line
