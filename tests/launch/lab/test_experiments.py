"""The experiments: same seed, same figures; what bumps or never ends is counted; the patterns."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from support.processes import command_line
from support.sweeps import sampled

from cpcbl_launch.commands.experimenting import conduct
from cpcbl_launch.lab.experiments import directions, figure7, runs, table1
from cpcbl_launch.lab.experiments.runs import (
    Case,
    Experiment,
    Outcome,
    accuracy,
    circuit_team,
    run_case,
    spread,
    with_settings,
)
from cpcbl_launch.lab.seeds import Workers
from cpcbl_launch.reporting.metrics import pose_errors
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError

DRAWN = (table1.EXPERIMENT, figure7.EXPERIMENT, figure7.OF_VARIANTS, directions.EXPERIMENT)
EVERY = {experiment.name: experiment for experiment in DRAWN}
KEYS = {"experiment", "version", "seeds", "loops", "teams", "figures", "paper", "pattern"}
PNG = b"\x89PNG\r\n\x1a\n"


def small(experiment: Experiment) -> Experiment:
    """The same experiment with one loop (or two seconds), one pair of weights, one team size."""

    def cases() -> Mapping[Any, Case]:
        every = experiment.cases()
        if experiment is table1.EXPERIMENT:
            every = {k: c for k, c in every.items() if k[0] in (*table1.PROBABILISTIC, PAIR)}
        if experiment is directions.EXPERIMENT:
            return {k: c._replace(limit_s=2.0) for k, c in every.items() if k[0] == 2}
        return {k: c._replace(loops=1) for k, c in every.items()}

    return experiment._replace(cases=cases)


PAIR = "weighted 0.05 0.5"


def one_loop(team: Team, **changes: Any) -> Case:
    return Case(team, ("runner",), loops=1)._replace(**changes)


@pytest.fixture
def runner() -> Team:
    return circuit_team(["runner"])


def without_noise(team: Team) -> Team:
    quiet = msgspec.structs.replace(team.simulation, noise=0.0)
    return msgspec.structs.replace(team, simulation=quiet)


@pytest.mark.parametrize("name", sampled(EVERY, ["figure7"]))
def test_an_experiment_writes_json_and_picture_and_shows_a_table(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new"
    conduct(small(EVERY[name]), seeds=1, where=Workers(1), output=folder, as_json=False)
    shown = capsys.readouterr().out
    assert "…" not in shown
    assert all(len(line) <= 80 for line in shown.splitlines() if not line.startswith("written"))
    written = json.loads((folder / f"{name}.json").read_text())
    assert written.keys() == KEYS
    assert (written["experiment"], written["seeds"]) == (name, 1)
    assert written["teams"]
    assert (folder / f"{name}.png").read_bytes().startswith(PNG)


@pytest.mark.thorough
def test_as_json_prints_what_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    conduct(
        small(EVERY["one-way-vs-both"]), seeds=1, where=Workers(1), output=tmp_path, as_json=True
    )
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "one-way-vs-both.json").read_text()


def test_with_one_landmark_a_circle_costs_certainty() -> None:
    """Across the line of sight the oval is long; the circle is as wide everywhere."""
    along_m = {}
    for variant in ("oval", "circular"):
        case = figure7.OF_VARIANTS.cases()[f"{variant} {figure7.ONE_LANDMARK}"]
        samples = run_case(case._replace(loops=1), 1).robots["navigator"]
        assert samples.covariance is not None
        matrices = samples.covariance[len(samples.covariance) // 2 :, [0, 1, 1, 2]].reshape(
            -1, 2, 2
        )
        along_m[variant] = float(np.sqrt(np.linalg.eigvalsh(matrices)[:, 0]).mean())
    assert along_m["circular"] > 2.0 * along_m["oval"]


@pytest.mark.long
def test_the_number_of_jobs_changes_no_figure() -> None:
    experiment = small(EVERY["figure7"])
    cases, done = experiment.cases(), []
    outcomes = [
        experiment.outcome(experiment.results(cases, 2, Workers(jobs), lambda: done.append(1)))
        for jobs in (1, 2)
    ]
    assert len(done) == 2 * len(cases) * 2
    assert msgspec.json.encode(outcomes[0]) == msgspec.json.encode(outcomes[1])


def test_seeds_differ(runner: Team) -> None:
    case = one_loop(runner)
    assert not np.array_equal(run_case(case, 1).at_waypoints, run_case(case, 2).at_waypoints)


def test_a_run_ends_when_every_waypoint_of_its_loops_was_reached(runner: Team) -> None:
    found = run_case(Case(runner, ("runner",), loops=2), 1)
    assert found.finished
    assert found.at_waypoints.shape == found.odometry_at_waypoints.shape == (2 * 4, 3)
    assert found.bumps == found.restarts == 0


def test_odometry_alone_is_right_without_noise_and_drifts_with_wheels_that_are_off(
    runner: Team,
) -> None:
    quiet = without_noise(runner)
    exact = run_case(one_loop(quiet), 1).odometry_at_waypoints
    assert np.abs(exact).max() < 1e-3  # the field turns within a piece of odometry
    crooked = with_settings(quiet, "runner", odometry={"turn_scale": 1.1})
    drift = run_case(one_loop(quiet, truth=crooked), 1).odometry_at_waypoints[-1, 2]
    turned = 1.5 * math.pi  # three corners lie behind when the fourth is reached
    assert drift == pytest.approx(turned / 1.1 - turned, abs=0.15)


def test_a_bump_restarts_the_run_until_it_has_failed(
    runner: Team, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "MOST_RESTARTS", 2)
    everywhere = msgspec.structs.replace(runner.simulation, bump_radius_m=9.0)
    found = run_case(one_loop(msgspec.structs.replace(runner, simulation=everywhere)), 1)
    assert (found.finished, found.bumps, found.restarts) == (False, 3, 2)


def test_a_run_that_does_not_end_is_counted_as_failed_and_has_no_part_in_the_means(
    runner: Team,
) -> None:
    through, stuck = run_case(one_loop(runner), 1), run_case(one_loop(runner, limit_s=2.0), 1)
    assert not stuck.finished
    assert stuck.bumps == 0
    both, alone = accuracy([through, stuck]), accuracy([through])
    assert (both.failed, both.runs) == (1, 2)
    assert both.position_mean_m == alone.position_mean_m
    assert accuracy([stuck]).position_mean_m is None


def test_spread_is_the_median_and_the_range_of_80_percent() -> None:
    found = spread([float(i) for i in range(11)])
    assert found is not None
    assert (found.median, found.low, found.high) == (5.0, 1.0, 9.0)
    assert spread([]) is None


def test_quantities_of_the_table_from_known_errors() -> None:
    errors = np.array([(0.3, 0.4, math.radians(-2.0)), (0.3, -0.4, math.radians(4.0))])
    found = table1.quantities(errors)
    assert found == pytest.approx((0.5, 0.0, 0.4, 0.5, 3.0, 4.0))


def test_observers_are_displaced_from_their_assumed_positions() -> None:
    team = directions.crowd_team(10)
    moved = directions.with_displaced_observers(team, 0.2)
    assert len(team.robots) == 10
    for name, robot in team.robots.items():
        believed, true = robot.start, moved.robots[name].start
        assert believed is not None
        assert true is not None
        off = math.hypot(true.x_m - believed.x_m, true.y_m - believed.y_m)
        assert off == pytest.approx(0.2 if name.startswith("observer") else 0.0)


@pytest.mark.long
def test_a_deaf_observer_stays_wrong_and_one_that_listens_does_not() -> None:
    cases = directions.cases([2])
    errors = {}
    for direction in ("deaf", "both-ways"):
        case = cases[2, direction, "split-ci", 0.2]._replace(scored=("navigator0", "observer0"))
        runs = [run_case(case, seed).robots["observer0"] for seed in range(1, 6)]
        last = [pose_errors(samples)[-1] for samples in runs]
        errors[direction] = np.median([np.hypot(*offset[:2]) for offset in last])
    assert errors["deaf"] == pytest.approx(0.2, abs=0.01)
    assert errors["both-ways"] < 0.1


@pytest.mark.parametrize("sizes", [[], [1], [21], [5, 0]])
def test_team_sizes_are_checked(sizes: list[int]) -> None:
    with pytest.raises(InputError, match="--team-sizes: sizes from 2 to 20"):
        directions.experiment_of_sizes(sizes)


def test_a_wrong_option_is_one_line(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("")
    failed = command_line("experiment", "figure7", "--output", taken)
    assert failed.returncode == 2
    (line,) = failed.stderr.splitlines()
    assert f"--output {taken}" in line
    assert "name a folder" in line
    assert command_line("experiment", "figure7", "--seeds", "0").returncode == 2
    assert "one-way-vs-both" in command_line("experiment", "--help").stdout


def outcome_of(
    experiment: Experiment, seeds: int, cases: Mapping[Any, Case], jobs: int = 1
) -> Outcome:
    found = experiment.outcome(experiment.results(cases, seeds, Workers(jobs), lambda: None))
    assert isinstance(found, Outcome)
    return found


@pytest.mark.long
@pytest.mark.timeout(600)
def test_table_1_is_reached_in_every_cell_by_the_probabilistic_variants() -> None:
    shown = (*table1.PROBABILISTIC, PAIR)
    cases = {key: case for key, case in table1.cases().items() if key[0] in shown}
    found = outcome_of(table1.EXPERIMENT, 5, cases)
    assert len(found.pattern) == 3
    assert all(found.pattern.values()), found.pattern
    assert not any(found.figures["failed"].values())


@pytest.mark.long
@pytest.mark.timeout(600)
def test_figure_7_has_the_pattern_of_the_paper() -> None:
    found = outcome_of(figure7.EXPERIMENT, 10, figure7.cases())
    assert len(found.pattern) == 5
    assert all(found.pattern.values()), found.pattern
    assert found.figures["C"].failed == 0


@pytest.mark.long
def test_a_sharper_camera_helps_a_cheap_one(tmp_path: Path) -> None:
    experiment = figure7.WITH_CAMERAS

    def cases() -> Mapping[Any, Case]:
        return {c: case._replace(loops=1) for c, case in experiment.cases().items()}

    conduct(
        experiment._replace(cases=cases), seeds=1, where=Workers(2), output=tmp_path, as_json=False
    )
    written = json.loads((tmp_path / "figure7-cameras.json").read_text())
    assert (tmp_path / "figure7-cameras.png").read_bytes().startswith(PNG)
    sensing = {name: r["sensing"] for name, r in written["teams"]["F"]["robots"].items()}
    assert sensing == {"navigator": "camera", "observer": "camera"}
    mean_m = {c: figures["position_mean_m"] for c, figures in written["figures"].items()}
    assert mean_m["E"] < 0.6 * mean_m["C"]
    assert mean_m["F"] < 0.6 * mean_m["C"]
    assert mean_m["C"] < 0.2


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_figure_7_with_cameras_has_the_pattern_of_the_paper() -> None:
    found = outcome_of(figure7.WITH_CAMERAS, 5, figure7.WITH_CAMERAS.cases(), jobs=2)
    assert len(found.pattern) == 5
    assert all(found.pattern.values()), found.pattern
    assert found.figures["C"].failed == 0
