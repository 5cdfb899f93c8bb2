"""Calibration finds what the simulated field was told, says what it cannot, and writes it down."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from support.logs import write_log
from support.processes import cpcbl_team

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.calibration.logs import read_log, read_logs
from cpcbl_launch.calibration.odometry import calibrate_odometry
from cpcbl_launch.calibration.robot_log import RobotLog
from cpcbl_launch.calibration.robots import Calibration, RobotCalibration, calibrated
from cpcbl_launch.calibration.sensor import calibrate_sensor
from cpcbl_launch.calibration.statistics import Estimate, decimals, robust_fit, told, variance_parts
from cpcbl_launch.calibration.team_text import INTERVAL_S, changed_keys, team_text
from cpcbl_launch.overrides import Overrides, with_overrides
from cpcbl_launch.reporting.recording import read_recording
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team_file import TeamFileError, load_team, parse_team
from cpcbl_team.config import (
    Field,
    Landmark,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)
from cpcbl_team.errors import InputError

SECONDS = 90.0
PLACES = [(0.0, 0.0), (9.0, 0.0), (9.0, 5.0), (0.0, 5.0), (4.5, -1.0), (4.5, 6.0)]
MAP = Field(landmarks={f"m{i}": Landmark(x_m=x, y_m=y) for i, (x, y) in enumerate(PLACES)})
WORSE = RobotSettings(
    start=Start(x_m=1.5, y_m=1.0),
    waypoints_m=((7.5, 1.0), (7.5, 4.0), (1.5, 4.0), (1.5, 1.0)),
    odometry=OdometrySettings(
        distance_scale=0.93,
        distance_loss_m_per_rad=0.06,
        turn_scale=0.95,
        turn_bias_rad_per_m=-0.04,
        delay_s=0.21,
        distance_sigma_m_per_sqrt_m=0.05,
        turn_sigma_rad_per_sqrt_rad=0.1,
        turn_sigma_rad_per_sqrt_m=0.03,
        distance_sigma_m_per_sqrt_rad=0.03,
    ),
    sensor=SensorSettings(
        field_of_view_deg=100.0,
        max_range_m=12.0,
        range_share=0.04,
        range_floor_m=0.03,
        bearing_sigma_deg=1.0,
        delay_s=0.04,
        range_scale=1.03,
        range_bias_m=0.05,
        robot_range_bias_m=0.15,
        bearing_bias_deg=-0.7,
        bearing_scale=0.97,
        range_is_depth=True,
        optical_axis_deg=3.0,
        correlation_s=0.6,
    ),
)
BETTER = RobotSettings(
    start=Start(x_m=7.0, y_m=3.5),
    waypoints_m=((2.0, 3.5), (2.0, 1.5), (4.5, 2.5), (7.0, 1.5), (7.0, 3.5)),
    odometry=OdometrySettings(
        distance_scale=1.06,
        turn_scale=1.1,
        distance_sigma_m_per_sqrt_m=0.02,
        turn_sigma_rad_per_sqrt_rad=0.03,
        turn_sigma_rad_per_sqrt_m=0.06,
    ),
    sensor=SensorSettings(
        field_of_view_deg=180.0,
        max_range_m=12.0,
        range_share=0.01,
        range_floor_m=0.05,
        delay_s=-0.03,
        range_scale=0.97,
        range_bias_m=-0.1,
        robot_range_bias_m=0.0,
        bearing_bias_deg=1.5,
    ),
)
STANDING = RobotSettings(
    start=Start(x_m=4.5, y_m=5.0, heading_deg=-90.0),
    odometry=OdometrySettings(moves=False),
    sensor=SensorSettings(field_of_view_deg=180.0, max_range_m=12.0, bearing_bias_deg=0.5),
)
TEAM = with_overrides(  # without help: where they drive does not depend on how help is routed
    Team(name="trio", robots={"a": WORSE, "b": BETTER, "c": STANDING}, map=MAP),
    Overrides(collaboration="none"),
)
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
    simulate(TEAM, 1, SECONDS, record=path)
    return path


@pytest.fixture(scope="module")
def found(recorded: Path) -> Calibration:
    return calibrated(read_logs([recorded]), ["trio.mcap"])


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


def test_depths_are_told_from_ranges_and_along_which_axis(found: Calibration) -> None:
    assert found.robots["a"].range_is_depth
    axis = found.robots["a"].sensor["optical_axis_deg"]
    assert axis.value == pytest.approx(3.0, abs=min(1.0, SIGMAS * axis.standard_error))
    assert axis.standard_error < 1.0
    assert not found.robots["b"].range_is_depth
    assert "optical_axis_deg" not in found.robots["b"].sensor


def test_a_robot_that_stands_keeps_its_odometry_and_says_so(found: Calibration) -> None:
    robot = found.robots["c"]
    assert robot.odometry == {}
    assert "odometry stays" in robot.notes[0]
    bias = robot.sensor["bearing_bias_deg"]
    assert bias.value == pytest.approx(0.5, abs=4.0 * bias.standard_error)
    assert bias.standard_error < 0.2


def test_several_logs_are_pooled(recorded: Path) -> None:
    log = read_log(recorded)["a"]
    early = log.truth[:, 0] < 0.5 * SECONDS
    halves = [log._replace(truth=log.truth[half]) for half in (early, ~early)]
    one, both = (calibrate_odometry(logs)["distance_scale"] for logs in (halves[:1], halves))
    assert both.standard_error < 0.95 * one.standard_error
    assert both.value == pytest.approx(0.93, abs=SIGMAS * both.standard_error)


# What logs do not tell --------------------------------------------------------------------------


def circling(turn_rate: float = 0.3, speed: float = 0.3, seconds: float = 100.0) -> RobotLog:
    """An exact drive, one landmark in its midst, sightings at 5 Hz."""
    times = np.arange(0.0, seconds, 0.02)
    heading = turn_rate * times
    radius = speed / turn_rate if turn_rate else 0.0
    x, y = radius * np.sin(heading), radius * (1.0 - np.cos(heading))
    truth = np.stack([times, x, y, (heading + math.pi) % math.tau - math.pi], axis=1)
    from_s = times[:-1:5]
    step = np.full_like(from_s, 0.1)
    odometry = np.stack([from_s, from_s + 0.1, speed * step, turn_rate * step], axis=1)
    rows = slice(0, None, 10)
    dx, dy = 3.0 - x[rows], 1.0 - y[rows]
    bearing = np.arctan2(dy, dx) - heading[rows]
    bearing = (bearing + math.pi) % math.tau - math.pi
    seen = np.stack([times[rows], np.zeros_like(dx), np.hypot(dx, dy), bearing], axis=1)
    return RobotLog(truth, odometry, seen, (np.array([[0.0, 3.0, 1.0]]),))


def test_an_exact_log_is_found_to_be_exact() -> None:
    log = circling()
    odometry, sensor = calibrate_odometry([log]), calibrate_sensor([log])[0]
    assert odometry["distance_scale"].value == pytest.approx(1.0, abs=1e-3)
    assert odometry["turn_scale"].value == pytest.approx(1.0, abs=1e-3)
    assert sensor["range_scale"].value == pytest.approx(1.0, abs=1e-3)
    assert sensor["bearing_bias_deg"].value == pytest.approx(0.0, abs=0.02)
    assert sensor["range_share"].value < 1e-3
    assert "robot_range_bias_m" not in sensor


def test_gross_outliers_do_not_matter() -> None:
    log = circling()
    random = np.random.default_rng(1)
    seen = log.sightings.copy()
    seen[:, 2] += random.normal(0.0, 0.05, len(seen))
    seen[:, 3] += random.normal(0.0, 0.02, len(seen))
    clean = calibrate_sensor([log._replace(sightings=seen)])[0]
    seen[::150, 2] += 3.0
    seen[::150, 3] += 0.5
    dirty = calibrate_sensor([log._replace(sightings=seen)])[0]
    for name, estimate in clean.items():
        if name != "correlation_s":
            slack = estimate.standard_error + 1e-3
            assert dirty[name].value == pytest.approx(estimate.value, abs=slack), name


def crawling(least_speed: float, slow: float = 0.008, sigma: float = 0.0) -> RobotLog:
    """Straight on, by turns at 0.3 m/s and slowly; the truth is known to 0.5 mm. `sigma`: of the
    way while it is slow, in m per root of a second."""
    random = np.random.default_rng(3)
    times = np.arange(0.0, 120.0, 0.02)
    commanded = np.where(times % 10.0 < 5.0, 0.3, slow)
    each = np.maximum(commanded, least_speed) * 0.02
    each += random.normal(0.0, sigma * math.sqrt(0.02), len(each)) * (commanded == slow)
    way = np.concatenate([[0.0], np.cumsum(each)[:-1]])
    way += random.normal(0.0, 0.0005, len(way))
    nothing = np.zeros_like(way)
    from_s = times[:-1:5]
    step = np.full_like(from_s, 0.1)
    odometry = np.stack([from_s, from_s + 0.1, commanded[:-1:5] * step, 0.0 * step], axis=1)
    return RobotLog(
        np.stack([times, way, nothing, nothing], axis=1), odometry, np.empty((0, 4)), ()
    )


def test_motors_with_a_dead_zone_are_found_to_have_one() -> None:
    found = calibrate_odometry([crawling(least_speed=0.02)])
    assert found["least_speed_m_s"].value == pytest.approx(0.02, abs=0.001)
    assert found["distance_scale"].value == pytest.approx(1.0, abs=3e-3)
    without = calibrate_odometry([crawling(least_speed=0.0)])
    assert "least_speed_m_s" not in without
    assert "crawl_sigma_m_per_sqrt_s" not in without


def test_how_crawling_errs_is_found() -> None:
    found = calibrate_odometry([crawling(least_speed=0.02, sigma=0.006)])
    crawl = found["crawl_sigma_m_per_sqrt_s"]
    assert crawl.standard_error < 0.0015
    assert abs(crawl.value - 0.006) < 3.0 * crawl.standard_error


def test_a_robot_that_only_turns_tells_no_distance_scale() -> None:
    found = calibrate_odometry([circling(turn_rate=0.5, speed=0.0)])
    assert "distance_scale" not in found
    assert found["turn_scale"].value == pytest.approx(1.0, abs=1e-3)


def test_truth_with_gaps_is_used_only_where_it_is_known() -> None:
    log = circling()
    random = np.random.default_rng(2)
    seen = log.sightings.copy()
    seen[:, 2] += random.normal(0.0, 0.05, len(seen))
    gaps = (log.truth[:, 0] % 10.0) < 7.0  # three of ten seconds are missing
    whole = calibrate_sensor([log._replace(sightings=seen)])[0]
    holed = calibrate_sensor([log._replace(sightings=seen, truth=log.truth[gaps])])[0]
    assert holed["range_floor_m"].value == pytest.approx(whole["range_floor_m"].value, rel=0.1)
    odometry = calibrate_odometry([log._replace(truth=log.truth[gaps])])
    assert odometry["turn_scale"].value == pytest.approx(1.0, abs=2e-3)


def test_a_range_at_one_distance_tells_the_bias_and_not_the_scale() -> None:
    random = np.random.default_rng(3)
    columns = np.stack([np.full(400, 3.0), np.ones(400)], axis=1) / 0.05
    assert told(columns, (0.2, 0.3)).sum() == 1
    varied = np.stack([random.uniform(1.0, 6.0, 400), np.ones(400)], axis=1) / 0.05
    assert told(varied, (0.2, 0.3)).all()


def test_statistics_find_what_was_drawn() -> None:
    random = np.random.default_rng(4)
    x = random.uniform(0.5, 5.0, 4000)
    errors = random.normal(0.0, np.hypot(0.05 * x, 0.1))
    parts = variance_parts(errors, np.stack([x * x, np.ones_like(x)], axis=1))[0]
    assert np.sqrt(parts) == pytest.approx([0.05, 0.1], rel=0.1)
    values = 2.0 * x - 1.0 + errors
    values[::100] += 50.0
    fitted = robust_fit(np.stack([x, np.ones_like(x)], axis=1), values)
    assert fitted == pytest.approx([2.0, -1.0], abs=0.03)


# Logs -------------------------------------------------------------------------------------------


def test_mrclam_logs_are_read_with_all_their_faults(tmp_path: Path) -> None:
    write_log(tmp_path, ("1", "2"), seconds=40.0, backwards=True, unknown_barcode=True)
    logs = read_logs([tmp_path])
    found = calibrated(logs, ["MRCLAM"])
    assert found.robots.keys() == {"1", "2"}
    for robot in found.robots.values():
        assert robot.odometry["distance_scale"].value == pytest.approx(1.0, abs=0.01)
        assert robot.odometry["turn_scale"].value == pytest.approx(1.0, abs=0.01)
        assert robot.sensor["bearing_bias_deg"].value == pytest.approx(0.0, abs=0.1)
        assert robot.sensor["range_scale"].value == pytest.approx(1.0, abs=0.01)


def without_truth(path: Path) -> None:
    robots = {"r1": msgspec.structs.replace(WORSE, source="external")}
    simulate(msgspec.structs.replace(TEAM, robots=robots), 1, 1.0, record=path)


def no_recording(path: Path) -> None:
    path.write_bytes(b"something else")


def cut_short(path: Path) -> None:
    simulate(TEAM, 1, 2.0, record=path)
    path.write_bytes(path.read_bytes()[:-300])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (without_truth, "holds no truth"),
        (no_recording, "not a whole recording"),
        (cut_short, "not a whole recording"),
        (lambda path: None, "cannot be read"),
    ],
    ids=["no truth", "no recording", "cut short", "not there"],
)
def test_a_log_that_cannot_be_used_is_one_line(
    make: Callable[[Path], Any], said: str, tmp_path: Path
) -> None:
    path = tmp_path / "log.mcap"
    make(path)
    with pytest.raises(LogError, match=said) as raised:
        read_log(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_team_that_sees_and_does_nothing_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "blind.mcap"
    blind = Team(name="blind", robots={"c": STANDING})
    simulate(blind, 1, 20.0, record=path)
    with pytest.raises(InputError, match="nothing to calibrate") as raised:
        calibrated(read_logs([path]), ["blind.mcap"])
    assert "\n" not in str(raised.value)


# Team file --------------------------------------------------------------------------------------

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


def written(
    found: Calibration, base: str, margin: float = 0.0, correction_margin: float = 0.0
) -> str:
    return team_text(found, base, margin=margin, correction_margin=correction_margin)


def test_types_are_added_to_the_base_team_file() -> None:
    text = written(FOUND, BASE)
    team, before = parse_team(text), parse_team(BASE)
    assert text.startswith("# Calibrated by `cpcbl-team calibrate` from log.")
    assert "# kept" in text
    assert "distance_scale = 0.935 # ± 0.011" in text
    r1 = team.robots["r1"]
    assert r1.odometry == OdometrySettings(distance_scale=0.935, delay_s=0.0, rate_hz=5.0)
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
    r1 = parse_team(written(FOUND, own)).robots["r1"]
    assert not r1.sensor.range_is_depth
    assert not r1.localizer.self_calibration
    assert r1.localizer.object_interval_s == INTERVAL_S
    assert (r1.sensor.max_range_m, r1.localizer.variant) == (4.0, "oval")


def test_a_type_that_others_have_is_not_overwritten() -> None:
    named = BASE.replace("old", "robot-r1")
    with pytest.raises(InputError, match=r"robots\.r2\.type: robot-r1: robot r1 gets a type"):
        written(FOUND, named)
    alone = named.split("[robots.r2]")[0]
    assert parse_team(written(FOUND, alone)).robots["r1"].speed_m_s == 0.3


def test_noise_is_written_as_of_another_day() -> None:
    sensor = {
        "range_scale": Estimate(0.9, 0.001),
        "range_share": Estimate(0.02, 0.001),
        "range_bias_m": Estimate(0.04, 0.001),
        "range_floor_m": Estimate(0.0, 0.001),
        "bearing_sigma_deg": Estimate(1.0, 0.1),
    }
    found = Calibration(("log",), {"r1": RobotCalibration({}, sensor, range_is_depth=True)})
    r1 = parse_team(written(found, BASE, margin=0.5, correction_margin=0.4)).robots["r1"].sensor
    assert r1.range_is_depth
    assert r1.range_share == pytest.approx(math.hypot(0.03, 0.04), abs=5e-4)
    assert r1.range_floor_m == pytest.approx(0.016, abs=5e-4)
    assert r1.bearing_sigma_deg == pytest.approx(1.5, abs=0.05)


def test_a_dead_zone_of_another_day_is_in_the_noise_of_crawling() -> None:
    odometry = {
        "least_speed_m_s": Estimate(0.02, 0.001),
        "distance_sigma_m_per_sqrt_m": Estimate(0.03, 0.001),
        "crawl_sigma_m_per_sqrt_s": Estimate(0.006, 0.0003),
    }
    found = Calibration(("log",), {"r1": RobotCalibration(odometry, {})})
    r1 = parse_team(written(found, BASE, margin=0.5, correction_margin=0.4)).robots["r1"].odometry
    for_two_s = 0.4 * 0.02 * math.sqrt(2.0)
    assert r1.crawl_sigma_m_per_sqrt_s == pytest.approx(math.hypot(0.009, for_two_s), abs=1e-4)
    assert r1.distance_sigma_m_per_sqrt_m == pytest.approx(0.045, abs=5e-4)


def test_a_calibrated_team_file_can_be_calibrated_again() -> None:
    once = written(FOUND, BASE)
    twice = written(FOUND, once)
    assert parse_team(twice).robots == parse_team(once).robots
    assert parse_team(twice).calibrated_on == ("log",)


def test_a_base_without_the_robots_is_refused() -> None:
    with pytest.raises(InputError, match="has none of the robots r1"):
        written(FOUND, 'name = "x"\n[robots.other]\nsource = "external"\n')
    with pytest.raises(TeamFileError):
        written(FOUND, "nonsense")


def test_a_recorded_team_is_written_as_it_was(recorded: Path) -> None:
    team = read_recording(recorded).team
    assert team == TEAM
    assert msgspec.convert(changed_keys(team), Team) == TEAM


@pytest.mark.parametrize(
    ("standard_error", "places"), [(0.0108, 3), (0.0058, 3), (0.5, 1), (4.0, 0), (0.0, 4)]
)
def test_values_are_rounded_to_what_their_error_allows(standard_error: float, places: int) -> None:
    assert decimals(standard_error) == places


# Command line -----------------------------------------------------------------------------------


def test_calibrate_prints_writes_and_draws(recorded: Path, tmp_path: Path) -> None:
    written, picture = tmp_path / "calibrated.toml", tmp_path / "residuals.png"
    ran = cpcbl_team("calibrate", recorded, "--output", written, "--picture", picture)
    assert ran.returncode == 0, ran.stderr
    assert max(len(line) for line in ran.stdout.splitlines()[:-1]) <= 80  # last: a path
    for word in ("loss m/rad", "bias deg", "±", "does not drive", str(written.name)):
        assert word in ran.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    team = load_team(written)
    assert team.robots["a"].odometry.distance_scale == pytest.approx(0.93, abs=0.03)
    assert team.robots["c"].odometry == STANDING.odometry
    assert team.map == MAP
    checked = cpcbl_team("check", written)
    assert checked.returncode == 0, checked.stderr
    simulate(team, 1, 1.0)


def test_calibrate_prints_json_and_says_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    write_log(tmp_path / "log", ("1",), seconds=30.0)
    written = tmp_path / "out.toml"
    ran = cpcbl_team("calibrate", tmp_path / "log", "--output", written, "--json")
    assert ran.returncode == 0, ran.stderr
    scale = json.loads(ran.stdout)["robots"]["1"]["odometry"]["turn_scale"]
    assert scale["value"] == pytest.approx(1.0, abs=0.02)
    assert load_team(written).robots["1"].source == "mrclam"
    for arguments, said in (
        ([tmp_path], "no MRCLAM log here"),
        ([tmp_path / "log", "--team", tmp_path / "no.toml"], "no.toml: cannot be read"),
    ):
        failed = cpcbl_team("calibrate", *arguments)
        assert failed.returncode == 2
        (line,) = failed.stderr.splitlines()
        assert said in line
