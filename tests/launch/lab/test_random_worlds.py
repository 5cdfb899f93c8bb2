"""Random worlds: what is drawn is a team without faults, and what robots say of it is false."""

import math
from collections import Counter

import numpy as np
import pytest
from support.processes import command_line
from support.sweeps import over_seeds

from cpcbl_launch.lab.experiments.random_teams import random_team, with_drawn_starts
from cpcbl_launch.lab.experiments.random_worlds import (
    RandomRun,
    alarm_kind,
    alarm_rows,
    row,
    rows,
    run_random_world,
    team_text,
    what_it_sees,
)
from cpcbl_launch.lab.experiments.rough_teams import odometry_lost, rough_team
from cpcbl_launch.lab.experiments.worlds import WorldRun
from cpcbl_launch.lab.seeds import Workers, run_seeds
from cpcbl_launch.team.checks import problems
from cpcbl_launch.team.file import parse_team

DRAWN = 300
GOOD = WorldRun(rmse_m=0.1, nees=2.0, heading_nees=1.0, inside_3_sigma=0.99, lost_share=0.0)
LOST = WorldRun(math.nan, math.nan, math.nan, math.nan, 1.0)
LEAST_INSIDE = 0.97
MOST_ALARMED = 0.03  # of the robots; none of a few
FIRST_SEED = 3000  # of the runs: of worlds that nothing was chosen by


def test_each_drawn_team_passes_the_checks_and_is_its_own_team_file() -> None:
    for seed in range(0, DRAWN, 6):
        team = random_team(seed)
        assert list(problems(team)) == []
        assert list(problems(with_drawn_starts(team, seed))) == []
        assert parse_team(team_text(team)) == team
    assert random_team(7) == random_team(7) != random_team(8)


def test_the_draw_reaches_every_kind_of_world() -> None:
    teams = [random_team(seed) for seed in range(DRAWN)]
    sights = Counter(what_it_sees(team, name) for team in teams for name in team.robots)
    assert len(sights) == 14
    assert min(sights.values()) >= 3
    robots = [robot for team in teams for robot in team.robots.values()]
    assert {robot.localizer.variant for robot in robots} == {"joint", "oval", "circular"}
    assert 0.1 < sum(robot.start is None for robot in robots) / len(robots) < 0.25
    assert 0.05 < sum(robot.position_sensor is not None for robot in robots) / len(robots) < 0.15
    assert 0.1 < sum(not robot.odometry.moves for robot in robots) / len(robots) < 0.2
    assert 0.1 < sum(bool(team.map.walls) for team in teams) / len(teams) < 0.3


def test_rough_teams_are_the_same_teams_known_less_well() -> None:
    """Each thing of which only a sigma is known, and each that is lost or late, is in some of
    them."""
    teams = [rough_team(seed) for seed in range(0, DRAWN, 6)]
    for seed, team in zip(range(0, DRAWN, 6), teams, strict=True):
        assert list(problems(team)) == []
        assert parse_team(team_text(team)) == team
        assert team.robots.keys() == random_team(seed).robots.keys()
        assert team.map.landmarks.keys() == random_team(seed).map.landmarks.keys()
    robots = [robot for team in teams for robot in team.robots.values()]
    shares = [
        np.mean([bool(robot.sensor.bearing_bias_sigma_deg) for robot in robots]),
        np.mean([bool(robot.sensor.correlation_s) for robot in robots]),
        np.mean([bool(robot.sensor.delay_s) for robot in robots]),
        np.mean([bool(robot.odometry.distance_scale_sigma) for robot in robots]),
        np.mean([bool(robot.collaboration.budget.bytes_per_s) for robot in robots]),
        np.mean([any(m.sigma_m for m in team.map.landmarks.values()) for team in teams]),
        np.mean([odometry_lost(seed) > 0.0 for seed in range(DRAWN)]),
    ]
    assert all(0.25 < share < 0.75 for share in shares), shares


def test_a_robot_whose_start_is_drawn_is_where_landmarks_are() -> None:
    for seed in range(DRAWN):
        team = random_team(seed)
        drawn = with_drawn_starts(team, seed)
        for name, settings in team.robots.items():
            start = drawn.robots[name].start
            assert start is not None
            if settings.start is not None:
                assert start == settings.start
            else:
                x_m = [mark.x_m for mark in team.map.landmarks.values()]
                assert min(x_m) <= start.x_m <= max(x_m)


def test_a_row_is_made_of_what_runs_know() -> None:
    def run(seed: int, robot: str, figures: WorldRun, **alarms: int) -> RandomRun:
        return RandomRun(seed, robot, "1", "range", "joint", figures, len(alarms), alarms)

    runs = [
        run(1, "r0", GOOD),
        run(1, "r1", GOOD._replace(nees=4.0), one=3),
        run(2, "r0", GOOD._replace(nees=7.0)),
        run(3, "r0", LOST, one=1, two=2),
    ]
    found = row("1", "range", runs)
    assert (found["robots"], found["teams"], found["median_nees"]) == (4, 3, 4.0)
    assert found["nees"] == pytest.approx(5.0)  # the mean of the two teams', 3 and 7
    assert found["nees_bound"] == pytest.approx(1.96 * math.sqrt(8.0) / math.sqrt(2.0))
    assert (found["lost_share"], found["quarantines"], found["alarmed"]) == (0.25, 3, 2)
    assert alarm_rows(runs) == [
        {"says": "one", "robots": ["1 r1", "3 r0"]},
        {"says": "two", "robots": ["3 r0"]},
    ]
    nothing = row("1", "range", runs[3:])
    assert (nothing["nees"], nothing["inside_3_sigma"]) == (None, None)
    assert [r["landmarks"] for r in rows(runs)] == ["1", "all", "all"]


@pytest.mark.parametrize(
    ("problem", "kind"),
    [
        ("finds m12 elsewhere than on the map: 0.5 m from there", "finds # elsewhere"),
        ("miscalibrated: σ of its odometry × 2.1", "miscalibrated"),
        ("distrusts r1 (biased)", "distrusts # (biased)"),
        ("the pose jumped by 0.6 m and 0° without odometry", None),
    ],
)
def test_the_same_problem_is_of_the_same_kind(problem: str, kind: str | None) -> None:
    assert alarm_kind(problem) == (kind or "the pose jumped by # m and #° without odometry")


def test_one_world_is_shown_as_a_team_file() -> None:
    shown = command_line("experiment", "random-worlds", "--show", "21")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert parse_team(shown.stdout) == random_team(21)
    shown = command_line("experiment", "random-worlds", "--show", "21", "--rough")
    assert parse_team(shown.stdout) == rough_team(21)


@over_seeds(0, 100, more=3)
@pytest.mark.parametrize("is_rough", [False, True], ids=["exact", "rough"])
@pytest.mark.timeout(3600)
def test_robots_know_how_far_they_err_in_random_worlds(is_rough: bool, seeds: range) -> None:
    """Of the first four hundred rough teams, three ended a robot."""
    tasks = [(is_rough, FIRST_SEED + seed) for seed in seeds]
    teams = run_seeds(run_random_world, tasks, Workers(1 if len(seeds) < 10 else None))
    runs = [run for team in teams for run in team]
    found = row("all", "", runs)
    assert found["nees"] - found["nees_bound"] < 2.0  # type: ignore[operator]
    assert found["inside_3_sigma"] > LEAST_INSIDE  # type: ignore[operator]
    if not is_rough:
        assert found["alarmed"] <= MOST_ALARMED * len(runs)  # type: ignore[operator]
    if len(seeds) < 10:
        assert run_random_world(is_rough, FIRST_SEED) == teams[0]
