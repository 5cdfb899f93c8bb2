"""How faults are made. An injector's context lasts as long as its fault. Remarks on faults."""

import os
import random
import sched
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from cpcbl_agents.clock import Clock
from cpcbl_launch.lab.chaos.abuses import ABUSES
from cpcbl_launch.lab.chaos.links import LinkQuality, TunLink
from cpcbl_launch.lab.chaos.scenario import FaultRun, Injector
from cpcbl_launch.lab.chaos.team import FIELD, OPERATOR, ROUTER, TeamUnderTest
from cpcbl_launch.lab.faulty_robot import faulty_command
from cpcbl_launch.run.processes import PROGRAM, ProcessSpec, own_memory_mib
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.security import Identity
from cpcbl_transport.topics import Role

CLOCK_AHEAD_NS = 3_000_000_000
LIE = "bias:0.5,0.5"
GUEST_AT = "4.5,0,90"
IN_FULL_S = 12.0  # until an abuse has taken all that it can
LATEST_S = 4.0  # twice what a robot's timeline goes back
TOO_LATE_S, LATE_COPIES = 2.3, 4


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


def abuse(name: str, victim: str = "") -> Injector:
    """What a member of the team does to it (`abuses.py`), in a process of its own. A `victim` is a
    robot that is killed while it goes on, and has to start again."""
    assert name in ABUSES, name

    @contextmanager
    def inject(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
        module = (sys.executable, "-m", "cpcbl_launch.lab.chaos.abuses", name)
        words = (str(team.team_file), team.endpoint, str(os.getpid()), run.robot, *run.others)
        before_mib = _router_mib(team)
        with subprocess.Popen([*module, *words], stdout=subprocess.PIPE, text=True) as process:
            try:
                if victim:
                    team.run_for(IN_FULL_S)
                    run.victim, run.incarnation = victim, team.run_log.latest_incarnation(victim)
                    run.killed_s = team.now_s
                    team.signal(victim, signal.SIGKILL)
                yield
            finally:
                after_mib = _router_mib(team)
                process.terminate()
                run.sent = int(process.communicate(timeout=20.0)[0] or 0)
        if before_mib is not None and after_mib is not None:
            run.router_mib = after_mib - before_mib

    return inject


def _router_mib(team: TeamUnderTest) -> float | None:
    try:
        return own_memory_mib(team.pid(ROUTER))
    except OSError:  # no Linux
        return None


flood, garbage = abuse("flood"), abuse("garbage")


def respawn(key: str, change: Callable[[ProcessSpec], ProcessSpec]) -> Injector:
    """The robot is killed and starts again with another command; the same afterwards."""

    @contextmanager
    def inject(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
        team.change_command(run.robot, key, change)
        team.signal(run.robot, signal.SIGKILL)
        yield
        team.change_command(run.robot, key, None)
        team.signal(run.robot, signal.SIGKILL)

    return inject


def _with_clock_ahead(spec: ProcessSpec) -> ProcessSpec:
    clock = Clock.parse(spec.command[len(spec.command) - spec.command[::-1].index("--clock")])
    ahead = clock._replace(epoch_ns=clock.epoch_ns + CLOCK_AHEAD_NS)
    return spec._replace(command=(*spec.command, "--clock", str(ahead)))


def _with_lie(spec: ProcessSpec) -> ProcessSpec:
    return spec._replace(command=faulty_command(spec.command, LIE))


clock_step, liar = respawn("clock", _with_clock_ahead), respawn("liar", _with_lie)


@contextmanager
def guest(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """A guest comes, and goes: it says so, or (with an odd name) it is killed."""
    own = ("--connect", team.endpoint, "--clock", str(team.clock), "--parent", str(os.getpid()))
    words = ("observer", str(team.team_file), "--name", run.robot, "--at", GUEST_AT, *own)
    log = (team.folder / f"guest-{run.robot}.log").open("ab")
    with log, subprocess.Popen([*PROGRAM, *words], stdout=log, stderr=log) as process:
        try:
            yield
        finally:
            (process.kill if run.robot.endswith("1") else process.terminate)()


def repeat(delays: Callable[[random.Random], Sequence[float]]) -> Injector:
    """All help of a robot comes again, so many seconds late."""

    @contextmanager
    def inject(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
        with (
            team.session(OPERATOR) as ears,
            team.session(Identity(Role.ROBOT, run.robot)) as mouth,
            echoes(ears, mouth, run.robot, delays, team.plan.seed) as sent,
        ):
            yield
        run.sent = sent.total()

    return inject


echo = repeat(lambda dice: (0.0, dice.uniform(0.0, LATEST_S)))
late = repeat(lambda dice: [dice.uniform(TOO_LATE_S, LATEST_S) for _ in range(LATE_COPIES)])


@contextmanager
def echoes(
    ears: Bus,
    mouth: Bus,
    robot: str,
    delays: Callable[[random.Random], Sequence[float]],
    seed: int,
) -> Iterator[Counter[str]]:
    """Sends the help of one robot again, after each of these delays, so that messages lose their
    order. Counts the copies by their key."""
    dice, due, stop = random.Random(seed), sched.scheduler(time.monotonic), threading.Event()
    publishers: dict[str, Publisher] = {}
    sent: Counter[str] = Counter()
    repeated: set[bytes] = set()  # the ears hear what the mouth says

    def receive(key: str, payload: bytes) -> None:
        if payload in repeated:
            return
        repeated.add(payload)
        for late_s in delays(dice):
            due.enter(late_s, 0, send, (key, payload))

    def send(key: str, payload: bytes) -> None:
        if key not in publishers:
            publishers[key] = mouth.publisher(key, topics.Qos.FRESH)
        publishers[key].put(payload)
        sent[key] += 1

    def send_due() -> None:
        while not stop.wait(0.01):
            due.run(blocking=False)

    keys = (topics.FIX.at(observer=robot), topics.BELIEF.at(robot=robot))
    handles = [ears.subscribe(key, receive) for key in keys]
    thread = threading.Thread(target=send_due, daemon=True)
    thread.start()
    try:
        yield sent
    finally:
        for handle in handles:
            handle.close()
        stop.set()
        thread.join()


# Remarks: figures of a fault without bounds -------------------------------------------------------


def packets(team: TeamUnderTest, run: FaultRun) -> str:
    link = team.links[run.robot]
    assert isinstance(link, TunLink)
    share = link.lost / max(link.lost + link.passed, 1)
    return f"{link.lost} packets lost of {link.passed} ({share:.0%} in all)"


def clock_offsets(team: TeamUnderTest, run: FaultRun) -> str:
    trust = (trust for name in run.others for trust in run.log.latest_trust(name))
    offsets = ", ".join(f"{-t.late_s:.2f} s" for t in trust if t.peer == run.robot)
    return f"the other robots estimate that its clock is ahead by {offsets}"


def copies(team: TeamUnderTest, run: FaultRun) -> str:
    return f"{run.sent} copies"


def flood_rate(team: TeamUnderTest, run: FaultRun) -> str:
    return f"{run.sent / (run.healed_s - run.fault_s):.0f} messages/s sent"
