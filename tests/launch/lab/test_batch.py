"""Batch least squares on logs whose noise is known, and the command that shows it."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.logs import log_team, write_log
from support.noisy_logs import ROBOTS, figure, noisy_log, rewrite_table, with_start_poses
from support.processes import command_line
from support.sweeps import over_seeds

from cpcbl_launch.commands.old_forms import with_values
from cpcbl_launch.lab.baselines import baseline_inputs, run_ekf
from cpcbl_launch.lab.batch import smooth
from cpcbl_launch.lab.evaluation import baseline_report
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.recorder import BaselineReport
from cpcbl_launch.run.logged_team import LoggedTeam, load_logged_team
from cpcbl_launch.team.overrides import with_blind_robots


def stamps_of(logged: LoggedTeam) -> dict[str, range]:
    return dict.fromkeys(logged.team.robots, range(logged.start_ns, logged.end_ns, 100_000_000))


def batch_of(logged: LoggedTeam) -> BaselineReport:
    """The report of the batch, at the times of the filters."""
    paths = smooth(baseline_inputs(logged), logged.team.map, stamps_of(logged))
    return baseline_report(paths, logged.truth)


def test_the_batch_has_no_error_without_noise(tmp_path: Path) -> None:
    write_log(tmp_path, ROBOTS, 20.0)
    logged = load_logged_team(log_team(*ROBOTS), tmp_path)
    report = batch_of(logged._replace(team=with_blind_robots(logged.team, ["2"])))
    for robot in report.robots.values():
        assert robot.samples == 200
        assert robot.position_max_m == pytest.approx(0.0, abs=1e-6)


@over_seeds(2, 5)
def test_the_batch_is_the_ceiling_and_consistent(tmp_path: Path, seeds: range) -> None:
    """It knows the future: better than the centralized EKF in each run, with a NEES of 2."""
    batches = []
    for seed in seeds:
        (tmp_path / str(seed)).mkdir()
        logged = noisy_log(tmp_path / str(seed), seed, 20.0)
        batches.append(batch_of(logged))
        ekf = run_ekf(baseline_inputs(logged), logged.team.map, stamps_of(logged))
        assert figure(batches[-1]) < 0.9 * figure(baseline_report(ekf, logged.truth))
    assert np.mean([figure(batch, "nees") for batch in batches]) == pytest.approx(2.0, abs=0.4)


@pytest.mark.thorough
def test_the_batch_bears_wrong_sightings(tmp_path: Path) -> None:
    """Every twentieth range is 3 m too long: the error stays below that of the filter."""
    logged = noisy_log(tmp_path, 9, 20.0)

    def lengthened(rows: Floats) -> Floats:
        rows[::20, 2] += 3.0
        return rows

    for robot in ROBOTS:
        rewrite_table(tmp_path / f"Robot{robot}_Measurement.dat", lengthened, 4)
    wrong = with_start_poses(load_logged_team(logged.team, tmp_path))
    clean = figure(batch_of(logged))
    assert figure(batch_of(wrong)) < 1.5 * clean


def test_the_command_shows_the_batch_beside_the_filters(tmp_path: Path) -> None:
    write_log(tmp_path, ROBOTS, 3.0)
    evaluate = "evaluate", "--yardstick", "batch", "mrclam-uncalibrated", str(tmp_path)
    shown = command_line(*evaluate, "--blind", "3")
    assert shown.returncode == 0, shown.stderr
    for words in ("dead reckoning", "solo EKF", "centralized EKF", "batch least squares"):
        assert words in shown.stdout
    assert max(map(len, shown.stdout.splitlines())) <= 80
    written = json.loads(command_line(*evaluate, "--json").stdout)
    assert written["yardsticks"]["batch_least_squares"]["robots"].keys() == set(ROBOTS)


def test_a_yardstick_without_a_value_is_that_of_filters(tmp_path: Path) -> None:
    write_log(tmp_path, ROBOTS, 3.0)
    shown = command_line("evaluate", "--yardstick", "mrclam-uncalibrated", str(tmp_path))
    assert shown.returncode == 0, shown.stderr
    assert "centralized EKF" in shown.stdout
    assert "batch" not in shown.stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["evaluate", "a", "b", "--yardstick"], ["evaluate", "a", "b", "--yardstick=ekf"]),
        (["evaluate", "--yardstick", "a", "b"], ["evaluate", "--yardstick=ekf", "a", "b"]),
        (["evaluate", "--yardstick", "--json"], ["evaluate", "--yardstick=ekf", "--json"]),
        (["evaluate", "--yardstick", "batch", "b"], ["evaluate", "--yardstick", "batch", "b"]),
        (["evaluate", "--yardstick=batch"], ["evaluate", "--yardstick=batch"]),
        (["evaluate", "a", "--no-yardstick", "b"], ["evaluate", "a", "b"]),
        (["check", "--yardstick"], ["check", "--yardstick"]),
        ([], []),
    ],
)
def test_a_value_may_be_left_out(words: list[str], expected: list[str]) -> None:
    assert with_values(words) == expected


def test_the_former_option_is_one_line_that_names_the_present_one() -> None:
    ran = command_line("evaluate", "mrclam", "MRCLAM6", "--batch")
    assert ran.returncode == 2
    (line,) = ran.stderr.splitlines()
    assert "evaluate mrclam MRCLAM6 --yardstick=batch" in line
