"""What the robots of a run sensed, and when each took it: all that a run needs to be made again.

It is read from the folder of a run, from a recording of the bus (`.mcap`) or from a real log.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_agents.flight_recorder.entries import Detected, FrameTaken, MessageTaken, Polled, Step
from cpcbl_agents.node import NodeStart
from cpcbl_agents.sources.mrclam import MrclamSource
from cpcbl_launch.recordings.gather import gather
from cpcbl_launch.recordings.read import Process, read_run, recorded_files
from cpcbl_launch.recordings.summary import summarize
from cpcbl_launch.reporting.metrics import Floats, Trajectory
from cpcbl_launch.reporting.recorder import Report
from cpcbl_launch.run.logged_team import LoggedTeam
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sightings
from cpcbl_transport.messages import AnnotatedFrame, encode

BUS, LOG, CAMERA, DETECTOR = "bus", "log", "camera", "detector"
AS_RECORDED = "0"  # the incarnation where a recording has none


class Taken(NamedTuple):
    """Something that a robot took."""

    now_ns: int  # by its clock, when it took it
    way: str  # BUS, LOG, CAMERA or DETECTOR
    key: str  # of the bus; of a frame that the detector could not use the reason
    payload: bytes  # as on the bus


class RecordedProcess(NamedTuple):
    """One process of a robot: how it started, what it took, and when it ended."""

    robot: str
    team: Team  # as it had it
    start: NodeStart
    robot_start_ns: int
    end_ns: int
    taken: tuple[Taken, ...]
    is_pose_given: bool = True  # by `start` in its settings
    restarted: bool = False
    is_guest: bool = False
    has_camera: bool = False  # of its own
    leaves: bool = False  # as a guest does, in place of ending with the run


class RecordedInputs(NamedTuple):
    """A run's inputs, and what is known of the run besides."""

    name: str
    team: Team
    processes: tuple[RecordedProcess, ...]  # of robots in the order of the team, then of guests
    truth: Mapping[str, Floats] = MappingProxyType(
        {}
    )  # rows of s, x, y, heading by robot; empty: not known
    paths: Mapping[str, Trajectory] = MappingProxyType(
        {}
    )  # the robots' estimates as they were recorded
    report: Report | None = None  # of the run as it was recorded
    remarks: tuple[str, ...] = ()  # what is missing, one line each

    @property
    def start_ns(self) -> int:
        return min(process.start.stamp_ns for process in self.processes)

    @property
    def end_ns(self) -> int:
        return max(process.end_ns for process in self.processes)

    @property
    def robots(self) -> tuple[str, ...]:
        """Those whose inputs are known, guests last."""
        return tuple(dict.fromkeys(process.robot for process in self.processes))

    def until(self, end_ns: int) -> "RecordedInputs":
        """The part of the run before this time."""
        processes = [
            process._replace(
                end_ns=min(process.end_ns, end_ns),
                leaves=process.leaves and process.end_ns <= end_ns,
                taken=tuple(t for t in process.taken if t.now_ns <= end_ns),
            )
            for process in self.processes
            if process.start.stamp_ns < end_ns
        ]
        return self._replace(processes=tuple(processes))


# The folder of a run ------------------------------------------------------------------------------


def read_inputs(path: Path) -> RecordedInputs:
    """The inputs in the folder of a run, or in a recording of the bus. Raises LogError,
    TeamFileError, and InputError where the robots' inputs are not in it."""
    if path.is_dir() and recorded_files(path):
        run = read_run(path)
        damage: list[str] = []
        every = [process for of_robot in run.processes.values() for process in of_robot]
        processes = [recorded_process(process, process.steps(damage)) for process in every]
        cut = tuple(
            f"{p.robot}: the recording begins after its start, so here it has to find its pose"
            for p in every
            if p.header.segment
        )
        team = every[0].team
        guests = {p.robot for p in processes if p.is_guest}
        if members := [p for p in every if p.robot not in guests]:
            team = members[0].team
    else:
        (team, processes), cut = _of_bus(path), ()
    return _described(path, team, processes, cut)


