"""A real robot that gets 100,000 payloads, 5,000 a second, publishes at its rate.

Its inputs are not limited by the router: what is measured is the robot alone.
"""

import random
import subprocess
import time
from itertools import cycle, pairwise
from pathlib import Path

import pytest
from fuzz.payloads import damaged_payload, random_payload, valid_payload
from support.processes import eventually
from support.routers import open_router

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Subscriber
from cpcbl_transport.messages import Status, encode
from cpcbl_transport.zenoh_bus import open_bus

PAYLOADS, BURST, PAUSE_S = 100_000, 50, 0.01
TEAM = """
name = "fuzz"
[robots.victim]
source = "external"
start = { x_m = 1.0, y_m = 1.0 }
sensor.field_of_view_deg = 360.0
[robots.mate]
source = "external"
[map.landmarks]
oak = { x_m = 5.0, y_m = 1.0 }
elm = { x_m = 1.0, y_m = 5.0 }
"""
TARGETS = (topics.IN_SIGHTINGS, topics.IN_ODOMETRY, topics.IN_POSITION, topics.IN_SIGHTINGS)


def odd_payload(target: topics.Topic, rng: random.Random) -> bytes:
    """Of four payloads one is damaged, one random, and two are sightings of odd times."""
    now_ns = time.time_ns()
    match rng.randrange(4):
        case 0:
            return damaged_payload(valid_payload(target, "victim", "mate", now_ns), rng)
        case 1:
            return random_payload(rng)
    seen = Sighting("oak", 4.0 + rng.random(), rng.random()), Sighting("elm", 4.0, 1.5)
    return encode(Sightings(now_ns - rng.randrange(1_900_000_000), seen))


class Victim:
    """What is heard of the robot."""

    def __init__(self, bus: Bus) -> None:
        self.arrivals: list[float] = []
        self.statuses: list[Status] = []
        bus.subscribe(topics.TRACK.at(robot="victim"), self._on_track)
        self._ear = Subscriber(bus, Status, lambda r: self.statuses.append(r.message))

    def rate(self, begin: float, end: float) -> tuple[float, float]:
        """The rate of its tracks within a time, Hz, and their longest gap, s."""
        arrivals = [at for at in self.arrivals if begin <= at <= end]
        gaps = [b - a for a, b in pairwise([begin, *arrivals, end])]
        return len(arrivals) / (end - begin), max(gaps)

    def _on_track(self, key: str, payload: bytes) -> None:
        self.arrivals.append(time.monotonic())


def honest(bus: Bus, seconds: float) -> None:
    """The driver alone."""
    publisher = bus.publisher(topics.IN_ODOMETRY.at(robot="victim"), topics.Qos.INPUT)
    last_ns = time.time_ns()
    until_ns = last_ns + int(seconds * 1e9)
    while last_ns < until_ns:
        time.sleep(0.05)
        from_ns, last_ns = last_ns, time.time_ns()
        publisher.put(encode(Odometry(from_ns, last_ns, 0.0, 0.0)))


def flood(bus: Bus) -> None:
    """All payloads, and the odometry of an honest driver at 20 Hz between them."""
    rng, publishers = random.Random(1), {}
    for target in TARGETS:
        key = target.at(robot="victim")
        publishers[target.key] = bus.publisher(key, topics.Qos.INPUT)
    last_ns = time.time_ns()
    begin_s = time.monotonic()
    for number, target in zip(range(PAYLOADS), cycle(TARGETS), strict=False):
        if number % BURST == 0:
            time.sleep(max(0.0, begin_s + number / BURST * PAUSE_S - time.monotonic()))
        publishers[target.key].put(odd_payload(target, rng))
        if (now_ns := time.time_ns()) - last_ns >= 50_000_000:
            piece = encode(Odometry(last_ns, now_ns, 0.0, 0.0))
            publishers[topics.IN_ODOMETRY.key].put(piece)
            last_ns = now_ns


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_robot_under_a_hundred_thousand_payloads_keeps_its_rate(tmp_path: Path) -> None:
    file, endpoint = tmp_path / "team.toml", free_endpoint()
    file.write_text(TEAM)
    words = [*PROGRAM, "robot", str(file), "victim", "--connect", endpoint]
    with open_router("fuzz", [endpoint]), open_bus("fuzz", [endpoint]) as bus:
        victim = Victim(bus)
        with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
            try:
                assert eventually(lambda: len(victim.arrivals) > 20, 30.0)
                times = [time.monotonic()]
                honest(bus, 5.0)
                times.append(time.monotonic())
                flood(bus)
                times.append(time.monotonic())
                assert eventually(lambda: len(victim.statuses) > 0)
            finally:
                process.kill()
    (usual_hz, usual_gap_s), (hz, gap_s) = (victim.rate(*span) for span in pairwise(times))
    print(f"{hz:.1f} Hz after {usual_hz:.1f} Hz, longest silence {gap_s:.2f} s")  # noqa: T201
    assert hz >= 0.9 * usual_hz  # which is 10 Hz on a machine that is not busy
    assert gap_s <= usual_gap_s + 0.4
    assert any("overloaded" in p for s in victim.statuses for p in s.problems)
