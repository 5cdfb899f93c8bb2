"""Runs the robots of a run again on what they sensed. Who helps whom they decide anew.

All nodes share a bus in memory. It delivers at once, so the delays between robots are not those of
the recorded run; those between sensors and robots are, for each input is taken when it was taken.
"""

from collections import Counter, deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cpcbl_agents.detection_worker import DetectedFrame, Detection
from cpcbl_agents.node import GuestNode, Node, Steppable
from cpcbl_agents.robot import NEVER_NS, Robot, build_sensing
from cpcbl_agents.sources import OwnCamera
from cpcbl_agents.tape import Tape
from cpcbl_launch.lab.what_if.inputs import (
    BUS,
    CAMERA,
    DETECTOR,
    LOG,
    RecordedInputs,
    RecordedProcess,
    only_settings,
)
from cpcbl_launch.reporting.metrics import Floats, Trajectory
from cpcbl_launch.reporting.recorder import Recorder, Report, variants_of
from cpcbl_launch.simulation.in_process import Progress, run_nodes
from cpcbl_team.inputs import Sightings
from cpcbl_transport import topics
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.memory_bus import MemoryBus, MemoryHub
from cpcbl_transport.messages import LARGEST_FRAME, Drive, decode_tagged


class Rerun(NamedTuple):
    """What came of a run that was made again."""

    report: Report
    paths: dict[str, Trajectory]
    commands: dict[str, Floats]
    """What robots that drive by their estimates told their wheels: rows of s, m/s, rad/s."""


def run_again(inputs: RecordedInputs, progress: Progress | None = None) -> Rerun:
    """The run with these inputs. The same inputs give the same bits."""
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    commands: dict[str, list[tuple[float, float, float]]] = {}

    def on_drive(received: Received[Drive]) -> None:
        drive = received.message
        row = drive.stamp_ns * 1e-9, drive.speed_m_s, drive.turn_rate_rad_s
        commands.setdefault(drive.robot, []).append(row)

    Subscriber(hub.session(), Drive, on_drive)
    hub.session().subscribe(topics.JOIN.at(), lambda key, payload: None)  # guests ask on without
    robots = [
        _RecordedRobot([p for p in inputs.processes if p.robot == name], hub)
        for name in inputs.robots
    ]
    run_nodes([_Feeder(robots), *robots], inputs.start_ns, inputs.end_ns, progress)
    variants = variants_of(inputs.team)
    report = recorder.report({n: variants.get(n, "") for n in inputs.robots}, inputs.truth)
    paths = {name: recorder.trajectory(name) for name in inputs.robots}
    return Rerun(report, paths, {name: np.array(rows) for name, rows in commands.items()})


class _RecordedRobot(Steppable):
    """The processes of one robot, one after the other."""

    def __init__(self, processes: Sequence[RecordedProcess], hub: MemoryHub) -> None:
        self._processes, self._hub = deque(processes), hub
        self._node: Node | None = None
        self._bus: MemoryBus | None = None
        self._tape = _Fed()
        self._inputs: deque[Any] = deque()

    @property
    def next_input_ns(self) -> int:
        """When its next input that the robot does not poll itself is due."""
        return self._inputs[0].now_ns if self._inputs else NEVER_NS

    @property
    def next_ns(self) -> int:
        if not self._processes:
            return NEVER_NS
        process = self._processes[0]
        if self._node is None:
            return process.start.stamp_ns
        return min(self._node.next_ns, process.end_ns)

    @property
    def waiting(self) -> bool:
        return self._node is not None and (self._node.waiting or self._tape.detection.has_news)

    def feed(self, now_ns: int) -> None:
        """Starts what is due, and hands over the inputs that are."""
        if self._node is None and self._processes and now_ns >= self._processes[0].start.stamp_ns:
            self._start(self._processes[0])
        while self._inputs and self._inputs[0].now_ns <= now_ns:
            assert self._node is not None
            _, way, key, payload = self._inputs.popleft()
            if way == BUS:
                self._node.arrivals.put_message(key, payload)
            else:
                self._tape.detection.add(payload, key)

    def step(self, now_ns: int) -> None:
        self.feed(now_ns)
        if self._node is None:
            return
        self._node.step(now_ns)
        self._tape.detection.has_news = False
        if now_ns >= self._processes[0].end_ns:
            self._end(now_ns)

    def _start(self, process: RecordedProcess) -> None:
        self._bus, self._tape = self._hub.session(), _Fed()
        self._node = _node(process, self._bus, self._tape)
        self._inputs = deque(t for t in process.taken if t.way in (BUS, DETECTOR))

    def _end(self, now_ns: int) -> None:
        """The process is gone: a guest says so, all else sees its tokens end."""
        assert self._bus is not None
        if self._processes.popleft().leaves and isinstance(self._node, GuestNode):
            self._node.leave(now_ns)
        self._bus.close()
        self._node = None
        self._inputs.clear()


