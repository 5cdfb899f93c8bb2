"""Robots that are recorded, and their disk, which is full for a while.

The files are real ones in a temporary folder, written in virtual time.
"""

import errno
import io
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from cpcbl_agents.flight_recorder import NO_ROOM, header_of
from cpcbl_agents.flight_recorder.entries import Header
from cpcbl_agents.flight_recorder.recorder import FlightRecorder, StoppedRecorder
from cpcbl_agents.flight_recorder.segments import SegmentWriter
from cpcbl_agents.node import NodeStart
from cpcbl_agents.robot import Robot
from cpcbl_agents.tape import Tape
from cpcbl_launch.lab.luck.history import Event
from cpcbl_launch.lab.luck.network import Network
from cpcbl_launch.recordings.read import read_run
from cpcbl_launch.recordings.replay import Replay
from cpcbl_team.config import RecordingSettings, Team
from cpcbl_transport.messages import Status

ROOM = 100  # bytes that a full disk still takes


class Disk:
    """The disk of one robot's machine, and what the processes of the robot record on it."""

    def __init__(self, events: Sequence[Event], network: Network) -> None:
        """`events`: the times in which it is full."""
        self._events, self._network = events, network
        self._temporary = TemporaryDirectory(prefix="cpcbl-luck-")
        self._folder = Path(self._temporary.name)
        self._writer: _Writer | None = None
        self._missed = 0  # statuses since something found no room
        self._written: dict[str, int] = {}  # steps that are on the disk, by process

    @property
    def is_full(self) -> bool:
        now_s = self._network.now_ns * 1e-9
        return any(event.from_s <= now_s < event.until_s for event in self._events)

    def tape(self, robot: Robot, team: Team, start: NodeStart) -> Tape:
        """The tape of a process that starts."""
        self.end_process()
        try:
            self._writer = _Writer(self, self._folder, header_of(robot, team, start))
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise
            self._missed = 1
            return StoppedRecorder(f"not recorded: {error.strerror}")
        return FlightRecorder(self._writer)

    def write(self, status: Status) -> str:
        """Writes what has come since the last status; what is wrong with what this one says of the
        recording."""
        if self._missed:
            self._missed += 1
            is_said = any("recorded" in problem for problem in status.problems)
            return "it does not say that it stopped" if self._missed > 2 and not is_said else ""
        if (writer := self._writer) is not None:
            writer.write()
            if writer.problem:
                self._missed = 1
            else:
                self._written[writer.incarnation] = writer.steps
        return ""

    def end_process(self) -> None:
        """The process ends without a word: what was not written is lost."""
        if self._writer is not None:
            self._writer.abandon()
        self._writer, self._missed = None, 0

    def damage(self) -> Iterator[str]:
        """What is wrong with what was recorded: all that was written replays, to the bit."""
        self.end_process()
        if not self._written:
            return
        for process in read_run(self._folder).processes_of(()):
            replay, written = Replay(process), self._written.get(process.header.incarnation, 0)
            replay.run()
            if replay.difference is not None or replay.exception:
                yield f"{process.name}: {replay.difference or replay.exception}"
            elif replay.number + 1 != written:
                yield f"{process.name}: {replay.number + 1} of {written} steps can be replayed"

    def close(self) -> None:
        self.end_process()
        self._temporary.cleanup()


class _Writer(SegmentWriter):
    """Writes when it is told to, not on a thread of its own."""

    def __init__(self, disk: Disk, folder: Path, header: Header) -> None:
        self._disk, self.incarnation = disk, header.incarnation
        super().__init__(folder, header, RecordingSettings())

    @property
    def steps(self) -> int:
        return self._number

    def _start_thread(self) -> None:
        pass

    def _open(self, path: Path) -> BinaryIO:
        return _File(path, self._disk)

    def abandon(self) -> None:
        """What a process that is killed leaves: nothing more is written."""
        self._file.close()


class _File(io.FileIO):
    """A file on a disk that may be full."""

    def __init__(self, path: Path, disk: Disk) -> None:
        super().__init__(path, "x")
        self._disk = disk

    def write(self, data: bytes, /) -> int:  # type: ignore[override]
        if self._disk.is_full and len(data) > ROOM:
            super().write(data[:ROOM])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data)
