"""As many real processes as keep 10 Hz on this machine, beside an all-to-all broadcast.

Each size of a team runs as `up` runs it: one process a robot, one for the simulated field, a router
in this one, real time. Then as many bare processes each put a belief at the rate at which robots
do, and hear and read everybody's; they localize nothing. A size is kept when even the worst of its
robots keeps `KEPT` of its ticks.
"""

import os
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from statistics import mean

import msgspec
from rich.console import RenderableType

from cpcbl_agents.clock import Clock
from cpcbl_agents.node import STATUS_NS
from cpcbl_agents.process import Stop
from cpcbl_launch.lab.scaling.swarm import MOST_ROBOTS, swarm
from cpcbl_launch.reporting.tables import number, table
from cpcbl_launch.run.processes import process_table
from cpcbl_launch.run.supervisor import Supervisor
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.run.usage import MIB, process_usage
from cpcbl_launch.team_file import save_resolved
from cpcbl_team.config import CollaborationSettings
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Belief, Odometry
from cpcbl_transport import topics
from cpcbl_transport.compact import BELIEF_BYTES, decode_help, encode_help
from cpcbl_transport.messages import Status, Track, decode, encode
from cpcbl_transport.zenoh_bus import open_bus, open_router

KEPT = 0.95
LATE_NS = 100_000_000
TRACKS_HZ = 10.0
ODOMETRY_LATE_NS = 50_000_000
BELIEFS_HZ = CollaborationSettings().belief_rate_hz
WARM_S = 5.0
PATIENCE_S = 30.0
LEAD_S, LEAD_S_A_PROCESS = 2.0, 0.5


class Load(msgspec.Struct, frozen=True, kw_only=True):
    """What so many processes needed; shares of CPU are of one core."""

    kept: float
    """Of the messages due from the worst process (tracks at 10 Hz; beliefs, where it broadcasts):
    the share that was heard within 100 ms of the time it speaks of."""
    kept_mean: float
    field_kept: float | None
    """Of a robot's odometry: what was heard within 50 ms. None without a field."""
    cpu: float
    """A robot's process, mean."""
    cpu_field: float | None
    cpu_router: float
    resident_mib: float
    """A robot's process, mean."""
    proportional_mib: float
    """The same, with shared pages counted in parts."""
    sent_hz: float
    """Beliefs and fixes that a robot sends, mean."""
    received_hz: float
    sent_bytes_s: float
    """Their payloads."""
    received_bytes_s: float


class Size(msgspec.Struct, frozen=True, kw_only=True):
    """One size of a team, both ways."""

    robots: int
    team: Load
    broadcast: Load


class Processes(msgspec.Struct, frozen=True, kw_only=True):
    """What the experiment writes."""

    experiment: str
    version: str
    seconds: float
    """Measured, of each."""
    sizes: list[Size]
    most_kept: int
    """The largest team of these that kept its 10 Hz; 0 if none did."""
    cores: int
    load_average: float
    """Of the last minute, before the start: what else the machine did plays a part."""


class _Ear:
    """Counts what comes in time, by key. Its callbacks run on the bus's thread."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self.in_time: Counter[str] = Counter()
        self.status: dict[str, Status] = {}

    def arrived(self, key: str, payload: bytes) -> None:
        now_ns = self._clock.now_ns()
        helps = key.startswith("belief/")
        message = decode_help(key, payload) if helps else decode(payload)
        late_ns = ODOMETRY_LATE_NS if isinstance(message, Odometry) else LATE_NS
        with self._lock:
            if isinstance(message, Status):
                self.status[message.robot] = message
            elif isinstance(message, Track | Belief | Odometry):
                self.in_time[key.rsplit("/", 1)[-1]] += now_ns - message.stamp_ns <= late_ns

    def wait_for(self, names: Iterable[str], seconds: float) -> None:
        """Until all have said how they are, and some time more. Raises TimeoutError."""
        until = time.monotonic() + seconds
        while silent := set(names) - self.taken()[1].keys():
            if time.monotonic() > until:
                raise TimeoutError(f"{', '.join(sorted(silent))}: silent for {seconds:.0f} s")
            time.sleep(0.1)
        time.sleep(WARM_S)

    def taken(self) -> tuple[Counter[str], dict[str, Status]]:
        """What there is now."""
        with self._lock:
            return self.in_time.copy(), dict(self.status)


def sizes_in(text: str) -> list[int]:
    """Sizes as they are written on a command line: `4,8,16`. Raises InputError."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and 1 <= int(part) <= MOST_ROBOTS for part in parts):
        raise InputError(f"--robots {text}: name sizes from 1 to {MOST_ROBOTS}, such as 4,8,16")
    return [int(part) for part in parts]


