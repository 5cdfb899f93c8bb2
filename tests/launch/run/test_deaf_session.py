"""A session that stops reading, while others send it much, silences nobody at a real router."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from support.buses import wait_until

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_transport.bus import Bus
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import open_bus

BIG = 60_000
TICKS, TICK_S, MOST_MISSED = 160, 0.05, 40
DEAF = """
import sys, time
from cpcbl_transport.zenoh_bus import open_bus
with open_bus("lab", [sys.argv[1]]) as bus:
    bus.subscribe("in/deaf/odometry", lambda key, payload: None)
    print("listens", flush=True)
    time.sleep(120.0)
"""


@contextmanager
def router_at(endpoint: str, folder: Path) -> Iterator[None]:
    file = folder / "lab.toml"
    file.write_text('name = "lab"\n[robots.deaf]\nsource = "external"\n')
    words = [*PROGRAM, "router", str(file), "--listen", endpoint]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.kill()


@contextmanager
def deaf_session(endpoint: str) -> Iterator[None]:
    """Has subscribed, and is stopped."""
    words = [sys.executable, "-c", DEAF, endpoint]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "listens\n"
            process.send_signal(signal.SIGSTOP)
            yield
        finally:
            process.kill()


@contextmanager
def sender(endpoint: str) -> Iterator[None]:
    """Sends as much as it can to whom it finds, and waits rather than drop anything."""
    over, sent = threading.Event(), [0]

    def send() -> None:
        with open_bus("lab", [endpoint]) as bus:
            publisher = bus.publisher("in/deaf/odometry", Qos.INPUT)
            while not over.wait(0.002):
                publisher.put(bytes(BIG))
                sent[0] += 1

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(20.0)
    assert sent[0] > 0


def longest_miss(mouth: Bus, ear: Bus) -> int:
    """How many ticks at most were sent between two that were heard."""
    heard: list[int] = []
    sent = 0
    publisher = mouth.publisher("belief/3/other", Qos.FRESH)
    ear.subscribe("belief/*/*", lambda key, payload: heard.append(sent))
    wait_until(lambda: publisher.matching)
    for _ in range(TICKS):
        sent += 1
        publisher.put(b"tick")
        time.sleep(TICK_S)
    counts = [0, *heard, sent]
    return max(b - a for a, b in pairwise(counts))


@pytest.mark.long
def test_a_session_that_stops_reading_silences_nobody_else(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with (
        router_at(endpoint, tmp_path),
        open_bus("lab", [endpoint]) as mouth,
        open_bus("lab", [endpoint]) as ear,
        deaf_session(endpoint),
        sender(endpoint),
        sender(endpoint),
    ):
        assert longest_miss(mouth, ear) < MOST_MISSED
