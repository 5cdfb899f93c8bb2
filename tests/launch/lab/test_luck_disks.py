"""Full disks in the simulator of bad luck: the recording ends, and nothing else changes."""

import errno
import os
from dataclasses import dataclass
from pathlib import Path

import pytest

from cpcbl_agents.flight_recorder import recorded
from cpcbl_agents.flight_recorder.recorder import FlightRecorder
from cpcbl_agents.flight_recorder.segments import SegmentWriter
from cpcbl_agents.node import NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_launch.lab.luck.disks import Disk
from cpcbl_launch.lab.luck.history import Event, History
from cpcbl_launch.lab.luck.outcome import run_history
from cpcbl_launch.lab.luck.plan import history_of
from cpcbl_launch.lab.luck.teams import team_of
from cpcbl_team.errors import InputError

SEED, DURATION_S = 0, 9.0


def history(*events: Event) -> History:
    robots = history_of(SEED).robots
    return History(SEED, DURATION_S, robots, (Event(0, "kill", robots[1], 4.0, 5.0), *events))


def full(robot: int, from_s: float, until_s: float) -> Event:
    return Event(robot + 1, "disk-full", history_of(SEED).robots[robot], from_s, until_s)


def test_a_full_disk_ends_the_recording_and_changes_nothing_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written: list[dict[str, int]] = []
    end = Disk.close

    def close(disk: Disk) -> None:
        written.append(disk._written)
        end(disk)

    monkeypatch.setattr(Disk, "close", close)
    # The second robot is killed meanwhile, and starts again when its disk is still full
    with_events = run_history(history(full(0, 6.0, 7.0), full(1, 3.5, 6.0)))
    assert with_events.violations == ()
    assert with_events.digest == run_history(history()).digest
    assert [len(processes) for processes in written] == [1, 1]
    assert all(steps > 20 for processes in written for steps in processes.values())


def test_a_recording_that_lacks_steps_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    write_steps = SegmentWriter._write_steps
    monkeypatch.setattr(
        SegmentWriter, "_write_steps", lambda self, steps: write_steps(self, steps[::2])
    )
    found = run_history(history(full(0, 6.0, 7.0))).violations
    assert [v.invariant for v in found] == ["recorded"]


def test_a_recording_that_stops_in_silence_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FlightRecorder, "problems", ())
    found = run_history(history(full(0, 3.0, 4.0))).violations
    assert [v.invariant for v in found] == ["recorded"]


@dataclass
class Unwritable:
    number: int

    def __call__(self, *arguments: object) -> None:
        raise OSError(self.number, os.strerror(self.number))


def test_a_robot_starts_on_a_full_disk_and_says_that_it_is_not_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    team = team_of(SEED)
    robot = build_robot("observer", team, 0)
    start = NodeStart(0, "a")
    monkeypatch.setattr(SegmentWriter, "_open", Unwritable(errno.ENOSPC))
    with recorded(tmp_path, robot, team, start) as tape:
        assert tape.problems == (f"not recorded: No space left on device ({tmp_path})",)
    monkeypatch.setattr(SegmentWriter, "_open", Unwritable(errno.EACCES))
    with (
        pytest.raises(InputError, match="name a folder that can be written to"),
        recorded(tmp_path, robot, team, start),
    ):
        pass
