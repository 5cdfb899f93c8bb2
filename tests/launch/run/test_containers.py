"""Teams in real containers: as good as processes, started again when killed, nothing is left."""

import json
import math
import os
import re
import secrets
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from support.docker import composed, image, left_of
from support.processes import cpcbl_team, eventually

from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.run.containers.docker import command_output
from cpcbl_launch.run.containers.fleet import SERVICE_LABEL
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_transport.zenoh_bus import open_bus

pytestmark = [pytest.mark.docker, pytest.mark.timeout(600)]

ROBOTS = {"navigator", "observer", "scout", "patrol"}
SERVICES = {"router", "field", *(f"robot-{name}" for name in ROBOTS)}


class Demo(NamedTuple):
    """The demonstration under a name of its own, helping almost from the start."""

    file: Path
    name: str
    endpoint: str

    @property
    def project(self) -> str:
        return f"cpcbl-{self.name}-"

    def containers(self) -> dict[str, str]:
        """Service -> id of the containers that run."""
        form = f'{{{{.Label "{SERVICE_LABEL}"}}}} {{{{.ID}}}}'
        listed = command_output(
            ["docker", "ps", "--filter", f"name={self.project}", "--format", form]
        )
        return dict(line.split() for line in listed.splitlines())


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[Demo]:
    with renamed("demo", tmp_path) as team:
        yield team


@contextmanager
def renamed(shipped: str, folder: Path) -> Iterator[Demo]:
    """Fails when a container or network of the team is left."""
    name, endpoint = f"{shipped}{secrets.token_hex(3)}", free_endpoint()
    text = builtin_path(shipped).read_text()
    text = text.replace(
        f'name = "{shipped}"', f'name = "{name}"\ntransport.listen = ["{endpoint}"]'
    )
    file = folder / "team.toml"
    file.write_text(text.replace("after_s = 10.0", "after_s = 2.0"))
    assert load_team(file).name == name
    team = Demo(file, name, endpoint)
    yield team
    assert left_of(team.project) == []


@contextmanager
def going_up(demo: Demo, *options: object, extras: str = "") -> Iterator["subprocess.Popen[str]"]:
    """`up --containers` as a process; stopped as a user would when the test fails."""
    command = [*PROGRAM, "up", demo.file, "--containers", "--image", image(extras), *options]
    with subprocess.Popen(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)


def when(demo: Demo, condition: Callable[[Recorder], bool]) -> None:
    """Waits for something that the robots say."""
    with open_bus(demo.name, [demo.endpoint]) as bus:
        recorder = Recorder(bus)
        assert eventually(lambda: condition(recorder), 90.0)


def assert_good(report: dict[str, Any]) -> None:
    assert report["robots"].keys() == ROBOTS
    for name, robot in report["robots"].items():
        assert robot["samples"] > 20, name
        assert robot["lost_at_end"] == "", name
    assert report["robots"]["observer"]["messages_sent"] > 0
    assert report["robots"]["observer"]["messages_received"] == 0
    assert report["robots"]["scout"]["messages_received"] > 0


def test_the_image_is_small_and_runs_as_nobody_on_a_read_only_file_system() -> None:
    confined = ["docker", "run", "--rm", "--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"]
    assert "demo: good" in command_output([*confined, image(), "check", "demo"])
    shell = [*confined, "--entrypoint", "sh", image(), "-c"]
    assert command_output([*shell, "id -u"]).strip() == "10001"
    assert command_output([*shell, "touch /x 2>&1 || echo refused"]).splitlines()[-1] == "refused"
    for heavy in ("cv2", "matplotlib", "hatchling", "pytest"):
        found = f"python3 -c 'import {heavy}' 2>&1 || echo absent"
        assert command_output([*shell, found]).splitlines()[-1] == "absent", heavy
    size = int(command_output(["docker", "image", "inspect", "--format", "{{.Size}}", image()]))
    assert size < 350e6


def test_a_team_in_containers_is_as_good_as_in_processes(demo: Demo, tmp_path: Path) -> None:
    options = ("--duration", 15, "--seed", 3, "--json")
    written, logs = tmp_path / "report.json", tmp_path / "logs"
    with going_up(demo, *options, "--report", written, "--logs", logs) as process:
        out, err = process.communicate(timeout=180.0)
    assert process.returncode == 0, err
    report = json.loads(out)
    assert report == json.loads(written.read_text())
    assert_good(report)
    assert report["restarts"] == {}
    assert "in containers: project cpcbl-demo" in err
    assert "taking the containers down" in err
    assert {path.stem for path in logs.glob("*.log")} == SERVICES
    assert "listens at tcp/0.0.0.0:7447" in (logs / "router.log").read_text()

    ran = cpcbl_team("up", demo.file, *options)
    assert ran.returncode == 0, ran.stderr
    processes = json.loads(ran.stdout)["team"]["position_rmse_m"]
    assert report["team"]["position_rmse_m"] < 1.5 * processes + 0.05


def test_robots_with_cameras_see_in_containers_too(tmp_path: Path) -> None:
    options = ("--duration", 12, "--seed", 3, "--json")
    with (
        renamed("eyes", tmp_path) as eyes,
        going_up(eyes, *options, extras="camera") as process,
    ):
        out, err = process.communicate()
        assert process.returncode == 0, err
    for name, robot in json.loads(out)["robots"].items():
        assert robot["lost_at_end"] == "", name
        assert robot["counts"]["frame"] > 20, name
        assert robot["position_rmse_m"] < 0.5, name


