"""How faults are made. An injector's context lasts as long as its fault."""

import os
import random
import sched
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from cpcbl_launch.lab.chaos.links import LinkQuality
from cpcbl_launch.lab.chaos.scenario import FaultRun, Injector
from cpcbl_launch.lab.chaos.team import FIELD, TeamUnderTest
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.zenoh_bus import open_bus

LATEST_S = 4.0  # twice what a robot's timeline goes back


@contextmanager
def kill(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """SIGKILL; the supervisor starts the process again."""
    team.signal(run.robot, signal.SIGKILL)
    yield


@contextmanager
def freeze(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    team.signal(run.robot, signal.SIGSTOP)
    yield
    team.signal(run.robot, signal.SIGCONT)


@contextmanager
def kill_field(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """SIGKILL; a new world starts, in which the robots stand elsewhere."""
    old = team.pid(FIELD)
    team.signal(FIELD, signal.SIGKILL)
    team.wait_until(lambda: team.supervisor.pids.get(FIELD, old) != old, 15.0)
    run.restarted_s = team.now_s
    yield


def impair(quality: LinkQuality) -> Injector:
    """The link of a robot or router, over which it receives all that it receives."""

    @contextmanager
    def inject(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
        team.links[run.robot].quality = quality
        yield
        team.links[run.robot].quality = LinkQuality()

    return inject


cut = impair(LinkQuality(cut=True))
slow = impair(LinkQuality(delay_s=0.2, jitter_s=0.1))
narrow = impair(LinkQuality(bytes_per_s=50_000 / 8))
lossy = impair(LinkQuality(loss=0.2))


@contextmanager
def flood(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """A process that sends fixes, beliefs and statuses of 60 kB in the name of a robot, far more
    often than the robot may."""
    module = (sys.executable, "-m", "cpcbl_launch.lab.chaos.flooder")
    words = (team.plan.team.name, team.endpoint, str(os.getpid()), run.robot, *run.others)
    with subprocess.Popen([*module, *words], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield
        finally:
            process.terminate()
            run.sent = int(process.communicate(timeout=20.0)[0] or 0)


@contextmanager
def echo(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """Repeats all help of a robot at once, and again up to 4 s late."""
    with (
        open_bus(team.plan.team.name, [team.endpoint]) as bus,
        Echo(bus, run.robot, LATEST_S, team.plan.seed) as copies,
    ):
        yield
    run.sent = copies.sent


class Echo:
    """Sends the help of one robot again, once at once and once up to `latest_s` later, so that
    messages lose their order. A context manager."""

    def __init__(self, bus: Bus, robot: str, latest_s: float, seed: int) -> None:
        self._bus, self._latest_s, self._random = bus, latest_s, random.Random(seed)
        self._keys = (topics.FIX.at(observer=robot), topics.BELIEF.at(robot=robot))
        self._publishers: dict[str, Publisher] = {}
        self._due, self._stop = sched.scheduler(time.monotonic), threading.Event()
        self.sent = 0

    def __enter__(self) -> "Echo":
        self._handles = [self._bus.subscribe(key, self._receive) for key in self._keys]
        self._thread = threading.Thread(target=self._send_due, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        for handle in self._handles:
            handle.close()
        self._stop.set()
        self._thread.join()

    def _receive(self, key: str, payload: bytes) -> None:
        for late_s in (0.0, self._random.uniform(0.0, self._latest_s)):
            self._due.enter(late_s, 0, self._send, (key, payload))

    def _send_due(self) -> None:
        while not self._stop.wait(0.01):
            self._due.run(blocking=False)

    def _send(self, key: str, payload: bytes) -> None:
        if key not in self._publishers:
            self._publishers[key] = self._bus.publisher(key, topics.Qos.FRESH)
        self._publishers[key].put(payload)
        self.sent += 1
