"""Simulated teams of mixed quality, with which budgets are measured."""

import pytest

from cpcbl_launch.lab.experiments import budget
from cpcbl_launch.lab.experiments.budget import mixed_team


@pytest.mark.parametrize("size", [2, 5, 12])
def test_one_robot_in_five_sees_landmarks(size: int) -> None:
    team = mixed_team(size, seed=3)
    guides = [name for name, robot in team.robots.items() if robot.sensor.sees_landmarks]
    assert len(team.robots) == size
    assert len(guides) == (size + 4) // 5
    assert mixed_team(size, seed=3) == team
    assert mixed_team(size, seed=4) != team


def test_a_curve_of_simulated_teams_has_the_means_of_its_seeds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(budget, "SIMULATED_S", 30.0)
    by_setting = {(case.series, case.setting): case for case in budget.cases()}
    runs = budget.simulated_runs(5, 2)
    tight, generous = (
        budget.measure_point(runs, by_setting["bytes limited", f"{limit} B/s"]) for limit in (4, 50)
    )
    assert tight == budget.measure_point(runs, by_setting["bytes limited", "4 B/s"])
    assert 0.0 < tight.bytes_per_s < generous.bytes_per_s
    assert tight.within_budget
    assert generous.within_budget
    assert tight.blind_rmse_m is not None
    assert tight.blind_rmse_m > tight.position_rmse_m
    first = budget.measure_point(budget.simulated_runs(5, 1), by_setting["nothing", "alone"])
    assert first.bytes_per_s == 0.0