def measured(
    sizes: Sequence[int], seconds: float, done: Callable[[], None] = lambda: None
) -> Processes:
    """Sizes in this order until one does not keep 10 Hz; `done` is called after each."""
    load_average = os.getloadavg()[0]
    found: list[Size] = []
    for robots in sizes:
        found.append(
            Size(robots=robots, team=_team(robots, seconds), broadcast=_broadcast(robots, seconds))
        )
        done()
        if found[-1].team.kept < KEPT:
            break
    return Processes(
        experiment="processes",
        version=version("cpcbl-team"),
        seconds=seconds,
        sizes=found,
        most_kept=max((s.robots for s in found if s.team.kept >= KEPT), default=0),
        cores=os.cpu_count() or 1,
        load_average=load_average,
    )


def _team(robots: int, seconds: float) -> Load:
    """A team as `up` runs it."""
    team, endpoint, lead_s = swarm(robots, 1), free_endpoint(), _lead_s(robots)
    clock = _clock_in(lead_s)
    with tempfile.TemporaryDirectory(prefix="cpcbl-") as name, ExitStack() as stack:
        folder = Path(name)
        save_resolved(team, folder / "team.json")
        bus = stack.enter_context(open_router(team.name, [endpoint]))
        ear = _Ear(clock)
        for topic in (topics.TRACK, topics.STATUS):
            bus.subscribe(topic.at(), ear.arrived)
        bus.subscribe(topics.IN_ODOMETRY.at(robot=next(iter(team.robots))), ear.arrived)
        processes = process_table(
            team, folder / "team.json", endpoint, clock, seed=1, here=team.robots
        )
        supervisor = stack.enter_context(Supervisor(processes, folder))
        ear.wait_for(team.robots, lead_s + PATIENCE_S)
        pids = {name.removeprefix("robot-"): pid for name, pid in supervisor.pids.items()}
        odometry_hz = next(iter(team.robots.values())).odometry.rate_hz
        return _load(list(team.robots), pids, TRACKS_HZ, odometry_hz, ear, seconds)


def _broadcast(robots: int, seconds: float) -> Load:
    """As many processes that tell everybody everything."""
    names, endpoint, lead_s = [f"r{n:04}" for n in range(robots)], free_endpoint(), _lead_s(robots)
    clock = _clock_in(lead_s)
    with open_router("broadcast", [endpoint]) as bus, ExitStack() as stack:
        ear = _Ear(clock)
        for topic in (topics.BELIEF, topics.STATUS):
            bus.subscribe(topic.at(), ear.arrived)
        context = get_context("spawn")
        pids = {}
        for n, name in enumerate(names):
            ahead_ns = int(n / robots * 1e9 / BELIEFS_HZ)
            process = context.Process(
                target=_tell_all, args=(name, ahead_ns, endpoint, clock, os.getpid())
            )
            process.start()
            stack.callback(process.join)
            stack.callback(process.kill)
            pids[name] = process.pid or 0
        ear.wait_for(names, lead_s + PATIENCE_S)
        return _load(names, pids, BELIEFS_HZ, None, ear, seconds)


def _tell_all(name: str, ahead_ns: int, endpoint: str, clock: Clock, parent: int) -> None:
    """A process that puts its belief, reads everybody's, and says once a second how many."""
    stop, period_ns = Stop(parent), int(1e9 / BELIEFS_HZ)
    sent, heard, status_ns = 0, [0, 0], clock.epoch_ns

    def arrived(key: str, payload: bytes) -> None:
        if isinstance(decode_help(key, payload), Belief):
            heard[0] += 1
            heard[1] += len(payload)

    with open_bus("broadcast", [endpoint], stop) as bus:
        bus.subscribe(topics.BELIEF.at(), arrived)
        beliefs = bus.publisher(topics.BELIEF.at(tier=2, robot=name), topics.BELIEF.qos)
        statuses = bus.publisher(topics.STATUS.at(robot=name), topics.STATUS.qos)
        due_ns = clock.epoch_ns + ahead_ns
        while not stop():
            time.sleep(clock.seconds_until(due_ns))
            due_ns += period_ns
            now_ns = clock.now_ns()
            certain = (0.01, 0.0, 0.01, 0.0, 0.0, 0.01)
            beliefs.put(encode_help(Belief(name, now_ns, 1.0, 2.0, 0.5, certain)))
            sent += 1
            if now_ns - status_ns >= STATUS_NS:
                status_ns = now_ns
                told = (sent, sent * BELIEF_BYTES, heard[0], heard[1])
                statuses.put(encode(Status(name, "1", now_ns, 0.1, 0.1, 2, "", {}, *told)))


