"""Generated teams of any size: what one robot costs in each, beside its accuracy.

Homes lie on a square lattice, one for each robot; a landmark stands on every second corner between
them. A robot drives around its home, so that the density is constant. It sees so far that even a
small team fills its view: about seven teammates and three landmarks, fewer at the edge. One robot
in five is an observer with good sensors; every second one of the others is a scout, blind to
landmarks.

`make bench-scaling ARGS='--team-sizes 2,10,50,200,1000'`
"""

import argparse
import gc
import math
import time
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from random import Random

from benchmarks.report import show_and_write, user_errors
from msgspec import Struct
from msgspec.structs import replace
from rich.console import RenderableType
from support.simulated import SteppableProxy

from cpcbl_agents.node import Steppable
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import Progress, robot_nodes, run_nodes, simulated_report
from cpcbl_launch.team.requirements import require_duration
from cpcbl_launch.views.run import progress_bar
from cpcbl_team import config
from cpcbl_team.config import RobotSettings, SensorSettings, Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Sightings
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.memory_bus import MemoryHub

DURATION_S = 5.0
LEAST_S = 2.0  # a robot tells once a second what it has sent
MOST_ROBOTS = 9999
SPACING_M = 2.45  # of homes: one robot on 6 m²
ROUND_M = 0.7  # radius of the way round a home
STRAY_M = 0.2  # how far a home lies off its place on the lattice, at most
SPEED_M_S = 0.3
NAVIGATOR = SensorSettings(
    range_share=0.05, bearing_sigma_deg=4.0, field_of_view_deg=360.0, max_range_m=3.7
)
OBSERVER = replace(NAVIGATOR, range_share=0.01, bearing_sigma_deg=1.0)
SCOUT = replace(NAVIGATOR, sees_landmarks=False)
SENSORS = (OBSERVER, SCOUT, NAVIGATOR, SCOUT, NAVIGATOR)
LEGEND = (
    "Means over the robots. in sight: teammates in a frame; out, in: fixes and beliefs,\n"
    "and their bytes on the link; CPU: of a robot's own steps, per second of its time."
)


class TeamSizeFigures(Struct, frozen=True, kw_only=True):
    """The figures of a team, means over its robots. Seconds are robot time; bytes are those on the
    sender's link, with Zenoh's own."""

    robots: int
    in_sight: float  # the number of teammates in one frame
    messages_sent_per_s: float
    bytes_sent_per_s: float
    messages_received_per_s: float
    bytes_received_per_s: float  # fixes and beliefs
    cpu_ms_per_s: float  # CPU of the robot's own steps; to send is to fill its receivers' inboxes
    field_cpu_ms_per_s: float  # CPU of the simulation of one robot: its motion and its sightings
    times_real_time: float  # of the whole process, without start-up and report
    position_rmse_m: float | None
    inside_3_sigma: float | None


class ScalingReport(Struct, frozen=True, kw_only=True):
    """What the benchmark writes."""

    duration_s: float
    seed: int
    sizes: tuple[TeamSizeFigures, ...]


def swarm_team(size: int, seed: int) -> Team:
    """A team of this size; the seed determines each robot's home and direction."""
    random = Random(f"{seed} {size}")
    columns = math.ceil(math.sqrt(size))
    robots = {}
    for i, place in enumerate(random.sample(range(size), size)):
        row, column = divmod(place, columns)
        x, y = (SPACING_M * (k + 0.5) + random.uniform(-STRAY_M, STRAY_M) for k in (column, row))
        robots[f"r{i:04}"] = _robot(x, y, random.uniform(0.0, math.tau), SENSORS[i % len(SENSORS)])
    rows = math.ceil(size / columns)
    marks = {
        f"m{column}-{row}": config.Landmark(x_m=SPACING_M * column, y_m=SPACING_M * row)
        for row in range(rows + 1)
        for column in range(row % 2, columns + 1, 2)
    }
    return Team(name=f"swarm{size}", robots=robots, map=config.Field(landmarks=marks))


def _robot(home_x: float, home_y: float, from_rad: float, sensor: SensorSettings) -> RobotSettings:
    """A robot that drives on a square around its home, from the corner in this direction."""
    directions = (from_rad + 0.5 * math.pi * k for k in range(4))
    corners = [(home_x + ROUND_M * math.cos(a), home_y + ROUND_M * math.sin(a)) for a in directions]
    (x, y), *others = corners
    return RobotSettings(
        start=config.Start(x_m=x, y_m=y, heading_deg=math.degrees(from_rad) + 135.0),
        sensor=sensor,
        odometry=config.OdometrySettings(distance_sigma_m_per_sqrt_m=0.1),
        waypoints_m=(*others, (x, y)),
        speed_m_s=SPEED_M_S,
    )


def parse_sizes(text: str) -> list[int]:
    """The sizes in a text such as `2,10,50`. Raises InputError."""
    sizes = [int(part) if part.strip().isdecimal() else 0 for part in text.split(",")]
    if not all(2 <= size <= MOST_ROBOTS for size in sizes):
        raise InputError(f"--team-sizes {text}: sizes from 2 to {MOST_ROBOTS}, such as 2,10,50")
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

    def show_part(before: int, size: int, done: float) -> None:
        if progress is not None:
            progress((before + done * size) / sum(sizes))

    for i, size in enumerate(sizes):
        part = partial(show_part, sum(sizes[:i]), size)
        figures.append(measure_team(swarm_team(size, seed), seed, duration_s, part))
    return ScalingReport(duration_s=duration_s, seed=seed, sizes=tuple(figures))


