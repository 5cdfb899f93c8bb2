"""A running team under test: router, field and robots as real processes, and a log of them."""

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_agents.clock import Clock
from cpcbl_launch.keys.folder import KeyRequest, make_keys
from cpcbl_launch.lab.chaos.links import Relay, TunLink
from cpcbl_launch.lab.chaos.machine import IDLE, MachineWatch
from cpcbl_launch.lab.chaos.run_log import RunLog, RunRecorder
from cpcbl_launch.lab.experiments.runs import with_settings
from cpcbl_launch.lab.faulty_robot import faulty_command
from cpcbl_launch.recordings.read import BUS
from cpcbl_launch.run.processes import PROGRAM, ProcessSpec, Supervisor, process_table
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import builtin_path, load_team, save_resolved
from cpcbl_team.config import Team
from cpcbl_team.errors import CpcblError
from cpcbl_transport.security import Identity, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

LEAD_S, LEAD_S_A_PROCESS = 2.0, 0.4
SETTLED_M = 0.4
PATIENCE_S = 60.0
POLL_S = 0.05
ROUTER, FIELD, FAR_ROUTER = "router", "field", "far-router"
UP, WATCHER = "up", "cpcbl_launch.lab.chaos.watcher"
OPERATOR = Identity(Role.OPERATOR)


class ChaosError(CpcblError):
    """A scenario did not reach its fault, or its end."""


class RunPlan(NamedTuple):
    team: Team
    seed: int = 1
    relayed: Sequence[str] = ()  # robots that dial a relay instead of the router
    lossy: Sequence[str] = ()  # robots (at most one) whose only link is a `TunLink`
    far: Sequence[str] = ()  # robots at a site whose own router dials the first over a relay
    faults: Mapping[str, str] = MappingProxyType({})  # such as `bias:0.5,0.5@10-30`, by robot
    left_out: Sequence[str] = ()  # robots of the file that are not started
    secured: bool = False  # with keys: mutual TLS and access control
    guests: Sequence[str] = ()  # observers that get keys in a secured team
    watched: bool = False  # with a process that records it, as `up --record` does
    recordings: Path | None = None  # where each robot records, and that process, if there is one


def secured_plan(plan: RunPlan, folder: Path) -> RunPlan:
    """The plan with keys for all members, in this folder."""
    transport = replace(plan.team.transport, security="mtls", keys=str(folder), listen=())
    team = replace(plan.team, transport=transport)
    make_keys(team, folder, KeyRequest(observers=plan.guests))
    return plan._replace(team=team)


def demo_team() -> Team:
    """The demonstration, with help from the start: navigator, observer, scout (blind), patrol."""
    return with_settings(load_team(builtin_path("demo")), None, collaboration={"after_s": 0.0})


