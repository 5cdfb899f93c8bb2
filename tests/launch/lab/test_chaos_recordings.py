"""What the soak test keeps: the recordings of the robots where something did not hold."""

from pathlib import Path

import pytest

from cpcbl_launch.lab.chaos import soak as soaks
from cpcbl_launch.lab.chaos.checks import equal_to
from cpcbl_launch.lab.chaos.scenario import ScenarioOptions, ScenarioResult
from cpcbl_launch.lab.chaos.team import ChaosError, RunPlan, demo_team, run_team
from cpcbl_launch.recordings.read import BUS, read_run


def soak_that_ends(
    monkeypatch: pytest.MonkeyPatch, folder: Path, tracebacks: int | None
) -> ScenarioResult:
    """A soak test that takes no time and recorded something. None: the team does not start."""

    def run(options: ScenarioOptions, recordings: Path) -> ScenarioResult:
        (recordings / "r1").mkdir()
        if tracebacks is None:
            raise ChaosError("the team did not settle")
        return ScenarioResult([equal_to("tracebacks in logs", tracebacks, 0)], ("faults: none",))

    monkeypatch.setattr(soaks, "_soak", run)
    monkeypatch.setattr("tempfile.mkdtemp", lambda prefix: folder)
    folder.mkdir()
    return soaks.soak(ScenarioOptions())


def test_recordings_are_deleted_where_all_held(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert soak_that_ends(monkeypatch, tmp_path / "run", 0).remarks == ("faults: none",)
    assert not (tmp_path / "run").exists()


def test_recordings_are_kept_where_a_check_is_not_met(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    remarks = soak_that_ends(monkeypatch, tmp_path / "run", 1).remarks
    assert remarks[-1] == f"recorded: cpcbl-team replay {tmp_path / 'run'}"
    assert (tmp_path / "run" / "r1").exists()


def test_recordings_are_kept_where_the_team_did_not_get_so_far(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(ChaosError, match=r"did not settle; recorded: cpcbl-team replay .*/run"):
        soak_that_ends(monkeypatch, tmp_path / "run", None)
    assert (tmp_path / "run" / "r1").exists()


@pytest.mark.thorough
def test_each_robot_of_a_recorded_team_records(tmp_path: Path) -> None:
    plan = RunPlan(demo_team(), watched=True, recordings=tmp_path)
    with run_team(plan) as team:
        team.settle()
        team.run_for(2.0)
    assert read_run(tmp_path).processes.keys() >= set(team.robots)
    assert (tmp_path / BUS).stat().st_size > 0


def test_recordings_are_bounded() -> None:
    assert 0 < soaks.RECORDING.segment_bytes < soaks.RECORDING.keep_bytes
