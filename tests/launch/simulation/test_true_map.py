"""Where the objects of an uncertain map truly stand, and robots that find landmarks themselves."""

import math
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from msgspec.structs import replace
from support.core import matrix2
from support.simulated import record_run
from support.traffic import seen

from cpcbl_launch.lab.experiments.world_list import worlds
from cpcbl_launch.recordings.foxglove import FoxgloveRun
from cpcbl_launch.recordings.summary import summarize
from cpcbl_launch.reporting.metrics import ellipse_of
from cpcbl_launch.simulation.true_map import true_map
from cpcbl_launch.views.report.charts import drawn_robots, field
from cpcbl_launch.views.web.feed import LatestMessages, Snapshot
from cpcbl_launch.views.web.page_data import robot_pictures
from cpcbl_team.config import Field, Landmark, SimulationSettings, Team, Unsurveyed, Wall
from cpcbl_team.gaussian import Covariance2

TREE = Landmark(x_m=2.0, y_m=1.0, covariance_m2=(0.04, 0.03, 0.09))
WALL = Wall(from_m=(0.0, 5.0), to_m=(8.0, 5.0), sigma_m=0.1, direction_sigma_deg=2.0)
MAP = Field(
    landmarks={"tree": TREE, "oak": Landmark(x_m=0.0, y_m=0.0)},
    walls={"wall": WALL},
    unsurveyed={"box": Unsurveyed(true_m=(3.0, 4.0))},
)
TEAM = Team(name="tests", map=MAP, robots={})


def test_true_places_have_the_errors_of_the_map() -> None:
    """Over many seeds their covariance is that of the map, and exact objects stay."""
    found = [true_map(TEAM, seed) for seed in range(400)]
    trees = np.array(
        [(f.landmarks["tree"].x_m - 2.0, f.landmarks["tree"].y_m - 1.0) for f in found]
    )
    due = np.array([[0.04, 0.03], [0.03, 0.09]])
    assert np.cov(trees.T) == pytest.approx(due, abs=0.015)
    middles = [0.5 * (f.walls["wall"].from_m[1] + f.walls["wall"].to_m[1]) - 5.0 for f in found]
    turns = [f.walls["wall"].direction_rad for f in found]
    assert np.std(middles) == pytest.approx(0.1, rel=0.15)
    assert np.std(turns) == pytest.approx(math.radians(2.0), rel=0.15)
    assert {(f.landmarks["oak"].x_m, f.landmarks["oak"].y_m) for f in found} == {(0.0, 0.0)}
    assert found[0].landmarks["box"] == Landmark(x_m=3.0, y_m=4.0)
    assert all(f.is_exact for f in found)
    assert true_map(TEAM, 7) == found[7]


def test_without_noise_the_map_is_right() -> None:
    still = true_map(replace(TEAM, simulation=SimulationSettings(noise=0.0)), 3)
    assert (still.landmarks["tree"].x_m, still.landmarks["tree"].y_m) == (2.0, 1.0)
    assert still.walls["wall"].to_m == pytest.approx(WALL.to_m)


def test_what_a_robot_finds_is_said_and_drawn(tmp_path: Path) -> None:
    """In its status, on the page, in a report and for other programs: where the landmarks stand,
    as certain as it says."""
    team = worlds()["unsurveyed, 2 of 8 known"].team
    record_run(tmp_path / "run", team, 3, 12.0)
    run = summarize(tmp_path / "run")
    status = run.recorder.status["r"]
    assert {found.landmark for found in status.places} == set(team.map.unsurveyed)
    for found in status.places:
        true = team.map.unsurveyed[found.landmark].true_m
        assert true is not None
        off = np.array([found.x_m - true[0], found.y_m - true[1]])
        covariance = matrix2(Covariance2(*found.covariance))
        assert off @ np.linalg.solve(covariance, off) < 18.4
    latest = LatestMessages(
        arrivals=seen(status), places=status.places, tokens=frozenset("t"), latest_s=10.0
    )
    picture = robot_pictures(Snapshot({"r": latest}), ["r"], 10.1, 0.0)["r"]
    first = status.places[0]
    assert picture.places[0][0] == first.landmark
    assert picture.places[0][3:] == pytest.approx(ellipse_of(*first.covariance), abs=1e-4)
    assert field(run, drawn_robots(run)).count('class="found') == 2 * len(status.places)
    shown = list(FoxgloveRun(run.team).messages_for(status.stamp_ns, status))
    (places,) = [message for message in shown if message.topic == "/robots/r/places"]
    assert isinstance(places.message, SceneUpdate)
    assert len(places.message.entities) == len(status.places)
