"""Runs one history: the field, the processes of all robots and the network, in virtual time."""

import traceback
from collections import defaultdict
from collections.abc import Mapping
from hashlib import blake2b
from random import Random
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from cpcbl_launch.lab.chaos.run_log import ReceivedTrack, RunLog
from cpcbl_launch.lab.luck import intruder
from cpcbl_launch.lab.luck.history import Event, History
from cpcbl_launch.lab.luck.network import FIELD, WATCHER, Network, Session
from cpcbl_launch.lab.luck.probe import Probe, ProcessAccount, account
from cpcbl_launch.lab.luck.process import RobotClock, RobotProcess
from cpcbl_launch.lab.luck.teams import GUESTS, guest_settings, team_of, with_world_events
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_team.config import SimulationEvent, Team
from cpcbl_transport import topics
from cpcbl_transport.compact import sent_bytes
from cpcbl_transport.messages import Status, Track, decode_tagged

RESTART_STEP_S, RESTART_S = 0.25, 1.0  # a clock that is set by more ends the process for so long
LONGEST_ROUNDS = 1000  # of steps at one time


class HelpSent(NamedTuple):
    """A fix or belief that a robot put on the bus."""

    at_ns: int
    tier: int
    size: int  # bytes on the link


class Evidence(NamedTuple):
    """All by which a history is judged."""

    history: History
    team: Team
    digest: str
    log: RunLog  # all times are true times
    sent: Mapping[str, list[HelpSent]]
    accounts: list[ProcessAccount]
    probes: list[Probe]  # of the latest processes, and of those before
    latest: Mapping[str, Status]
    sources: Mapping[str, frozenset[tuple[str, int]]]  # whose beliefs each takes at the end
    tiers: Mapping[str, int]  # that each announces at the end
    exception: str = ""


class _FieldOfClocks(SimulatedField):
    """The field, whose robots have clocks of their own."""

    def __init__(self, team: Team, seed: int, clocks: Mapping[str, RobotClock]) -> None:
        super().__init__(team, seed, 0)
        self._clocks = clocks

    def clock_offset_ns(self, robot: str) -> int:
        clock = self._clocks.get(robot)
        return 0 if clock is None else clock.ahead_ns(self.now_ns)


