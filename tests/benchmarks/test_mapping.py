"""The benchmark of maps: both ways find the places of an exact log, and so does its team."""

from pathlib import Path

from benchmarks.mapping import OURS, compare, mapped_landmarks, team_rmse_m
from support.logs import LANDMARKS, write_log

from cpcbl_launch.run.logged_team import load_logged_team
from cpcbl_launch.team.file import find_team


def test_an_exact_log_has_an_exact_map(tmp_path: Path) -> None:
    folder = tmp_path / "MRCLAM9"
    write_log(folder, ("1", "2"), seconds=20.0)
    team = find_team(Path("mrclam-uncalibrated"))
    mapped, found = compare(folder, ("6", "8"), team)
    assert OURS in found
    for figures in found.values():
        assert figures.worst_m < 2e-3
    assert found[OURS].nees < 0.1
    logged = load_logged_team(team, folder)
    places = mapped_landmarks(mapped, logged.team.map.landmarks)
    assert set(places) == set(LANDMARKS)
    on_map, on_survey = (team_rmse_m(logged, m) for m in (places, logged.team.map.landmarks))
    assert abs(on_map - on_survey) < 5e-3
