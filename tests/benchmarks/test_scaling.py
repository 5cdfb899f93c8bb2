"""The benchmark of generated teams of several sizes, in one process."""

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from benchmarks.scaling import (
    SPACING_M,
    TeamSizeFigures,
    main,
    measure_sizes,
    measure_team,
    parse_sizes,
    swarm_team,
)
from support.benchmarks import refusal_of, run_benchmark

from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.checks import problems
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

TIMED = ("cpu_ms_per_s", "field_cpu_ms_per_s", "times_real_time")
PNG = b"\x89PNG\r\n\x1a\n"


def untimed(size: TeamSizeFigures | dict[str, Any]) -> dict[str, Any]:
    """The figures that are the same on every machine."""
    figures = (
        size
        if isinstance(size, dict)
        else {n: getattr(size, n) for n in TeamSizeFigures.__struct_fields__}
    )
    return {name: value for name, value in figures.items() if name not in TIMED}


# Generated teams --------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [2, 3, 10, 50, 200])
def test_generated_teams_are_good_and_equally_dense(size: int) -> None:
    team = swarm_team(size, 1)
    assert len(team.robots) == size
    assert list(problems(team)) == []
    x0, y0, x1, y1 = team.map.bounds()
    area = (x1 - x0) * (y1 - y0)
    assert size * SPACING_M**2 <= area <= (size + 2.0 * math.sqrt(size)) * SPACING_M**2 + 12.0
    corners = (round((x1 - x0) / SPACING_M) + 1) * (round((y1 - y0) / SPACING_M) + 1)
    assert len(team.map.landmarks) == pytest.approx(corners / 2, abs=0.5)
    for robot in team.robots.values():
        assert robot.start is not None
        assert robot.waypoints_m[-1] == (robot.start.x_m, robot.start.y_m)
        for place in robot.waypoints_m:
            assert x0 < place[0] < x1
            assert y0 < place[1] < y1
        for mark in team.map.landmarks.values():
            away = min(math.dist(p, (mark.x_m, mark.y_m)) for p in robot.waypoints_m)
            assert away > team.simulation.bump_radius_m + 0.2
    sigmas = [robot.sensor.range_share for robot in team.robots.values()]
    assert sigmas.count(min(sigmas)) == math.ceil(size / 5)
    blind = [name for name, robot in team.robots.items() if not robot.sensor.sees_landmarks]
    assert 0 < len(blind) <= size / 2


def test_a_seed_makes_one_team() -> None:
    assert swarm_team(10, 1) == swarm_team(10, 1) != swarm_team(10, 2)


@pytest.mark.thorough
def test_robots_of_a_generated_team_drive_round_their_homes() -> None:
    team = swarm_team(4, 1)
    _, recorder = simulate(team, 1, 12.0)
    for name, rows in recorder.simulated_truth().items():
        way = rows[:, 1:3].tolist()
        assert sum(math.dist(a, b) for a, b in pairwise(way)) > 1.5
        xs, ys = zip(*team.robots[name].waypoints_m, strict=True)
        home = sum(xs) / len(xs), sum(ys) / len(ys)
        assert max(math.dist(place, home) for place in way) < 1.5


# Measuring --------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["", "2,", "1", "0,5", "-2", "2,x", "2.5", "10000", "2;5"])
def test_sizes_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"--team-sizes .*such as 2,10,50"):
        parse_sizes(text)


@pytest.mark.parametrize("duration_s", [1.9, 0.0, -5.0, math.nan, math.inf])
def test_too_short_a_time_measures_nothing(duration_s: float) -> None:
    with pytest.raises(InputError, match="--duration"):
        measure_sizes([2], 1, duration_s)


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_figures_whatever_was_run_before() -> None:
    shown: list[float] = []
    both = measure_sizes([2, 6], 3, 2.0, shown.append)
    assert shown == sorted(shown)
    assert shown[-1] == pytest.approx(1.0, abs=0.02)
    (alone,) = measure_sizes([6], 3, 2.0).sizes
    (other,) = measure_sizes([6], 4, 2.0).sizes
    assert [size.robots for size in both.sizes] == [2, 6]
    assert untimed(alone) == untimed(both.sizes[1]) != untimed(other)
    for size in both.sizes:
        assert all(getattr(size, name) > 0.0 for name in TIMED)


def test_what_is_counted_is_what_the_robots_said() -> None:
    (size,) = measure_sizes([4], 1, 3.0).sizes
    report, recorder = simulate(swarm_team(4, 1), 1, 3.0)
    seconds = {name: status.stamp_ns * 1e-9 for name, status in recorder.status.items()}
    for figure, count in (
        (size.messages_sent_per_s, "messages_sent"),
        (size.bytes_sent_per_s, "bytes_sent"),
        (size.messages_received_per_s, "messages_received"),
        (size.bytes_received_per_s, "bytes_received"),
    ):
        due = [getattr(r, count) / seconds[name] for name, r in report.robots.items()]
        assert figure == pytest.approx(sum(due) / 4)
        assert figure > 0.0
    assert size.position_rmse_m == report.team.position_rmse_m


@pytest.mark.parametrize(("apart_m", "in_sight"), [(2.0, 1.0), (9.0, 0.0)])
def test_teammates_are_counted_that_are_in_sight(apart_m: float, in_sight: float) -> None:
    """Two that stand face to face, each before a landmark."""
    robots = {
        name: RobotSettings(
            start=Start(x_m=x_m, y_m=0.0, heading_deg=heading_deg),
            sensor=SensorSettings(max_range_m=6.0),
            odometry=OdometrySettings(moves=False),
        )
        for name, x_m, heading_deg in (("west", 0.0, 0.0), ("east", apart_m, 180.0))
    }
    marks = {n: Landmark(x_m=x_m, y_m=0.5) for n, x_m in (("w", 1.5), ("e", apart_m - 1.5))}
    team = Team(name="t", robots=robots, map=Field(landmarks=marks))
    assert measure_team(team, 1, 2.0).in_sight == in_sight


# The benchmark ----------------------------------------------------------------------------------


@pytest.mark.thorough
def test_sizes_as_table_json_and_picture(tmp_path: Path) -> None:
    shown = run_benchmark(
        "scaling", "--team-sizes", "2,5", "--duration", 2, "--seed", 3, "--output", tmp_path
    )
    assert shown.returncode == 0, shown.stderr
    assert shown.stderr == ""
    for word in ("robots", "in sight", "CPU ms/s", "B/s", "RMSE m", "in 3 σ"):
        assert word in shown.stdout
    lines = [line for line in shown.stdout.splitlines() if "written" not in line]
    assert max(map(len, lines)) <= 80
    assert (tmp_path / "scale.png").read_bytes().startswith(PNG)
    figures = json.loads((tmp_path / "scale.json").read_text())
    assert (figures["duration_s"], figures["seed"]) == (2.0, 3)
    keys = set(TeamSizeFigures.__struct_fields__)
    assert [size.keys() for size in figures["sizes"]] == [keys, keys]
    again = measure_sizes([2, 5], 3, 2.0)
    assert [untimed(s) for s in figures["sizes"]] == [untimed(s) for s in again.sizes]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--team-sizes", "2,x"], "--team-sizes 2,x"),
        (["--team-sizes", "2", "--duration", 1], "--duration 1"),
    ],
)
def test_what_the_user_can_mend_is_one_line(arguments: list[object], said: str) -> None:
    assert said in refusal_of(main, *arguments).splitlines()[-1]