class Simulation:
    """One run of a history."""

    def __init__(self, history: History) -> None:
        self.history, whole = history, team_of(history.seed)
        robots = {name: whole.robots[name] for name in history.robots}
        team = replace(whole, robots=robots)
        self.team = with_world_events(team, tuple(_world_events(history, team)))
        self.network = Network(self._on_put)
        names = (*history.robots, *GUESTS)
        self.clocks = {name: RobotClock() for name in names}
        field = _FieldOfClocks(self.team, history.seed, self.clocks)
        self.field, self._robots = FieldNode(field, Session(self.network, FIELD)), field.robots
        self.processes = {name: self._process(name) for name in history.robots}
        self._digest = blake2b(digest_size=16)
        self._tracks = defaultdict[str, list[tuple[int, bytes]]](list)
        self._statuses: dict[str, bytes] = {}
        self._sent = defaultdict[str, list[HelpSent]](list)
        self._rows = defaultdict[str, list[tuple[float, float, float, float]]](list)
        self._intruders: dict[int, Session] = {}
        watcher = Session(self.network, WATCHER)
        for topic in (topics.TRACK, topics.STATUS):
            watcher.subscribe(topic.at(), lambda key, payload: None)
        for event in history.events:
            self._plan(event)

    def _process(self, name: str, is_guest: bool = False) -> RobotProcess:
        history, team = self.history, self.team
        if is_guest:
            settings = guest_settings(team, name)
            team = replace(team, robots={**team.robots, name: settings})
        lies = [event for event in history.of_kind("liar") if event.robot == name]
        records = any(event.robot == name for event in history.of_kind("full-disk"))
        clock = self.clocks[name]
        lie = lies[0] if lies else None
        return RobotProcess(name, team, self.network, clock, records, lie, is_guest)

    # Events -------------------------------------------------------------------------------------

    def _plan(self, event: Event) -> None:
        if event.robot and event.robot not in (*self.history.robots, *GUESTS):
            return
        from_ns, until_ns = _ns(event.from_s), _ns(event.until_s)
        self.network.at(from_ns, lambda: self._begin(event))
        self.network.at(until_ns, lambda: self._end(event))

    def _begin(self, event: Event) -> None:
        process, now_ns = self.processes.get(event.robot), self.network.now_ns
        match event.kind:
            case "guest":
                self.processes[event.robot] = self._process(event.robot, is_guest=True)
                self.processes[event.robot].start(now_ns)
            case "kill" if process is not None:
                process.kill()
            case "pause" if process is not None:
                process.is_paused = True
            case "full-disk" if process is not None:
                process.fill_disk()
            case "clock-step" if process is not None:
                self._set_clock(process, event.strength)
            case "clock-drift":
                self.clocks[event.robot].set(now_ns, drift=event.strength * 1e-6)
            case "garbage" | "token-flood" | "odd-sightings":
                name = event.robot if event.kind == "odd-sightings" else "intruder"
                self._intruders[event.number] = Session(self.network, f"{name} {event.number}")
                self._flood(event, Random(f"{event}"))
        self.network.begin(event)

    def _end(self, event: Event) -> None:
        process, now_ns = self.processes.get(event.robot), self.network.now_ns
        self.network.end(event)
        match event.kind:
            case "guest" if process is not None:
                process.leave(now_ns)
            case "kill" if process is not None and process.node is None:
                process.start(now_ns)
            case "pause" if process is not None:
                process.is_paused = False
            case "clock-drift":
                self.clocks[event.robot].set(now_ns, drift=0.0)
            case "garbage" | "token-flood" | "odd-sightings":
                self._intruders.pop(event.number).close()

    def _set_clock(self, process: RobotProcess, by_s: float) -> None:
        """Sets a robot's clock; a process ends that notices it, and is started again."""
        now_ns = self.network.now_ns
        process.clock.set(now_ns, _ns(by_s))
        if abs(by_s) > RESTART_STEP_S and process.node is not None:
            process.kill()
            again_ns = now_ns + _ns(RESTART_S)
            self.network.at(again_ns, lambda: self._start_again(process))

    def _start_again(self, process: RobotProcess) -> None:
        killed = self.history.of_kind("kill")
        now_s = self.network.now_ns * 1e-9
        is_down = any(e.robot == process.name and e.from_s <= now_s < e.until_s for e in killed)
        if process.node is None and not is_down:
            process.start(self.network.now_ns)

    def _flood(self, event: Event, dice: Random) -> None:
        session, now_ns = self._intruders.get(event.number), self.network.now_ns
        if session is None:
            return
        if event.kind == "token-flood":
            session.declare_token(intruder.token_of_stranger(dice))
        local_ns = now_ns + self.clocks[event.robot].ahead_ns(now_ns)
        marks = tuple(self.team.map.landmarks)
        for key, payload in intruder.burst(event, dice, marks, local_ns):
            self.network.put(session, key, payload)
        self.network.at(now_ns + _ns(intruder.EVERY_S), lambda: self._flood(event, dice))

    # The loop -----------------------------------------------------------------------------------

    def run(self) -> Evidence:
        """Runs to the end, or to the first exception of an agent."""
        exception = ""
        try:
            self._run()
        except Exception:
            exception = traceback.format_exc(limit=-3)
        return self._evidence(exception)

    def _run(self) -> None:
        network, now_ns, end_ns = self.network, 0, _ns(self.history.duration_s)
        for process in list(self.processes.values()):
            process.start(0)
        while now_ns < end_ns:
            processes = list(self.processes.values())
            due = [self.field.next_ns, *(p.next_ns(now_ns) for p in processes)]
            if network.next_ns is not None:
                due.append(network.next_ns)
            now_ns = max(now_ns, min(end_ns, *due))
            network.run_until(now_ns)
            if self.field.next_ns <= now_ns:
                self.field.step(now_ns)
                self._note_truth(now_ns)
            self._step_robots(now_ns)

    def _step_robots(self, now_ns: int) -> None:
        processes = list(self.processes.values())
        for process in processes:
            if process.next_ns(now_ns) <= now_ns or process.waiting:
                process.step(now_ns)
        for _ in range(LONGEST_ROUNDS):
            ready = [process for process in processes if process.waiting]
            if not ready:
                return
            for process in ready:
                process.step(now_ns)
        raise RuntimeError("robots answer each other without end")

    def _note_truth(self, now_ns: int) -> None:
        for name, robot in self._robots.items():
            self._rows[name].append((now_ns * 1e-9, *robot.pose))

    def _on_put(self, session: Session, key: str, payload: bytes) -> None:
        now_ns = self.network.now_ns
        self._digest.update(f"{now_ns} {session.name} {key} ".encode())
        self._digest.update(payload)
        kind = key.partition("/")[0]
        if kind == "track":
            self._tracks[session.name].append((now_ns, payload))
        elif kind == "status":
            self._statuses[session.name] = payload
        elif kind in ("fix", "belief") and session.name in self.processes:
            tier = int(key.split("/")[-2])
            self._sent[session.name].append(HelpSent(now_ns, tier, sent_bytes(len(payload))))

    # What is judged -----------------------------------------------------------------------------

    def _evidence(self, exception: str) -> Evidence:
        processes, latest = self.processes.values(), dict[str, Status]()
        for name, payload in self._statuses.items():
            status = decode_tagged(payload)
            assert isinstance(status, Status)
            latest[name] = status
        accounts = [a for process in processes for a in process.accounts]
        sources, tiers = {}, {}
        for name, process in self.processes.items():
            if process.node is not None and process.probe is not None:
                accounts.append(account(process.node, process.probe))
                sources[name] = process.node.robot.collaboration.sources
                tiers[name] = process.probe.tier
                state = process.node.robot.filter.timeline.state
                self._digest.update(f"{name} {state.stamp_ns} {state.estimate}".encode())
        probes = [probe for process in processes for probe in process.probes]
        digest = self._digest.hexdigest()
        log = self._run_log()
        return Evidence(
            self.history,
            self.team,
            digest,
            log,
            self._sent,
            accounts,
            probes,
            latest,
            sources,
            tiers,
            exception,
        )

    def _run_log(self) -> RunLog:
        tracks = {name: self._received(name, kept) for name, kept in self._tracks.items()}
        truth = {name: np.array(rows) for name, rows in self._rows.items()}
        return RunLog(0, tracks, {}, (), truth)

    def _received(self, name: str, kept: list[tuple[int, bytes]]) -> list[ReceivedTrack]:
        clock, received = self.clocks[name], []
        for at_ns, payload in kept:
            track = _tracks.decode(payload[1:])
            stamp_ns = track.stamp_ns - clock.ahead_ns(at_ns)
            received.append(ReceivedTrack(at_ns * 1e-9, stamp_ns * 1e-9, track))
        return received


_tracks = msgspec.msgpack.Decoder(Track)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def _world_events(history: History, team: Team) -> list[SimulationEvent]:
    """What happens to the bodies and the landmarks."""
    events = []
    for event in history.of_kind("dark", "kidnap"):
        if event.kind == "dark":
            lasts_s = event.until_s - event.from_s
            events.append(SimulationEvent(at_s=event.from_s, hide_landmarks_s=lasts_s))
        elif event.robot in team.robots:
            x_m = 1.0 + (event.strength * 7.0) % 7.0
            y_m = 1.0 + (event.strength * 11.0) % 3.5
            to = (x_m, y_m, 360.0 * event.strength % 360.0 - 180.0)
            events.append(SimulationEvent(at_s=event.from_s, kidnap=event.robot, to=to))
    return events
