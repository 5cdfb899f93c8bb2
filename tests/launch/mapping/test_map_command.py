"""`calibrate map`: what it reads, prints and writes."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from support.logs import LANDMARKS, write_log
from support.processes import command_line

from cpcbl_launch.calibration.team_tables import TablePath, TomlValue, edit_team

TEAM = """# our team
name = "lab"
[map.landmarks]
6 = { x_m = 0.0, y_m = 0.0 }
7 = { x_m = 9.0, y_m = 9.0, gives = "both" } # measured by eye
8 = { x_m = 4.0, y_m = 3.0 }

[defaults]
source = "mrclam"
[robots]
1 = {}
2 = {}
"""


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """A team file and a log without noise."""
    team, log = tmp_path / "team.toml", tmp_path / "MRCLAM9"
    team.write_text(TEAM)
    write_log(log, ("1", "2"), seconds=20.0)
    return team, log


def run(*words: object) -> tuple[int, str]:
    """The exit code, and what is printed; of an error its line."""
    result = command_line("calibrate", "map", *words)
    return result.returncode, result.stdout if result.returncode == 0 else result.stderr


def test_new_places_are_written_and_the_rest_of_the_file_stays(files: tuple[Path, Path]) -> None:
    team, log = files
    picture, paths = team.with_name("map.png"), team.with_name("paths")
    code, printed = run(
        team, log, "--withhold", "7", "--picture", picture, "--export", paths, "--start", ""
    )
    assert code == 0, printed
    assert f"written: {team}" in printed
    text = team.read_text()
    assert text.startswith("# our team\n")
    assert "# measured by eye" in text
    marks = tomllib.loads(text)["map"]["landmarks"]
    assert marks["6"] == {"x_m": 0.0, "y_m": 0.0}
    for name in ("7", "9"):
        assert (marks[name]["x_m"], marks[name]["y_m"]) == pytest.approx(LANDMARKS[name], abs=1e-3)
        assert 0.0 < marks[name]["sigma_m"] < 0.05
    assert marks["7"]["gives"] == "both"
    assert picture.read_bytes().startswith(b"\x89PNG")
    rows = np.loadtxt(paths / "1_MRCLAM9.tum")
    assert rows.shape[1] == 8
    code, printed = run(team, log, "--dry-run")  # 7 and 9 are estimated anew
    assert code == 0
    assert "frame: the known landmarks 6, 8" in printed


def test_a_dry_run_writes_nothing(files: tuple[Path, Path]) -> None:
    team, log = files
    code, printed = run(team, log, "--withhold", "7", "--dry-run")
    assert code == 0
    assert "[map.landmarks.9]" in printed
    assert team.read_text() == TEAM


def test_json_has_covariances_drives_and_frame(files: tuple[Path, Path]) -> None:
    code, printed = run(*files, "--withhold", "7", "--dry-run", "--json")
    assert code == 0
    found = json.loads(printed)
    assert found["frame"] == "the known landmarks 6, 8"
    xx, xy, yy = found["landmarks"]["7"]["covariance"]
    assert xx * yy > xy * xy
    assert found["landmarks"]["6"]["known"] is True
    assert [drive["robot"] for drive in found["drives"]] == ["1", "2"]
    assert found["runs"] == ["MRCLAM9"]


def test_a_known_place_that_is_wrong_is_not_used(files: tuple[Path, Path]) -> None:
    code, printed = run(*files, "--dry-run")
    assert code == 0
    assert "its place is not used" in " ".join(printed.split())


def test_two_runs_of_one_name_are_two_runs(files: tuple[Path, Path]) -> None:
    team, log = files
    other = log.parent / "other" / "MRCLAM9"
    other.parent.mkdir()
    write_log(other, ("1", "2"), seconds=20.0)
    code, printed = run(team, log, other, "--withhold", "7", "--dry-run", "--json")
    assert code == 0
    assert {drive["run"] for drive in json.loads(printed)["drives"]} == {"MRCLAM9-1", "MRCLAM9-2"}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--known", "5"), "--known 5: no such name in the team"),
        (("--withhold", "door"), "--withhold door: no such name in the team"),
        (("--start", "r1"), "--start r1: no such name in the team"),
        (("--start", "1"), "--start 1: robots.1 has no start in the team file"),
    ],
)
def test_wrong_options_are_one_line(
    files: tuple[Path, Path], words: tuple[str, str], says: str
) -> None:
    code, printed = run(*files, *words, "--dry-run")
    assert code == 2
    assert says in printed


def test_a_folder_that_is_no_run_is_one_line(files: tuple[Path, Path]) -> None:
    team, _ = files
    code, printed = run(team, team.parent, "--dry-run")
    assert code == 2
    assert "neither a recording" in printed


def test_a_landmark_with_a_place_is_no_longer_one_that_nobody_has_surveyed() -> None:
    text = (
        'name = "lab"\n[map.landmarks]\n'
        "oak = { x_m = 1.0, y_m = 2.0, covariance_m2 = [1.0, 0.0, 1.0] }\n"
        '[map.unsurveyed]\nbox = { gives = "bearing" }  # somewhere\nelm = {}\n[robots.r1]\n'
        'source = "external"\n'
    )
    values = {"x_m": TomlValue(3.0), "y_m": TomlValue(4.0), "sigma_m": TomlValue(0.01)}
    tables = {TablePath(("map", "landmarks", name)): values for name in ("box", "oak")}
    found = tomllib.loads(edit_team(text, "team.toml", tables))["map"]
    assert found["unsurveyed"] == {"elm": {}}
    place = {"x_m": 3.0, "y_m": 4.0, "sigma_m": 0.01}
    assert found["landmarks"] == {"oak": place, "box": {**place, "gives": "bearing"}}
    of_elm = {TablePath(("map", "landmarks", "elm")): values}
    assert "unsurveyed" not in edit_team(text.replace("box =", "#"), "team.toml", of_elm)