class _Feeder(Steppable):
    """Hands all robots their inputs before any of them works, as one field does."""

    waiting = False

    def __init__(self, robots: Sequence[_RecordedRobot]) -> None:
        self._robots = robots

    @property
    def next_ns(self) -> int:
        return min(robot.next_input_ns for robot in self._robots)

    def step(self, now_ns: int) -> None:
        for robot in self._robots:
            robot.feed(now_ns)


def _node(process: RecordedProcess, bus: MemoryBus, tape: "_Fed") -> Node:
    """The node of a process as it started. No file is opened, no camera."""
    name, own_team = process.robot, only_settings(process)
    has_log = process.team.robots[name].source == "mrclam"
    source = _Polled(process, LOG) if has_log else None
    camera = _Polled(process, CAMERA) if process.has_camera else None
    sensing = build_sensing(name, own_team, source, camera)
    robot = Robot(name, own_team, process.robot_start_ns, sensing, process.restarted)
    kind = GuestNode if process.is_guest else Node
    return kind(robot, process.team, bus, process.start, tape=tape)


class _Polled(OwnCamera):
    """What a robot's own log or camera had, when it had it."""

    def __init__(self, process: RecordedProcess, way: str) -> None:
        self._items = deque(
            (t.now_ns, decode_tagged(t.payload, LARGEST_FRAME))
            for t in process.taken
            if t.way == way
        )

    @property
    def counts(self) -> Counter[str]:
        return Counter()

    @property
    def next_ns(self) -> int | None:
        return self._items[0][0] if self._items else None

    @property
    def is_finished(self) -> bool:
        return not self._items

    def poll(self, now_ns: int) -> Sequence[Any]:
        found = []
        while self._items and self._items[0][0] <= now_ns:
            found.append(self._items.popleft()[1])
        return found

    def close(self) -> None:
        """There is nothing to close."""


class _FedDetection(Detection):
    """What a robot's detector found in the frames, when it was done with them."""

    problems = ()

    def __init__(self) -> None:
        self.has_news = False
        self._found: list[DetectedFrame] = []
        self._submitted_ns = self._collected_ns = -1

    def add(self, payload: bytes, reason: str) -> None:
        found = decode_tagged(payload) if payload else None
        if isinstance(found, Sightings):
            self._found.append(DetectedFrame(found.stamp_ns, found))
        else:
            self._found.append(DetectedFrame(self._submitted_ns, reason))
        self.has_news = True

    @property
    def counts(self) -> Counter[str]:
        return Counter()

    @property
    def is_busy(self) -> bool:
        return self._collected_ns < self._submitted_ns

    def submit(self, frame: Any, annotates: bool) -> bool:
        self._submitted_ns = frame.stamp_ns
        return False

    def collect(self) -> Sequence[DetectedFrame]:
        found, self._found = self._found, []
        if found:
            self._collected_ns = found[-1].stamp_ns
        return found


class _Fed(Tape):
    """Puts what the detector found in place of the detector."""

    def __init__(self) -> None:
        self.detection = _FedDetection()

    def wrap_detection(self, detection: Detection) -> Detection:
        return self.detection
