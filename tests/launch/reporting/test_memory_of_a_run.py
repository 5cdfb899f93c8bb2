"""The memory of `up` does not grow with the length of a run, nor with the names that it hears."""

import errno
import logging
import os
import platform
import subprocess
import sys
import tracemalloc

import msgspec
import pytest
from support.messages import STATUS, TRACK

from cpcbl_launch.reporting.activity import MOST_ROWS, ActivityLog
from cpcbl_launch.reporting.encoded_log import BLOCK_BYTES, BlockFile, EncodedLog
from cpcbl_launch.reporting.recorder import MOST_NAMES, MOST_PROCESSES, Recorder
from cpcbl_launch.reporting.statuses import MOST_PROBLEMS, ProblemLog
from cpcbl_transport import topics
from cpcbl_transport.bus import Publisher
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, Tagged, Track, Truth, Truths, encode

ROBOTS = ("r1", "r2", "r3", "r4")
TENTH = 100_000_000


class Speaker:
    """A recorder, and who publishes to it."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.recorder, self.bus = Recorder(self.hub.session()), self.hub.session()
        self.publishers: dict[str, Publisher] = {}

    def put(self, key: str, message: Tagged) -> None:
        if key not in self.publishers:
            self.publishers[key] = self.bus.publisher(key, topics.Qos.TELEMETRY)
        self.publishers[key].put(encode(message))

    def run(self, from_s: int, until_s: int) -> None:
        """A team as it is recorded: tracks and truth at 10 Hz, a status a second."""
        for tenth in range(10 * from_s, 10 * until_s):
            rows = tuple(Truth(name, 1.0, 2.0, 0.5) for name in ROBOTS)
            self.put(topics.TRUTH.at(), Truths(tenth * TENTH, rows))
            for name in ROBOTS:
                track = Track(name, tenth * TENTH, 1.0, 2.0, 0.5, (0.1, 0.0) * 3, 3)
                self.put(f"track/{name}", track)
                if tenth % 10 == 0:
                    self.put(f"status/{name}", status(name, stamp_ns=tenth * TENTH))


def status(robot: str, **changes: object) -> Status:
    return msgspec.structs.replace(STATUS, robot=robot, **changes)


def test_the_memory_of_a_recorder_does_not_grow_with_time() -> None:
    on = Speaker()
    on.run(0, 200)
    tracemalloc.start()
    try:
        on.run(200, 400)
        grown = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert grown < 1.5 * BLOCK_BYTES * (len(ROBOTS) + 1)  # it was 1.7 MB
    assert len(on.recorder.trajectory("r1").stamps_ns) == 4000
    assert len(on.recorder.simulated_truth()["r4"]) == 4000


def tracks(count: int) -> list[Track]:
    return [msgspec.structs.replace(TRACK, stamp_ns=n) for n in range(count)]


def test_a_log_returns_what_it_was_given_in_its_order() -> None:
    encoded: EncodedLog[Track] = EncodedLog(BlockFile())
    other: EncodedLog[Track] = EncodedLog(encoded._file)
    given = tracks(2000)
    for track in given:
        encoded.append(encode(track))
        other.append(encode(msgspec.structs.replace(track, robot="r2")))
    assert list(encoded) == given
    assert len(encoded) == len(given)
    assert (encoded.last, encoded.recent()) == (given[-1], given[-20:])
    assert {track.robot for track in other} == {"r2"}


def test_a_full_disk_costs_memory_and_one_line_but_no_message(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def no_room(descriptor: int, data: bytes, offset: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", no_room)
    encoded: EncodedLog[Track] = EncodedLog(BlockFile())
    given = tracks(2000)
    with caplog.at_level(logging.WARNING):
        for track in given:
            encoded.append(encode(track))
    assert list(encoded) == given
    assert len(caplog.messages) == 1
    assert "No space left on device" in caplog.text


def test_names_and_processes_that_come_and_go_are_bounded() -> None:
    on = Speaker()
    for n in range(MOST_NAMES + 50):
        on.put(f"track/ghost{n}", msgspec.structs.replace(TRACK, robot=f"ghost{n}"))
    on.put("track/ghost0", msgspec.structs.replace(TRACK, robot="ghost0"))
    assert len(on.recorder.tracks) == MOST_NAMES
    assert len(on.recorder.tracks["ghost0"]) == 2
    assert on.recorder.counts["too_many_names"] == 50
    other = Speaker()
    for n in range(MOST_PROCESSES + 50):
        other.put("status/r1", status("r1", incarnation=f"{n}", counts={"odometry": 1}))
    report = other.recorder.robot_report("r1", "joint", None)
    assert report.counts["odometry"] == MOST_PROCESSES


def test_what_a_robot_did_is_known_more_coarsely_in_a_long_run() -> None:
    activity = ActivityLog()
    for second in range(MOST_ROWS + 100):
        counts = {"accepted": 7 * second}
        activity.add(status("r1", stamp_ns=second * 10 * TENTH, counts=counts))
    rates = activity.rates(0.0)
    assert len(rates.times_s) < MOST_ROWS
    assert rates.used == pytest.approx(7.0)


def test_problems_with_free_names_in_them_are_bounded() -> None:
    log = ProblemLog()
    for n in range(MOST_PROBLEMS + 50):
        text = f"`{'x' * (n + 1)}` is no landmark"
        log.add(status("r1", problems=(text,), unconfirmed=""))
    assert len(log.reports) == MOST_PROBLEMS


HEAPS = """
import ctypes, sys, threading
from cpcbl_launch.run.one_heap import use_one_heap
use_one_heap() if sys.argv[1] == "one" else None
library, barrier = ctypes.CDLL(None), threading.Barrier(8)
def allocate():
    library.malloc(100_000)
    barrier.wait()
threads = [threading.Thread(target=allocate) for _ in range(8)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
library.fopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(library.fopen(b"/dev/stdout", b"w"))
library.malloc_info(0, out)
library.fclose(out)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a heap for each thread is glibc's")
def test_all_threads_of_a_process_share_one_heap() -> None:
    heaps = {}
    for which in ("one", "usual"):
        words = [sys.executable, "-c", HEAPS, which]
        done = subprocess.run(words, check=True, capture_output=True, text=True)
        heaps[which] = done.stdout.count("<heap nr=")
    assert heaps["one"] == 1 < heaps["usual"]
