"""The simulated field: true poses, what robots sense of it, what they bump into.

Deterministic for a seed and the same commands.
"""

import math
from collections import deque
from collections.abc import Iterable
from functools import partial
from itertools import product

from msgspec.structs import replace

from cpcbl_launch.simulation.robot import Noise, SimulatedRobot, VisibleObject
from cpcbl_launch.simulation.true_map import true_map
from cpcbl_team.config import SimulationEvent, Team
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import (
    Drive,
    Frame,
    SensorInput,
    SimulatedRobotModel,
    Truth,
    Truths,
    settings_from_model,
)

_GUEST_SEED = 2**31  # no robot of a team file has this number
_MARGIN_M = 1e-3  # so that rounding moves nothing beyond the next cell of a grid


class Grid:
    """Objects by square cell, which is as wide as anybody can reach, so that nine are enough."""

    def __init__(self, reach_m: float, objects: Iterable[VisibleObject]) -> None:
        self._side_m = reach_m + _MARGIN_M
        self._cells: dict[tuple[int, int], list[tuple[int, VisibleObject]]] = {}
        for number, seen in enumerate(objects):
            self._cells.setdefault(self._cell(seen.x, seen.y), []).append((number, seen))
        self._near: dict[tuple[int, int], list[VisibleObject]] = {}  # as far as it was asked for

    def near(self, x: float, y: float) -> list[VisibleObject]:
        """All within reach of a place (metres) and some beyond, in the order they were given."""
        column, row = own = self._cell(x, y)
        if own not in self._near:
            cells = product((column - 1, column, column + 1), (row - 1, row, row + 1))
            found = [numbered for cell in cells for numbered in self._cells.get(cell, ())]
            self._near[own] = [seen for _, seen in sorted(found)]  # no two have the same number
        return self._near[own]

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        return math.floor(x / self._side_m), math.floor(y / self._side_m)