def _lead_s(robots: int) -> float:
    return LEAD_S + LEAD_S_A_PROCESS * robots


def _clock_in(seconds: float) -> Clock:
    ahead_ns = int(seconds * 1e9)
    return Clock(time.time_ns() + ahead_ns, time.monotonic_ns() + ahead_ns, 1.0)


def _load(
    names: Sequence[str],
    pids: Mapping[str, int],
    rate_hz: float,
    odometry_hz: float | None,
    ear: _Ear,
    seconds: float,
) -> Load:
    """What happens from now on for so long. Raises OSError when a process has died."""
    every = {**pids, "router": os.getpid()}
    before, (heard, status) = {n: process_usage(pid) for n, pid in every.items()}, ear.taken()
    from_s = time.monotonic()
    time.sleep(seconds)
    took_s = time.monotonic() - from_s
    after, (heard_then, status_then) = (
        {n: process_usage(pid) for n, pid in every.items()},
        ear.taken(),
    )
    cpu = {n: (after[n].cpu_s - before[n].cpu_s) / took_s for n in every}
    kept = [(heard_then[n] - heard[n]) / (took_s * rate_hz) for n in names]
    in_time = heard_then["odometry"] - heard["odometry"]
    rates = [_rates(status[n], status_then[n]) for n in names]
    return Load(
        kept=min(1.0, *kept),
        kept_mean=min(1.0, mean(kept)),
        field_kept=None if odometry_hz is None else min(1.0, in_time / (took_s * odometry_hz)),
        cpu=mean(cpu[n] for n in names),
        cpu_field=cpu.get("field"),
        cpu_router=cpu["router"],
        resident_mib=mean(after[n].resident_bytes for n in names) / MIB,
        proportional_mib=mean(after[n].proportional_bytes for n in names) / MIB,
        **{what: mean(rate[i] for rate in rates) for i, what in enumerate(_RATES)},
    )


_RATES = ("sent_hz", "sent_bytes_s", "received_hz", "received_bytes_s")


def _rates(before: Status, after: Status) -> list[float]:
    """Of help, by the robot's own count, in a second."""
    seconds = max(after.stamp_ns - before.stamp_ns, 1) * 1e-9
    counts = [
        (s.messages_sent, s.bytes_sent, s.messages_received, s.bytes_received)
        for s in (before, after)
    ]
    return [(then - now) / seconds for now, then in zip(*counts, strict=True)]


def tables(result: Processes) -> Iterable[RenderableType]:
    """What a person sees."""
    shown = table(
        f"Real processes, {result.seconds:g} s each",
        ("robots", ""),
        ("kept %", "field", "CPU %", "field", "router", "RSS", "PSS", "in /s", "in B/s"),
    )
    for size in result.sizes:
        for what, load in (("team", size.team), ("broadcast", size.broadcast)):
            shares = (load.kept, load.field_kept, load.cpu, load.cpu_field, load.cpu_router)
            shown.add_row(
                str(size.robots) if load is size.team else "",
                what,
                *(number(None if share is None else 100.0 * share, 1) for share in shares),
                number(load.resident_mib, 0),
                number(load.proportional_mib, 0),
                number(load.received_hz, 1),
                number(load.received_bytes_s, 0),
            )
    yield shown
    yield (
        f"{result.most_kept} robots keep 10 Hz: {KEPT:.0%} of the ticks of the worst.\n"
        "CPU (% of a core), memory (MiB) and what comes in are a robot's, mean.\n"
        f"{result.cores} cores, load average before: {result.load_average:.1f}"
    )
