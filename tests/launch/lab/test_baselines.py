"""Dead reckoning, solo and centralized EKF on logs whose noise is known; their TUM files."""

import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.logs import FRAME_MS, log_team, write_log
from support.noisy_logs import (
    KINDS,
    ROBOTS,
    SENSOR,
    add_noise,
    figure,
    noisy_log,
    rewrite_table,
    with_robot_settings,
    with_start_poses,
)
from support.processes import command_line
from support.sweeps import thorough

from cpcbl_launch.lab.baselines import baseline_inputs
from cpcbl_launch.lab.evaluation import (
    baseline_report,
    evaluate_log,
    run_baselines,
)
from cpcbl_launch.reporting.metrics import Floats, Trajectory, position_errors, samples_with_truth
from cpcbl_launch.reporting.recorder import BaselineReport
from cpcbl_launch.run.logged_team import LoggedTeam, load_logged_team
from cpcbl_launch.team.overrides import with_blind_robots
from cpcbl_team.config import (
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
)


def paths_of(logged: LoggedTeam) -> dict[str, dict[str, Trajectory]]:
    stamps = range(logged.start_ns, logged.end_ns, 100_000_000)
    return run_baselines(
        baseline_inputs(logged), logged.team.map, dict.fromkeys(logged.team.robots, stamps)
    )


def reports_of(logged: LoggedTeam) -> dict[str, BaselineReport]:
    return {kind: baseline_report(paths, logged.truth) for kind, paths in paths_of(logged).items()}


# Accuracy ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("blind", [[], ["2"]], ids=["full map", "blind"])
def test_without_noise_there_is_no_error(tmp_path: Path, blind: list[str]) -> None:
    write_log(tmp_path, ROBOTS, 20.0, unknown_barcode=True)
    logged = load_logged_team(log_team(*ROBOTS), tmp_path)
    reports = reports_of(logged._replace(team=with_blind_robots(logged.team, blind)))
    assert tuple(reports) == KINDS
    for report in reports.values():
        assert report.robots.keys() == set(ROBOTS)
        for robot in report.robots.values():
            assert robot.samples == 200
            assert robot.position_max_m == pytest.approx(0.0, abs=1e-6)
            assert robot.heading_rmse_deg == pytest.approx(0.0, abs=1e-4)
            assert robot.inside_3_sigma == 1.0