class SimulatedField:
    """All robots of a team on one field, in fixed steps of time."""

    def __init__(self, team: Team, seed: int, start_ns: int, is_paired: bool = False) -> None:
        """`is_paired`: its errors are those of a field with more or fewer robots or landmarks."""
        self.team, self._seed, self._is_paired = team, seed, is_paired
        self._step_ns = int(1e9 / team.simulation.step_rate_hz)
        self.now_ns = start_ns
        noise, first_ns = team.simulation.noise, start_ns + self._step_ns
        self.robots = {
            name: SimulatedRobot(
                robot,
                Noise(noise, (seed, *name.encode(), 256) if is_paired else (seed, i), is_paired),
                start_ns,
                self._step_ns,
                _first_frame_ns(team, name, first_ns),
            )
            for i, (name, robot) in enumerate(team.robots.items())
            if robot.source == "simulated"
        }
        self._map, self._cameras = true_map(team, seed), None
        if team.renders:  # OpenCV is loaded for nobody else
            from cpcbl_launch.simulation.camera.cameras import Cameras

            self._cameras = Cameras(replace(team, map=self._map), seed)
        self.skipped_frames = 0  # frames that were due in steps without pictures
        self._start_ns = start_ns
        self._events = deque(sorted(team.simulation.events, key=lambda event: event.at_s))
        self._hidden_until_ns = start_ns
        landmarks = self._map.landmarks.items()
        self.place_landmarks(VisibleObject(name, m.x_m, m.y_m, m.gives) for name, m in landmarks)

    def place_landmarks(self, landmarks: Iterable[VisibleObject]) -> None:
        """These landmarks stand on the field from now on, and no others; two may have one name.
        (Cameras show those of the map.)"""
        self.landmarks = tuple(landmarks)
        self._landmarks_to_bump = Grid(self.team.simulation.bump_radius_m, self.landmarks)
        self._update_sensing_range()

    def _update_sensing_range(self) -> None:
        ranges_m = [robot.settings.sensor.max_range_m for robot in self.robots.values()]
        self._reach_m = max(ranges_m, default=0.0)
        self._landmarks_to_see = Grid(self._reach_m, self.landmarks)

    def add_guest(self, name: str, model: SimulatedRobotModel) -> None:
        """A guest has a body from now on. Its noise is its own: the others' stays what it was."""
        settings = settings_from_model(model)
        seed, noise = (self._seed, _GUEST_SEED, *name.encode()), self.team.simulation.noise
        self.robots[name] = SimulatedRobot(
            settings, Noise(noise, seed, self._is_paired), self.now_ns, self._step_ns
        )
        self._update_sensing_range()

    def remove_guest(self, name: str) -> None:
        del self.robots[name]
        self._update_sensing_range()

    @property
    def next_ns(self) -> int:
        return self.now_ns + self._step_ns

    def clock_offset_ns(self, robot: str) -> int:
        """How far a robot's clock is ahead of the field's."""
        return int(self.team.simulation.clocks_ahead_s.get(robot, 0.0) * 1e9)

    def command(self, drive: Drive) -> None:
        """A robot's wheels from now on; commands for unknown robots are ignored."""
        if drive.robot in self.robots:
            self.robots[drive.robot].drive = drive

    def advance(self, pictures: bool = True) -> list[tuple[str, SensorInput]]:
        """One step; what each robot senses at its end, with or without its camera."""
        self.now_ns += self._step_ns
        elapsed_s = (self.now_ns - self._start_ns) * 1e-9
        while self._events and elapsed_s >= self._events[0].at_s:
            self._apply_event(self._events.popleft())
        for robot in self.robots.values():
            robot.move(self.now_ns, self._step_ns * 1e-9)
            self._count_bumps(robot)
        mates = Grid(
            self._reach_m,
            [VisibleObject(n, *r.pose[:2], "both", teammate=True) for n, r in self.robots.items()],
        )
        sensed: list[tuple[str, SensorInput]] = []
        for name, robot in self.robots.items():
            piece = robot.odometry(self.now_ns)
            frames = robot.frames(self.now_ns, partial(self._take_frame, name, mates, pictures))
            items = (piece, *frames, *robot.positions(self.now_ns))
            sensed += [(name, item) for item in items if item is not None]
        return sensed

    def truth(self) -> Truths:
        robots = tuple(Truth(n, *r.pose, r.bumps) for n, r in self.robots.items())
        return Truths(self.now_ns, robots)

    def _apply_event(self, event: SimulationEvent) -> None:
        hidden_ns = self._start_ns + int((event.at_s + event.hide_landmarks_s) * 1e9)
        self._hidden_until_ns = max(self._hidden_until_ns, hidden_ns)
        if event.to is not None and event.kidnap in self.robots:
            x, y, heading_deg = event.to
            self.robots[event.kidnap].pose = Pose2(x, y, wrap_angle(math.radians(heading_deg)))

    def _take_frame(
        self, name: str, mates: Grid, pictures: bool, stamp_ns: int
    ) -> Sightings | Frame | None:
        """What a robot sees now: a picture, if it has a camera."""
        robot = self.robots[name]
        if robot.settings.sensing == "camera" and self._cameras is not None:
            if not pictures:
                self.skipped_frames += 1
                return None
            poses = {other: r.pose for other, r in self.robots.items()}
            return self._cameras.frame(name, stamp_ns, poses, self._are_landmarks_hidden)
        return robot.sightings(self.now_ns, stamp_ns, self._visible_objects(name, mates))

    @property
    def _are_landmarks_hidden(self) -> bool:
        return self.now_ns < self._hidden_until_ns

    def _visible_objects(self, viewer: str, mates: Grid) -> Iterable[VisibleObject]:
        pose = self.robots[viewer].pose
        if not self._are_landmarks_hidden:
            yield from self._landmarks_to_see.near(pose.x, pose.y)
            yield from self._nearest_wall_points(pose)
        yield from (mate for mate in mates.near(pose.x, pose.y) if mate.name != viewer)

    def _nearest_wall_points(self, pose: Pose2) -> Iterable[VisibleObject]:
        for name, wall in self._map.walls.items():
            (ax, ay), (bx, by) = wall.from_m, wall.to_m
            length = math.hypot(bx - ax, by - ay)
            ux, uy = (bx - ax) / length, (by - ay) / length
            along = ux * (pose.x - ax) + uy * (pose.y - ay)
            if 0.0 <= along <= length:
                yield VisibleObject(name, ax + along * ux, ay + along * uy, wall.gives)

    def _count_bumps(self, robot: SimulatedRobot) -> None:
        radius = self.team.simulation.bump_radius_m
        touching = frozenset(
            mark.name
            for mark in self._landmarks_to_bump.near(robot.pose.x, robot.pose.y)
            if math.hypot(mark.x - robot.pose.x, mark.y - robot.pose.y) < radius
        )
        robot.bumps += len(touching - robot.touching)
        robot.touching = touching


def _first_frame_ns(team: Team, name: str, from_ns: int) -> int | None:
    """When a camera's first frame is due: one after the other, as cameras do not wait for each
    other and pictures take time."""
    robots = team.cameras
    if name not in robots:
        return None
    period_ns = 1e9 / team.robots[name].sensor.rate_hz
    return from_ns + int(period_ns * robots.index(name) / len(robots))
