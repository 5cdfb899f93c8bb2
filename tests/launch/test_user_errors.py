"""What a user meets when something is wrong: one clear line, and an exit code that says so."""

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.processes import command_line, cpcbl_team, eventually

from cpcbl_agents.extras import command_from_origin, install_command
from cpcbl_agents.stop import StopSignal
from cpcbl_launch import cli
from cpcbl_launch.cli import LONGEST
from cpcbl_launch.run.containers import compose
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import find_team
from cpcbl_team.errors import InputError
from cpcbl_transport.zenoh_bus import listen_problem, one_line

EXTERNAL = """
name = "{name}"
[map.landmarks]
door = {{ x_m = 2.0, y_m = 0.2 }}
[robots.r1]
source = "external"
start = {{ x_m = 0.0, y_m = 0.0 }}
"""


@pytest.fixture
def external(tmp_path: Path) -> Path:
    path = tmp_path / "team.toml"
    path.write_text(EXTERNAL.format(name="real"))
    return path


def last_line(ran: "subprocess.CompletedProcess[str]") -> str:
    assert "Traceback" not in ran.stderr
    return ran.stderr.splitlines()[-1]


def test_a_run_in_which_nobody_drives_fails_and_says_so(external: Path, tmp_path: Path) -> None:
    picture = tmp_path / "run.png"
    ran = cpcbl_team("up", external, "--duration", 3, "--picture", picture)
    assert ran.returncode == 1
    assert "nothing was heard in this run: no robot received any input" in last_line(ran)
    assert "in/r1/odometry" in last_line(ran)
    assert "Robot r1 received no input" in ran.stdout
    assert "0.0%" not in ran.stdout
    assert picture.exists()


def test_an_unknown_team_lists_those_that_there_are() -> None:
    ran = command_line("up", "nosuch")
    assert ran.returncode == 2
    assert "nosuch: no such file; the built-in teams are blind, circuit," in last_line(ran)


def test_a_team_of_logs_asks_for_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ran = command_line("up", "mrclam")
    assert ran.returncode == 2
    assert "--data MRCLAM6" in last_line(ran)


