"""What the processes of a team need: CPU, memory, start-up time, and the ticks that they keep."""

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from multiprocessing import get_context
from pathlib import Path
from statistics import mean, median

import msgspec
from benchmarks.scaling import swarm_team
from support.process_usage import MIB, process_usage
from support.routers import open_router

from cpcbl_agents.clock import Clock
from cpcbl_agents.node import STATUS_NS
from cpcbl_agents.stop import StopSignal
from cpcbl_launch.run.processes import ProcessSpec, Supervisor, process_table
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import save_resolved
from cpcbl_team.config import CollaborationSettings, Team
from cpcbl_team.inputs import Belief, Odometry
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.compact import BELIEF_BYTES, decode_help, encode_help
from cpcbl_transport.messages import Status, Track, decode_tagged, encode
from cpcbl_transport.zenoh_bus import open_bus

LATE_NS = 100_000_000
TRACKS_HZ = 10.0
ODOMETRY_LATE_NS = 50_000_000
BELIEFS_HZ = CollaborationSettings().belief_rate_hz
WARM_S = 5.0
PATIENCE_S = 30.0
LEAD_S, LEAD_S_PER_PROCESS = 2.0, 0.5
CHECKOUT_PATHS = ("", "agents", "transport", "launch")


class Start(msgspec.Struct, frozen=True, kw_only=True):
    """The starts of one robot, one after the other, with nothing else running."""

    median_s: float
    """From the start of the process to its liveliness token."""
    slowest_s: float
    resident_mib: float
    """Of the process when its token is there, mean."""


class Load(msgspec.Struct, frozen=True, kw_only=True):
    """What so many processes needed; shares of CPU are of one core."""

    kept: float
    """The share of the messages due from the worst process (tracks at 10 Hz, or the beliefs of a
    broadcast) that was received within 100 ms of its stamp."""
    kept_mean: float
    field_kept: float | None
    """The share of a robot's odometry that was received within 50 ms; None without a field."""
    cpu: float
    """Of a robot's process, mean."""
    cpu_field: float | None
    cpu_router: float
    resident_mib: float
    """Of a robot's process, mean."""
    proportional_mib: float
    """The same, with each shared page divided by the number of its processes."""
    sent_hz: float
    """Beliefs and fixes that a robot sends, mean."""
    received_hz: float
    sent_bytes_s: float
    """Their payloads."""
    received_bytes_s: float