def measure_team(
    team: Team, seed: int, duration_s: float, progress: Progress | None = None
) -> TeamSizeFigures:
    """Simulates a team in one process over the bus in memory."""
    hub, count = MemoryHub(), len(team.robots)
    recorder = Recorder(hub.session())
    in_sight: list[int] = []  # teammates, of each frame

    def count_teammates(frame: Received[Sightings]) -> None:
        in_sight.append(sum(seen.id in team.robots for seen in frame.message.sightings))

    Subscriber(hub.session(), Sightings, count_teammates)
    field = TimedNode(FieldNode(SimulatedField(team, seed, 0), hub.session()))
    robots = [TimedNode(node) for node in robot_nodes(team, hub, 0)]
    began_s = time.monotonic()
    # Python's garbage collector examines the robots of the whole process, which would grow with the
    # team; in a process of its own a robot has only itself. Robots create no reference cycles.
    gc.disable()
    try:
        run_nodes([field, *robots], 0, int(duration_s * 1e9), progress)
    finally:
        gc.enable()
    took_s = time.monotonic() - began_s
    score = simulated_report(recorder, team).team
    ms_per_s = 1e3 / (count * duration_s)

    def rate(name: str) -> float:
        reports = recorder.status.values()
        return sum(float(getattr(r, name)) / (r.stamp_ns * 1e-9) for r in reports) / count

    return TeamSizeFigures(
        robots=count,
        in_sight=sum(in_sight) / max(len(in_sight), 1),
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


class TimedNode(SteppableProxy):
    """A node, and the CPU time that its steps took."""

    def __init__(self, node: Steppable) -> None:
        super().__init__(node)
        self.cpu_s = 0.0

    def step(self, now_ns: int) -> None:
        began_s = time.process_time()
        super().step(now_ns)
        self.cpu_s += time.process_time() - began_s


def tables(scale: ScalingReport) -> Iterable[RenderableType]:
    """The figures for people."""
    title = f"generated teams in one process, {scale.duration_s:g} s of robot time"
    rates = ("out/s", "B/s", "in/s", "B/s", "CPU ms/s", "x real")
    columns = ("robots", "in sight", *rates, "RMSE m", "in 3 σ")
    shown = table(f"{title}, seed {scale.seed}", (), columns)
    quantities = "robots in_sight:.1f messages_sent_per_s:.1f bytes_sent_per_s:.0f"
    quantities += " messages_received_per_s:.1f bytes_received_per_s:.0f cpu_ms_per_s:.1f"
    quantities += " times_real_time:.3g position_rmse_m:.3f inside_3_sigma:.1%"
    for size in scale.sizes:
        shown.add_row(*cells(size, quantities))
    yield shown
    yield LEGEND


def draw(scale: ScalingReport, path: Path) -> None:
    """The bytes per second that a robot sends and receives, and the CPU of its steps."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    mpl.use("Agg")

    figure, (traffic, cpu) = plt.subplots(1, 2, figsize=(10, 4))
    sizes = [s.robots for s in scale.sizes]
    traffic.plot(sizes, [s.bytes_sent_per_s for s in scale.sizes], "o-", label="sent")
    traffic.plot(sizes, [s.bytes_received_per_s for s in scale.sizes], "o-", label="received")
    traffic.set(title="fixes and beliefs of a robot", ylabel="bytes a second on their link")
    traffic.legend()
    cpu.plot(sizes, [s.cpu_ms_per_s for s in scale.sizes], "o-", color="C2")
    cpu.set(title="CPU of a robot", ylabel="ms in a second of robot time")
    for axes in (traffic, cpu):
        axes.set(xlabel="robots in the team", xscale="log", ylim=(0, None))
        axes.set_xticks(sizes, labels=[str(size) for size in sizes], minor=False)
        axes.minorticks_off()
        axes.grid(True, alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Simulates generated teams in one process, and writes `scale.json` and `scale.png`."""
    parser = argparse.ArgumentParser(prog="bench-scaling", description=main.__doc__)
    parser.add_argument("--team-sizes", default="2,10,50,200", help="Sizes of the teams.")
    parser.add_argument("--duration", type=float, default=DURATION_S, help="Seconds of robot time.")
    parser.add_argument("--seed", type=int, default=1, help="Of the noise and of the teams.")
    parser.add_argument("--output", type=Path, default=Path("build"), help="Folder for the files.")
    given = parser.parse_args()
    with user_errors(parser):
        sizes = parse_sizes(given.team_sizes)
        with progress_bar("scaling", quiet=False) as progress:
            result = measure_sizes(sizes, given.seed, given.duration, progress)
    show_and_write(result, tables(result), given.output / "scale.json")
    draw(result, given.output / "scale.png")


if __name__ == "__main__":
    main()