def test_containers_killed_by_hand_are_started_again_and_the_report_says_so(demo: Demo) -> None:
    with going_up(demo, "--duration", 25, "--json") as process:
        when(demo, lambda heard: len(heard.tracks.get("navigator", ())) > 50)
        killed = demo.containers()
        assert killed.keys() == SERVICES
        command_output(["docker", "kill", killed["robot-navigator"]])
        command_output(["docker", "rm", "--force", killed["robot-patrol"]])
        command_output(["docker", "kill", killed["router"]])
        out, err = process.communicate(timeout=180.0)
    assert process.returncode == 0, err
    report = json.loads(out)
    assert_good(report)
    assert report["restarts"] == {"router": 1, "robot-navigator": 1, "robot-patrol": 1}
    assert "container robot-navigator ended (137)" in err
    assert re.search("container robot-patrol (is gone|ended)", err)  # ended: while it is removed


def test_a_signal_takes_everything_down_and_the_report_is_written(demo: Demo) -> None:
    with going_up(demo, "--duration", 600, "--json") as process:
        when(demo, lambda heard: all(len(heard.tracks.get(n, ())) > 80 for n in ROBOTS))
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=60.0)
    assert process.returncode == 0, err
    assert_good(json.loads(out))


def test_a_signal_during_the_start_takes_everything_down(demo: Demo) -> None:
    with going_up(demo, "--duration", 600, "--json") as process:
        assert eventually(lambda: "router" in demo.containers(), 60.0)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60.0)


def test_nothing_is_left_when_nobody_reads_what_it_says(demo: Demo) -> None:
    with going_up(demo, "--duration", 600) as process:
        when(demo, lambda heard: bool(heard.tracks))
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        process.stderr.close()
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60.0)


def test_what_docker_cannot_do_is_one_line(demo: Demo) -> None:
    ended = cpcbl_team("up", demo.file, "--containers", "--image", "cpcbl-no-such-image:0")
    assert ended.returncode == 2
    assert "no image cpcbl-no-such-image:0" in ended.stderr.splitlines()[-1]

    nowhere = {**os.environ, "DOCKER_HOST": "unix:///nowhere/docker.sock"}
    command = [*PROGRAM, "up", str(demo.file), "--containers"]
    lone = subprocess.run(command, env=nowhere, capture_output=True, text=True, check=False)
    assert lone.returncode == 2
    assert "no Docker daemon answers" in lone.stderr.splitlines()[-1]
    assert "docker/dockerd.sh start" in lone.stderr.splitlines()[-1]


def test_a_port_that_is_taken_is_one_line_and_nothing_is_left(demo: Demo) -> None:
    with going_up(demo, "--duration", 600) as first:
        when(demo, lambda heard: bool(heard.tracks))
        second = cpcbl_team("up", demo.file, "--containers", "--image", image())
        assert second.returncode == 2
        assert "port is already allocated" in second.stderr.splitlines()[-1]
        assert demo.containers().keys() == SERVICES
        first.send_signal(signal.SIGINT)
        first.communicate(timeout=60.0)


def healths(ids: list[str]) -> set[str]:
    return set(
        command_output(["docker", "inspect", "--format", "{{.State.Health.Status}}", *ids]).split()
    )


def test_the_committed_compose_file_runs_and_a_robot_that_crashes_comes_back(
    tmp_path: Path,
) -> None:
    with (
        composed("compose.yaml", tmp_path, ("7447",)) as (project, (endpoint,)),
        open_bus("demo", [endpoint]) as bus,
    ):
        recorder = Recorder(bus)
        assert eventually(lambda: recorder.tracks.keys() == ROBOTS, 60.0)
        watching = ("--connect", endpoint, "--duration", 3, "--json")
        seen = cpcbl_team("traffic", "demo", *watching)
        assert json.loads(seen.stdout)["robots"].keys() == ROBOTS
        containers = project.containers()
        assert containers.keys() == SERVICES
        ids = [container.id for container in containers.values()]
        assert eventually(lambda: healths(ids) == {"healthy"}, 60.0)

        os.kill(containers["robot-navigator"].pid, signal.SIGKILL)

        def is_back_and_knows_where_it_is() -> bool:
            tracks, _, truths = recorder.latest()
            track, truth = tracks["navigator"], truths["navigator"]
            error_m = math.hypot(track.x_m - truth.x_m, track.y_m - truth.y_m)
            restarts = project.containers()["robot-navigator"].restarts
            return restarts == 1 and not track.lost and error_m < 0.3

        assert eventually(is_back_and_knows_where_it_is, 60.0)


def observing(demo: Demo, *options: object) -> list[str]:
    at = ("--at", "4.5,6,-90", "--connect", demo.endpoint, "--image", image())
    command = (*PROGRAM, "observer", demo.file, "tripod", *at, "--container", *options)
    return list(map(str, command))


def test_an_observer_in_a_container_helps_a_team_in_containers_and_leaves(demo: Demo) -> None:
    sensor = demo.file.parent / "a camera, of ours.toml"
    sensor.write_text("sensor = { range_share = 0.005, field_of_view_deg = 180.0 }\n")
    with going_up(demo, "--duration", 600, "--json") as process:
        when(demo, lambda heard: "scout" in heard.tracks)
        ended = subprocess.run(
            observing(demo, "--duration", 6, "--json", "--sensor", sensor, "--fov", 170),
            capture_output=True,
            text=True,
            timeout=90.0,
            check=False,
        )
        assert ended.returncode == 0, ended.stderr
        visited = json.loads(ended.stdout)
        assert visited["name"] == "tripod"
        assert visited["lost"] == ""
        assert {row["peer"] for row in visited["sent"] if row["topic"] == "fix"} & ROBOTS
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60.0)
    assert "tripod" in json.loads(out)["guests"]
