"""What a robot costs in teams of different sizes: messages, bytes and CPU, beside the accuracy."""

import gc
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import msgspec

from cpcbl_agents.node import Steppable
from cpcbl_launch.checks import require_duration
from cpcbl_launch.lab.scaling.swarm import MOST_ROBOTS, swarm_team
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import Progress, robot_nodes, run_nodes, simulated_report
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, decode_tagged

DURATION_S = 5.0
LEAST_S = 2.0  # a robot tells once a second what it has sent


class TeamSizeFigures(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a team, means over its robots. Seconds are robot time; bytes are those on the
    sender's link, with Zenoh's own."""

    robots: int
    in_sight: float
    """The number of teammates in one frame."""
    messages_sent_per_s: float
    bytes_sent_per_s: float
    messages_received_per_s: float
    bytes_received_per_s: float
    """Fixes and beliefs."""
    cpu_ms_per_s: float
    """CPU of the robot's own steps; sending puts a message into the inboxes of its receivers."""
    field_cpu_ms_per_s: float
    """CPU of the simulation of one robot: its motion and its sightings."""
    times_real_time: float
    """Of the whole process, without start-up and report."""
    position_rmse_m: float | None
    inside_3_sigma: float | None


class ScalingReport(msgspec.Struct, frozen=True, kw_only=True):
    """The report of `simulate --robots`."""

    duration_s: float
    seed: int
    sizes: tuple[TeamSizeFigures, ...]


def parse_sizes(text: str) -> list[int]:
    """The sizes in a text such as `2,10,50`. Raises InputError."""
    sizes = [int(part) if part.strip().isdecimal() else 0 for part in text.split(",")]
    if not all(2 <= size <= MOST_ROBOTS for size in sizes):
        raise InputError(f"--robots {text}: team sizes from 2 to {MOST_ROBOTS}, such as 2,10,50")
    return sizes


def measure_sizes(
    sizes: Sequence[int],
    seed: int = 1,
    duration_s: float = DURATION_S,
    progress: Progress | None = None,
) -> ScalingReport:
    """Measures generated teams of these sizes, one after the other.

    Raises InputError if the duration is too short.
    """
    require_duration(duration_s, LEAST_S)
    figures: list[TeamSizeFigures] = []
    for i, size in enumerate(sizes):
        part = _partial_progress(progress, sum(sizes[:i]), size, sum(sizes))
        figures.append(measure_team(swarm_team(size, seed), seed, duration_s, part))
    return ScalingReport(duration_s=duration_s, seed=seed, sizes=tuple(figures))


def _partial_progress(progress: Progress | None, before: int, size: int, total: int) -> Progress:
    """The progress of one team as a part of the progress of all."""
    show = progress or (lambda done: None)
    return lambda done: show((before + done * size) / total)


def measure_team(
    team: Team, seed: int, duration_s: float, progress: Progress | None = None
) -> TeamSizeFigures:
    """Simulates a team in one process over the bus in memory."""
    hub, count = MemoryHub(), len(team.robots)
    recorder, sight = Recorder(hub.session()), TeammateCounter(hub.session(), team)
    field = TimedNode(FieldNode(SimulatedField(team, seed, 0), hub.session()))
    robots = [TimedNode(node) for node in robot_nodes(team, hub, 0)]
    began_s = time.monotonic()
    with garbage_collector_disabled():
        run_nodes([field, *robots], 0, int(duration_s * 1e9), progress)
    took_s = time.monotonic() - began_s
    score = simulated_report(recorder, team).team
    ms_per_s = 1e3 / (count * duration_s)

    def rate(name: str) -> float:
        return sum(_per_s(status, name) for status in recorder.status.values()) / count

    return TeamSizeFigures(
        robots=count,
        in_sight=sight.mean,
        messages_sent_per_s=rate("messages_sent"),
        bytes_sent_per_s=rate("bytes_sent"),
        messages_received_per_s=rate("messages_received"),
        bytes_received_per_s=rate("bytes_received"),
        cpu_ms_per_s=ms_per_s * sum(robot.cpu_s for robot in robots),
        field_cpu_ms_per_s=ms_per_s * field.cpu_s,
        times_real_time=duration_s / took_s,
        position_rmse_m=score.position_rmse_m,
        inside_3_sigma=score.inside_3_sigma,
    )


def _per_s(status: Status, name: str) -> float:
    return float(getattr(status, name)) / (status.stamp_ns * 1e-9)


@contextmanager
def garbage_collector_disabled() -> Iterator[None]:
    """Python's garbage collector examines the robots of the whole process, which would grow with
    the team; in a process of its own a robot has only itself. Robots create no reference cycles."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class TimedNode:
    """A node, and the CPU time that its steps took."""

    def __init__(self, node: Steppable) -> None:
        self._node = node
        self.cpu_s = 0.0

    @property
    def next_ns(self) -> int:
        return self._node.next_ns

    @property
    def waiting(self) -> bool:
        return self._node.waiting

    def step(self, now_ns: int) -> None:
        began_s = time.process_time()
        self._node.step(now_ns)
        self.cpu_s += time.process_time() - began_s


class TeammateCounter:
    """Counts the teammates in the robots' frames."""

    def __init__(self, bus: Bus, team: Team) -> None:
        self._robots = team.robots
        self._frames = self._teammates = 0
        bus.subscribe(topics.IN_SIGHTINGS.at(), self._arrived)

    @property
    def mean(self) -> float:
        return self._teammates / max(self._frames, 1)

    def _arrived(self, key: str, payload: bytes) -> None:
        frame = decode_tagged(payload)
        if isinstance(frame, Sightings):
            self._frames += 1
            self._teammates += sum(seen.id in self._robots for seen in frame.sightings)
