"""Whole drives on the simulated field, by robots that steer by their own estimates."""

import math
from itertools import pairwise
from typing import Any

import msgspec
import pytest
from support.fields import LOOP, MILLIMETRE, marks
from support.sweeps import sampled

from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import (
    LocalizerSettings,
    OdometrySettings,
    PositionSensor,
    RobotSettings,
    SensorSettings,
    SimulationSettings,
    Start,
    Team,
    Variant,
)

MOVING = ("navigator", "scout", "patrol")
TURNING_MATE_M = 0.005  # a teammate that turns is believed to drive on until its next belief


@pytest.mark.parametrize(
    ("kinds", "limit_m"),
    [pytest.param("none", MILLIMETRE, marks=pytest.mark.thorough), ("both", TURNING_MATE_M)],
)
def test_robots_drive_their_loops_by_their_own_estimates(kinds: str, limit_m: float) -> None:
    demo = load_team(builtin_path("demo"))
    quiet = msgspec.structs.replace(demo, simulation=SimulationSettings(noise=0.0))
    report, recorder = simulate(with_overrides(quiet, Overrides(collaboration=kinds)), 1, 30.0)
    for name, figures in report.robots.items():
        assert figures.samples > 250
        assert figures.position_max_m is not None
        assert figures.position_max_m < limit_m
        assert figures.heading_rmse_deg is not None
        assert figures.heading_rmse_deg < 0.3
        assert figures.lost_share == 0.0
        assert figures.bumps == 0
        way = recorder.simulated_truth()[name][:, 1:3].tolist()
        driven = sum(math.dist(a, b) for a, b in pairwise(way))
        assert driven > 3.0 if name in MOVING else driven == 0.0
    helped = {name for name, r in report.robots.items() if r.messages_received}
    assert ("scout" in helped) is (kinds == "both")


@pytest.mark.thorough
def test_robots_pass_their_waypoints() -> None:
    demo = load_team(builtin_path("demo"))
    quiet = msgspec.structs.replace(demo, simulation=SimulationSettings(noise=0.0))
    _, recorder = simulate(quiet, 1, 40.0)
    for name in MOVING:
        way = recorder.simulated_truth()[name][:, 1:3].tolist()
        for waypoint in quiet.robots[name].waypoints_m:
            assert min(math.dist(waypoint, place) for place in way) < 0.3


EXACT_RANGE = {"range_share": 0.0, "range_floor_m": 0.0}
EXACT_BEARING = {"bearing_sigma_deg": 0.0}
EXACT_ODOMETRY = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.0, turn_sigma_rad_per_sqrt_rad=0.0, turn_sigma_rad_per_sqrt_m=0.0
)


@pytest.mark.parametrize(
    "sensor",
    [EXACT_RANGE, EXACT_BEARING, EXACT_RANGE | EXACT_BEARING],
    ids=["range", "bearing", "range and bearing"],
)
@pytest.mark.parametrize("odometry", [OdometrySettings(), EXACT_ODOMETRY], ids=["usual", "exact"])
@pytest.mark.parametrize("variant", sampled(["joint", "oval", "circular", "weighted"], ["joint"]))
@pytest.mark.parametrize("duration_s", [8.0, pytest.param(20.0, marks=pytest.mark.long)])
def test_a_sensor_that_never_errs_stops_no_robot(
    sensor: dict[str, Any], odometry: OdometrySettings, variant: Variant, duration_s: float
) -> None:
    def perfect(x_m: float, *waypoints_m: tuple[float, float]) -> RobotSettings:
        return RobotSettings(
            start=Start(x_m=x_m, y_m=1.0),
            sensor=SensorSettings(**sensor),
            odometry=odometry,
            localizer=LocalizerSettings(variant=variant),
            waypoints_m=waypoints_m,
        )

    ahead, behind = (4.0, 1.0), (1.0, 4.0)
    team = Team(
        name="t",
        robots={"r1": perfect(1.0, ahead, behind), "r2": perfect(4.0, behind, ahead)},
        map=marks(oak=(0.0, 0.0), elm=(5.0, 0.0), ash=(5.0, 5.0)),
        simulation=SimulationSettings(noise=0.0),
    )
    report, recorder = simulate(team, 1, duration_s)
    tracks = [track for tracks in recorder.tracks.values() for track in tracks]
    variances = [t.covariance[i] for t in tracks if t.covariance is not None for i in (0, 2, 5)]
    assert min(variances, default=0.0) >= 0.0
    assert [r.samples > 10 * duration_s - 10 for r in report.robots.values()] == [True, True]


@pytest.mark.parametrize("delay_s", sampled([0.0, 0.3], [0.3]))
def test_a_position_sensor_keeps_a_robot_that_sees_nothing_on_its_way(delay_s: float) -> None:
    """However late it is, as long as the settings say so."""
    sensor = PositionSensor(sigma_m=0.03, rate_hz=5.0, delay_s=delay_s)
    blind = SensorSettings(sees_landmarks=False, sees_robots=False)
    start = Start(x_m=0.0, y_m=0.0)
    robots = {
        "by_dead_reckoning": RobotSettings(start=start, sensor=blind, waypoints_m=LOOP),
        "with_gps": RobotSettings(
            start=start, sensor=blind, waypoints_m=LOOP, position_sensor=sensor
        ),
    }
    believed = Team(name="t", robots=robots)
    report, _ = simulate(believed, 2, 40.0)
    with_gps = report.robots["with_gps"]
    assert with_gps.position_rmse_m is not None
    assert with_gps.position_rmse_m < 0.05
    assert with_gps.inside_3_sigma is not None
    assert with_gps.inside_3_sigma > 0.95
    reckoning = report.robots["by_dead_reckoning"].position_rmse_m
    assert reckoning is not None
    assert reckoning > 0.1
    if delay_s:
        prompt = msgspec.structs.replace(sensor, delay_s=0.0)
        unaware = msgspec.structs.replace(robots["with_gps"], position_sensor=prompt)
        other = msgspec.structs.replace(believed, robots={**robots, "with_gps": unaware})
        wrong, _ = simulate(other, 2, 40.0, truth=believed)
        misled = wrong.robots["with_gps"].position_rmse_m
        assert misled is not None
        assert misled > 1.5 * with_gps.position_rmse_m
