"""Robots, router and drivers, started in any order by real processes: when `start` is kept."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from subprocess import PIPE, Popen

import pytest
from support.buses import SECOND

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.inputs import Odometry
from cpcbl_transport import topics
from cpcbl_transport.decoding import Subscriber
from cpcbl_transport.messages import Status, encode
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

TEAM = """
name = "floor"
[robots.r1]
source = "external"
start = { x_m = 1.0, y_m = 2.0 }
[map.landmarks]
door = { x_m = 5.0, y_m = 1.0 }
"""
PATIENCE_S = 60.0


class Floor:
    """A team file, and the processes that a test starts of it."""

    def __init__(self, folder: Path) -> None:
        self.file, self.endpoint = folder / "floor.toml", free_endpoint()
        self.file.write_text(TEAM)
        self.stack = ExitStack()

    def router(self) -> "Popen[str]":
        return self._start("router", self.file, "--listen", self.endpoint)

    def robot(self, *more: str) -> "Popen[str]":
        return self._start("robot", self.file, "r1", "--connect", self.endpoint, *more)

    def bus(self) -> ZenohBus:
        return self.stack.enter_context(open_bus("floor", [self.endpoint]))

    def _start(self, *arguments: object) -> "Popen[str]":
        command = [*PROGRAM, *map(str, arguments)]
        process = Popen(command, stderr=PIPE, text=True)
        self.stack.callback(end, process)
        return process


def end(process: "Popen[str]") -> str:
    """Kills a process; what it said, if it was not killed before."""
    if process.returncode is not None:
        return ""
    process.kill()
    return process.communicate()[1]


@pytest.fixture
def floor(tmp_path: Path) -> Iterator[Floor]:
    floor = Floor(tmp_path)
    with floor.stack:
        yield floor


class Driver:
    """Publishes odometry of r1, and hears what r1 says of itself."""

    def __init__(self, bus: ZenohBus) -> None:
        self._out = bus.publisher(topics.IN_ODOMETRY.at(robot="r1"), topics.IN_ODOMETRY.qos)
        self._statuses: list[Status] = []
        self._ear = Subscriber(bus, Status, lambda r: self._statuses.append(r.message))
        self._last_ns = time.time_ns()

    def drive_until(self, condition: Callable[[Status], bool], metres: float = 0.0) -> Status:
        """So many metres a piece, ten pieces a second, until a status is as it should be."""
        self._statuses.clear()
        until = time.monotonic() + PATIENCE_S
        while not any(map(condition, self._statuses)):
            assert time.monotonic() < until, self._statuses[-1:]
            time.sleep(0.1)
            from_ns, self._last_ns = self._last_ns, time.time_ns()
            self._out.put(encode(Odometry(from_ns, self._last_ns, metres, 0.0)))
        return next(filter(condition, self._statuses))


def is_fed(status: Status) -> bool:
    return any(health.taken > 5 for health in status.inputs)


def test_a_robot_keeps_its_start_in_any_order_until_it_was_restarted_after_it_moved(
    floor: Floor,
) -> None:
    robot = floor.robot()
    assert robot.stderr is not None
    assert "waiting for it" in robot.stderr.readline()
    time.sleep(1.5)  # longer than a robot once could wait
    floor.router()
    driver = Driver(floor.bus())
    assert driver.drive_until(is_fed).lost == ""  # router last, driver last
    said = end(robot)
    for words in (f"r1: connected to team floor at {floor.endpoint}", "r1: waiting for its inputs"):
        assert words in said
    assert "r1: first odometry" in said

    robot = floor.robot()  # driver and router first; restarted before it moved
    assert driver.drive_until(is_fed).lost == ""
    fed_ns = time.time_ns()
    driver.drive_until(lambda s: s.stamp_ns > fed_ns + 3 * SECOND, metres=0.05)
    end(robot)

    robot = floor.robot()
    assert driver.drive_until(is_fed).lost != ""  # it may be anywhere now
    assert "r1: has moved since the team started" in end(robot)

    robot = floor.robot("--no-restarted")
    assert driver.drive_until(is_fed).lost == ""


def test_a_second_process_of_a_robot_ends_with_one_line_and_the_first_goes_on(
    floor: Floor,
) -> None:
    floor.router()
    first = floor.robot()
    driver = Driver(floor.bus())
    incarnation = driver.drive_until(is_fed).incarnation
    second = floor.robot()
    said = second.communicate(timeout=PATIENCE_S)[1]
    assert second.returncode == 2
    assert "robot r1: another process is this robot already" in said.splitlines()[-1]
    assert incarnation in said
    assert driver.drive_until(is_fed).incarnation == incarnation
    assert first.poll() is None
