"""What `init` writes runs: its driver feeds a robot, and doctor, list and status say so."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.processes import command_line, eventually
from support.routers import open_router

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint

LISTEN = ("--duration", 1.5)


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The team file that `init` wrote, of two robots, of which r1 knows its pose by its driver; a
    driver of another team is on the same router."""
    folder, endpoint = tmp_path_factory.mktemp("lab"), free_endpoint()
    words = ("--yes", "--robots", "r1,r2", "--router", endpoint)
    assert command_line("init", folder, *words).returncode == 0
    file, driver = folder / "team.toml", folder / "driver.py"
    (folder / "strayed.toml").write_text(file.read_text().replace('"lab"', '"labb"'))
    (folder / "strayed.py").write_text(driver.read_text().replace("team.toml", "strayed.toml"))
    commands = [
        [*PROGRAM, "robot", str(file), "r1"],
        [sys.executable, str(driver), "r1"],
        [sys.executable, str(folder / "strayed.py"), "r2"],
    ]
    with open_router("nobody", [endpoint]):
        processes = [subprocess.Popen(c, stderr=subprocess.DEVNULL) for c in commands]
        try:
            assert eventually(lambda: r1_status(file)["tier"] in (0, 1, 2), within_s=40.0)
            yield file
        finally:
            for process in processes:
                process.send_signal(signal.SIGINT)
                process.wait(timeout=30.0)


def report(*words: object) -> object:
    """What a command writes as JSON."""
    return json.loads(command_line(*words, "--json").stdout)


def r1_status(team: Path) -> dict[str, object]:
    """What `status` says of r1."""
    own = report("status", team, "r1", *LISTEN)
    assert isinstance(own, list)
    return dict(own[0])


def test_the_driver_feeds_its_robot(team: Path) -> None:
    inputs = r1_status(team)["inputs"]
    assert isinstance(inputs, list)
    assert [own["input"] for own in inputs] == ["odometry", "sightings"]
    assert all(own["published_hz"] > 0.0 for own in inputs)
    # What was on its way when the robot started is too late for it
    assert all(set(own["refused"]) <= {"too_late"} for own in inputs)


def test_doctor_finds_what_is_missing_and_the_strayed_driver(team: Path) -> None:
    ran = command_line("doctor", team, *LISTEN, "--json")
    assert ran.returncode == 1
    found = json.loads(ran.stdout)
    assert found["well"] is False
    errors = [f["text"] for f in found["findings"] if f["level"] == "error"]
    assert "r2: sends no status for 1.5 s" in errors
    assert "this team is `lab`; somebody publishes to `labb` (r2)" in errors
    assert not [error for error in errors if "r1" in error]


def test_list_has_both_teams(team: Path) -> None:
    teams = report("list", team, *LISTEN)
    assert isinstance(teams, list)
    assert [(own["team"], own["robots"]) for own in teams] == [("lab", ["r1"]), ("labb", [])]


@pytest.mark.parametrize("columns", ["60", "100"])
def test_no_row_is_wider_than_the_terminal(
    team: Path, columns: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    for words in (("doctor", team), ("list", team), ("status", team), ("status", team, "r1")):
        shown = command_line(*words, "--duration", 0.3).stdout.splitlines()
        assert shown
        assert max(map(len, shown)) <= int(columns)


def test_without_a_router_each_says_so_in_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:  # it listens, and never answers
        here = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        command_line("init", tmp_path, "--yes", "--router", here)
        file = tmp_path / "team.toml"
        for words in (("list", file), ("status", file)):
            ran = command_line(*words, "--wait", 0.2)
            assert ran.returncode == 2
            assert f"no router at {here}" in ran.stderr.splitlines()[-1]
        ran = command_line("doctor", file, "--wait", 0.2)
    assert ran.returncode == 1
    assert "something listens there" in ran.stdout


def test_doctor_says_all_that_is_wrong_with_a_file(tmp_path: Path) -> None:
    (tmp_path / "team.toml").write_text('name = "t"\nx = 1\n[robots.r1]\nsens = {}\n')
    ran = command_line("doctor", tmp_path / "team.toml", "--json")
    assert ran.returncode == 1
    errors = [f["text"] for f in json.loads(ran.stdout)["findings"] if f["level"] == "error"]
    assert len(errors) == 2


def test_a_robot_that_the_team_lacks_is_named(team: Path) -> None:
    ran = command_line("status", team, "r9", "--duration", 0.2)
    assert ran.returncode == 2
    assert "team lab has no robot r9; there are r1, r2" in ran.stderr
