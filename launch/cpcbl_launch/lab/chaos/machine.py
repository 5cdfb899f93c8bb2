"""How busy the machine was: a control robot that no fault touches, and who used the processors.

The control robot has a router of its own. Its messages take the same way as those of the team under
test: process, router, the recorder in this process. What it is late, the machine is late.
"""

import os
import threading
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, Self

from cpcbl_agents.clock import Clock
from cpcbl_launch.run.processes import PROGRAM, ProcessSpec, Supervisor
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import save_resolved
from cpcbl_team.config import OdometrySettings, RobotSettings, Start, Team
from cpcbl_transport import topics
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Track
from cpcbl_transport.zenoh_bus import open_bus

CONTROL, PERIOD_S, SAMPLE_S = "control", 0.1, 1.0
LATE_S = 0.2  # a control robot that is later than this shows a machine that is too busy,
OTHERS_SHARE = 0.35  # if other programs used so much of the processors in some 5 s
SPAN = 5
_STAT, _TICKS_HZ = Path("/proc/stat"), os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100


class MachineLog(NamedTuple):
    """What was seen of the machine. Times are seconds of its monotonic clock less `zero_s`."""

    arrivals_s: tuple[float, ...] = ()  # of the control robot's tracks
    delays_s: tuple[float, ...] = ()  # of each, from stamp to arrival
    others: tuple[tuple[float, float], ...] = ()  # (time, share of the processors others used)
    zero_s: float = 0.0

    def late_s(self, from_s: float, until_s: float) -> float:
        """By how much the machine lengthened a gap between tracks within this window, at most."""
        low, high = from_s + self.zero_s, until_s + self.zero_s
        inside = [at_s for at_s in self.arrivals_s if low < at_s < high]
        if not self.arrivals_s or high - low < PERIOD_S:
            return 0.0
        return max(0.0, max(b - a for a, b in pairwise([low, *inside, high])) - PERIOD_S)

    def delay_s(self, from_s: float, until_s: float) -> float:
        """The longest delay of the control robot's tracks within this window."""
        low, high = from_s + self.zero_s, until_s + self.zero_s
        both = zip(self.arrivals_s, self.delays_s, strict=True)
        return max((delay_s for at_s, delay_s in both if low < at_s < high), default=0.0)

    def rate_hz(self, from_s: float, until_s: float) -> float:
        """How many tracks of the control robot arrived a second."""
        low, high = from_s + self.zero_s, until_s + self.zero_s
        return sum(low < at_s < high for at_s in self.arrivals_s) / (high - low)

    def too_busy(self, from_s: float, until_s: float) -> str:
        """Why no time of this window can be judged; empty if it can."""
        low, high = from_s + self.zero_s, until_s + self.zero_s
        shares = [share for at_s, share in self.others if low < at_s < high]
        spans = [sum(shares[n : n + SPAN]) / SPAN for n in range(len(shares) - SPAN + 1)]
        share, late_s = max(spans, default=0.0), self.late_s(from_s, until_s)
        if share < OTHERS_SHARE or late_s < LATE_S:
            return ""
        return (
            f"the machine was too busy: other programs used {share:.0%} of its processors, and a"
            f" robot without a fault was silent for {late_s:.1f} s longer than usual"
        )


IDLE = MachineLog()


class MachineWatch:
    """Watches the machine as long as its context lasts."""

    def __init__(self) -> None:
        self._arrivals_s: list[float] = []
        self._delays_s: list[float] = []
        self._others: list[tuple[float, float]] = []
        self._stop = threading.Event()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="cpcbl-control-")))
            endpoint, clock = free_endpoint(), Clock.starting_in(0.0)
            stack.enter_context(Supervisor(_control_table(folder, endpoint, clock), folder))
            end_s = time.monotonic() + 60.0
            bus = open_bus(CONTROL, [endpoint], lambda: time.monotonic() > end_s)
            self._clock = clock
            stack.enter_context(bus).subscribe(topics.TRACK.at(), self._on_message)
            thread = threading.Thread(target=self._sample, daemon=True)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._stop.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def log(self, zero_s: float = 0.0) -> MachineLog:
        """All that was seen so far."""
        known = len(self._delays_s)  # another thread appends to both
        arrivals_s, delays_s = self._arrivals_s[:known], self._delays_s[:known]
        return MachineLog(tuple(arrivals_s), tuple(delays_s), tuple(self._others), zero_s)

    def _on_message(self, key: str, payload: bytes) -> None:
        if isinstance(track := decode(key, payload), Track):
            self._arrivals_s.append(time.monotonic())
            self._delays_s.append((self._clock.now_ns() - track.stamp_ns) * 1e-9)

    def _sample(self) -> None:
        if not _STAT.exists():
            return
        before = time.monotonic(), _busy_ticks(), _own_ticks()
        while not self._stop.wait(SAMPLE_S):
            now = time.monotonic(), _busy_ticks(), _own_ticks()
            own = sum(ticks - before[2].get(pid, 0) for pid, ticks in now[2].items())
            available = (now[0] - before[0]) * _TICKS_HZ * (os.cpu_count() or 1)
            share = max(0.0, (now[1] - before[1] - own) / available)
            self._others.append((now[0], share))
            before = now


def _control_table(folder: Path, endpoint: str, clock: Clock) -> list[ProcessSpec]:
    """A router, and a robot that stands still and has no driver."""
    robot = RobotSettings(
        source="external",
        start=Start(x_m=1.0, y_m=1.0, sigma_m=0.1),
        odometry=OdometrySettings(moves=False),
    )
    team = Team(name=CONTROL, robots={CONTROL: robot})
    file, own = folder / "team.json", ("--parent", str(os.getpid()))
    save_resolved(team, file)
    router = ("router", str(file), "--listen", endpoint, *own)
    words = ("robot", str(file), CONTROL, "--connect", endpoint, "--clock", str(clock), *own)
    return [
        ProcessSpec("control-router", (*PROGRAM, *router)),
        ProcessSpec("control-robot", (*PROGRAM, *words)),
    ]


def _busy_ticks() -> int:
    """Ticks in which any processor of the machine was busy (without idle and waiting for disks)."""
    user, nice, system, _, _, irq, soft, steal, *_ = map(
        int, _STAT.read_text().splitlines()[0].split()[1:]
    )
    return user + nice + system + irq + soft + steal


def _own_ticks() -> dict[int, int]:
    """The ticks of this process and of all that it has started, by pid."""
    ticks: dict[int, int] = {}
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it ended just now
            continue
        pid = int(path.parent.name)
        parents[pid], ticks[pid] = int(fields[1]), int(fields[11]) + int(fields[12])
    own = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in own} - own:
        own |= more
    return {pid: ticks[pid] for pid in own if pid in ticks}
