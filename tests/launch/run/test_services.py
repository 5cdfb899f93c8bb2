"""Robot and router as services of systemd: the units, and what the processes tell it."""

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import pytest
from support.processes import command_line, eventually

from cpcbl_agents.watchdog import notify, with_watchdog
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint

UNITS = ("cpcbl-robot@.service", "cpcbl-router.service")
COMMAND = "/opt/cpcbl/bin/cpcbl-team"
TEAM = """
name = "floor"
[robots.r1]
source = "external"
start = { x_m = 1.0, y_m = 2.0 }
[map.landmarks]
door = { x_m = 5.0, y_m = 1.0 }
"""


class Manager:
    """A service manager's socket, and what it was told."""

    def __init__(self, folder: Path, name: str, watchdog_s: float = 0.8) -> None:
        self.path = str(folder / name)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.path)
        self._socket.setblocking(False)
        self.told: list[str] = []
        self.environment = {
            **os.environ,
            "NOTIFY_SOCKET": self.path,
            "WATCHDOG_USEC": str(int(watchdog_s * 1e6)),
        }

    def hear(self) -> list[str]:
        while True:
            try:
                self.told.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return self.told

    def close(self) -> None:
        self._socket.close()


@pytest.mark.parametrize("unit", UNITS)
def test_systemd_finds_nothing_wrong_with_a_unit(unit: str, tmp_path: Path) -> None:
    text = (files("cpcbl_launch") / "systemd" / unit).read_text()
    assert COMMAND in text
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze here")
    path = tmp_path / unit.replace("@", "@r1")
    path.write_text(text.replace(COMMAND, sys.executable))
    words = ("systemd-analyze", "verify", "--man=no", "--recursive-errors=no", str(path))
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_runs_a_command_that_there_is(unit: str) -> None:
    text = (files("cpcbl_launch") / "systemd" / unit).read_text()
    line = next(line for line in text.splitlines() if line.startswith("ExecStart="))
    words = line.removeprefix(f"ExecStart={COMMAND} ").replace("%i", "r1").split()
    assert words[0] in ("robot", "router")
    assert "Usage: " in command_line(*words[:1], "--help").stdout


def test_robot_and_router_tell_that_they_are_ready_and_alive_until_they_hang(
    tmp_path: Path,
) -> None:
    endpoint, file = free_endpoint(), tmp_path / "floor.toml"
    file.write_text(TEAM)
    commands = (
        ("robot", file, "r1", "--connect", endpoint),
        ("router", file, "--listen", endpoint),
    )
    managers = [Manager(tmp_path, str(words[0])) for words in commands]
    robot, router = managers
    started = []
    try:
        started.append(_started(commands[0], robot))
        assert not robot.hear()  # it waits for its router: it is not ready
        started.append(_started(commands[1], router))
        for manager in managers:
            assert eventually(lambda m=manager: len(m.hear()) >= 5, 60.0)  # type: ignore[misc]
            assert manager.told[0] == "READY=1"
            assert set(manager.told[1:]) == {"WATCHDOG=1"}
        for process, manager in zip(started, managers, strict=True):
            process.send_signal(signal.SIGSTOP)
            manager.hear()
        before = [len(manager.hear()) for manager in managers]
        assert not eventually(lambda: [len(m.hear()) for m in managers] != before, 1.6)
    finally:
        for process in started:
            process.kill()
            process.communicate()
        for manager in managers:
            manager.close()


def _started(words: tuple[object, ...], manager: Manager) -> "subprocess.Popen[bytes]":
    command = [*PROGRAM, *map(str, words)]
    return subprocess.Popen(command, env=manager.environment, stderr=subprocess.DEVNULL)


def test_without_a_service_manager_nothing_is_told() -> None:
    def never() -> bool:
        return False

    assert not notify("READY=1", {})
    assert with_watchdog(never, {}) is never
    elsewhere = {"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}  # of the shell that started it
    assert with_watchdog(never, elsewhere) is never
    assert not notify("READY=1", {"NOTIFY_SOCKET": "/nobody/listens"})


def test_signs_of_life_are_no_more_than_the_service_manager_wants(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manager, now_ns = Manager(tmp_path, "socket", watchdog_s=10.0), [0]
    monkeypatch.setattr("time.monotonic_ns", lambda: now_ns[0])
    asked: Callable[[], bool] = with_watchdog(lambda: False, manager.environment)
    for _ in range(100):  # ten seconds
        assert not asked()
        now_ns[0] += 100_000_000
    assert manager.hear() == ["READY=1", *["WATCHDOG=1"] * 4]
    manager.close()
