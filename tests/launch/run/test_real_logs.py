"""The five robots of real logs (UTIAS MRCLAM). `make test-long CPCBL_MRCLAM=FOLDER`."""

import json
import os
from functools import lru_cache
from pathlib import Path

import msgspec
import pytest
from support.processes import cpcbl_team

from cpcbl_launch.lab.evaluation import evaluate_log
from cpcbl_launch.lab.evaluation import evaluate_log as evaluated_log
from cpcbl_launch.reporting.recorder import Report
from cpcbl_launch.run.logged_team import builtin_for, load_logged_team, with_duration
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.team.overrides import Overrides, with_blind_robots, with_overrides
from cpcbl_team.config import Field

pytestmark = [pytest.mark.log, pytest.mark.timeout(900)]

BLIND = ("3", "4", "5")
SETS = ("MRCLAM2", "MRCLAM4", "MRCLAM6")


def log_folder(name: str) -> Path:
    """The folder of one data set; the marker `log` promises that it is there."""
    return Path(os.environ["CPCBL_MRCLAM"]) / name


@lru_cache
def evaluated(name: str, blind: bool, choice: Overrides, calibrated: bool = True) -> Report:
    """A built-in team on a data set; the same run is not done twice."""
    folder = log_folder(name)
    file = builtin_for(folder) if calibrated else builtin_path("mrclam-uncalibrated")
    logged = load_logged_team(with_overrides(load_team(file), choice), folder)
    team = with_blind_robots(logged.team, BLIND if blind else ())
    return evaluate_log(logged._replace(team=team)).report


def team_rmse_m(report: Report) -> float:
    assert report.team.position_rmse_m is not None
    return report.team.position_rmse_m


@pytest.mark.parametrize("kind", ["exchanged", "moved"])
def test_wrong_places_on_the_map_lead_nobody_astray(kind: str) -> None:
    """Robots look at one landmark for long: it was taken for being elsewhere (0.39 and 0.10 m)."""
    folder = log_folder("MRCLAM4")
    logged = load_logged_team(load_team(builtin_for(folder)), folder)
    marks = dict(logged.team.map.landmarks)
    if kind == "exchanged":
        marks["9"], marks["16"] = marks["16"], marks["9"]
    else:
        marks["10"] = msgspec.structs.replace(marks["10"], x_m=marks["10"].x_m + 0.6)
    team = msgspec.structs.replace(logged.team, map=Field(landmarks=marks))
    report = evaluate_log(with_duration(logged._replace(team=team), 600.0)).report
    assert team_rmse_m(report) <= 0.05
    assert report.team.nees is not None
    assert report.team.nees < 3.0


def test_blind_robots_are_carried_by_their_teammates() -> None:
    helped = evaluated("MRCLAM6", True, Overrides())
    alone = evaluated("MRCLAM6", True, Overrides(collaboration="none"))
    assert team_rmse_m(helped) <= 0.12
    assert team_rmse_m(alone) > 0.5
    for name, robot in helped.robots.items():
        assert robot.lost_at_end == "", name
        assert robot.lost_share < 0.02, name


@pytest.mark.parametrize(
    ("name", "blind", "rmse_m"),
    [
        ("MRCLAM6", False, 0.08),
        ("MRCLAM2", False, 0.05),
        ("MRCLAM4", False, 0.04),
        ("MRCLAM6", True, 0.12),
        ("MRCLAM2", True, 0.12),
        ("MRCLAM4", True, 0.12),
    ],
)
def test_robots_calibrated_on_other_logs_are_accurate_and_know_how_much(
    name: str, blind: bool, rmse_m: float
) -> None:
    """The bounds are what was measured, and a little; below a centralized EKF whose cameras' ranges
    are taken as ranges (0.101, 0.056, 0.047; blind 0.135, 0.107, 0.096)."""
    report = evaluated(name, blind, Overrides())
    assert name not in report.calibrated_on
    assert not report.seen_before
    assert team_rmse_m(report) <= rmse_m
    assert report.team.nees is not None
    assert 0.5 <= report.team.nees <= 4.0  # σ holds what differs between days
    for robot, r in report.robots.items():
        assert r.inside_3_sigma is not None
        assert r.inside_3_sigma >= 0.97, robot
        assert r.lost_at_end == "", robot


def test_self_calibration_is_better_than_none_where_nothing_was_calibrated() -> None:
    on = team_rmse_m(evaluated("MRCLAM4", False, Overrides(), calibrated=False))
    logged = load_logged_team(load_team(builtin_path("mrclam-uncalibrated")), log_folder("MRCLAM4"))
    replace = msgspec.structs.replace
    robots = {
        name: replace(robot, localizer=replace(robot.localizer, self_calibration=False))
        for name, robot in logged.team.robots.items()
    }
    off = evaluate_log(logged._replace(team=replace(logged.team, robots=robots))).report
    assert on < 0.97 * team_rmse_m(off)


def test_the_yardsticks_are_worth_the_name() -> None:
    """Start poses and settings are the team's; the centralized filter is the ceiling."""
    logged = load_logged_team(load_team(builtin_path("mrclam-uncalibrated")), log_folder("MRCLAM6"))
    report = evaluated_log(logged, with_baselines=True).report
    rmse = {kind: y.team.position_rmse_m or 0.0 for kind, y in report.yardsticks.items()}
    assert 0.0 < rmse["centralized_ekf"] < 0.15
    assert rmse["centralized_ekf"] < rmse["solo_ekf"] < 0.22
    assert 2.0 < rmse["dead_reckoning"] < 3.5
    assert team_rmse_m(report) < rmse["solo_ekf"]


def test_processes_over_zenoh_agree_with_one_process() -> None:
    arguments = ("--data", log_folder("MRCLAM6"), "--blind", ",".join(BLIND), "--speed", "10")
    ran = cpcbl_team("up", "mrclam", *arguments, "--json", timeout_s=300.0)
    assert ran.returncode == 0, ran.stderr
    report = json.loads(ran.stdout)
    assert report["robots"].keys() == {"1", "2", "3", "4", "5"}
    expected = team_rmse_m(evaluated("MRCLAM6", True, Overrides()))
    assert report["team"]["position_rmse_m"] == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("variant", ["joint", "oval", "circular", "weighted"])
@pytest.mark.parametrize("collaboration", ["none", "passive", "active", "both"])
@pytest.mark.parametrize("fusion", ["split-ci", "naive"])
def test_no_divergence_lasts(name: str, variant: str, collaboration: str, fusion: str) -> None:
    """A lost robot recovers: within 30 s where it sees landmarks, 2 min where it sees teammates now
    and then, 10 min where it is only told its position (nothing then tells its heading). Without
    a covariance, as `weighted` has none, that may take 25 min: what it is told is worth little."""
    if collaboration == "none" and fusion == "naive":
        fusion = "split-ci"  # nothing is merged: the same run
    choice = Overrides(variant=variant, collaboration=collaboration, fusion=fusion)
    report = evaluated(name, True, choice, calibrated=False)
    for robot, r in report.robots.items():
        assert r.position_rmse_m is not None
        if robot not in BLIND:
            assert r.longest_lost_s < 30.0, robot
            assert r.lost_at_end == "", robot
            assert r.position_rmse_m < 0.6, robot
        elif collaboration in ("passive", "both"):
            assert r.longest_lost_s < 120.0, robot
            assert r.position_rmse_m < 1.5, robot
        elif collaboration == "active":
            assert r.longest_lost_s < (1500.0 if variant == "weighted" else 600.0), robot
            assert r.position_rmse_m < 4.0, robot
