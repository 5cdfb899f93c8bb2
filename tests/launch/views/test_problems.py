"""What people read of problems, in the live table, the traffic view and the report."""

import io
import time
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from rich.console import Console, RenderableType
from support.buses import SECOND
from support.traffic import recorded, seen, shown, status

from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.views.run import LiveTable
from cpcbl_launch.views.traffic import traffic_from_statuses
from cpcbl_launch.views.traffic_tables import traffic_view
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import InputHealth, Tagged, Track, encode

UNCONFIRMED = "the pose is not confirmed: it stood"
SILENT = "no odometry on in/r1/odometry for 4 s"
HEALTH = InputHealth("odometry", 0.0, 5, 100, {"too_late": 3}, 0.5)


class TwoProcesses:
    """Robots r1 and r2 run."""

    names, pids, restarts = ["robot-r1", "robot-r2"], {"robot-r1": 1, "robot-r2": 2}, {"x": 0}

    def watch(self) -> None: ...


class Table:
    """A live table, and what is published to it."""

    def __init__(self) -> None:
        hub = MemoryHub()
        self.recorder, self._speaker = Recorder(hub.session()), hub.session()
        self._console = Console(file=io.StringIO(), width=80)
        self._table = LiveTable("team", ["r1", "r2"], self._console)

    def put(self, key: str, message: Tagged) -> None:
        self._speaker.publisher(key, topics.STATUS.qos).put(encode(message))

    def tracks(self, stamp_ns: int, *names: str) -> None:
        for name in names:
            track = Track(name, stamp_ns, 1.0, 2.0, 0.0, (0.01, 0.0, 0.01, 0.0, 0.0, 0.01), 3)
            self.put(topics.TRACK.at(robot=name), track)

    def rows(self) -> dict[str, str]:
        """The lines of the table by their first words."""
        text = drawn(self._console, self._table._table_and_problems, self.recorder)
        return {
            line.split()[0]: " ".join(line.split()) for line in text.splitlines() if line.split()
        }


def drawn(console: Console, table: Callable[..., RenderableType], recorder: Recorder) -> str:
    with console.capture() as capture:
        console.print(table(recorder, TwoProcesses(), 1.0))
    return capture.get()


@pytest.mark.parametrize(
    ("state", "key", "wrong", "right", "text"),
    [
        ("problem", "problems", (SILENT,), (), SILENT),
        ("unconfirmed", "unconfirmed", UNCONFIRMED, "", UNCONFIRMED),
    ],
)
def test_a_robot_with_a_problem_or_an_unconfirmed_pose_is_not_ok_in_the_live_table(
    state: str, key: str, wrong: Any, right: Any, text: str
) -> None:
    table = Table()
    table.tracks(SECOND, "r1", "r2")
    for name, value in (("r1", wrong), ("r2", right)):
        message = msgspec.structs.replace(status(name, 1.0, 3), **{key: value})
        table.put(topics.STATUS.at(robot=name), message)
    rows = table.rows()
    assert rows["r1"].endswith(state)
    assert rows["r2"].endswith("ok")
    assert rows["r1:"] == f"r1: {text}"


def test_a_report_says_what_is_not_confirmed_at_the_end() -> None:
    not_yet = [status("r1", 1.0 + n, 3, unconfirmed=UNCONFIRMED) for n in range(3)]
    assert f"Robot r1, for 3 s: {UNCONFIRMED}." in shown(recorded(*not_yet))
    assert UNCONFIRMED not in shown(recorded(*not_yet, status("r1", 9.0, 3)))


def test_a_robot_that_is_silent_is_not_ok_in_the_live_table(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    table, now_s = Table(), time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    table.tracks(SECOND, "r1", "r2")
    assert table.rows()["r1"].endswith("ok")
    now_s += 4.0
    table.tracks(5 * SECOND, "r2")
    rows = table.rows()
    assert rows["r1"].endswith("gone")
    assert rows["r1:"] == "r1: gone: silent for 4 s"
    assert rows["r2"].endswith("ok")


def test_a_report_says_each_problem_once_with_its_length_and_the_inputs() -> None:
    statuses = [
        status("r1", 1.0 + n, 3, problems=(SILENT.replace("4", str(4 + n)),), inputs=(HEALTH,))
        for n in range(3)
    ]
    report = recorded(*statuses, status("r1", 9.0, 3, inputs=(HEALTH,)))
    (problem,), (health,) = report.robots["r1"].problems, report.robots["r1"].inputs
    assert (problem.text, problem.seconds) == (SILENT.replace("4", "6"), 3.0)
    assert (health.input, health.taken, health.refused) == ("odometry", 100, {"too_late": 3})
    assert f"Robot r1, for 3 s: {problem.text}." in shown(report)
    assert "for 3 s" not in shown(recorded(status("r1", 1.0, 3)))


def test_the_traffic_view_says_problems_too() -> None:
    arrivals = {"r1": seen(status("r1", 1.0, 3, problems=(SILENT,)))}
    now = traffic_from_statuses("team", (), arrivals, 0.0, 1.0)
    console = Console(file=io.StringIO(), width=80)
    with console.capture() as capture:
        console.print(traffic_view(now, "here"))
    assert f"r1: {SILENT}" in capture.get()
