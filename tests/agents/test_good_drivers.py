"""Nothing is said of drivers that do well, whatever they measure, and however seldom and late."""

import math
import os
import random
from pathlib import Path

import pytest
from msgspec.structs import replace
from support.drivers import PLACES, Drive, DrivenRobot, World
from support.sweeps import thorough

from cpcbl_agents.node import Node, NodeCallbacks, NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_agents.sources.mrclam import MrclamSource
from cpcbl_launch.run.logged_team import load_logged_team
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import SensorSettings, Team
from cpcbl_team.geometry import Pose2
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, encode


def drives(random: random.Random) -> Drive:
    """One of many: standing, spinning, driving backwards, in circles, with stops."""
    v = random.choice([0.1, 0.3, 0.5, 1.0])
    w = random.choice([-1, 1]) * random.choice([0.1, 0.3, 0.6, 1.0])
    made: list[Drive] = [
        lambda t: (0.0, 0.0),
        lambda t: (0.0, w),
        lambda t: (-v, 0.3 * w),
        lambda t: (v if t % 16 < 8 else -v, 0.0),
        lambda t: (v, w),
        lambda t: (v, 0.0) if t % 7 < 4 else (0.0, w),
        lambda t: (v, w) if t % 5 < 2 else (0.0, 0.0),
        lambda t: (0.05, 0.05 * w),
        lambda t: (v, 0.8 * math.copysign(math.cos(t), w)),
    ]
    return random.choice(made)


def world(seed: int) -> World:
    """Any world, and any sensors that are as good as the team file says, but for their outliers."""
    r = random.Random(seed)
    share, deg, view_deg = r.choice([0.01, 0.03, 0.1]), r.choice([0.5, 2, 4]), r.choice([60, 360])
    number, worse = r.choice([0, 1, 1, 2, 3, 4, 4]), r.choice([1.0, 1.0, 1.5])
    sensor = SensorSettings(
        field_of_view_deg=view_deg, range_share=share, bearing_sigma_deg=float(deg)
    )
    return World(
        drives(r),
        {name: (r.uniform(-5, 5), r.uniform(-5, 5)) for name in [*PLACES][:number]},
        Pose2(r.uniform(-1, 1), r.uniform(-1, 1), r.uniform(-3, 3)),
        odometry_hz=r.choice([2.0, 5.0, 10.0, 20.0, 50.0]),
        sightings_hz=r.choice([1.0, 2.0, 5.0, 10.0, 30.0]),
        position_hz=r.choice([0.0, 0.0, 1.0, 5.0, 10.0]),
        latency_s=r.choice([0.0, 0.02, 0.1, 0.3, 0.49]),
        jitter_s=r.choice([0.0, 0.0, 0.05, 0.2]),
        range_share=share * worse,
        bearing_deg=deg * worse,
        slip=r.choice([0.0, 0.03, 0.1]),
        outliers=r.choice([0.0, 0.0, 0.05, 0.2]),
        view_deg=view_deg,
        empty_frames=r.random() < 0.5,
        settings={"sensor": sensor},
        seed=seed,
    )


def said_of(seeds: range) -> dict[int, set[str]]:
    """What is said of the drivers of these worlds, where anything is."""
    said = {}
    for seed in seeds:
        robot = DrivenRobot(world(seed))
        robot.run(25.0)
        if problems := {text for status in robot.statuses for text in status.problems}:
            said[seed] = problems
    return said


@pytest.mark.parametrize("seeds", [range(5), thorough(range(5, 10))], ids=["5", "5 more"])
def test_nothing_is_said_of_good_drivers(seeds: range) -> None:
    assert said_of(seeds) == {}


@pytest.mark.long
@pytest.mark.parametrize("first", range(10, 450, 20))
def test_nothing_is_said_of_many_more_good_drivers(first: int) -> None:
    assert said_of(range(first, first + 20)) == {}


@pytest.mark.log
@pytest.mark.parametrize("number", [2, 4, 6])
def test_nothing_is_said_of_real_robots(number: int) -> None:
    folder = Path(os.environ["CPCBL_MRCLAM"]) / f"MRCLAM{number}"
    logged = load_logged_team(load_team(builtin_path(f"mrclam-without-{number}")), folder)
    for name, settings in logged.team.robots.items():
        robots = logged.team.robots | {name: replace(settings, source="external")}
        said = problems_of(name, replace(logged.team, robots=robots), folder, logged.start_ns)
        assert {text for text in said if "barcode-" not in text} == set()  # read wrong


def problems_of(name: str, team: Team, folder: Path, start_ns: int) -> set[str]:
    """What the first 200 s of a log say, sent as a driver sends them."""
    source, hub, statuses = MrclamSource(folder, name), MemoryHub(), list[Status]()
    start_ns = max(start_ns, source.first_ns)
    robot = build_robot(name, team, start_ns)
    callbacks = NodeCallbacks(on_status=statuses.append)
    node = Node(robot, team, hub.session(), NodeStart(start_ns, "1"), callbacks)
    bus = hub.session()
    source.poll(start_ns)
    for now_ns in range(start_ns, start_ns + 200 * 10**9, 10**8):
        for message in source.poll(now_ns):
            topic = topics.topic_of(type(message))
            bus.publisher(topic.at(robot=name), topic.qos).put(encode(message))
        node.step(now_ns)
    return {text for status in statuses for text in status.problems}
