"""Walls on their way from a team file through a recorded run into the file."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from support.mapped_worlds import exact_walls, moved
from support.mapping_worlds import ROOM, make_world
from support.processes import command_line
from support.simulated import record_run

from cpcbl_launch.calibration.team_tables import edit_team
from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapped_walls import MappedWall
from cpcbl_launch.mapping.mapper import build_map
from cpcbl_launch.mapping.plots import draw_map
from cpcbl_launch.mapping.report import map_report, map_tables
from cpcbl_launch.simulation.true_map import true_map
from cpcbl_launch.team.file import parse_team

TEAM = """# our hall
name = "hall"
[map.landmarks]
door = { x_m = 0.5, y_m = 0.5 }
lamp = { x_m = 7.5, y_m = 0.6 }
desk = { x_m = 7.2, y_m = 5.4 }

[map.walls]
# measured with a tape, in a hurry
north = { from_m = [0.0, 6.0], to_m = [8.0, 6.0], sigma_m = 0.2, direction_sigma_deg = 2.0 }

[map.unsurveyed_walls]
east = { gives = "both", true_from_m = [8.0, 0.0], true_to_m = [8.0, 6.0] }

[defaults]
sensor = { field_of_view_deg = 360.0 }
[robots.r1]
start = { x_m = 4.0, y_m = 3.0, heading_deg = 0.0 }
waypoints_m = [[6.5, 3.0], [6.5, 4.8], [1.5, 4.8], [1.5, 1.2]]
[robots.r2]
start = { x_m = 2.0, y_m = 2.0, heading_deg = 90.0 }
waypoints_m = [[2.0, 4.5], [6.0, 1.5]]
"""

LAB = 'name = "lab"\n[robots.r1]\nsource = "external"\n'


def run(*words: object) -> str:
    result = command_line("calibrate", "map", *words)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.thorough
def test_walls_are_written_and_the_rest_of_the_file_stays(tmp_path: Path) -> None:
    file, picture = tmp_path / "team.toml", tmp_path / "map.png"
    file.write_text(TEAM)
    team = parse_team(TEAM, "team.toml")
    truth = true_map(team, 3).walls
    record_run(tmp_path / "run", team, 3, 40.0, with_bus=True)
    printed = run(file, tmp_path / "run", "--picture", picture)
    assert "north" in printed
    assert "direction σ deg" in printed
    assert picture.read_bytes().startswith(b"\x89PNG")
    text = file.read_text()
    assert text.startswith("# our hall\n")
    assert "# measured with a tape, in a hurry" in text
    found = tomllib.loads(text)["map"]
    assert "unsurveyed_walls" not in found
    assert found["walls"]["east"]["gives"] == "both"
    written = parse_team(text, "team.toml").map.walls
    for name, wall in written.items():
        true_begin, normal = np.array(truth[name].from_m), _normal(truth[name].direction_rad)
        for end in (wall.from_m, wall.to_m):
            off = abs(float((np.array(end) - true_begin) @ normal))
            assert off < 4.0 * (wall.sigma_m + 4.0 * np.radians(wall.direction_sigma_deg))
            assert off < 0.1
        assert 0.0 < wall.sigma_m < 0.05
    again = json.loads(run(file, tmp_path / "run", "--dry-run", "--json"))
    assert "come from these runs, which do not count twice" in again["notes"][0]
    assert again["walls"]["north"]["sigma_m"] == pytest.approx(written["north"].sigma_m, rel=0.3)


def _normal(direction: float) -> np.ndarray:
    return np.array([-np.sin(direction), np.cos(direction)])


def test_sigmas_that_are_taken_as_independent_cover_the_covariance() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        root = rng.standard_normal((2, 2)) * (0.1, 0.01)
        wall = MappedWall(np.array([[0.0, 0.0], [4.0, 0.0]]), root.T @ root, (-1.0, 1.0))
        offset, direction = wall.independent_sigmas
        larger = np.diag((offset**2, direction**2)) - wall.covariance
        assert np.linalg.eigvalsh(larger)[0] > -1e-12
        row = np.array([1.0, 3.0])
        assert wall.sigma_at(3.0) == pytest.approx(np.sqrt(row @ wall.covariance @ row))


def test_a_landmark_that_is_known_badly_in_one_direction_gets_a_covariance() -> None:
    world = make_world(
        seconds=20.0,
        places={"door": (0.0, 0.0), "lamp": (0.3, 0.0), "desk": (8.6, 5.2), "pole": (4.4, 2.6)},
    )
    marks = {name: world.team.map.landmarks[name] for name in ("door", "lamp")}
    report = map_report(build_map(world.team, world.runs, Request(marks)), ["day1"], 1.0)
    text = f"{LAB}[map.landmarks.desk]\nx_m = 1.0\ny_m = 2.0\nsigma_m = 3.0\n"
    written = parse_team(edit_team(text, "team.toml", map_tables(report)), "team.toml").map
    desk = written.landmarks["desk"]
    assert desk.sigma_m == 0.0
    assert desk.covariance_m2 is not None
    assert np.allclose(desk.covariance_m2, report.landmarks["desk"].covariance, rtol=0.02)


def test_a_map_of_walls_alone_is_drawn_and_written(tmp_path: Path) -> None:
    world = make_world(seconds=30.0, walls=ROOM, places={})
    rough = replace(moved(exact_walls(ROOM)["south"], y_m=0.1), sigma_m=0.1)
    mapped = build_map(world.team, world.runs, Request({}, walls={"south": rough}))
    draw_map(mapped, tmp_path / "map.svg")
    assert (tmp_path / "map.svg").stat().st_size > 10_000
    report = map_report(mapped, ["day1"], 1.0)
    text = edit_team(LAB, "team.toml", map_tables(report))
    walls = parse_team(text, "team.toml").map.walls
    assert set(walls) == set(ROOM)
    assert np.allclose(walls["south"].from_m[1], rough.from_m[1], atol=1e-3)
    assert walls["south"].sigma_m == pytest.approx(0.1, rel=0.02)
