"""The processes of a simulated team: real nodes, each with the clock of its own machine."""

from collections.abc import Callable, Mapping

from msgspec.structs import replace

from cpcbl_agents.clock import Clock
from cpcbl_agents.earlier_processes import EarlierRuns
from cpcbl_agents.node import GuestNode, Node, NodeCallbacks, NodeStart
from cpcbl_agents.process import MAX_CLOCK_STEP_S, make_robot
from cpcbl_agents.robot import NEVER_NS, build_robot
from cpcbl_agents.tape import NO_TAPE
from cpcbl_launch.lab.luck.disks import Disk
from cpcbl_launch.lab.luck.network import Network
from cpcbl_launch.lab.luck.witness import Report, Witness
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_team.config import Team
from cpcbl_team.inputs import Odometry
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import SensorInput, Status

RESTART_S = 1.0  # from the end of a process to the next, where nothing else says when


class MachineClock:
    """The clock of a robot's machine, beside true time: it drifts, and somebody sets it."""

    def __init__(self) -> None:
        self._ahead_ns, self._since_ns, self._drift = 0.0, 0, 0.0
        self.stepped_ns = 0  # the sum of all steps

    def ahead_ns(self, true_ns: int) -> int:
        if not self._ahead_ns and not self._drift:
            return 0
        return round(self._ahead_ns + (true_ns - self._since_ns) * self._drift)

    def set_by(self, true_ns: int, step_s: float) -> None:
        """The clock is set, forwards or backwards."""
        step_ns = int(step_s * 1e9)
        self._ahead_ns, self.stepped_ns = self._ahead_ns + step_ns, self.stepped_ns + step_ns

    def drift(self, true_ns: int, ppm: float) -> None:
        """The clock gains so much from now on."""
        self._ahead_ns, self._since_ns = float(self.ahead_ns(true_ns)), true_ns
        self._drift = ppm * 1e-6


class ClockedField(SimulatedField):
    """A field whose drivers stamp by the clocks of their robots' machines."""

    def __init__(self, team: Team, seed: int, clocks: Mapping[str, MachineClock]) -> None:
        super().__init__(team, seed, 0)
        self._clocks, self._before_ns = clocks, dict.fromkeys(clocks, 0)

    def clock_offset_ns(self, robot: str) -> int:
        clock = self._clocks.get(robot)
        return 0 if clock is None else clock.ahead_ns(self.now_ns)

    def advance(self, pictures: bool = True) -> list[tuple[str, SensorInput]]:
        """One step. A piece of odometry begins where the one before ended, by the same clock."""
        sensed = []
        for name, item in super().advance(pictures):
            if isinstance(item, Odometry) and name in self._before_ns:
                ahead_ns = self.clock_offset_ns(name)
                shift_ns = self._before_ns[name] - ahead_ns
                self._before_ns[name] = ahead_ns
                item = replace(item, from_ns=item.from_ns + shift_ns) if shift_ns else item
            sensed.append((name, item))
        return sensed


class _StandingClock(Clock):
    """A clock that stands at its epoch: that of a process which starts."""

    def now_ns(self) -> int:
        return self.epoch_ns


