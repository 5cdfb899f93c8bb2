"""What `init` writes is a team file without warnings, and a driver; it never replaces a file."""

import ast
import sys
from pathlib import Path

import pytest
from support.processes import command_line

from cpcbl_launch.commands import initializing
from cpcbl_launch.team.file import load_team


def init(folder: Path, *options: str) -> list[str]:
    """What `init` prints, a line each."""
    ran = command_line("init", folder, *options)
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr == ""
    return ran.stdout.splitlines()


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--robots", "a", "--router", "192.168.1.10"),
        ("--robots", "a,b,c,d", "--camera", "a,b", "--blind", "d", "--router", "tcp/base:7000"),
        ("--camera", "r1,r2,r3", "--team-name", "lab2", "--router", "fe80::1"),
    ],
)
def test_check_of_what_is_written_is_clean(options: tuple[str, ...], tmp_path: Path) -> None:
    init(tmp_path, "--yes", *options)
    checked = command_line("check", tmp_path / "team.toml")
    assert checked.returncode == 0
    assert checked.stderr == ""
    ast.parse((tmp_path / "driver.py").read_text())


def test_the_options_are_in_the_file(tmp_path: Path) -> None:
    options = ("--robots", "a,b,c", "--camera", "b", "--blind", "c", "--router", "10.0.0.2:7000")
    init(tmp_path / "new" / "t.toml", "--yes", "--team-name", "lab2", *options)
    team = load_team(tmp_path / "new" / "t.toml")
    assert (team.name, list(team.robots)) == ("lab2", ["a", "b", "c"])
    assert [robot.source for robot in team.robots.values()] == ["external"] * 3
    assert team.cameras == ("b",)
    assert [robot.sensor.sees_landmarks for robot in team.robots.values()] == [True, True, False]
    assert team.transport.listen == ("tcp/0.0.0.0:7000",)
    assert team.transport.connect == ("tcp/10.0.0.2:7000",)


@pytest.mark.parametrize(
    ("address", "listen", "connect"),
    [
        ("127.0.0.1", "127.0.0.1:7447", "127.0.0.1:7447"),
        ("192.168.1.10", "0.0.0.0:7447", "192.168.1.10:7447"),
        ("tcp/base:7000", "0.0.0.0:7000", "base:7000"),
        ("fe80::1", "[::]:7447", "[fe80::1]:7447"),
        ("[fe80::1]:7000", "[::]:7000", "[fe80::1]:7000"),
    ],
)
def test_an_address_is_written_as_people_write_it(
    address: str, listen: str, connect: str, tmp_path: Path
) -> None:
    init(tmp_path, "--yes", "--router", address)
    transport = load_team(tmp_path / "team.toml").transport
    assert transport.listen == (f"tcp/{listen}",)
    assert transport.connect == (f"tcp/{connect}",)


def test_little_is_asked_at_a_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    answers = {"Names of the robots": "north,south", "Address": "10.0.0.9", "south": "none"}

    def answer(question: str, default: str) -> str:
        asked.append(question)
        return next((a for q, a in answers.items() if question.startswith(q)), default)

    monkeypatch.setattr(initializing, "_ask", answer)
    monkeypatch.setattr(sys, "stdin", type("Terminal", (), {"isatty": lambda self: True})())
    init(tmp_path, "--team-name", "lab")
    assert len(asked) == 4
    team = load_team(tmp_path / "team.toml")
    assert list(team.robots) == ["north", "south"]
    assert not team.robots["south"].sensor.sees_landmarks
    assert team.transport.connect == ("tcp/10.0.0.9:7447",)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--robots", "a b"), "--robots a b: a name has"),
        (("--robots", "a,a"), "--robots: a is the name of two things"),
        (("--robots", "northwest"), "--robots: northwest is the name of two things"),
        (("--robots", ","), "--robots: names no robot"),
        (("--camera", "r9"), "--camera: no robot r9; there are r1, r2, r3"),
        (("--router", "my machine"), "--router my machine: no address"),
        (("--team-name", "my team"), "--team-name my team: a name has"),
    ],
)
def test_an_answer_that_cannot_be_used_is_one_line(
    options: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    ran = command_line("init", tmp_path, "--yes", *options)
    assert ran.returncode == 2
    assert ran.stderr.startswith(f"cpcbl-team: {said}")
    assert list(tmp_path.iterdir()) == []


def test_no_file_is_replaced_unless_it_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "driver.py").write_text("mine")
    ran = command_line("init", tmp_path, "--yes")
    assert ran.returncode == 2
    assert f"{tmp_path / 'driver.py'}: is there already" in ran.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["driver.py"]
    init(tmp_path, "--yes", "--force")
    assert (tmp_path / "driver.py").read_text() != "mine"


def test_where_nothing_can_be_written_is_one_line() -> None:
    ran = command_line("init", "/dev/null/x", "--yes")
    assert ran.returncode == 2
    assert len(ran.stderr.splitlines()) == 1
