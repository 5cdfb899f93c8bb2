"""A running team under test: router, field and robots as real processes, and a log of them."""

import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from cpcbl_agents.clock import Clock
from cpcbl_launch.lab.chaos.figures import latest_incarnation, localized_after_s
from cpcbl_launch.lab.chaos.run_log import RunLog, RunRecorder
from cpcbl_launch.lab.faulty_robot import faulty_command
from cpcbl_launch.run.processes import PROGRAM, process_table
from cpcbl_launch.run.supervisor import ProcessSpec, Supervisor
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team_file import builtin_path, load_team, save_resolved
from cpcbl_team.config import Team
from cpcbl_team.errors import CpcblError
from cpcbl_transport.zenoh_bus import open_bus

LEAD_S, LEAD_S_A_PROCESS = 2.0, 0.4
SETTLED_M = 0.4
PATIENCE_S = 60.0
POLL_S = 0.05
ROUTER, FIELD = "router", "field"


class ChaosError(CpcblError):
    """A scenario did not reach its fault, or its end."""


class Site(NamedTuple):
    """Another router, joined to the first."""

    listen: str
    joins: str
    """The endpoint that it dials: that of the first router, or of a relay."""
    robots: Sequence[str]
    """The robots whose inputs the field publishes at this site."""


class RunPlan(NamedTuple):
    """How a team is run."""

    team: Team
    seed: int = 1
    links: Mapping[str, str] = MappingProxyType({})
    """The endpoints of robots that do not dial the router directly."""
    prefix: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    """The start of a robot's command, such as `ip netns exec`."""
    faults: Mapping[str, str] = MappingProxyType({})
    """The fault of a robot that sends wrong positions, such as `bias:0.5,0.5@10-30`."""
    also_listen: Sequence[str] = ()
    """Further endpoints at which the router listens."""
    sites: Mapping[str, Site] = MappingProxyType({})
    """The routers of other sites, by the name of their process."""
    endpoint: str = ""
    """The router's endpoint; default: a free one of this machine."""
    left_out: Sequence[str] = ()
    """Robots of the file that are not started."""


def demo_team() -> Team:
    """The demonstration, with help from the start: navigator, observer, scout (blind), patrol."""
    team = load_team(builtin_path("demo"))
    return with_collaboration(team, after_s=0.0)


def with_collaboration(team: Team, **changes: object) -> Team:
    """The team with these settings of every robot's collaboration."""
    robots = {
        name: msgspec.structs.replace(
            robot, collaboration=msgspec.structs.replace(robot.collaboration, **changes)
        )
        for name, robot in team.robots.items()
    }
    return msgspec.structs.replace(team, robots=robots)


class TeamUnderTest:
    """Made by `run_team_under_test`. Times are seconds of robot time after the run's epoch."""

    def __init__(
        self, plan: RunPlan, folder: Path, endpoint: str, clock: Clock, supervisor: Supervisor
    ) -> None:
        self.plan, self.folder, self.endpoint = plan, folder, endpoint
        self.clock, self.supervisor = clock, supervisor
        self.robots = [
            name
            for name, robot in plan.team.robots.items()
            if name not in plan.left_out and robot.source == "simulated"
        ]
        """The robots of the simulated field, whose ground truth is known."""
        self.recorder = RunRecorder(clock, plan.team.simulation.clocks_ahead_s)
        self.seen_pids: set[int] = set()

    @property
    def now_s(self) -> float:
        return self.recorder.now_s

    @property
    def run_log(self) -> RunLog:
        return self.recorder.run_log()

    def pid(self, name: str) -> int:
        """The process id of a robot, the field or a router. Raises ChaosError if it does not
        run."""
        process = f"robot-{name}" if name in self.plan.team.robots else name
        pid = self.supervisor.pids.get(process)
        if pid is None:
            raise ChaosError(f"{process} does not run: {self.last_log_line(process)}")
        return pid

    def incarnation(self, robot: str) -> str:
        return latest_incarnation(self.run_log, robot)

    def others(self, *names: str) -> list[str]:
        return [robot for robot in self.robots if robot not in names]

    # What is done to it -------------------------------------------------------------------------

    def kill(self, name: str) -> float:
        """Kills a process (SIGKILL); returns the time."""
        return self._signal(name, signal.SIGKILL)

    def freeze(self, name: str) -> float:
        return self._signal(name, signal.SIGSTOP)

    def thaw(self, name: str) -> float:
        return self._signal(name, signal.SIGCONT)

    def _signal(self, name: str, number: signal.Signals) -> float:
        os.kill(self.pid(name), number)
        return self.now_s

    # Waiting ------------------------------------------------------------------------------------

    def watch(self) -> None:
        """Restarts processes that have died; to be called several times a second."""
        self.supervisor.watch()
        self.seen_pids.update(self.supervisor.pids.values())

    def run_for(self, seconds: float) -> None:
        self.wait_until(lambda: False, seconds)

    def wait_until(self, condition: Callable[[], bool], within_s: float = PATIENCE_S) -> bool:
        """Waits for a condition, and restarts what dies meanwhile; returns whether it was met in
        time."""
        end_s = time.monotonic() + within_s
        while not condition():
            if time.monotonic() >= end_s:
                return False
            self.watch()
            time.sleep(POLL_S)
        return True

    def settle(self, within_m: float = SETTLED_M, patience_s: float = PATIENCE_S) -> float:
        """Waits until all robots are localized; returns the time. Raises ChaosError."""

        def unsettled() -> list[str]:
            notes = self.run_log
            from_s = max(0.0, self.now_s - 4.0)
            return [
                robot
                for robot in self.robots
                if localized_after_s(notes, robot, from_s, within_m) is None
            ]

        if not self.wait_until(lambda: self.now_s > 3.0 and not unsettled(), patience_s):
            waiting = unsettled()
            raise ChaosError(
                f"the team did not settle: {', '.join(waiting)}: "
                + "; ".join(self.last_log_line(f"robot-{name}") for name in waiting)
            )
        return self.now_s

    def process_log(self, process: str) -> str:
        """The output of a process."""
        path = self.folder / f"{process}.log"
        return path.read_text(errors="replace") if path.exists() else ""

    def tracebacks(self) -> int:
        """The number of tracebacks in the logs of all processes."""
        logs = (path.read_text(errors="replace") for path in self.folder.glob("*.log"))
        return sum(log.count("Traceback (most recent call last)") for log in logs)

    def last_log_line(self, process: str) -> str:
        lines = self.process_log(process).splitlines()
        return lines[-1] if lines else f"{process} wrote nothing"


