"""Simulated drives among landmarks, as robots report them, with what is true."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.drives import RunInputs
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import (
    Field,
    Landmark,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
    UnsurveyedWall,
)
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_team.motion import distance_variance, turn_variance
from cpcbl_team.sensors import range_sigma_m

STEP_NS = 100_000_000
STEPS_PER_FRAME = 5
MARKS = {
    "door": (0.0, 0.0),
    "lamp": (9.0, 0.3),
    "desk": (8.6, 5.2),
    "rack": (0.4, 4.8),
    "pole": (4.4, 2.6),
    "sofa": (6.3, 6.1),
}
ROOM = {  # around all of them
    "south": ((-0.8, -0.7), (9.8, -0.7)),
    "east": ((9.8, -0.7), (9.8, 6.9)),
    "north": ((9.8, 6.9), (-0.8, 6.9)),
    "west": ((-0.8, 6.9), (-0.8, -0.7)),
}
Ends = tuple[tuple[float, float], tuple[float, float]]
ODOMETRY = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.03,
    turn_sigma_rad_per_sqrt_rad=0.03,
    turn_sigma_rad_per_sqrt_m=0.03,
)
SENSOR = SensorSettings(range_share=0.02, range_floor_m=0.01, bearing_sigma_deg=1.0)
Change = Callable[[str, float, Sighting], Sighting | None]
"""What becomes of a sighting of a robot at a time (s) of a run."""


class World(NamedTuple):
    """Runs of a team, and the true places of its landmarks."""

    team: Team
    runs: list[RunInputs]
    places: dict[str, tuple[float, float]]
    paths: list[dict[str, Floats]]  # of each run and robot: true poses (n, 3), one each step
    walls: dict[str, Ends]  # where they are, which no robot is told


def make_world(
    seed: int = 1,
    robots: int = 1,
    days: int = 1,
    seconds: float = 60.0,
    noise: float = 1.0,
    blind: Sequence[str] = (),
    range_m: float = 7.0,
    places: dict[str, tuple[float, float]] | None = None,
    change: Change = lambda robot, at_s, sighting: sighting,
    walls: dict[str, Ends] | None = None,
    odometry: OdometrySettings = ODOMETRY,
) -> World:
    """Robots that drive from one random point of the field to the next, and see all around. `noise`
    is a multiple of what the settings state; `blind` robots see teammates alone. The team file says
    that nobody has surveyed the walls."""
    places, walls = MARKS if places is None else places, walls or {}
    rng, names = np.random.default_rng(seed), [f"r{i + 1}" for i in range(robots)]
    start = Start(x_m=1.0, y_m=1.0, heading_deg=20.0, sigma_m=0.0, heading_sigma_deg=0.0)
    settings = {
        name: RobotSettings(source="external", odometry=odometry, sensor=SENSOR, start=start)
        for name in names
    }
    marks = {name: Landmark(x_m=x, y_m=y) for name, (x, y) in places.items()}
    field = Field(landmarks=marks, unsurveyed_walls={name: UnsurveyedWall() for name in walls})
    team = Team(name="mapping", robots=settings, map=field)
    runs, paths = [], []
    for day in range(days):
        path = {name: _path(rng, i, seconds) for i, name in enumerate(names)}
        run = f"day{day + 1}"
        inputs = _run(rng, run, path, places, walls, noise, set(blind), range_m, change, odometry)
        runs.append(inputs)
        paths.append(path)
    return World(team, runs, places, paths, walls)


def _path(rng: np.random.Generator, number: int, seconds: float) -> Floats:
    """True poses, one each step."""
    pose = Pose2(1.0 + 2.0 * number, 1.0, math.radians(20.0))
    goal, poses = rng.uniform((0.8, 0.8), (8.2, 4.4)), [pose]
    for _ in range(round(seconds / (STEP_NS * 1e-9))):
        if math.hypot(goal[0] - pose.x, goal[1] - pose.y) < 0.3:
            goal = rng.uniform((0.8, 0.8), (8.2, 4.4))
        error = wrap_angle(math.atan2(goal[1] - pose.y, goal[0] - pose.x) - pose.heading)
        turn = min(max(error, -0.15), 0.15)
        pose = step(pose, 0.05 * max(math.cos(error), 0.2), turn)
        poses.append(pose)
    return np.array(poses)


def _run(
    rng: np.random.Generator,
    name: str,
    paths: dict[str, Floats],
    places: dict[str, tuple[float, float]],
    walls: dict[str, Ends],
    noise: float,
    blind: set[str],
    range_m: float,
    change: Change,
    settings: OdometrySettings,
) -> RunInputs:
    odometry, frames = dict[str, list[Odometry]](), dict[str, list[Sightings]]()
    for robot, path in paths.items():
        odometry[robot] = _odometry(rng, path, noise, settings)
        frames[robot] = []
        for i in range(0, len(path), STEPS_PER_FRAME):
            seen: dict[str, tuple[float, float]] = {} if robot in blind else dict(places)
            seen |= {n: (p[i, 0], p[i, 1]) for n, p in paths.items() if n != robot}
            seen |= {} if robot in blind else _feet(path[i], walls)
            read = [_sighting(rng, path[i], n, at, noise) for n, at in seen.items()]
            near = [s for s in read if s.range_m is not None and s.range_m < range_m]
            changed = [change(robot, i * STEP_NS * 1e-9, s) for s in near]
            sightings = tuple(s for s in changed if s is not None)
            if sightings:
                frames[robot].append(Sightings(i * STEP_NS, sightings))
    return RunInputs(name, odometry, frames)


def _feet(pose: Floats, walls: dict[str, Ends]) -> dict[str, tuple[float, float]]:
    """Where the perpendiculars from a pose meet the walls."""
    feet = {}
    for name, (begin, end) in walls.items():
        along = np.subtract(end, begin)
        share = float((pose[:2] - begin) @ along / (along @ along))
        if 0.0 <= share <= 1.0:
            x, y = np.add(begin, share * along).tolist()
            feet[name] = x, y
    return feet


def _odometry(
    rng: np.random.Generator, path: Floats, noise: float, settings: OdometrySettings
) -> list[Odometry]:
    pieces = []
    for i, (before, after) in enumerate(pairwise(path)):
        turn = wrap_angle(after[2] - before[2])
        distance = math.hypot(*(after - before)[:2])
        along = math.sqrt(distance_variance(distance, turn, settings, 0.0))
        around = math.sqrt(turn_variance(distance, turn, settings))
        e = noise * rng.standard_normal(2)
        read = float(distance + e[0] * along), float(turn + e[1] * around)
        pieces.append(Odometry(i * STEP_NS, (i + 1) * STEP_NS, *read))
    return pieces


def _sighting(
    rng: np.random.Generator, pose: Floats, name: str, at: tuple[float, float], noise: float
) -> Sighting:
    dx, dy = at[0] - pose[0], at[1] - pose[1]
    r, e = math.hypot(dx, dy), noise * rng.standard_normal(2)
    bearing = float(math.atan2(dy, dx) - pose[2] + e[1] * SENSOR.bearing_sigma_rad)
    range_m = max(r + float(e[0]) * range_sigma_m(SENSOR, r), 0.01)
    return Sighting(name, float(range_m), wrap_angle(bearing))