def recorded_process(process: Process, steps: Iterable[Step]) -> RecordedProcess:
    """A process as its flight recorder noted it."""
    header, taken, first, last = process.header, list[Taken](), None, None
    for last in steps:
        first = first or last
        for entry in last.entries:
            taken += _taken_in(last.now_ns, entry)
    is_whole = header.segment == 0  # else its first files are gone, and with them its start
    start_ns = header.start_ns if is_whole or first is None else first.now_ns
    return RecordedProcess(
        header.robot,
        process.team,
        NodeStart(start_ns, header.incarnation, header.speed),
        header.robot_start_ns if is_whole else start_ns,
        start_ns if last is None else last.now_ns,
        tuple(taken),
        header.is_pose_given and is_whole,
        header.restarted or not is_whole,
        header.is_guest,
        header.has_camera,
        leaves=last is not None and last.leaves,
    )


def _taken_in(now_ns: int, entry: object) -> Iterator[Taken]:
    match entry:
        case MessageTaken() | FrameTaken() if entry.key.startswith("in/"):
            yield Taken(now_ns, BUS, entry.key, entry.payload)
        case Polled():
            way = CAMERA if entry.source == "camera" else LOG
            yield from (Taken(now_ns, way, "", payload) for payload in entry.payloads)
        case Detected():
            yield Taken(now_ns, DETECTOR, entry.reason, entry.sightings)


def _described(
    path: Path, team: Team, processes: Sequence[RecordedProcess], cut: Sequence[str]
) -> RecordedInputs:
    """The inputs with the truth and the estimates that were recorded."""
    summary = summarize(path)
    known = {process.robot for process in processes if process.taken}
    if not known:
        raise InputError(f"{path}: holds no inputs of robots, which what-if needs; record a folder")
    order = {name: number for number, name in enumerate(team.robots)}
    ordered = sorted(processes, key=lambda p: (order.get(p.robot, len(order)), p.start.stamp_ns))
    remarks = [
        f"{name}: its inputs are not in the recording, so it takes no part in what is run again"
        for name in team.robots
        if name not in known
    ]
    recorder = summary.recorder
    return RecordedInputs(
        path.name or str(path),
        team,
        tuple(p for p in ordered if p.robot in known),
        dict(summary.truth),
        {name: recorder.trajectory(name) for name in recorder.tracks},
        summary.report,
        (*summary.remarks, *cut, *remarks),
    )


# A recording of the bus, and a log ----------------------------------------------------------------


def _of_bus(path: Path) -> tuple[Team, list[RecordedProcess]]:
    """What a recording of the bus holds: inputs by their stamps, for nobody knows when the robots
    took them. Of cameras it has what robots showed of their frames."""
    found = gather(path)
    inputs: dict[str, list[Taken]] = {}
    for at_ns, key, message in found.messages:
        if isinstance(message, Odometry | Sightings | Position | InitialPose):
            inputs.setdefault(key.split("/")[1], []).append(Taken(at_ns, BUS, key, encode(message)))
        elif isinstance(message, AnnotatedFrame):
            seen = encode(Sightings(message.stamp_ns, message.found))
            inputs.setdefault(message.robot, []).append(Taken(at_ns, DETECTOR, "", seen))
    team = found.team
    stamps = [taken.now_ns for of_robot in inputs.values() for taken in of_robot]
    start = NodeStart(min(stamps, default=0), AS_RECORDED)
    end_ns = max(stamps, default=0)
    return team, [
        RecordedProcess(name, team, start, start.stamp_ns, end_ns, tuple(inputs[name]))
        for name in team.robots
        if name in inputs
    ]


def inputs_of_log(logged: LoggedTeam, name: str) -> RecordedInputs:
    """The inputs of a team on a real log, which its robots take at their stamps."""
    processes = []
    for robot in logged.team.robots:
        log = MrclamSource(Path(logged.team.data), robot)
        start_ns = max(logged.start_ns, log.first_ns)
        taken = [
            Taken(item.stamp_ns, LOG, "", encode(item))
            for item in log.poll(logged.end_ns)
            if item.stamp_ns > start_ns
        ]
        start = NodeStart(logged.start_ns, AS_RECORDED)
        processes.append(
            RecordedProcess(robot, logged.team, start, start_ns, logged.end_ns, tuple(taken))
        )
    remarks = tuple(f"{robot}: left out: {why}" for robot, why in logged.left_out.items())
    return RecordedInputs(name, logged.team, tuple(processes), logged.truth, remarks=remarks)


def only_settings(process: RecordedProcess) -> Team:
    """The team of a process as its robot started: without a start where none was given."""
    if process.is_pose_given:
        return process.team
    settings = replace(process.team.robots[process.robot], start=None)
    return replace(process.team, robots={**process.team.robots, process.robot: settings})
