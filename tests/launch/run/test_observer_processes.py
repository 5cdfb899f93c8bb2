"""Observers as processes and containers that join a running team."""

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.buses import PATIENCE_S
from support.docker import image, left_of
from support.observers import BLIND, changed
from support.processes import eventually, pids_of
from support.routers import open_router

import cpcbl_launch
from cpcbl_launch.reporting.metrics import seconds
from cpcbl_launch.reporting.phases import presence_spans
from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.run.containers.compose import Mount
from cpcbl_launch.run.containers.launch import KEYS_INSIDE, docker_run, mounts_of_keys
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import Run, free_endpoint, run_team
from cpcbl_launch.team.file import save_resolved
from cpcbl_team.config import TransportSettings
from cpcbl_transport import topics
from cpcbl_transport.messages import Status, decode_tagged
from cpcbl_transport.security import CA, CERTIFICATE, PRIVATE_KEY, SecurityError

SHIPPED = Path(cpcbl_launch.__file__).parent / "observers"


DRIVER = Path(__file__).parents[3] / "docs" / "tripod_driver.py"


STAY_S = 5.0  # of a guest, longer than it takes to help everybody


class View:
    """Acts on a run step by step: each waits for its condition."""

    def __init__(self, *steps: Callable[[Recorder], bool]) -> None:
        self._steps = list(steps)

    def show(self, recorder: Recorder, supervisor: object, elapsed_s: float) -> None:
        if self._steps and self._steps[0](recorder):
            self._steps.pop(0)

    def done(self) -> bool:
        return not self._steps


def sigma_m(recorder: Recorder, robot: str) -> float:
    """The robot's latest."""
    track = recorder.latest()[0][robot]
    assert track.covariance is not None
    return math.sqrt(0.5 * (track.covariance[0] + track.covariance[2]))


class Team3:
    """The blind team as processes, and observers that join it."""

    def __init__(self, folder: Path) -> None:
        self.endpoint, self.file = free_endpoint(), folder / "blind.json"
        transport = TransportSettings(listen=(self.endpoint,), connect=(self.endpoint,))
        self.team = changed(transport=transport)
        save_resolved(self.team, self.file)
        self.folder = folder
        self.observers: list[subprocess.Popen[str]] = []
        self.said: list[tuple[str, str]] = []
        """What each has written to standard output and error, once the run is over."""

    def observe(self, *more: str) -> bool:
        command = [*PROGRAM, "observer", str(self.file), "tripod", "--at", "4.5,6,-90"]
        self.observers.append(
            subprocess.Popen(
                [*command, *more],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        )
        return True

    def run(self, *steps: Callable[[Recorder], bool], limit_s: float = 90.0) -> Report:
        view = View(*steps)
        try:
            report = run_team(
                Run(self.team, limit_s, seed=3, folder=self.folder / "logs"), view.show, view.done
            )
        finally:
            for process in self.observers:
                if process.poll() is None:
                    process.kill()
                self.said.append(process.communicate())
        logs = "".join(f"\n{p.name}:\n{p.read_text()}" for p in self.folder.rglob("*.log"))
        assert view.done(), f"it did not get to its end{logs}"
        return report

    def all_lose_their_way(self, recorder: Recorder) -> bool:
        there = recorder.latest()[0].keys() >= self.team.robots.keys()
        return there and all(sigma_m(recorder, name) > 0.15 for name in self.team.robots)

    def all_know_their_place(self, recorder: Recorder) -> bool:
        return all(sigma_m(recorder, name) < 0.05 for name in self.team.robots)

    def guest_stays(self, recorder: Recorder) -> bool:
        spans = presence_spans(seconds(recorder.trajectory("tripod").stamps_ns).tolist())
        return any(span.until_s - span.from_s > STAY_S for span in spans)

    def guest_has_left(self, recorder: Recorder) -> bool:
        status = recorder.latest()[1]
        return all(status[name].counts.get("guest_left") for name in self.team.robots)


@pytest.fixture
def team3(tmp_path: Path) -> Team3:
    return Team3(tmp_path)


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        pytest.param(signal.SIGTERM, marks=pytest.mark.long),
        pytest.param(signal.SIGKILL, marks=pytest.mark.thorough),
    ],
)
def test_an_observer_joins_a_running_team_and_leaves_it(
    team3: Team3, number: signal.Signals
) -> None:
    """Another one of the same name is not let in meanwhile."""
    gone: list[int] = []

    def second_is_over(recorder: Recorder) -> bool:
        return team3.observers[1].poll() is not None

    def leaves(recorder: Recorder) -> bool:
        process = team3.observers[0]
        process.send_signal(number)
        gone.append(process.wait(timeout=PATIENCE_S))
        return True

    report = team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe(),
        team3.all_know_their_place,
        lambda recorder: team3.observe(),
        second_is_over,
        team3.guest_stays,
        leaves,
        team3.guest_has_left,
        team3.all_lose_their_way,
        lambda recorder: "tripod" not in recorder.latest()[2],
    )
    assert gone == [{signal.SIGKILL: -number, signal.SIGINT: 130}.get(number, 0)]
    (said, _), (_, refused) = team3.said
    assert team3.observers[1].returncode == 2
    assert "the team has one of this name" in refused
    assert "tripod joins team blind" in said
    if number is not signal.SIGKILL:
        assert "tripod took part for" in said
        assert "fix sent to r1" in said
    guest = report.guests["tripod"]
    assert guest.position_rmse_m is not None
    assert guest.position_rmse_m < 0.05
    for name, effect in guest.robots.items():
        before, during = effect.before.position_sigma_m, effect.during.position_sigma_m
        assert before is not None
        assert during is not None
        assert during < before, name
    assert report.restarts == {}
    assert report.robots.keys() == team3.team.robots.keys()
    assert all(robot.lost_at_end == "" for robot in report.robots.values())
    assert not pids_of([str(team3.file)])