def clock_starting_in(seconds: float) -> Clock:
    """A clock whose epoch is so many seconds from now."""
    ahead_ns = int(seconds * 1e9)
    return Clock(time.time_ns() + ahead_ns, time.monotonic_ns() + ahead_ns, 1.0)


@contextmanager
def run_team_under_test(plan: RunPlan) -> Iterator[TeamUnderTest]:
    """A team with all its processes, all of which have ended afterwards. Raises ChaosError if
    not."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cpcbl-chaos-")))
        endpoint = plan.endpoint or free_endpoint()
        clock = clock_starting_in(LEAD_S + LEAD_S_A_PROCESS * len(plan.team.robots))
        table = _table(plan, folder, endpoint, clock)
        supervisor = stack.enter_context(Supervisor(table, folder))
        team = TeamUnderTest(plan, folder, endpoint, clock, supervisor)
        bus = stack.enter_context(open_bus(plan.team.name, [endpoint], _patience()))
        team.recorder.listen(bus)
        yield team
    left = [pid for pid in team.seen_pids if _runs(pid)]
    if left:
        raise ChaosError(f"left running: pids {', '.join(map(str, left))}")


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def _patience() -> Callable[[], bool]:
    end_s = time.monotonic() + PATIENCE_S
    return lambda: time.monotonic() > end_s


def _table(plan: RunPlan, folder: Path, endpoint: str, clock: Clock) -> list[ProcessSpec]:
    """The router, the field and the robots, started as `up` does, with their own links and
    clocks."""
    team_file = folder / "team.json"
    save_resolved(plan.team, team_file)
    rows = [router_spec(team_file, (endpoint, *plan.also_listen))]
    rows += [
        router_spec(team_file, (site.listen,), (site.joins,), name)
        for name, site in plan.sites.items()
    ]
    for field in process_table(plan.team, team_file, endpoint, clock, plan.seed, here=()):
        there = (f"{site.listen}={','.join(site.robots)}" for site in plan.sites.values())
        words = [word for at in there for word in ("--site", at)]
        rows.append(field._replace(command=(*field.command, *words)))
    for name in plan.team.robots:
        if name in plan.left_out:
            continue
        link = plan.links.get(name, endpoint)
        own = process_table(plan.team, team_file, link, clock, plan.seed, here=(name,))[-1]
        fault = plan.faults.get(name, "")
        command = faulty_command(own.command, fault) if fault else own.command
        rows.append(own._replace(command=(*plan.prefix.get(name, ()), *command)))
    return rows


def router_spec(
    team_file: Path, listen: Sequence[str], connect: Sequence[str] = (), name: str = ROUTER
) -> ProcessSpec:
    """A router as a process of its own."""
    ends = (word for at in listen for word in ("--listen", at))
    joins = (word for at in connect for word in ("--connect", at))
    own = ("router", str(team_file), *ends, *joins, "--parent", str(os.getpid()))
    return ProcessSpec(name, (*PROGRAM, *own))
