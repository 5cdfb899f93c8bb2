"""One history on virtual time: the real agents, the simulated field and bad luck.

The same history gives the same digest of every payload and of the last states, in every process.
"""

import hashlib
import traceback
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from functools import partial
from math import cos, sin, tau
from typing import NamedTuple

import msgspec
import numpy as np

from cpcbl_launch.lab.chaos.run_log import ReceivedTrack, RunLog, TokenEvent
from cpcbl_launch.lab.faulty_robot import Fault, FaultyBus
from cpcbl_launch.lab.luck.disks import Disk
from cpcbl_launch.lab.luck.history import Event, History
from cpcbl_launch.lab.luck.members import BURSTS, Member
from cpcbl_launch.lab.luck.network import FIELD, WATCHER, Network
from cpcbl_launch.lab.luck.processes import (
    ClockedField,
    GuestProcess,
    MachineClock,
    RobotProcess,
)
from cpcbl_launch.lab.luck.spending import SpendingMonitor
from cpcbl_launch.lab.luck.teams import guest_settings, team_of, with_world_events
from cpcbl_launch.lab.luck.violations import Violation
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import Track, decode_tagged


class Run(NamedTuple):
    """What came of a history."""

    log: RunLog
    digest: str
    violations: tuple[Violation, ...]
    messages: Mapping[str, int]  # put on the bus, by topic
    used: int  # inputs that timelines used


