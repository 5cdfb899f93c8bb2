"""Runs the nodes of a recorded run again, on what they took, and compares what comes out."""

import math
import traceback
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path

import msgspec
from msgspec.structs import replace

from cpcbl_agents.flight_recorder import program_version
from cpcbl_agents.flight_recorder.entries import CUT_OFF, Step
from cpcbl_agents.flight_recorder.states import StateError
from cpcbl_agents.node import GuestNode, Node, NodeStart
from cpcbl_agents.robot import Robot, build_sensing
from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.recordings.differences import Difference, DifferenceError
from cpcbl_launch.recordings.playback import OnPut, Playback, PlayedBus, PlayedSource, ignore
from cpcbl_launch.recordings.read import Process, Run
from cpcbl_launch.recordings.state_files import NodeState
from cpcbl_launch.team.faults import one_line
from cpcbl_team.errors import CpcblError, InputError

MOST_STEPS = 2**62  # of a process: any number that fits


class Replayed(msgspec.Struct, frozen=True, kw_only=True):
    """What a replay of one process found."""

    robot: str
    incarnation: str
    version: str  # that recorded it
    steps: int
    messages: int
    seconds: float  # since its start, by the robot's clock, to the latest step
    difference: Difference | None = None
    exception: str = ""  # that ended the process; without a difference also when it was recorded
    damage: tuple[str, ...] = ()


class RunReplayed(msgspec.Struct, frozen=True, kw_only=True):
    """What a replay of a run found."""

    version: str  # of this program, and a digest of its sources
    processes: tuple[Replayed, ...]
    damage: tuple[str, ...]
    """What of the run could not be read, one line each."""

    @property
    def is_equal(self) -> bool:
        """Whether all that there is was read, and came out to the bit. That a process was killed
        while it wrote is no damage."""
        damaged = [*self.damage, *(line for p in self.processes for line in p.damage)]
        any_differs = any(p.difference is not None for p in self.processes)
        return not any_differs and all(CUT_OFF in line for line in damaged)


