"""Calibration finds the errors that the simulated field was given."""

import math
from pathlib import Path

import msgspec
import pytest
from support.calibration_team import MAP, SECONDS, STANDING, TEAM
from support.processes import command_line
from support.simulated import simulate_recorded

from cpcbl_launch.calibration.logs import read_log, read_logs
from cpcbl_launch.calibration.odometry import calibrate_odometry
from cpcbl_launch.calibration.team_types import Calibration, calibrate_robots, non_default_settings
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import load_team
from cpcbl_team.config import Team

BOUNDS = {  # of robots a and b: the largest error that is allowed, whatever the standard error
    "distance_scale": (0.03, 0.025),
    "turn_scale": (0.08, 0.045),
    "odometry.delay_s": (0.05, 0.05),
    "distance_loss_m_per_rad": (0.028, 0.04),
    "turn_bias_rad_per_m": (0.018, 0.04),
    "distance_sigma_m_per_sqrt_rad": (0.1, 0.1),
    "distance_sigma_m_per_sqrt_m": (0.022, 0.009),
    "turn_sigma_rad_per_sqrt_rad": (0.049, 0.05),
    "turn_sigma_rad_per_sqrt_m": (0.08, 0.08),
    "range_scale": (0.0145, 0.01),
    "range_bias_m": (0.1, 0.04),
    "robot_range_bias_m": (0.06, 0.15),
    "bearing_bias_deg": (0.3, 0.3),
    "bearing_scale": (0.01, 0.02),
    "sensor.delay_s": (0.008, 0.008),
    "range_share": (0.01, 0.003),
    "range_floor_m": (0.06, 0.02),
    "bearing_sigma_deg": (0.2, 0.2),
    "correlation_s": (0.25, 0.25),
}
NOT_TOLD = {  # in 90 s to half of what there is to find: the bound only says how far off it may be
    *(("a", "turn_scale"), ("a", "distance_sigma_m_per_sqrt_rad")),
    *(("a", "range_bias_m"), ("a", "range_floor_m")),  # the scale and the share hide them
    *(("a", "turn_sigma_rad_per_sqrt_m"), ("b", "turn_sigma_rad_per_sqrt_m")),
    ("b", "turn_sigma_rad_per_sqrt_rad"),  # who turns on the way tells the sum, not its parts
}
SIGMAS = 5.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "trio.mcap"
    simulate_recorded(TEAM, 1, SECONDS, path)
    return path


@pytest.fixture(scope="module")
def found(recorded: Path) -> Calibration:
    return calibrate_robots(read_logs([recorded]), ["trio.mcap"])


@pytest.mark.thorough
@pytest.mark.parametrize("key", BOUNDS)
@pytest.mark.parametrize("robot", ["a", "b"])
def test_what_the_field_was_told_is_found(robot: str, key: str, found: Calibration) -> None:
    parts = found.robots[robot]
    name = key.rsplit(".")[-1]
    part = "sensor" if key.startswith("sensor.") or name not in parts.odometry else "odometry"
    estimate = getattr(parts, part)[name]
    true, bound = getattr(getattr(TEAM.robots[robot], part), name), BOUNDS[key]["ab".index(robot)]
    off = abs(true - (1.0 if name.endswith("scale") else 0.0))
    assert not off or bound < 0.5 * off or (robot, key) in NOT_TOLD
    error = abs(estimate.value - true)
    assert error <= bound
    assert error <= SIGMAS * estimate.standard_error + 1e-9
    assert estimate.standard_error <= bound


@pytest.mark.thorough
def test_depths_are_told_from_ranges_and_along_which_axis(found: Calibration) -> None:
    assert found.robots["a"].range_is_depth
    axis = found.robots["a"].sensor["optical_axis_deg"]
    assert axis.value == pytest.approx(3.0, abs=min(1.0, SIGMAS * axis.standard_error))
    assert axis.standard_error < 1.0
    assert not found.robots["b"].range_is_depth
    assert "optical_axis_deg" not in found.robots["b"].sensor


@pytest.mark.thorough
def test_a_robot_that_stands_keeps_its_odometry_and_says_so(found: Calibration) -> None:
    robot = found.robots["c"]
    assert robot.odometry == {}
    assert "odometry stays" in robot.notes[0]
    bias = robot.sensor["bearing_bias_deg"]
    assert bias.value == pytest.approx(0.5, abs=4.0 * bias.standard_error)
    assert bias.standard_error < 0.2


@pytest.mark.thorough
def test_several_logs_are_pooled(recorded: Path) -> None:
    log = read_log(recorded)["a"]
    early = log.truth[:, 0] < 0.5 * SECONDS
    halves = [log._replace(truth=log.truth[half]) for half in (early, ~early)]
    one, both = (calibrate_odometry(logs)[0]["distance_scale"] for logs in (halves[:1], halves))
    assert both.standard_error < 0.95 * one.standard_error
    assert both.value == pytest.approx(0.93, abs=SIGMAS * both.standard_error)


@pytest.mark.thorough
def test_a_recorded_team_is_written_as_it_was(recorded: Path) -> None:
    team = read_recording(recorded).team
    assert team == TEAM
    assert msgspec.convert(non_default_settings(team), Team) == TEAM


def test_calibrate_prints_writes_and_draws(tmp_path: Path) -> None:
    type_text, picture = tmp_path / "calibrated.toml", tmp_path / "residuals.png"
    path = tmp_path / "trio.mcap"
    simulate_recorded(TEAM, 1, 20.0, path)
    ran = command_line("calibrate", path, "--output", type_text, "--picture", picture)
    assert ran.returncode == 0, ran.stderr
    assert max(len(line) for line in ran.stdout.splitlines()[:-1]) <= 80  # last: a path
    for word in ("loss m/rad", "bias deg", "±", "does not drive", str(type_text.name)):
        assert word in ran.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    team = load_team(type_text)
    assert team.robots["a"].odometry.distance_scale == pytest.approx(0.93, abs=0.03)
    assert team.robots["c"].odometry == STANDING.odometry
    assert team.map == MAP
    checked = command_line("check", type_text)
    assert checked.returncode == 0, checked.stderr
    simulate(team, 1, 1.0)


def test_what_a_short_recording_does_not_tell_is_not_written(tmp_path: Path) -> None:
    path, output = tmp_path / "short.mcap", tmp_path / "calibrated.toml"
    simulate_recorded(TEAM, 1, 1.0, path)
    found = calibrate_robots(read_logs([path]), ["short.mcap"])
    estimates = [
        e for r in found.robots.values() for e in (*r.odometry.values(), *r.sensor.values())
    ]
    assert all(math.isfinite(e.value) and math.isfinite(e.standard_error) for e in estimates)
    assert any("not determined by the logs: " in note for note in found.robots["a"].notes)
    ran = command_line("calibrate", path, "--output", output)
    assert ran.returncode == 0, ran.stderr
    assert "nan" not in output.read_text()
    assert "nan" not in ran.stdout


def test_a_time_in_which_errors_fade_is_not_known_of_a_recording_too_short_to_show_it(
    tmp_path: Path,
) -> None:
    path, output = tmp_path / "short.mcap", tmp_path / "calibrated.toml"
    simulate_recorded(TEAM, 1, 3.0, path)
    ran = command_line("calibrate", path, "--output", output)
    assert ran.returncode == 0, ran.stderr
    assert "0.0000 ± 0.0000" not in ran.stdout
    assert "correlation_s" in ran.stdout
    assert "correlation_s = 0.0 #" not in output.read_text()