@pytest.fixture(scope="module", params=[2, thorough(5)])
def runs(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> list[dict[str, BaselineReport]]:
    """So many noisy logs."""
    seeds = range(request.param)
    return [reports_of(noisy_log(tmp_path_factory.mktemp("log"), seed, 25.0)) for seed in seeds]


def test_more_information_gives_a_smaller_error(runs: list[dict[str, BaselineReport]]) -> None:
    for run in runs:
        reckoning, solo, centralized = (figure(run[kind]) for kind in KINDS)
        assert 0.001 < centralized <= solo <= 0.7 * reckoning


@pytest.mark.parametrize("kind", KINDS[1:])
def test_filters_are_consistent_on_white_noise(
    runs: list[dict[str, BaselineReport]], kind: str
) -> None:
    """Over thirty other seeds NEES is 2.03 (solo) and 1.92, means of five scatter by 0.11."""
    assert np.mean([figure(run[kind], "nees") for run in runs]) == pytest.approx(2.0, abs=0.4)
    assert np.mean([figure(run[kind], "inside_3_sigma") for run in runs]) > 0.97


@pytest.mark.thorough
def test_a_blind_robot_has_only_the_centralized_filter(tmp_path: Path) -> None:
    logged = noisy_log(tmp_path, 4, 20.0)
    full = reports_of(logged)
    blind = reports_of(logged._replace(team=with_blind_robots(logged.team, ["2"])))
    assert blind["solo_ekf"].robots["2"] == blind["dead_reckoning"].robots["2"]
    assert blind["solo_ekf"].robots["1"] == full["solo_ekf"].robots["1"]
    alone, helped = (figure(blind[kind], robot="2") for kind in KINDS[1:])
    assert figure(full["centralized_ekf"], robot="2") < helped < 0.5 * alone


def test_without_sightings_of_robots_the_centralized_filter_is_many_solo_filters(
    tmp_path: Path,
) -> None:
    logged = noisy_log(tmp_path, 5, 10.0)
    sensor = msgspec.structs.replace(SENSOR, sees_robots=False)
    paths = paths_of(logged._replace(team=with_robot_settings(logged.team, sensor=sensor)))
    for name, alone in paths["solo_ekf"].items():
        together = paths["centralized_ekf"][name]
        np.testing.assert_allclose(together.estimate, alone.estimate, atol=1e-9)
        assert alone.covariance is not None
        assert together.covariance is not None
        np.testing.assert_allclose(together.covariance, alone.covariance, atol=1e-9)


# Settings ----------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_baselines_correct_inputs_as_the_team_does(tmp_path: Path) -> None:
    write_log(tmp_path, ROBOTS, 20.0)
    wheels, late = np.array([1.0, 1.25, 1.0 / 0.9]), np.array([0.1, 0.0, 0.0, 0.0])
    for robot in ROBOTS:
        rewrite_table(tmp_path / f"Robot{robot}_Odometry.dat", lambda rows: rows * wheels, 3)
        rewrite_table(tmp_path / f"Robot{robot}_Measurement.dat", lambda rows: rows + late, 4)
    odometry = OdometrySettings(distance_scale=0.8, turn_scale=0.9)
    plain, corrected = (
        reports_of(load_logged_team(team, tmp_path))
        for team in (
            log_team(*ROBOTS),
            with_robot_settings(
                log_team(*ROBOTS), odometry=odometry, sensor=SensorSettings(delay_s=0.1)
            ),
        )
    )
    for kind in KINDS:
        assert figure(plain[kind]) > 0.005
        assert figure(corrected[kind]) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.thorough
def test_a_repeated_sighting_is_ignored_or_weighted_less(tmp_path: Path) -> None:
    """Both leave a wider covariance; an interval of one frame uses every frame."""
    logged = noisy_log(tmp_path, 6, 10.0)

    def spread(interval_s: float = 0.0, correlation_s: float = 0.0) -> float:
        rules = LocalizerSettings(object_interval_s=interval_s)
        sensor = msgspec.structs.replace(SENSOR, correlation_s=correlation_s)
        team = with_robot_settings(logged.team, localizer=rules, sensor=sensor)
        covariance = paths_of(logged._replace(team=team))["solo_ekf"]["1"].covariance
        assert covariance is not None
        return float(covariance[:, 0].mean())

    assert spread(interval_s=FRAME_MS * 1e-3) == spread()
    assert spread(interval_s=1.0) > 1.5 * spread()
    assert spread(correlation_s=2.0) > 1.5 * spread()


def test_a_filter_that_rejects_everything_recovers(tmp_path: Path) -> None:
    """All robots start 1 m off and are sure of it: every gate stays shut until they doubt."""
    logged = with_start_poses(noisy_log(tmp_path, 7, 25.0), 1.0, -0.5)
    paths = paths_of(logged)
    for kind in KINDS[1:]:
        for name, path in paths[kind].items():
            errors = position_errors(samples_with_truth(path, logged.truth[name])[1])
            assert errors[0] > 1.0
            assert errors[200:].max() < 0.2, (kind, name)


# The command -------------------------------------------------------------------------------------


def rows_of(path: Path) -> Floats:
    rows = np.array([[float(v) for v in line.split(" ")] for line in path.read_text().splitlines()])
    assert rows.shape[1] == 8
    np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(rows[:, 3:6], 0.0)
    return rows


def rmse_of(folder: Path, name: str) -> tuple[float, float]:
    """(position m, heading deg) of an estimate, from the TUM files alone."""
    estimate, truth = rows_of(folder / f"{name}.tum"), rows_of(folder / f"{name[0]}_truth.tum")
    _, i, j = np.intersect1d(estimate[:, 0], truth[:, 0], return_indices=True)
    assert len(j) == len(truth)
    offset = estimate[i] - truth[j]
    heading = [2.0 * np.arctan2(rows[:, 6], rows[:, 7]) for rows in (estimate[i], truth[j])]
    turn = (heading[0] - heading[1] + math.pi) % math.tau - math.pi
    position = np.sqrt(np.mean(offset[:, 1] ** 2 + offset[:, 2] ** 2))
    return float(position), math.degrees(float(np.sqrt(np.mean(turn**2))))


def test_evaluate_compares_and_exports(tmp_path: Path) -> None:
    data, files = tmp_path / "log", tmp_path / "new" / "tum"
    write_log(data, ROBOTS, 10.0)
    add_noise(data, 8)
    options = ("--yardstick", "--export", files, "--blind", "3", "--json")
    ran = command_line("evaluate", "mrclam-uncalibrated", data, *options)
    assert ran.returncode == 0, ran.stderr
    report = json.loads(ran.stdout)
    assert tuple(report["yardsticks"]) == KINDS
    filters = {"estimate": report["robots"]}
    filters |= {kind: report["yardsticks"][kind]["robots"] for kind in KINDS}
    names = {f"{robot}_{kind}.tum" for robot in ROBOTS for kind in (*filters, "truth")}
    assert {path.name for path in files.iterdir()} == names
    for kind, robots in filters.items():
        for name, figures in robots.items():
            assert figures["samples"] == report["robots"][name]["samples"] > 90
            position, heading = rmse_of(files, f"{name}_{kind}")
            assert position == pytest.approx(figures["position_rmse_m"], abs=1e-6)
            assert heading == pytest.approx(figures["heading_rmse_deg"], abs=1e-4)
    for kind in KINDS:
        team = report["yardsticks"][kind]["team"]
        each = [robot["nees"] for robot in filters[kind].values()]
        assert team["nees"] == pytest.approx(np.mean(each))


def test_the_table_of_baselines_fits_and_is_shown_on_demand(tmp_path: Path) -> None:
    write_log(tmp_path, ROBOTS, 3.0)
    plain, compared_ = (
        command_line("evaluate", "mrclam-uncalibrated", tmp_path, *options)
        for options in ((), ("--yardstick",))
    )
    for words in ("dead reckoning", "solo EKF", "centralized EKF", "this team"):
        assert words in compared_.stdout
        assert words not in plain.stdout
    assert max(map(len, compared_.stdout.splitlines())) <= 80


def test_an_export_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    write_log(tmp_path / "log", ROBOTS, 2.0)
    taken = tmp_path / "file"
    taken.write_text("")
    ran = command_line("evaluate", "mrclam", tmp_path / "log", "--export", taken)
    assert ran.returncode == 2
    (line,) = ran.stderr.splitlines()
    assert f"--export {taken}" in line


def test_baselines_do_not_change_the_teams_figures(tmp_path: Path) -> None:
    write_log(tmp_path, ROBOTS, 5.0)
    logged = load_logged_team(log_team(*ROBOTS), tmp_path)
    plain = evaluate_log(logged)
    with_them = evaluate_log(logged, with_baselines=True)
    assert plain.report.yardsticks == {}
    assert msgspec.structs.replace(with_them.report, yardsticks={}) == plain.report
    assert tuple(with_them.paths) == ("estimate", *KINDS)


def test_progress_reaches_the_end_once(tmp_path: Path) -> None:
    write_log(tmp_path, ROBOTS, 2.0)
    shown: list[float] = []
    evaluate_log(load_logged_team(log_team(*ROBOTS), tmp_path), shown.append, with_baselines=True)
    assert shown == sorted(shown)
    assert shown[-1] == 1.0