class _Counts:
    """Counts the messages that arrive in time, by key. Its callbacks run on the bus's thread."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._in_time: Counter[str] = Counter()
        self._status: dict[str, Status] = {}

    def receive(self, key: str, payload: bytes) -> None:
        now_ns = self._clock.now_ns()
        is_belief = key.startswith("belief/")
        message = decode_help(key, payload) if is_belief else decode_tagged(payload)
        late_ns = ODOMETRY_LATE_NS if isinstance(message, Odometry) else LATE_NS
        with self._lock:
            if isinstance(message, Status):
                self._status[message.robot] = message
            elif isinstance(message, Track | Belief | Odometry):
                self._in_time[key.rsplit("/", 1)[-1]] += now_ns - message.stamp_ns <= late_ns

    def wait_for(self, names: Iterable[str], seconds: float) -> None:
        """Waits until all have sent a status, and `WARM_S` more. Raises TimeoutError."""
        until = time.monotonic() + seconds
        while silent := set(names) - self.snapshot()[1].keys():
            if time.monotonic() > until:
                raise TimeoutError(f"{', '.join(sorted(silent))}: silent for {seconds:.0f} s")
            time.sleep(0.1)
        time.sleep(WARM_S)

    def snapshot(self) -> tuple[Counter[str], dict[str, Status]]:
        """The messages in time by key, and the latest status by robot."""
        with self._lock:
            return self._in_time.copy(), dict(self._status)


# Starting -----------------------------------------------------------------------------------------


def measure_start(starts: int, checkout: Path | None = None) -> Start:
    """Starts one robot so many times. Raises TimeoutError if its token does not come."""
    team, endpoint = swarm_team(2, 1), free_endpoint()
    robot = next(iter(team.robots))
    seconds, resident = [], []
    with _routed(team, endpoint) as (folder, bus):
        for _ in range(starts):
            clock = Clock.starting_in(0.0)  # a robot declares its token after the run's epoch
            (spec,) = _robot_specs(team, folder, endpoint, clock, checkout, [robot])
            appeared, vanished = threading.Event(), threading.Event()
            tokens = bus.watch_liveliness(
                topics.ALIVE.at(robot=robot), _token_events(appeared, vanished)
            )
            began_s = time.monotonic()
            with closing(tokens):
                with subprocess.Popen(spec.command, stderr=subprocess.DEVNULL) as process:
                    try:
                        _wait(appeared, f"no token: {spec.command}")
                        seconds.append(time.monotonic() - began_s)
                        resident.append(process_usage(process.pid).resident_bytes / MIB)
                    finally:
                        process.kill()
                _wait(vanished, "a token that stays")  # else the next start would see it at once
    return Start(median_s=median(seconds), slowest_s=max(seconds), resident_mib=mean(resident))


def _token_events(
    appeared: threading.Event, vanished: threading.Event
) -> Callable[[str, bool], None]:
    return lambda key, alive: (appeared if alive else vanished).set()


def _wait(event: threading.Event, problem: str) -> None:
    if not event.wait(PATIENCE_S):
        raise TimeoutError(f"{problem} after {PATIENCE_S:g} s")


@contextmanager
def _routed(team: Team, endpoint: str) -> Iterator[tuple[Path, Bus]]:
    """A folder with the team file, and the bus of a router in this process."""
    with (
        tempfile.TemporaryDirectory(prefix="cpcbl-") as name,
        open_router(team.name, [endpoint]) as bus,
    ):
        save_resolved(team, Path(name) / "team.json")
        yield Path(name), bus


def _robot_specs(
    team: Team,
    folder: Path,
    endpoint: str,
    clock: Clock,
    checkout: Path | None,
    robots: Sequence[str],
    record: str = "",
) -> list[ProcessSpec]:
    """The processes of these robots, with the code of another checkout if one is given. `record`:
    the folder that they record into, if they do."""
    file = folder / "team.json"
    specs = process_table(team, file, endpoint, clock, seed=1, here=robots, record=record)
    robot_specs = [spec for spec in specs if spec.name.startswith("robot-")]
    if checkout is None:
        return robot_specs
    path = ":".join(str(checkout.resolve() / part) for part in CHECKOUT_PATHS)
    # Without PYTHONSAFEPATH the present directory would come before the other checkout
    environment = ("env", "PYTHONSAFEPATH=1", f"PYTHONPATH={path}")
    program = (*environment, sys.executable, "-m", "cpcbl_launch")
    old = []
    for spec in robot_specs:
        words = spec.command[spec.command.index("robot") :]
        old.append(spec._replace(command=(*program, *words)))
    return old


# Running ------------------------------------------------------------------------------------------


def measure_team(
    robots: int, seconds: float, checkout: Path | None = None, record: bool = False
) -> Load:
    """A team as `up` runs it; its robots with the code of another checkout if one is given, and
    each with a recording of what it takes if `record` is set. Raises OSError where none is."""
    team, endpoint, lead_s = swarm_team(robots, 1), free_endpoint(), _lead_s(robots)
    clock, names = Clock.starting_in(lead_s), list(team.robots)
    with _routed(team, endpoint) as (folder, bus), ExitStack() as stack:
        counts = _Counts(clock)
        for topic in (topics.TRACK, topics.STATUS):
            bus.subscribe(topic.at(), counts.receive)
        bus.subscribe(topics.IN_ODOMETRY.at(robot=names[0]), counts.receive)
        specs = process_table(team, folder / "team.json", endpoint, clock, seed=1, here=())
        recordings = str(folder / "recordings") if record else ""
        specs += _robot_specs(team, folder, endpoint, clock, checkout, names, recordings)
        supervisor = stack.enter_context(Supervisor(specs, folder))
        counts.wait_for(names, lead_s + PATIENCE_S)
        pids = {name.removeprefix("robot-"): pid for name, pid in supervisor.pids.items()}
        odometry_hz = team.robots[names[0]].odometry.rate_hz
        load = _load(names, pids, TRACKS_HZ, odometry_hz, counts, seconds)
        if record and (silent := set(names) - _recorded(folder / "recordings")):
            raise OSError(f"{', '.join(sorted(silent))}: nothing was recorded")
        return load


def _recorded(folder: Path) -> set[str]:
    """The robots with a recording that is not empty."""
    return {file.parent.name for file in folder.glob("*/*.cpcbl") if file.stat().st_size > 0}


def measure_broadcast(robots: int, seconds: float) -> Load:
    """As many processes, each of which sends its belief to all others."""
    names, endpoint, lead_s = [f"r{n:04}" for n in range(robots)], free_endpoint(), _lead_s(robots)
    clock = Clock.starting_in(lead_s)
    with open_router("broadcast", [endpoint]) as bus, ExitStack() as stack:
        counts = _Counts(clock)
        for topic in (topics.BELIEF, topics.STATUS):
            bus.subscribe(topic.at(), counts.receive)
        context = get_context("spawn")
        pids = {}
        for n, name in enumerate(names):
            ahead_ns = int(n / robots * 1e9 / BELIEFS_HZ)
            process = context.Process(
                target=_broadcast, args=(name, ahead_ns, endpoint, clock, os.getpid())
            )
            process.start()
            stack.callback(process.join)
            stack.callback(process.kill)
            pids[name] = process.pid or 0
        counts.wait_for(names, lead_s + PATIENCE_S)
        return _load(names, pids, BELIEFS_HZ, None, counts, seconds)


def _broadcast(name: str, ahead_ns: int, endpoint: str, clock: Clock, parent: int) -> None:
    """A process that puts its belief, decodes those of all others, and reports its counts."""
    stop, period_ns = StopSignal(parent), int(1e9 / BELIEFS_HZ)
    sent, received, status_ns = 0, [0, 0], clock.epoch_ns

    def receive(key: str, payload: bytes) -> None:
        if isinstance(decode_help(key, payload), Belief):
            received[0] += 1
            received[1] += len(payload)

    with open_bus("broadcast", [endpoint], stop) as bus:
        bus.subscribe(topics.BELIEF.at(), receive)
        beliefs = bus.publisher(topics.BELIEF.at(tier=2, robot=name), topics.BELIEF.qos)
        statuses = bus.publisher(topics.STATUS.at(robot=name), topics.STATUS.qos)
        due_ns = clock.epoch_ns + ahead_ns
        while not stop():
            time.sleep(clock.seconds_until(due_ns))
            due_ns += period_ns
            now_ns = clock.now_ns()
            covariance = (0.01, 0.0, 0.01, 0.0, 0.0, 0.01)
            beliefs.put(encode_help(Belief(name, now_ns, 1.0, 2.0, 0.5, covariance)))
            sent += 1
            if now_ns - status_ns >= STATUS_NS:
                status_ns = now_ns
                traffic = (sent, sent * BELIEF_BYTES, received[0], received[1])
                statuses.put(encode(Status(name, "1", now_ns, 0.1, 0.1, 2, "", {}, *traffic)))


def _lead_s(robots: int) -> float:
    return LEAD_S + LEAD_S_PER_PROCESS * robots


def _load(
    names: Sequence[str],
    pids: Mapping[str, int],
    rate_hz: float,
    odometry_hz: float | None,
    counts: _Counts,
    seconds: float,
) -> Load:
    """The load from now on for so long. Raises OSError when a process has died."""
    every = {**pids, "router": os.getpid()}
    before, (in_time, status) = (
        {n: process_usage(pid) for n, pid in every.items()},
        counts.snapshot(),
    )
    from_s = time.monotonic()
    time.sleep(seconds)
    took_s = time.monotonic() - from_s
    after, (now_in_time, now_status) = (
        {n: process_usage(p) for n, p in every.items()},
        counts.snapshot(),
    )
    cpu = {n: (after[n].cpu_s - before[n].cpu_s) / took_s for n in every}
    kept = [(now_in_time[n] - in_time[n]) / (took_s * rate_hz) for n in names]
    odometry = now_in_time["odometry"] - in_time["odometry"]
    rates = [_rates(status[n], now_status[n]) for n in names]
    return Load(
        kept=min(1.0, *kept),
        kept_mean=min(1.0, mean(kept)),
        field_kept=None if odometry_hz is None else min(1.0, odometry / (took_s * odometry_hz)),
        cpu=mean(cpu[n] for n in names),
        cpu_field=cpu.get("field"),
        cpu_router=cpu["router"],
        resident_mib=mean(after[n].resident_bytes for n in names) / MIB,
        proportional_mib=mean(after[n].proportional_bytes for n in names) / MIB,
        **{what: mean(rate[i] for rate in rates) for i, what in enumerate(_RATES)},
    )


_RATES = ("sent_hz", "sent_bytes_s", "received_hz", "received_bytes_s")


def _rates(before: Status, after: Status) -> list[float]:
    """Of help, per second, by the robot's own counts."""
    seconds = max(after.stamp_ns - before.stamp_ns, 1) * 1e-9
    old, new = (
        (s.messages_sent, s.bytes_sent, s.messages_received, s.bytes_received)
        for s in (before, after)
    )
    return [(now - then) / seconds for then, now in zip(old, new, strict=True)]