@pytest.mark.docker
@pytest.mark.timeout(600)
def test_an_observer_in_a_container_does_the_same(team3: Team3, tmp_path: Path) -> None:
    sensor = tmp_path / "eyes.toml"
    sensor.write_text((SHIPPED / "survey.toml").read_text())
    own = ("--container", "--image", image(), "--sensor", str(sensor), "--json")

    def leaves(recorder: Recorder) -> bool:
        team3.observers[0].send_signal(signal.SIGINT)
        return team3.observers[0].wait(timeout=PATIENCE_S) == 130

    team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe(*own),
        team3.all_know_their_place,
        leaves,
        team3.guest_has_left,
    )
    said = json.loads(team3.said[0][0])
    assert {flow["peer"] for flow in said["sent"] if flow["topic"] == "fix"} == {"r1", "r2", "r3"}
    assert left_of("cpcbl-tripod-") == []


def test_a_container_may_read_the_keys_of_its_observer_and_of_nobody_else(tmp_path: Path) -> None:
    transport = TransportSettings(security="mtls", keys=str(tmp_path))
    with pytest.raises(SecurityError, match="observer/tripod"):
        mounts_of_keys("tripod", changed(transport=transport))
    mine = tmp_path / "observer" / "tripod"
    mine.mkdir(parents=True)
    for name in (CA, CERTIFICATE, PRIVATE_KEY):
        (mine / name).touch()
    (mount,) = mounts_of_keys("tripod", changed(transport=transport))
    assert mount == Mount(str(mine), f"{KEYS_INSIDE}/observer/tripod")
    command = docker_run("it", "image", [mount], "7:8", ["observer", "tripod"])
    assert command[command.index("--volume") + 1].endswith("/observer/tripod:ro")
    assert command[command.index("--user") + 1] == "7:8"
    assert command[-3:] == ["image", "observer", "tripod"]
    assert mounts_of_keys("tripod", BLIND) == []


@pytest.mark.thorough
def test_after_its_time_an_observer_leaves_and_says_what_it_did(team3: Team3) -> None:
    def over(recorder: Recorder) -> bool:
        return team3.observers[0].poll() is not None

    team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe("--duration", "4", "--json"),
        over,
        team3.guest_has_left,
    )
    said = json.loads(team3.said[0][0])
    assert said["name"] == "tripod"
    assert said["seconds"] == pytest.approx(4.0, abs=0.5)
    assert said["lost"] == said["unfed"] == ""
    assert {flow["peer"] for flow in said["sent"] if flow["topic"] == "fix"} >= {"r1"}
    assert said["counts"]["sightings"] > 20


@pytest.mark.thorough
def test_a_field_that_is_restarted_has_its_guests_again(team3: Team3) -> None:
    def field_dies(recorder: Recorder) -> bool:
        (pid,) = pids_of(["cpcbl_launch field", team3.endpoint])
        os.kill(pid, signal.SIGKILL)
        return True

    heard: list[int] = []

    def field_is_gone(recorder: Recorder) -> bool:
        heard[:] = [len(recorder.truths)]
        return not pids_of(["cpcbl_launch field", team3.endpoint])

    def guest_is_on_the_new_field(recorder: Recorder) -> bool:
        return len(recorder.truths) > heard[0] and "tripod" in recorder.latest()[2]

    report = team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe(),
        lambda recorder: "tripod" in recorder.latest()[2],
        field_dies,
        field_is_gone,
        guest_is_on_the_new_field,
    )
    assert report.restarts == {"field": 1}


def test_a_real_tripod_is_fed_by_its_own_driver(tmp_path: Path) -> None:
    """A team of real robots, of which the test plays none: the tripod knows its place and sees."""
    endpoint, file = free_endpoint(), tmp_path / "lab.toml"
    file.write_text(
        'name = "lab"\n[robots.r1]\nsource = "external"\nodometry = { moves = false }\n'
        "start = { x_m = 0.1, y_m = 0.0, sigma_m = 0.5 }\n"
        f'[transport]\nconnect = ["{endpoint}"]\n'
    )
    heard: dict[str, Status] = {}

    def hear(key: str, payload: bytes) -> None:
        status = decode_tagged(payload)
        assert isinstance(status, Status)
        heard[status.robot] = status

    commands = [
        [*PROGRAM, "robot", str(file), "r1", "--connect", endpoint],
        [
            *(*PROGRAM, "observer", str(file), "tripod", "--at", "2,0,180"),
            *("--connect", endpoint),
        ],
        [sys.executable, str(DRIVER), str(file), "tripod"],
    ]
    with open_router("lab", [endpoint]) as bus:
        bus.subscribe(topics.STATUS.at(), hear)
        processes = [
            subprocess.Popen(c, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            for c in commands
        ]
        try:
            assert eventually(
                lambda: "r1" in heard and any(f.peer == "tripod" for f in heard["r1"].heard)
            )
            assert eventually(lambda: heard["r1"].position_sigma_m < 0.05)
            assert eventually(
                lambda: "tripod" in heard and heard["tripod"].counts.get("sightings", 0) > 0
            )
        finally:
            for process in processes:
                process.send_signal(signal.SIGINT)
                process.wait(timeout=30.0)
    assert heard["r1"].counts["guest_joined"] == 1