@pytest.mark.parametrize("command", [("router", "demo", "--listen"), ("up",)], ids=["router", "up"])
def test_a_port_in_use_is_one_clear_line(command: tuple[str, ...], external: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        words = [*command, endpoint]
        if command == ("up",):
            external.write_text(f'{external.read_text()}[transport]\nlisten = ["{endpoint}"]\n')
            words = ["up", str(external)]
        ran = cpcbl_team(*words)
    assert ran.returncode == 2
    line = f"cannot listen on {endpoint}: another program listens there; end or join it, or name"
    assert line in last_line(ran)


def test_an_error_of_zenoh_has_no_places_in_its_source() -> None:
    said = "Unknown  thing at /home/runner/.cargo/git/zenoh-link/src/lib.rs:120. - caused by more"
    assert one_line(said) == "Unknown thing - caused by more"
    assert listen_problem(said) == one_line(said)
    assert ".rs" not in one_line("Odd (/root/zenoh/io/src/tcp.rs:33:7): no")


def test_up_joins_a_router_that_runs() -> None:
    endpoint = free_endpoint()
    command = [*PROGRAM, "router", "demo", "--listen", endpoint]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as router:
        try:
            words = ("--connect", endpoint, "--robots", "observer", "--duration", 2)
            ran = cpcbl_team("up", "demo", *words)
            assert router.poll() is None
        finally:
            router.terminate()
    assert ran.returncode == 0, ran.stderr
    assert f"--connect {endpoint}" in ran.stdout
    assert "observer" in ran.stdout


def closing(descriptors: str, *words: str) -> "subprocess.CompletedProcess[str]":
    """A command of which some of the standard files are closed."""
    shell = ["sh", "-c", f'"$@" {descriptors}', "sh", *PROGRAM, *words]
    return subprocess.run(shell, capture_output=True, text=True, check=False, timeout=60)


def test_a_closed_standard_output_is_one_line() -> None:
    ran = closing(">&-", "check", "demo")
    assert ran.returncode == 1
    assert ran.stderr == "cpcbl-team: standard output: not written: it is closed\n"
    assert closing("2>&-", "check", "demo").returncode == 0


def interrupted_while(imports: str, *words: str) -> "subprocess.CompletedProcess[str]":
    """A command that gets Ctrl-C while it imports a module."""
    code = f"""
import builtins, os, signal, sys
usual = builtins.__import__
def interrupting(name, *rest):
    if name == {imports!r}:
        builtins.__import__ = usual
        os.kill(os.getpid(), signal.SIGINT)
    return usual(name, *rest)
builtins.__import__ = interrupting
sys.argv = ["cpcbl-team", *{words!r}]
from cpcbl_launch.cli import main
main()
"""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


@pytest.mark.parametrize("imports", ["logging", "cpcbl_team.errors", "cpcbl_launch.app"])
def test_ctrl_c_at_the_very_start_shows_no_traceback(imports: str) -> None:
    ran = interrupted_while(imports, "check", "demo")
    assert ran.returncode == 130
    assert ran.stderr == "cpcbl-team: stopped\n"


def test_ctrl_c_before_the_command_line_runs_shows_no_traceback() -> None:
    code = "import os, signal, cpcbl_launch.cli; os.kill(os.getpid(), signal.SIGINT); 1 + 1"
    command = [sys.executable, "-c", code]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert ran.returncode == -signal.SIGINT  # a shell's 130
    assert ran.stderr == "cpcbl-team: stopped\n"


@pytest.fixture
def waiting_robot() -> Iterator["subprocess.Popen[str]"]:
    """A robot that waits for its router."""
    words = ("robot", "demo", "scout", "--connect", free_endpoint())
    command = [*PROGRAM, *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


def test_ctrl_c_while_a_router_is_waited_for_has_the_same_exit_code(
    waiting_robot: "subprocess.Popen[str]",
) -> None:
    assert waiting_robot.stderr is not None
    assert eventually(lambda: "no router" in waiting_robot.stderr.readline())  # type: ignore[union-attr]
    waiting_robot.send_signal(signal.SIGINT)
    assert waiting_robot.wait(timeout=20.0) == 130


def test_a_very_long_line_is_cut_in_its_middle(tmp_path: Path) -> None:
    path = tmp_path / "team.toml"
    path.write_text(f"{'x' * 5000} = 1\n{EXTERNAL.format(name='real')}")
    ran = command_line("check", path)
    assert ran.returncode == 2
    line = last_line(ran)
    assert str(path) in line
    assert " ... " in line
    assert len(line) <= LONGEST + len("cpcbl-team: ")


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        ({}, "pip install '.[plot]' in a checkout of cpcbl-team"),
        ({"url": "file:///not/there"}, "pip install '.[plot]' in a checkout of cpcbl-team"),
        (
            {"url": "https://example.org/r.git", "vcs_info": {"vcs": "git", "commit_id": "0"}},
            "pip install 'cpcbl-team[plot] @ git+https://example.org/r.git'",
        ),
    ],
)
def test_an_extra_is_installed_from_where_the_package_came(
    origin: dict[str, Any], command: str
) -> None:
    assert command_from_origin(origin, "plot") == command


def test_an_extra_of_a_checkout_is_installed_from_it(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").touch()
    origin = {"url": tmp_path.as_uri(), "dir_info": {"editable": True}}
    assert command_from_origin(origin, "plot") == f"pip install --editable '{tmp_path}[plot]'"
    del origin["dir_info"]
    assert command_from_origin(origin, "plot") == f"pip install '{tmp_path}[plot]'"
    assert "'cpcbl-team[" not in install_command("plot")


def test_compose_names_no_image_that_nobody_built(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compose, "checkout", lambda: None)
    team, file = find_team(Path("demo")), Path("demo")
    with pytest.raises(InputError, match="nobody has built an image"):
        compose.deployment_text(team, file, Path(), None, 1)
    assert "mine:2" in compose.deployment_text(team, file, Path(), "mine:2", 1)


@pytest.mark.parametrize("code", [0, 1, 2, None])
def test_after_ctrl_c_the_exit_code_says_so_whatever_a_command_found(
    code: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StopSignal, "was_interrupted", True)
    monkeypatch.setattr(cli, "_run_command", lambda: sys.exit(code))
    with pytest.raises(SystemExit) as end:
        cli._run()
    assert end.value.code == 130
