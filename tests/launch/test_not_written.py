"""Full disks, and places where nothing can be written: what is lost is said, and no more is."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from support.buses import SECOND, standing
from support.logs import write_log
from support.processes import command_line, cpcbl_team
from support.simulated import simulate_recorded

from cpcbl_launch.commands.options import require_folder, require_writable_file
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.run.processes import PROGRAM, ProcessSpec, Supervisor
from cpcbl_launch.team.file import TeamFileError, builtin_path, load_team, save_resolved
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import encode

TEAM = Team(name="one", robots={"r1": RobotSettings(source="external")})
FULL = Path("/dev/full")  # takes any file's place: each write finds no space left
NO_SPACE = "No space left on device"

pytestmark = pytest.mark.skipif(not FULL.exists(), reason="/dev/full is Linux's")


def record_much(path: Path) -> Recording:
    """Records more than what is kept back before it is written."""
    hub = MemoryHub()
    publisher = hub.session().publisher("in/r1/odometry", topics.Qos.INPUT)
    with Recording(path, TEAM, hub.session()) as recording:
        for n in range(30_000):
            publisher.put(encode(standing((n + 2) * SECOND, (n + 1) * SECOND)))
    return recording


def test_a_recording_ends_where_its_disk_is_full_and_nobody_notices(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert record_much(tmp_path / "good.mcap").failed == ""
    assert read_recording(tmp_path / "good.mcap").inputs["r1"]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        recording = record_much(tmp_path / "bad.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert recording.failed == "File too large"
    assert caplog.text.count("bad.mcap: no longer recorded: File too large") == 1


def test_a_run_on_a_full_disk_goes_on_to_its_report() -> None:
    ran = cpcbl_team("up", "--robots", "observer", "--duration", 2, "--report", FULL, "--json")
    assert ran.returncode == 1
    assert set(json.loads(ran.stdout)["robots"]) == {"navigator", "observer", "scout", "patrol"}
    assert ran.stderr.splitlines()[-1] == f"cpcbl-team: /dev/full: not written: {NO_SPACE}"
    assert "Traceback" not in ran.stderr


def test_a_full_standard_output_is_one_line() -> None:
    with FULL.open("w") as full:
        ran = subprocess.run(
            [*PROGRAM, "simulate", "--duration", "2", "--json"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60.0,
            check=False,
        )
    assert ran.returncode == 1
    assert f"cpcbl-team: standard output: not written: {NO_SPACE}" in ran.stderr.splitlines()[-1]
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize(
    ("option", "name"),
    [("--record", "run.mcap"), ("--report", "run.json"), ("--picture", "run.png")],
)
def test_a_file_that_cannot_be_made_is_refused_before_anything_starts(
    option: str, name: str, tmp_path: Path
) -> None:
    ran = command_line("up", "--duration", 2, option, tmp_path / "nowhere" / name)
    assert ran.returncode == 2
    assert ran.stderr.splitlines()[-1].startswith(f"cpcbl-team: {option} ")
    assert "watch it" not in ran.stdout


def test_a_folder_is_no_file_and_a_file_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"--report .*: a folder; name a file"):
        require_writable_file("--report", tmp_path)
    with pytest.raises(InputError, match=r"--logs .*; name a folder"):
        require_folder("--logs", tmp_path / "file")


def test_a_team_that_cannot_be_handed_to_its_processes_is_one_line() -> None:
    with pytest.raises(TeamFileError, match=f"/dev/full: not written: {NO_SPACE}"):
        save_resolved(TEAM, FULL)


def test_a_process_whose_log_cannot_be_written_runs_without(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "sleeper.log").mkdir()  # no log can be written there
    with Supervisor([ProcessSpec("sleeper", ("sleep", "60"))], tmp_path) as supervisor:
        assert "sleeper" in supervisor.pids
        supervisor.watch()
    assert "sleeper.log: not written: Is a directory" in caplog.text


def test_a_simulation_whose_picture_is_lost_still_reports(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "run.png"
    path.symlink_to(FULL)
    ran = command_line("simulate", "--duration", 4, "--picture", path, "--json")
    assert ran.returncode == 1
    assert json.loads(ran.stdout)["not_written"] == {str(path): NO_SPACE}


@pytest.mark.long
def test_an_experiment_whose_files_are_lost_still_shows_its_figures(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    files = [tmp_path / f"one-way-vs-both.{ending}" for ending in ("json", "png")]
    for path in files:
        path.symlink_to(FULL)
    small = ("one-way-vs-both", "--team-sizes", 2, "--seeds", 1, "--output", tmp_path, "--json")
    ran = cpcbl_team("experiment", *small)
    assert ran.returncode == 1
    assert json.loads(ran.stdout)["experiment"] == "one-way-vs-both"
    said = [f"cpcbl-team: {path}: not written: {NO_SPACE}" for path in files]
    assert ran.stderr.splitlines()[-2:] == said


@pytest.mark.parametrize("ending", ["json", "png"])
def test_an_experiment_whose_file_is_a_folder_is_refused_before_it_runs(
    ending: str, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / f"table1.{ending}").mkdir()
    ran = command_line("experiment", "table1", "--output", tmp_path)
    assert ran.returncode == 2
    (line,) = ran.stderr.splitlines()
    assert f"table1.{ending}: a folder; name a file" in line


def test_an_evaluation_whose_export_is_lost_still_reports(tmp_path: Path) -> None:
    write_log(tmp_path / "log", seconds=4.0)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "1_estimate.tum").symlink_to(FULL)
    ran = command_line(
        *("evaluate", "mrclam-uncalibrated", tmp_path / "log"),
        *("--export", tmp_path / "out", "--json"),
    )
    assert ran.returncode == 1
    assert json.loads(ran.stdout)["robots"].keys() == {"1", "2"}
    assert ran.stderr.splitlines() == [f"cpcbl-team: {tmp_path / 'out'}: not written: {NO_SPACE}"]


def test_a_compose_file_that_is_lost_is_named() -> None:
    ran = command_line("compose", "--output", FULL)
    assert ran.returncode == 1
    assert ran.stderr.splitlines() == [f"cpcbl-team: /dev/full: not written: {NO_SPACE}"]


def test_a_file_that_became_a_folder_is_one_line(tmp_path: Path) -> None:
    ends = (
        "from cpcbl_launch import cli;"
        f"cli._run_command = lambda: open({str(tmp_path)!r}, 'w'); cli.main()"
    )
    ran = subprocess.run([sys.executable, "-c", ends], capture_output=True, text=True, check=False)
    assert ran.returncode == 1
    assert ran.stderr.splitlines() == [f"cpcbl-team: {tmp_path}: not written: Is a directory"]


def test_recording_a_simulation_onto_a_good_disk_loses_nothing(tmp_path: Path) -> None:
    team = load_team(builtin_path("demo"))
    report, _ = simulate_recorded(team, 1, 2.0, tmp_path / "run.mcap")
    assert report.not_written == {}
