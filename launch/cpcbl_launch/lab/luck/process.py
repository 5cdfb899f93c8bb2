"""The process of one robot or guest, as the simulator runs, kills, pauses and starts it again."""

from bisect import bisect_right

from cpcbl_agents.clock import Clock
from cpcbl_agents.earlier_processes import NEVER_RAN, EarlierRuns
from cpcbl_agents.flight_recorder.entries import Step, steps_block
from cpcbl_agents.flight_recorder.recorder import FlightRecorder
from cpcbl_agents.flight_recorder.segments import SegmentWriter
from cpcbl_agents.node import GuestNode, Node, NodeStart
from cpcbl_agents.process import make_robot
from cpcbl_agents.robot import NEVER_NS
from cpcbl_agents.tape import NO_TAPE, Tape
from cpcbl_launch.lab.faulty_robot import Fault, FaultyBus
from cpcbl_launch.lab.luck.history import Event
from cpcbl_launch.lab.luck.network import Network, Session
from cpcbl_launch.lab.luck.probe import Probe, ProcessAccount, account, probed
from cpcbl_team.config import Team
from cpcbl_transport.bus import Bus

GRID_NS = 1_000_000  # a process wakes at whole milliseconds
STANDING_NS = 2**62  # of the machine's clock: a robot's clock that the simulator sets


class RobotClock:
    """The clock of one robot: it is set and drifts."""

    def __init__(self) -> None:
        self._settings = [(0, 0, 0.0)]  # since when (true time), how far ahead then, its drift

    def ahead_ns(self, true_ns: int) -> int:
        """How far it is ahead at a time, not before the first setting."""
        number = bisect_right(self._settings, true_ns, key=lambda setting: setting[0]) - 1
        since_ns, ahead_ns, drift = self._settings[number]
        return ahead_ns + int(drift * (true_ns - since_ns))

    def set(self, true_ns: int, by_ns: int = 0, drift: float | None = None) -> None:
        """Sets it by so much, or gives it another drift."""
        drift = self._settings[-1][2] if drift is None else drift
        self._settings.append((true_ns, self.ahead_ns(true_ns) + by_ns, drift))


class SimulatedDisk(SegmentWriter):
    """A disk that becomes full. What is written is only encoded."""

    def __init__(self) -> None:
        self.problem, self.wants_state, self.written = "", False, 0

    def add(self, step: Step, size: int) -> None:
        if not self.problem:
            self.written += len(steps_block([step]))

    def fill(self) -> None:
        self.problem = "no longer recorded: No space left on device"

    def close(self) -> None:
        """Nothing waits."""


class RobotProcess:
    """One robot's body is on the field all the time; its process comes and goes."""

    def __init__(
        self,
        name: str,
        team: Team,
        network: Network,
        clock: RobotClock,
        records: bool = False,
        lie: Event | None = None,
        is_guest: bool = False,
    ) -> None:
        self.name, self._team, self._network, self.clock = name, team, network, clock
        self._records, self._lie, self._is_guest = records, lie, is_guest
        self._disk: SimulatedDisk | None = None
        self.node: Node | None = None
        self.probe: Probe | None = None
        self.is_paused = False
        self._session: Session | None = None
        self._before, self._starts = NEVER_RAN, 0
        self.accounts: list[ProcessAccount] = []
        self.probes: list[Probe] = []

    def start(self, true_ns: int) -> None:
        """A process starts, and keeps the robot's start pose unless the robot has moved."""
        local_ns = true_ns + self.clock.ahead_ns(true_ns)
        self._starts += 1
        standing = Clock(local_ns, STANDING_NS, 1.0)
        robot, probe = probed(
            make_robot(self.name, self._team, standing, self._before), self._team
        )
        self.probe = probe
        self.probes.append(probe)
        session = Session(self._network, self.name, probe.on_delivery, probe.on_token)
        self._session = session
        start, bus = NodeStart(local_ns, str(self._starts)), self._with_lie(session)
        kind = GuestNode if self._is_guest else Node
        self.node = kind(robot, self._team, bus, start, tape=self._tape())
        self.is_paused = False

    def _with_lie(self, bus: Bus) -> Bus:
        if self._lie is None:
            return bus
        shift = f"bias:{self._lie.strength / 1.4142},{self._lie.strength / 1.4142}"
        fault = Fault.parse(f"{shift}@{self._lie.from_s}-{self._lie.until_s}")
        return FaultyBus(bus, fault, self.name, 0)

    def _tape(self) -> Tape:
        if not self._records:
            return NO_TAPE
        self._disk = SimulatedDisk()
        return FlightRecorder(self._disk)

    def fill_disk(self) -> None:
        if self._disk is not None:
            self._disk.fill()

    def kill(self) -> None:
        """The process ends at once: its session, its state and what waited are gone."""
        if self.node is None or self.probe is None or self._session is None:
            return
        self._before = EarlierRuns(self._before.moved or self.node.has_moved, True)
        self.accounts.append(account(self.node, self.probe))
        session, self.node, self._session = self._session, None, None
        session.close()

    def leave(self, true_ns: int) -> None:
        """A guest says that it leaves, and its process ends."""
        if isinstance(self.node, GuestNode):
            self.node.leave(true_ns + self.clock.ahead_ns(true_ns))
        self.kill()

    def next_ns(self, now_ns: int) -> int:
        """The true time at which the process has something to do."""
        if self.node is None or self.is_paused:
            return NEVER_NS
        due_ns = self.node.next_ns - self.clock.ahead_ns(now_ns)
        return -(-due_ns // GRID_NS) * GRID_NS

    @property
    def waiting(self) -> bool:
        return self.node is not None and not self.is_paused and self.node.waiting

    def step(self, now_ns: int) -> None:
        if self.node is not None and not self.is_paused:
            self.node.step(now_ns + self.clock.ahead_ns(now_ns))