class Simulation:
    """A team under a history. `run` it once."""

    def __init__(self, history: History, stop_early: bool = False) -> None:
        """`stop_early`: whether to end at the first invariant that does not hold."""
        self._history, self._stop_early = history, stop_early
        self.team, self._digest = team_for(history), hashlib.blake2b(digest_size=16)
        self.violations: list[Violation] = []
        self._messages: dict[str, int] = defaultdict(int)
        self.network = network = Network(history.seed, self._on_put)
        self._spending = SpendingMonitor(self.team, network, self._report)
        self._tracks: dict[str, list[ReceivedTrack]] = {name: [] for name in self.team.robots}
        self._truth: dict[str, list[tuple[float, float, float, float]]] = defaultdict(list)
        self._tokens: list[TokenEvent] = []
        clocks = {name: MachineClock() for name in self.team.robots}
        self._field = ClockedField(self.team, history.seed, clocks)
        self._field_node = FieldNode(self._field, network.session(FIELD))
        self._listen(network.session(WATCHER))
        full = history.of_kind("disk-full")
        recorded = {event.robot for event in full} & clocks.keys()
        self._disks = {
            name: Disk([event for event in full if event.robot == name], network)
            for name in sorted(recorded)
        }
        self.robots = {
            name: RobotProcess(
                *(name, self.team, network, clock, self._report),
                self._wrapper(name),
                self._disks.get(name),
            )
            for name, clock in clocks.items()
        }
        self._guests: dict[str, GuestProcess] = {}
        for event in history.events:
            if event.kind != "disk-full":  # a disk knows its times
                self._schedule(event)

    def run(self) -> Run:
        """Runs to the end, or to the first exception."""
        network, end_ns = self.network, int(self._history.duration_s * 1e9)
        try:
            for process in self.robots.values():
                process.start()
            while network.now_ns < end_ns and not (self._stop_early and self.violations):
                self._step(end_ns)
            self._check_end()
        except Exception as bug:
            where = traceback.extract_tb(bug.__traceback__)[-1]
            what = (
                f"{type(bug).__name__}: {bug} ({where.filename.rpartition('/')[2]}:{where.lineno})"
            )
            self._report("no exception", "", what)
        finally:
            for disk in self._disks.values():
                disk.close()
        states = [r.node.robot.filter.timeline.state for r in self.robots.values() if r.node]
        self._digest.update("".join(map(_canonical, states)).encode())
        found, used = tuple(self.violations), sum(r.used for r in self.robots.values())
        return Run(self._log(), self._digest.hexdigest(), found, dict(self._messages), used)

    def _check_end(self) -> None:
        for robot in self.robots.values():
            if robot.node is not None and robot.witness is not None:
                robot.witness.check_order(robot.node.robot.filter.timeline)
        for name, disk in self._disks.items():
            for damage in disk.damage():
                self._report("recorded", name, damage)

    def _step(self, end_ns: int) -> None:
        """Goes to the next time at which something is due, and does all of it."""
        network = self.network
        steppables: list[RobotProcess | GuestProcess]
        steppables = [*self.robots.values(), *self._guests.values()]
        times_ns = [self._field_node.next_ns, *[s.next_ns for s in steppables]]
        if (queued_ns := network.next_ns) is not None:
            times_ns.append(queued_ns)
        network.run_until(min(end_ns, max(min(times_ns), network.now_ns)))
        if self._field_node.next_ns <= network.now_ns:
            self._field_node.step(network.now_ns)
            for name, robot in self._field.robots.items():
                self._truth[name].append((network.now_ns * 1e-9, *robot.pose))
        steppables = [*self.robots.values(), *self._guests.values()]
        while due := [s for s in steppables if s.is_due]:
            for steppable in due:
                steppable.step()

    # Events -------------------------------------------------------------------------------------

    def _schedule(self, event: Event) -> None:
        begin, end = self._actions(event)
        self.network.at(int(event.from_s * 1e9), begin)
        self.network.at(int(event.until_s * 1e9), end)

    def _actions(self, event: Event) -> tuple[Callable[[], None], Callable[[], None]]:
        """What happens when an event begins, and when it ends."""
        network, robot = self.network, self.robots.get(event.robot)
        match event.kind:
            case "guest":
                return partial(self._join, event.robot), partial(self._leave, event.robot)
            case "dark" | "kidnap" | "liar":
                return _nothing, _nothing  # the field's, and the liar's bus's
            case _ if robot is None:
                return _nothing, _nothing  # shrinking took the robot away
            case "kill":
                return robot.kill, robot.start
            case "pause":
                return partial(_pause, robot, True), partial(_pause, robot, False)
            case "clock-step":
                by_s = event.strength
                return partial(robot.set_clock, by_s), partial(robot.set_clock, -by_s)
            case "clock-drift":
                drift = robot.clock.drift
                return (
                    lambda: drift(network.now_ns, event.strength),
                    lambda: drift(network.now_ns, 0.0),
                )
            case kind if kind in BURSTS:
                member = Member(event, network, self.team)
                return member.begin, member.end
        return partial(network.begin, event), partial(network.end, event)

    def _join(self, name: str) -> None:
        settings = guest_settings(self.team, name)
        team = msgspec.structs.replace(self.team, robots={**self.team.robots, name: settings})
        if name not in self._guests:
            self._guests[name] = GuestProcess(name, team, self.network)

    def _leave(self, name: str) -> None:
        if name in self._guests:
            self._guests.pop(name).leave()

    def _wrapper(self, name: str) -> Callable[[Bus], Bus]:
        """What stands between a robot and its bus: where it lies, its help is shifted."""
        lies = [e for e in self._history.of_kind("liar") if e.robot == name]
        if not lies:
            return lambda bus: bus
        event = lies[0]
        angle = self.network.dice(event).uniform(0.0, tau)
        values = event.strength * cos(angle), event.strength * sin(angle)
        fault = Fault("bias", values, event.from_s, event.until_s)
        return lambda bus: FaultyBus(bus, fault, name, 0)

    # What is noted ------------------------------------------------------------------------------

    def _report(self, invariant: str, robot: str, what: str) -> None:
        at_s = self.network.now_ns * 1e-9
        if all((v.invariant, v.robot) != (invariant, robot) for v in self.violations):
            self.violations.append(Violation(invariant, robot, at_s, what))

    def _on_put(self, session: str, key: str, payload: bytes) -> None:
        head = f"{self.network.now_ns} {session} {key} {len(payload)} "
        self._digest.update(head.encode() + payload)
        self._messages[key[: key.index("/")]] += 1
        if session in self.robots:
            self._spending.note(session, key, payload)

    def _listen(self, bus: Bus) -> None:
        bus.subscribe(topics.TRACK.at(), self._on_track)
        bus.watch_liveliness(topics.ALIVE.at(), self._on_token)

    def _on_track(self, key: str, payload: bytes) -> None:
        track = decode_tagged(payload)
        if isinstance(track, Track) and track.robot in self._tracks:
            now_ns, robot = self.network.now_ns, self.robots[track.robot]
            stamp_s = (track.stamp_ns - robot.clock.ahead_ns(now_ns)) * 1e-9
            self._tracks[track.robot].append(ReceivedTrack(now_ns * 1e-9, stamp_s, track))

    def _on_token(self, key: str, alive: bool) -> None:
        if names := topics.ALIVE.names(key):
            self._tokens.append(TokenEvent(self.network.now_ns * 1e-9, alive=alive, **names))

    def _log(self) -> RunLog:
        statuses = {name: tuple(robot.statuses) for name, robot in self.robots.items()}
        truth = {name: np.array(rows) for name, rows in self._truth.items()}
        return RunLog(0, self._tracks, statuses, tuple(self._tokens), truth)


def team_for(history: History) -> Team:
    """The team of a history, in whose world its events happen."""
    team = team_of(history.seed)
    robots = {name: robot for name, robot in team.robots.items() if name in history.robots}
    return with_world_events(msgspec.structs.replace(team, robots=robots), history)


def _pause(robot: RobotProcess, is_paused: bool) -> None:
    robot.is_paused = is_paused


def _canonical(value: object) -> str:
    """The text of a state, with sets in the order of their texts: it differs between processes."""
    if isinstance(value, msgspec.Struct):
        return _canonical((type(value).__name__, *msgspec.structs.astuple(value)))
    if isinstance(value, Mapping):
        return _canonical(tuple(value.items()))
    if isinstance(value, tuple | deque):
        return f"({','.join(map(_canonical, value))})"
    if isinstance(value, frozenset | set):
        return f"{{{','.join(sorted(map(_canonical, value)))}}}"
    return repr(value)


def _nothing() -> None:
    pass
