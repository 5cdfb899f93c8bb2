"""Writes the steps of a node into files, on a thread of its own: a slow disk delays no step.

What is over is written once a second, and reaches the disk (fsync) then. Whatever goes wrong ends
the recording, never the robot.
"""

import os
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from msgspec.structs import replace

from cpcbl_agents.flight_recorder.entries import Header, Step, header_block, steps_block
from cpcbl_team.config import RecordingSettings

WRITE_S = 1.0
LARGEST_BACKLOG = 32 * 1024 * 1024  # bytes that wait for the disk
PATIENCE_S = 1.8  # for the thread at the end
SUFFIX = ".cpcbl"


class SegmentWriter:
    """Writes `FOLDER/<robot>/<incarnation>-NNNN.cpcbl`, a new file when one is large or old, and
    deletes the oldest of the robot's where all are to take a limited size. Raises OSError where the
    first file cannot be begun; later `problem` says why nothing is recorded any more."""

    def __init__(self, folder: Path, header: Header, rules: RecordingSettings) -> None:
        self._folder, self._header, self._rules = folder / header.robot, header, rules
        self.problem = ""
        self.wants_state = False
        """Whether the next file is due: it begins with the node's state after the latest step."""
        self._steps: deque[tuple[Step | bytes, int]] = deque()
        self._number = 0  # of the next step
        self._added = self._written = 0  # bytes in memory; each is changed by one thread
        self._begun_s, self._is_next_due = time.monotonic(), False
        self._begins_at = 0  # the steps, in the present file
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._folder.mkdir(parents=True, exist_ok=True)
        self._file = self._begin_file()
        self._start_thread()

    def _start_thread(self) -> None:
        self._thread = threading.Thread(target=self._run, name="flight-recorder", daemon=True)
        self._thread.start()

    def add(self, step: Step, size: int) -> None:
        """One more step, which takes about so many bytes in memory."""
        if self.problem:
            return
        if self._added + size - self._written > LARGEST_BACKLOG:
            self._give_up("the disk is too slow")
            return
        self._added += size
        self._steps.append((step, size))

    def add_state(self, state: bytes) -> None:
        """The state that the next file begins with; to be called once where it is wanted."""
        self.wants_state = False
        self._added += len(state)
        self._steps.append((state, len(state)))

    def close(self) -> None:
        """Writes what is left."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(PATIENCE_S)

    def _give_up(self, reason: str) -> None:
        self.problem = f"no longer recorded: {reason} ({self._folder})"
        self._steps.clear()

    # On the thread ------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self.problem:
                is_last = self._stop.wait(WRITE_S)
                self.write()
                if is_last:
                    break
        finally:
            if not self.problem and not self._stop.is_set():
                self._give_up("an error of this program")
            with suppress(OSError):  # what is left in the buffer finds no room either
                self._file.close()

    def write(self) -> None:
        """Writes what waits. A disk that takes no more ends the recording."""
        try:
            self._write()
        except OSError as error:
            self._give_up(error.strerror or str(error))

    def _write(self) -> None:
        steps: list[Step] = []
        for _ in range(len(self._steps)):
            item, size = self._steps.popleft()
            self._written += size
            if isinstance(item, Step):
                steps.append(item)
            else:
                self._write_steps(steps)
                steps = []
                self._begin_next_file(item)
        self._write_steps(steps)
        is_large = self._file.tell() - self._begins_at >= self._rules.segment_bytes
        is_old = time.monotonic() - self._begun_s >= self._rules.segment_s
        if not self._is_next_due and (is_large or is_old):
            self._is_next_due = self.wants_state = True

    def _write_steps(self, steps: list[Step]) -> None:
        self._number += len(steps)
        if steps:
            self._file.write(steps_block(steps))
            self._file.flush()
            os.fsync(self._file.fileno())

    def _begin_next_file(self, state: bytes) -> None:
        self._file.close()
        number = self._header.segment + 1
        self._header = replace(self._header, segment=number, first_step=self._number, state=state)
        self._file, self._is_next_due = self._begin_file(), False
        self._delete_oldest()

    def _begin_file(self) -> BinaryIO:
        name = f"{self._header.incarnation}-{self._header.segment:04}{SUFFIX}"
        file = self._open(self._folder / name)
        self._begun_s = time.monotonic()
        try:
            file.write(header_block(replace(self._header, began_unix_s=time.time())))
            file.flush()
            os.fsync(file.fileno())
        except OSError:
            with suppress(OSError):
                file.close()
            raise
        self._begins_at = file.tell()
        folder = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(folder)  # the file's name
        finally:
            os.close(folder)
        return file

    def _open(self, path: Path) -> BinaryIO:
        return path.open("xb")

    def _delete_oldest(self) -> None:
        """Keeps the files of this robot within the size that they may take together."""
        if not self._rules.keep_bytes:
            return
        files = sorted((path.stat().st_mtime_ns, path) for path in self._folder.glob(f"*{SUFFIX}"))
        sizes = [path.stat().st_size for _, path in files]
        total = sum(sizes)
        for (_, path), size in zip(files[:-1], sizes, strict=False):
            if total <= self._rules.keep_bytes:
                return
            path.unlink()
            total -= size