class RobotProcess:
    """One robot, over all its processes."""

    def __init__(
        self,
        name: str,
        team: Team,
        network: Network,
        clock: MachineClock,
        report: Report,
        wrap_bus: Callable[[Bus], Bus] = lambda bus: bus,
        disk: Disk | None = None,
    ) -> None:
        """`disk`: on which the robot is recorded, if it is."""
        self.name, self._team, self._network, self.clock = name, team, network, clock
        self._report, self._wrap_bus, self._disk = report, wrap_bus, disk
        self.node: Node | None = None
        self._next_ns = NEVER_NS  # of the node: only a step changes it
        self._has_arrivals = False
        self.witness: Witness | None = None
        self.is_paused = self._has_moved = False
        self._processes = self._stepped_ns = 0
        self._bus: Bus | None = None
        self._used = 0  # inputs, of the processes before
        self.statuses: list[tuple[float, Status]] = []

    @property
    def used(self) -> int:
        """How many inputs the timelines of all its processes used."""
        return self._used + (self.witness.used if self.witness else 0)

    def ahead_ns(self, true_ns: int) -> int:
        """How far the process is ahead of true time: it does not notice steps of the clock."""
        return self.clock.ahead_ns(true_ns) - self.clock.stepped_ns + self._stepped_ns

    def start(self) -> None:
        """A process starts, unless one runs."""
        if self.node is not None:
            return
        network, self._stepped_ns = self._network, self.clock.stepped_ns
        now_ns = network.now_ns + self.ahead_ns(network.now_ns)
        before = EarlierRuns(self._has_moved, self._processes > 0)
        robot = make_robot(self.name, self._team, _StandingClock(now_ns, 0, 1.0), before)
        start = NodeStart(now_ns, f"{self._processes:08x}")
        self._processes += 1
        self.witness = Witness(self.name, self._team, network, self._report)
        self._bus = network.session(self.name, self.witness.note_delivery)
        self._has_arrivals = False
        callbacks = NodeCallbacks(self._on_arrival, self._on_status)
        watched = self.witness.watch(robot)
        tape = NO_TAPE if self._disk is None else self._disk.tape(robot, self._team, start)
        self.node = Node(watched, self._team, self._wrap_bus(self._bus), start, callbacks, tape)
        self._next_ns = self.node.next_ns

    def kill(self) -> None:
        """The process ends without a word, and all that it knew is gone."""
        if self._bus is not None:
            self._bus.close()
        if self._disk is not None:
            self._disk.end_process()
        self._used = self.used
        self.node = self.witness = self._bus = None

    def set_clock(self, step_s: float) -> None:
        """The machine's clock is set. A process ends when it notices, if the step is large."""
        self.clock.set_by(self._network.now_ns, step_s)
        step_ns = self.clock.stepped_ns - self._stepped_ns
        if self.node is not None and abs(step_ns) * 1e-9 > MAX_CLOCK_STEP_S:
            self.kill()
            self._network.at(self._network.now_ns + int(RESTART_S * 1e9), self.start)

    @property
    def next_ns(self) -> int:
        """When the process has something to do, in true time."""
        if self.node is None or self.is_paused:
            return NEVER_NS
        return self._next_ns - self.ahead_ns(self._network.now_ns)

    @property
    def is_due(self) -> bool:
        if self.node is None or self.is_paused:
            return False
        now_ns = self._network.now_ns
        return self._has_arrivals or self._next_ns <= now_ns + self.ahead_ns(now_ns)

    def step(self) -> None:
        now_ns = self._network.now_ns
        if self.node is not None:
            self.node.step(now_ns + self.ahead_ns(now_ns))
            self._next_ns, self._has_arrivals = self.node.next_ns, self.node.waiting

    def _on_arrival(self) -> None:
        self._has_arrivals = True

    def _on_status(self, status: Status) -> None:
        assert self.node is not None
        assert self.witness is not None
        self._has_moved |= self.node.has_moved
        self.statuses.append((self._network.now_ns * 1e-9, status))
        self.witness.check(self.node, status)
        if self._disk is not None and (problem := self._disk.write(status)):
            self._report("recorded", self.name, problem)


class GuestProcess:
    """A guest, from its start until it leaves. It has a good clock."""

    def __init__(self, name: str, team: Team, network: Network) -> None:
        self._network, self._bus = network, network.session(name)
        start = NodeStart(network.now_ns, f"{network.now_ns:08x}")
        robot = build_robot(name, team, network.now_ns)
        self.node = GuestNode(robot, team, self._bus, start)

    def leave(self) -> None:
        self.node.leave(self._network.now_ns)
        self._bus.close()

    @property
    def next_ns(self) -> int:
        return self.node.next_ns

    @property
    def is_due(self) -> bool:
        return self.node.waiting or self.node.next_ns <= self._network.now_ns

    def step(self) -> None:
        self.node.step(self._network.now_ns)
