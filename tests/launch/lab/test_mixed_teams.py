"""Simulated teams of mixed quality, with which budgets are measured."""

import math
from random import Random

import pytest

from cpcbl_launch.lab.experiments import budget
from cpcbl_launch.lab.experiments.budget import (
    RunFigures,
    interval_rmse_m,
    share_of_interval,
    standard_error,
)
from cpcbl_launch.lab.experiments.mixed_teams import WORLDS, known_world, mixed_team
from cpcbl_team.errors import InputError


@pytest.mark.parametrize("size", [2, 5, 12])
def test_one_robot_in_five_sees_landmarks(size: int) -> None:
    team = mixed_team(size, seed=3)
    guides = [name for name, robot in team.robots.items() if robot.sensor.sees_landmarks]
    assert len(team.robots) == size
    assert len(guides) == (size + 4) // 5
    assert mixed_team(size, seed=3) == team
    assert mixed_team(size, seed=4) != team


@pytest.mark.thorough
def test_a_curve_of_simulated_teams_has_the_means_of_its_seeds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(budget, "SIMULATED_S", 15.0)
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


@pytest.mark.parametrize("world", WORLDS)
def test_in_each_world_somebody_knows_where_it_is_and_most_see_no_landmark(world: str) -> None:
    team = mixed_team(10, 3, world)
    guides = [name for name, robot in team.robots.items() if robot.sensor.sees_landmarks]
    assert len(guides) == (2 if world in ("mixed", "few-landmarks") else 1)
    assert known_world(world) == world
    assert mixed_team(10, 3, world) == team


def test_an_unknown_world_is_named_with_those_that_there_are() -> None:
    with pytest.raises(InputError, match="--world moon: unknown; write one of mixed, few"):
        known_world("moon")


def test_a_budget_is_compared_with_an_interval_of_the_same_bytes() -> None:
    """Halfway in logarithms; an interval that is worse at more bytes does not count."""
    intervals = [RunFigures(1.0, 0.8), RunFigures(4.0, 0.2), RunFigures(8.0, 0.3)]
    assert interval_rmse_m(intervals, 2.0) == pytest.approx(0.4)
    assert interval_rmse_m(intervals, 6.0) == pytest.approx(0.2)
    assert interval_rmse_m(intervals, 20.0) == pytest.approx(0.2)
    assert interval_rmse_m(intervals, 0.5) is None


def test_a_share_is_one_of_means_and_its_error_that_of_independent_runs() -> None:
    """A budget that sends and errs as an interval does, but in other runs, is as good as that."""
    random = Random(1)
    errors_m = [(random.uniform(0.9, 1.1), random.uniform(0.9, 1.1)) for _ in range(400)]
    by_run = [(RunFigures(1.0, a), RunFigures(1.0, b)) for a, b in errors_m]
    share, error = share_of_interval(by_run), standard_error(by_run)
    assert share is not None
    assert error is not None
    assert error == pytest.approx(0.1 / math.sqrt(3.0 * 400.0) * math.sqrt(2.0), rel=0.1)
    assert abs(share - 1.0) < 3.0 * error
    assert standard_error(by_run[:2]) is None


def test_the_luck_of_single_runs_does_not_count_for_intervals() -> None:
    by_run = [
        (RunFigures(2.0, 0.5), RunFigures(1.0, low), RunFigures(2.0, 1.0 - low))
        for low in (0.2, 0.8, 0.2, 0.8)
    ]
    assert share_of_interval(by_run) == pytest.approx(1.0)


@pytest.mark.long
def test_help_by_value_is_better_than_a_fixed_interval_of_the_same_bytes() -> None:
    """Clearly at 4 B/s; at 20 B/s an interval too sends nearly all that is worth sending."""
    chosen = {"4 B/s", "20 B/s", "120 s", "60 s", "30 s", "15 s", "8 s", "4 s"}
    of_both = [case for case in budget.cases() if case.setting in chosen]
    runs = budget.simulated_runs(5, 8)
    points = [budget.measure_point(runs, case) for case in of_both]
    assert all(p.within_budget for p in points)
    tight, generous = budget.comparisons(points)
    assert tight.share < 0.95
    assert generous.share < 1.02
