"""Runs the nodes of a recorded run again, on what they took, and compares what comes out."""

import msgspec
from msgspec.structs import replace

from cpcbl_agents.flight_recorder.entries import Step
from cpcbl_agents.node import GuestNode, Node, NodeStart
from cpcbl_agents.robot import Robot, build_sensing
from cpcbl_launch.recordings.differences import Difference, DifferenceError
from cpcbl_launch.recordings.playback import OnPut, Playback, PlayedBus, PlayedSource, ignore
from cpcbl_launch.recordings.read import Process


class Replayed(msgspec.Struct, frozen=True, kw_only=True):
    """What a replay of one process found."""

    robot: str
    incarnation: str
    steps: int
    messages: int
    seconds: float  # of the robot's time
    difference: Difference | None = None
    damage: tuple[str, ...] = ()


class Replay:
    """The node of one process, which is stepped as it was."""

    def __init__(self, process: Process, on_put: OnPut = ignore) -> None:
        self._process, self.damage = process, list[str]()
        self.playback = Playback(on_put)
        self._steps = process.steps(self.damage)
        self.number = -1  # of the latest step
        self.now_ns = process.header.start_ns
        self.upcoming = next(self._steps, None)
        """The step that comes next; None at the end."""
        self.node: Node | None = None
        self.difference: Difference | None = None

    def step(self) -> None:
        """Makes the step that comes next; to be called while there is one."""
        step = self.upcoming
        assert step is not None
        self.number, self.now_ns = self.number + 1, step.now_ns
        self.playback.load(step)
        try:
            self._make(step)
        except DifferenceError as error:
            header = self._process.header
            at_s = (step.now_ns - header.start_ns) * 1e-9
            named = header.robot, header.incarnation
            self.difference = error.difference(*named, self.number, at_s)
            self.upcoming = None
        else:
            self.upcoming = next(self._steps, None)

    def _make(self, step: Step) -> None:
        if self.node is None:
            self.node = node_of(self._process, self.playback)
        elif step.leaves:
            assert isinstance(self.node, GuestNode)
            self.node.leave(step.now_ns)
        else:
            self.node.step(step.now_ns, self.playback.may_go_on)

    @property
    def result(self) -> Replayed:
        header = self._process.header
        return Replayed(
            robot=header.robot,
            incarnation=header.incarnation,
            steps=self.number + 1,
            messages=self.playback.messages,
            seconds=(self.now_ns - header.start_ns) * 1e-9,
            difference=self.difference,
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


def replay_process(process: Process, until_ns: int | None = None) -> Replayed:
    """Replays one process, to its end or to this time of the robot."""
    replay = Replay(process)
    while (step := replay.upcoming) is not None and (until_ns is None or step.now_ns <= until_ns):
        replay.step()
    return replay.result
