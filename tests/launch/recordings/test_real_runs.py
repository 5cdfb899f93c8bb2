"""Real processes over Zenoh, killed while they record: three replays are equal to the bit."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from support.processes import command_line, eventually, pids_of
from support.programs import Program, programs

from cpcbl_launch.recordings.read import Run, read_run
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import builtin_path

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]
SECONDS = 60.0


def command(*words: object) -> tuple[str, ...]:
    return *PROGRAM, *map(str, words)


def require_three_equal_replays(folder: Path, processes: int) -> None:
    """Each in a process of its own, with other hashes."""
    for seed in "1", "2", "3":
        environment = {
            **os.environ,
            "PYTHONHASHSEED": seed,
            "PYTHONPATH": os.pathsep.join(sys.path),
        }
        done = subprocess.run(
            command("replay", folder), env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert done.stdout.count(": equal to the bit: ") == processes, done.stdout


def seconds(run: Run) -> dict[str, list[float]]:
    """How long each process of each robot recorded, by its robot's clock."""
    return {
        robot: [
            ([*process.steps()][-1].now_ns - process.header.start_ns) * 1e-9
            for process in processes
        ]
        for robot, processes in run.processes.items()
    }


def kill(*words: str) -> None:
    """Kills the one process whose command line holds these words."""
    (pid,) = pids_of(words)
    os.kill(pid, signal.SIGKILL)


def test_a_robot_the_router_and_the_launcher_are_killed(tmp_path: Path) -> None:
    endpoint, folder = free_endpoint(), tmp_path / "run"
    router = command("router", "demo", "--listen", endpoint)
    up = command("up", "demo", "--connect", endpoint, "--record", folder)
    with ExitStack() as stack:
        first = stack.enter_context(programs(tmp_path, router=router))["router"]
        launcher = Program(tmp_path, "up", *up, "--duration", str(10.0 * SECONDS)).process
        began_s = time.monotonic()
        assert eventually(lambda: len(list(folder.glob("*/*.cpcbl"))) == 4)
        _sleep_until(began_s + 0.3 * SECONDS)
        kill(endpoint, " robot ", "scout")
        _sleep_until(began_s + 0.5 * SECONDS)
        first.process.kill()
        _sleep_until(began_s + 0.55 * SECONDS)
        stack.enter_context(programs(tmp_path, again=router))
        _sleep_until(began_s + SECONDS)
        launcher.kill()
        launcher.wait()
        assert eventually(lambda: not pids_of([endpoint, " robot "]))  # they follow
    lasted = seconds(read_run(folder))
    assert {robot: len(of_robot) for robot, of_robot in lasted.items()} == {
        "navigator": 1,
        "observer": 1,
        "patrol": 1,
        "scout": 2,
    }
    assert lasted["navigator"][0] > SECONDS - 10.0
    assert lasted["scout"][0] > 0.3 * SECONDS - 10.0
    require_three_equal_replays(folder, 5)


def _sleep_until(then_s: float) -> None:
    time.sleep(max(0.0, then_s - time.monotonic()))


TEAM = """{eyes}
[defaults.collaboration.budget]
bytes_per_s = 200.0

[transport]
security = "mtls"
listen = ["{near}"]
connect = ["{near}"]
"""


@contextmanager
def two_sites(folder: Path, team: Path, near: str, far: str, record: Path) -> Iterator[None]:
    """A secured team with cameras at two routers, and a guest."""
    with ExitStack() as stack:

        def start(name: str, *words: object) -> None:
            stack.enter_context(programs(folder, **{name: command(*words)}))

        start("near", "router", team, "--listen", near)
        start("far", "router", team, "--listen", far, "--connect", near)
        sites = "--connect", near, "--site", f"{far}=rover2,follower"
        for robot, router in _sites(near, far):
            start(robot, "robot", team, robot, "--connect", router, "--record", record)
        start("field", "field", team, *sites)
        at = "--at", "5,1,90", "--duration", 0.6 * SECONDS
        start("guest", "observer", team, "tripod", *at, "--connect", near, "--record", record)
        yield


def _sites(near: str, far: str) -> Sequence[tuple[str, str]]:
    return ("spotter", near), ("rover1", near), ("rover2", far), ("follower", far)


def test_cameras_guests_budgets_keys_and_two_sites(tmp_path: Path) -> None:
    near, far, folder = free_endpoint("tls"), free_endpoint("tls"), tmp_path / "run"
    team = tmp_path / "team.toml"
    eyes = builtin_path("eyes").read_text(encoding="utf-8")
    team.write_text(TEAM.format(eyes=eyes, near=near), encoding="utf-8")
    keys = command_line("keys", team, "--observer", "tripod")
    assert keys.returncode == 0, keys.stderr
    with two_sites(tmp_path, team, near, far, folder):
        began_s = time.monotonic()
        assert eventually(lambda: len(list(folder.glob("*/*.cpcbl"))) == 5)
        _sleep_until(began_s + 0.5 * SECONDS)
        kill(str(team), " robot ", "rover2")
        _sleep_until(began_s + SECONDS)
    run = read_run(folder)
    assert set(run.processes) == {"follower", "rover1", "rover2", "spotter", "tripod"}
    kinds = {
        type(entry).__name__
        for process in run.processes_of(())
        for step in process.steps()
        for entry in step.entries
    }
    assert {"Detected", "FrameTaken", "MessageTaken", "Put"} <= kinds
    require_three_equal_replays(folder, 5)
