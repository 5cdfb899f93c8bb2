"""Real processes over real Zenoh: a team comes up, loses a robot, gets it back, and ends."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from support.buses import Subscription, robot_at, team_of, wait_until
from support.processes import command_of, eventually
from support.routers import open_router

from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.run.processes import PROGRAM, Processes, ProcessSpec, Supervisor
from cpcbl_launch.run.up import Run, free_endpoint, run_team
from cpcbl_launch.team.file import builtin_path, load_team, save_resolved
from cpcbl_team.config import GuardSettings, Team, TransportSettings
from cpcbl_transport import topics
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import open_bus

ROBOTS = ("navigator", "observer", "scout", "patrol")


def demo_team() -> Team:
    """The demonstration, helping from the start."""
    team = load_team(builtin_path("demo"))
    robots = {
        name: msgspec.structs.replace(
            robot, collaboration=msgspec.structs.replace(robot.collaboration, after_s=0.0)
        )
        for name, robot in team.robots.items()
    }
    return msgspec.structs.replace(team, robots=robots)


class Script:
    """A view that acts: every step waits for its condition, then does something."""

    def __init__(self, *steps: Callable[[Recorder, Processes], bool]) -> None:
        self._steps = list(steps)

    def show(self, recorder: Recorder, processes: Processes, elapsed_s: float) -> None:
        if self._steps and self._steps[0](recorder, processes):
            self._steps.pop(0)

    def done(self) -> bool:
        return not self._steps


def run(script: Script, team: Team, folder: Path, limit_s: float = 60.0) -> Report:
    """Runs a team until its script is done; fails when that takes too long."""
    until = time.monotonic() + limit_s
    report = run_team(
        Run(team, None, seed=3, folder=folder),
        script.show,
        lambda: script.done() or time.monotonic() > until,
    )
    logs = "".join(f"\n{p.name}:\n{p.read_text()}" for p in folder.glob("*.log"))
    assert script.done(), f"the script did not get to its end{logs}"
    return report


@pytest.mark.thorough  # `make chaos` does it as well
def test_kills_one_of_four_robot_processes_and_it_localizes_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cpcbl_launch.run.up.LEAD_S", 5.0)  # who starts late would be helped
    killed: dict[str, int] = {}
    seen: dict[str, int] = {}
    incarnations: dict[str, str] = {}

    def all_run(recorder: Recorder, supervisor: Processes) -> bool:
        return recorder.tracks.keys() == set(ROBOTS) and all(
            len(t) > 20 for t in recorder.tracks.values()
        )

    def kill_navigator(recorder: Recorder, supervisor: Processes) -> bool:
        if recorder.latest()[1].keys() != set(ROBOTS):
            return False
        seen.update(supervisor.pids)
        incarnations.update({n: s.incarnation for n, s in recorder.latest()[1].items()})
        for name in ROBOTS:
            assert f" {name} --connect" in command_of(supervisor.pids[f"robot-{name}"])
        assert len(set(seen.values())) == len(ROBOTS) + 1
        killed.update({name: len(t) for name, t in recorder.tracks.items()})
        os.kill(seen["robot-navigator"], signal.SIGKILL)
        return True

    def others_go_on(recorder: Recorder, supervisor: Processes) -> bool:
        return all(len(recorder.tracks[n]) > killed[n] + 10 for n in ROBOTS if n != "navigator")

    def it_is_back_and_knows_where_it_is(recorder: Recorder, supervisor: Processes) -> bool:
        tracks, statuses, truths = recorder.latest()
        new_pid = supervisor.pids.get("robot-navigator")
        if new_pid in (None, seen["robot-navigator"]):
            return False
        if statuses["navigator"].incarnation == incarnations["navigator"]:
            return False
        track, truth = tracks["navigator"], truths["navigator"]
        error = ((track.x_m - truth.x_m) ** 2 + (track.y_m - truth.y_m) ** 2) ** 0.5
        return not track.lost and error < 0.3

    script = Script(all_run, kill_navigator, others_go_on, it_is_back_and_knows_where_it_is)
    report = run(script, demo_team(), tmp_path)
    assert report.restarts == {"robot-navigator": 1}
    for name, robot in report.robots.items():
        assert robot.samples > 0, name
        assert robot.lost_at_end == "", name
    assert report.robots["observer"].messages_sent > 0
    assert report.robots["observer"].messages_received == 0
    assert not [pid for pid in seen.values() if command_of(pid)]


def test_robots_that_know_neither_map_nor_start_agree_on_a_frame(tmp_path: Path) -> None:
    """Also the best one, when it is started again: the others still are in its first frame."""
    frames: dict[str, str] = {}
    incarnation = ""

    def in_one_frame(recorder: Recorder) -> bool:
        tracks, statuses, _ = recorder.latest()
        frames.update({name: track.frame for name, track in tracks.items()})
        told = {status.frame for status in statuses.values()}
        return len(tracks) == len(statuses) == 3 and told == set(frames.values()) == {first()}

    def first() -> str:
        return next((f for f in frames.values() if f.startswith("pioneer.")), "none")

    def all_in_one_then_one_is_killed(recorder: Recorder, supervisor: Processes) -> bool:
        nonlocal incarnation
        errors_m = recorder.latest_errors_m()
        if not in_one_frame(recorder) or len(errors_m) < 3 or max(errors_m.values()) > 0.5:
            return False
        incarnation = recorder.latest()[1]["pioneer"].incarnation
        os.kill(supervisor.pids["robot-pioneer"], signal.SIGKILL)
        return True

    def it_is_back_in_the_frame_of_the_others(recorder: Recorder, supervisor: Processes) -> bool:
        is_new = recorder.latest()[1]["pioneer"].incarnation != incarnation
        return is_new and in_one_frame(recorder)

    script = Script(all_in_one_then_one_is_killed, it_is_back_in_the_frame_of_the_others)
    report = run(script, load_team(builtin_path("unmapped")), tmp_path)
    assert {robot.frame for robot in report.robots.values()} == {first()}
    assert report.robots["pioneer"].counts["frame_joined"] == 1
    assert report.team.inside_3_sigma is not None
    assert report.team.inside_3_sigma > 0.9


def test_a_process_that_keeps_dying_is_restarted_ever_later(tmp_path: Path) -> None:
    fails = ProcessSpec("fails", (sys.executable, "-c", "raise SystemExit(3)"))
    with Supervisor([fails], tmp_path) as supervisor:
        until = time.monotonic() + 20.0
        while supervisor.restarts.get("fails", 0) < 2 and time.monotonic() < until:
            supervisor.watch()
            time.sleep(0.01)
        assert supervisor.restarts == {"fails": 2}
        assert supervisor._children["fails"].backoff_s > 1.0


def test_a_process_that_ignores_sigint_is_killed(tmp_path: Path) -> None:
    stubborn = (
        "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN);"
        "open('ready', 'w').close(); time.sleep(60)"
    )
    code = f"import os; os.chdir({str(tmp_path)!r}); {stubborn}"
    spec = ProcessSpec("stubborn", (sys.executable, "-c", code))
    with Supervisor([spec], tmp_path) as supervisor:
        until = time.monotonic() + 20.0
        while not (tmp_path / "ready").exists() and time.monotonic() < until:
            time.sleep(0.01)
        pid = supervisor.pids["stubborn"]
    assert not command_of(pid)


@pytest.fixture
def lone_robot(tmp_path: Path) -> tuple[list[str], str, Team]:
    """(command, endpoint, team) of one robot process whose router the test opens."""
    team = demo_team()
    path = tmp_path / "team.json"
    save_resolved(team, path)
    endpoint = free_endpoint()
    command = [*PROGRAM, "robot", str(path), "observer", "--connect", endpoint]
    return command, endpoint, team


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_robot_soon(
    lone_robot: tuple[list[str], str, Team], number: signal.Signals
) -> None:
    command, endpoint, team = lone_robot
    alive: dict[str, bool] = {}
    with open_router(team.name, [endpoint]) as bus:
        bus.watch_liveliness(topics.ALIVE.at(robot="observer"), alive.__setitem__)
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            assert eventually(lambda: any(alive.values())), process.stderr
            process.send_signal(number)
            assert process.wait(timeout=30.0) == (130 if number == signal.SIGINT else 0)
        assert eventually(lambda: not any(alive.values()))


def test_a_robot_waiting_for_its_router_can_be_stopped(
    lone_robot: tuple[list[str], str, Team],
) -> None:
    command, endpoint, _ = lone_robot
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "no router" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30.0) == 130
        assert endpoint in process.stderr.read().splitlines()[-1]


def test_a_robot_ends_when_its_launcher_is_gone(
    lone_robot: tuple[list[str], str, Team],
) -> None:
    command, endpoint, team = lone_robot
    alive: dict[str, bool] = {}
    launcher = (
        "import subprocess, sys, os, time;"
        f"p = subprocess.Popen({command!r} + ['--parent', str(os.getpid())]);"
        "print(p.pid, flush=True); sys.stdin.read()"
    )
    with open_router(team.name, [endpoint]) as bus:
        bus.watch_liveliness(topics.ALIVE.at(robot="observer"), alive.__setitem__)
        with subprocess.Popen(
            [sys.executable, "-c", launcher],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as parent:
            assert eventually(lambda: any(alive.values()))
            parent.kill()
        assert eventually(lambda: not any(alive.values()))


def test_the_router_of_a_run_has_the_teams_guards(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    guards = GuardSettings(fix_rate_hz=0.01, largest_help_bytes=100)
    transport = TransportSettings(listen=(endpoint,), guards=guards)
    team = msgspec.structs.replace(team_of(me=robot_at()), transport=transport)
    key = topics.FIX.at(robot="me", tier=0, observer="faulty")

    def flooded(recorder: Recorder, supervisor: Processes) -> bool:
        with open_bus(team.name, [endpoint]) as me, open_bus(team.name, [endpoint]) as faulty:
            ear = Subscription(me, "**")  # one subscription: in order
            fix, last = faulty.publisher(key, Qos.INPUT), faulty.publisher("in/me/last", Qos.INPUT)
            wait_until(lambda: fix.matching and last.matching)
            for size in (100, 100, 100, 101):
                fix.put(bytes(size))
            last.put(b"last")
            wait_until(lambda: b"last" in ear.payloads)
            assert [len(payload) for heard, payload in ear.samples if heard == key] == [100]
        return True

    script = Script(flooded)
    run_team(Run(team, None, folder=tmp_path, here=()), script.show, script.done)
    assert script.done()