class Replay:
    """The node of one process, which is stepped as it was.

    It begins with the first step that is there, or after that of `state`, and ends so many seconds
    after the start of the process, by its robot's clock. Raises LogError where
    that cannot be: the state is of another process or version, or the begin of the recording is
    missing.
    """

    def __init__(
        self,
        process: Process,
        on_put: OnPut = ignore,
        state: NodeState | None = None,
        until_s: float = math.inf,
    ) -> None:
        header = process.header
        self._process, self.damage = process, list[str]()
        self.playback = Playback(on_put)
        self.difference: Difference | None = None
        self.exception = ""  # that the node raised
        self.node: Node | None = None
        self.now_ns, self.number = header.start_ns, header.first_step - 1  # of the latest step
        self.begun_at = self.number + 1
        self._steps = process.steps(self.damage)
        if state is not None:
            state.require_process(header.robot, header.incarnation)
            if not header.first_step - 1 <= state.step < MOST_STEPS:
                raise LogError(f"{state.where}: the state after a step that is not recorded")
            for _ in islice(self._steps, state.step + 1 - header.first_step):
                pass
            self.now_ns, self.number = state.now_ns, state.step
            self.node = self._restored(state.state, state.version, state.where)
        elif header.first_step:
            where = str(process.segments[0].path)
            if not header.state:
                raise LogError(
                    f"{where}: has no state to begin with, and files before it are missing"
                )
            self.node = self._restored(header.state, header.version, where)
        self.begun_at = self.number + 1
        self._until_ns = header.start_ns + until_s * 1e9
        self.upcoming = self._next_step()
        """The step that comes next; None at the end."""

    def _next_step(self) -> Step | None:
        step = next(self._steps, None)
        return step if step is not None and step.now_ns <= self._until_ns else None

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Makes all steps that are left, or until `stop()`."""
        while self.upcoming is not None and not stop():
            self.step()

    def _restored(self, state: bytes, version: str, where: str) -> Node:
        if version != program_version():
            raise LogError(
                f"{where}: a state of version {one_line(version, 80)}, this is {program_version()}:"
                " replay it with that version, or from the start of the process"
            )
        try:
            node = self.playback.restored(state)
        except StateError as error:
            raise LogError(f"{where}: no state of a robot: {one_line(str(error))}") from error
        if not isinstance(node, Node):
            raise LogError(f"{where}: no state of a robot")
        return node

    def step(self) -> None:
        """Makes the step that comes next; to be called while there is one."""
        step = self.upcoming
        assert step is not None
        self.number, self.now_ns = self.number + 1, step.now_ns
        self.playback.load(step)
        try:
            self._make(step)
        except DifferenceError as error:
            self._end(error)
        except CpcblError:  # such as a camera's robot without OpenCV
            raise
        except Exception as error:  # whatever a node raises, or a recording that a person made
            where = traceback.extract_tb(error.__traceback__)[-1]
            self.exception = (
                f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
            )
            self.upcoming = None  # a step that an exception ended is the last one
            if step.is_whole:
                self._end(DifferenceError(self.playback.input, None, None))
        else:
            self.upcoming = self._next_step()

    def _end(self, error: DifferenceError) -> None:
        """Ends here, for nothing that follows has a meaning."""
        header = self._process.header
        at_s = (self.now_ns - header.start_ns) * 1e-9
        named = header.robot, header.incarnation
        self.difference = error.difference(*named, self.number, at_s)
        if self.exception:
            self.difference = replace(self.difference, what="an exception", new=self.exception)
        self.upcoming = None

    def _make(self, step: Step) -> None:
        if self.node is None:
            self.node = node_of(self._process, self.playback)
        elif step.leaves:
            assert isinstance(self.node, GuestNode)
            self.node.leave(step.now_ns)
        else:
            self.node.step(step.now_ns, self.playback.may_go_on)

    @property
    def state(self) -> NodeState:
        """The state after the latest step. Raises InputError where the core is compiled."""
        header = self._process.header
        try:
            state = self.playback.state(self.node)
        except StateError as error:
            raise InputError(f"--dump: {error}; do it with the core as it comes") from error
        return NodeState(
            version=program_version(),
            robot=header.robot,
            incarnation=header.incarnation,
            step=self.number,
            now_ns=self.now_ns,
            state=state,
        )

    @property
    def result(self) -> Replayed:
        header = self._process.header
        return Replayed(
            robot=header.robot,
            incarnation=header.incarnation,
            version=header.version,
            steps=self.number + 1 - self.begun_at,
            messages=self.playback.messages,
            seconds=(self.now_ns - header.start_ns) * 1e-9,
            difference=self.difference,
            exception=self.exception,
            damage=tuple(self.damage),
        )


def node_of(process: Process, playback: Playback) -> Node:
    """The node of a process as it started, on this tape. No file is opened: what the robot's log or
    camera had is in the recording."""
    header, team = process.header, process.team
    name, own_team = header.robot, process.team
    if not header.is_pose_given:
        settings = replace(team.robots[name], start=None)
        own_team = replace(team, robots={**team.robots, name: settings})
    has_log = team.robots[name].source == "mrclam"
    source = PlayedSource("", playback) if has_log else None
    camera = PlayedSource("", playback) if header.has_camera else None
    sensing = build_sensing(name, own_team, source, camera)
    robot = Robot(name, own_team, header.robot_start_ns, sensing, header.restarted)
    start = NodeStart(header.start_ns, header.incarnation, header.speed)
    kind = GuestNode if header.is_guest else Node
    return kind(robot, team, PlayedBus(playback), start, tape=playback)


def replayed(run: Run, replays: Sequence[Replay]) -> RunReplayed:
    """What these replays of processes of a run found."""
    results = tuple(replay.result for replay in replays)
    return RunReplayed(version=program_version(), processes=results, damage=run.damage)


def replay_run(run: Run) -> RunReplayed:
    """Replays all processes of a run, one after the other."""
    replays = [Replay(process) for process in run.processes_of(())]
    for replay in replays:
        replay.run()
    return replayed(run, replays)