class TeamUnderTest:
    """Made by `run_team`. Times are seconds of robot time after the run's epoch."""

    def __init__(
        self,
        plan: RunPlan,
        folder: Path,
        stack: ExitStack,
        machine: MachineWatch | None,
        is_stopped: Callable[[], bool],
    ) -> None:
        """Starts all processes; `stack` ends them."""
        self._machine, self._is_stopped = machine, is_stopped
        plan = secured_plan(plan, folder / "keys") if plan.secured else plan
        team, protocol = plan.team, "tls" if plan.secured else "tcp"
        self.plan, self.folder, self.team_file = plan, folder, folder / "team.json"
        self.endpoint, self.far_endpoint = free_endpoint(protocol), free_endpoint(protocol)
        self.clock = Clock.starting_in(LEAD_S + LEAD_S_A_PROCESS * len(team.robots))
        simulated = [name for name, robot in team.robots.items() if robot.source == "simulated"]
        self.robots = [name for name in simulated if name not in plan.left_out]
        """The robots of the simulated field, whose ground truth is known."""
        relayed = [*plan.relayed, *([FAR_ROUTER] if plan.far else [])]
        self.links: dict[str, Relay | TunLink] = {
            **{
                name: stack.enter_context(Relay(self._router_of(name), plan.seed))
                for name in relayed
            },
            **{name: stack.enter_context(TunLink(plan.seed)) for name in plan.lossy},
        }
        """The links that can be impaired, by the robot or router that uses them."""
        self._table = self._process_table()
        self._changes: dict[str, dict[str, Callable[[ProcessSpec], ProcessSpec]]] = {}
        self.supervisor = stack.enter_context(Supervisor(self._table, folder))
        self.seen_pids: set[int] = set()
        self._recorders = []
        end_s = time.monotonic() + PATIENCE_S
        for endpoint in (self.endpoint, self.far_endpoint) if plan.far else (self.endpoint,):
            bus = self.session(OPERATOR, endpoint, lambda: time.monotonic() > end_s)
            self._recorders.append(RunRecorder(self.clock, team.simulation.clocks_ahead_s))
            self._recorders[-1].listen(stack.enter_context(bus))

    def session(
        self,
        identity: Identity,
        endpoint: str = "",
        give_up: Callable[[], bool] = lambda: False,
    ) -> ZenohBus:
        """A session of a member, with its keys if the team has keys."""
        link = link_of(self.plan.team, identity, [endpoint or self.endpoint])
        return open_bus(self.plan.team.name, link.endpoints, give_up, link.credentials)

    def _process_table(self) -> list[ProcessSpec]:
        """The routers, the field and the robots, started as `up` does, with their own links and
        clocks."""
        plan, team_file = self.plan, self.team_file
        save_resolved(plan.team, team_file)
        settings, seed = (plan.team, team_file), plan.seed
        lossy = [self.links[name].endpoint for name in plan.lossy]
        rows = [router_spec(team_file, [self.endpoint, *lossy])]
        (field,) = process_table(*settings, self.endpoint, self.clock, seed, here=())
        if plan.far:
            joins = [self.links[FAR_ROUTER].endpoint]
            rows.append(router_spec(team_file, [self.far_endpoint], joins, FAR_ROUTER))
            site = f"{self.far_endpoint}={','.join(plan.far)}"
            field = field._replace(command=(*field.command, "--site", site))
        rows.append(field)
        for name in (name for name in plan.team.robots if name not in plan.left_out):
            link = self.links.get(name)
            endpoint = link.endpoint if link else self._router_of(name)
            record = str(plan.recordings or "")
            own = process_table(*settings, endpoint, self.clock, seed, (name,), record)[-1]
            fault = plan.faults.get(name)
            command = faulty_command(own.command, fault) if fault else own.command
            rows.append(own._replace(command=(*(link.prefix if link else ()), *command)))
        if plan.watched:
            record_file = (plan.recordings or self.folder) / BUS
            words = (team_file, self.endpoint, record_file, os.getpid())
            rows.append(ProcessSpec(UP, (sys.executable, "-m", WATCHER, *map(str, words))))
        return rows

    def _router_of(self, name: str) -> str:
        return self.far_endpoint if name in self.plan.far else self.endpoint

    @property
    def now_s(self) -> float:
        return self._recorders[0].now_s

    @property
    def run_log(self) -> RunLog:
        zero_s = self.clock.from_ns * 1e-9
        machine = self._machine.log(zero_s) if self._machine else IDLE
        return self._recorders[0].run_log()._replace(machine=machine)

    @property
    def far_log(self) -> RunLog:
        """The far site's log, with the ground truth, which is published at the near site only."""
        near = self.run_log
        return self._recorders[-1].run_log()._replace(truth=near.truth, machine=near.machine)

    def pid(self, name: str) -> int:
        """The process id of a robot, the field or a router, once it runs. Raises ChaosError."""
        process = f"robot-{name}" if name in self.plan.team.robots else name
        if not self.wait_until(lambda: process in self.supervisor.pids, 20.0):
            raise ChaosError(f"{process} does not run: {self.last_log_line(process)}")
        return self.supervisor.pids[process]

    def signal(self, name: str, number: signal.Signals) -> None:
        os.kill(self.pid(name), number)

    def change_command(
        self, robot: str, key: str, change: Callable[[ProcessSpec], ProcessSpec] | None
    ) -> None:
        """What a robot is started with from its next start on: its command with all changes by
        their keys; None takes one back."""
        changes = self._changes.setdefault(robot, {})
        if change is None:
            changes.pop(key, None)
        else:
            changes[key] = change
        process = f"robot-{robot}"
        spec = next(spec for spec in self._table if spec.name == process)
        for _, one in sorted(changes.items(), key=lambda item: item[0]):
            spec = one(spec)
        self.supervisor.change(spec)

    # Waiting ------------------------------------------------------------------------------------

    def watch(self) -> None:
        """Restarts processes that have died; to be called several times a second."""
        self.supervisor.watch()
        self.seen_pids.update(self.supervisor.pids.values())

    def run_for(self, seconds: float) -> None:
        self.wait_until(lambda: False, seconds)

    def wait_until(self, condition: Callable[[], bool], within_s: float = PATIENCE_S) -> bool:
        """Waits for a condition, and restarts what dies meanwhile; whether it was met in time.
        Raises KeyboardInterrupt as soon as the run is stopped."""
        end_s = time.monotonic() + within_s
        while not condition():
            if time.monotonic() >= end_s:
                return False
            if self._is_stopped():
                raise KeyboardInterrupt
            self.watch()
            time.sleep(POLL_S)
        return True

    def settle(self, within_m: float = SETTLED_M, patience_s: float = PATIENCE_S) -> None:
        """Waits until all robots are localized. Raises ChaosError."""

        def not_localized() -> list[str]:
            log, from_s = self.run_log, max(0.0, self.now_s - 4.0)
            found = {name: log.localized_after_s(name, from_s, within_m) for name in self.robots}
            return [name for name, after_s in found.items() if after_s is None]

        if not self.wait_until(lambda: self.now_s > 3.0 and not not_localized(), patience_s):
            waiting = not_localized()
            lines = "; ".join(self.last_log_line(f"robot-{name}") for name in waiting)
            raise ChaosError(f"the team did not settle: {', '.join(waiting)}: {lines}")

    # Logs ---------------------------------------------------------------------------------------

    def process_log(self, process: str) -> str:
        path = self.folder / f"{process}.log"
        return path.read_text(errors="replace") if path.exists() else ""

    def tracebacks(self) -> int:
        logs = (path.read_text(errors="replace") for path in self.folder.glob("*.log"))
        return sum(log.count("Traceback (most recent call last)") for log in logs)

    def last_log_line(self, process: str) -> str:
        lines = self.process_log(process).splitlines()
        return lines[-1] if lines else f"{process} wrote nothing"


@contextmanager
def run_team(
    plan: RunPlan,
    machine: MachineWatch | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Iterator[TeamUnderTest]:
    """A team with all its processes. Raises ChaosError if one of them has not ended afterwards."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cpcbl-chaos-")))
        team = TeamUnderTest(plan, folder, stack, machine, is_stopped)
        yield team
    left = []
    for pid in team.seen_pids:
        with suppress(ProcessLookupError):
            os.kill(pid, 0)
            left.append(str(pid))
    if left:
        raise ChaosError(f"left running: pids {', '.join(left)}")


def router_spec(
    team_file: Path, listen: Sequence[str], connect: Sequence[str] = (), name: str = ROUTER
) -> ProcessSpec:
    """A router as a process of its own."""
    ends = (word for at in listen for word in ("--listen", at))
    joins = (word for at in connect for word in ("--connect", at))
    own = ("router", str(team_file), *ends, *joins, "--parent", str(os.getpid()))
    return ProcessSpec(name, (*PROGRAM, *own))
