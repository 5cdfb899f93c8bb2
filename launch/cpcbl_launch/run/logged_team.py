"""A team on a real log: its map, where its robots start, what truth there is."""

import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from cpcbl_agents.sources import mrclam
from cpcbl_launch.reporting.metrics import Floats, interpolated_truth
from cpcbl_launch.team.file import builtin_path
from cpcbl_launch.team.requirements import require_duration
from cpcbl_team.config import Field, Start, Team, Unsurveyed
from cpcbl_team.errors import InputError
from cpcbl_team.geometry import Pose2, step

LATEST_TRUTH_NS = 30_000_000_000
LEAST_S = 1.0


class LoggedTeam(NamedTuple):
    """A team whose robots have logs, and what the logs say besides."""

    team: Team
    truth: dict[str, Floats]
    left_out: dict[str, str]
    start_ns: int
    end_ns: int


def builtin_for(folder: Path) -> Path:
    """The built-in team file that was not calibrated on this data set (by the name's number)."""
    without = builtin_path(f"mrclam-without-{_number(folder.resolve().name)}")
    return without if without.exists() else builtin_path("mrclam")


def file_for(team_file: Path, folder: Path) -> Path:
    """The team file for a log: `mrclam` is the built-in one that was not calibrated on it."""
    is_name = team_file == Path("mrclam") and not team_file.is_file()
    return builtin_for(folder) if is_name else team_file


def is_calibrated_on(team: Team, folder: Path) -> bool:
    """Whether the team's robots were calibrated on this very data set."""
    return _number(folder.resolve().name) in map(_number, team.calibrated_on)


def _number(name: str) -> str:
    found = re.search(r"\d+$", name)
    return found.group() if found else name


def load_logged_team(team: Team, folder: Path) -> LoggedTeam:
    """The team on the MRCLAM log in `folder`: robots start at the log's first true pose.

    A robot whose files are missing is left out. Raises LogError, and InputError for a robot with
    files that would not read them.
    """
    there = set(mrclam.robots_in(folder))
    left_out = {
        name: "no " + ", ".join(mrclam.missing_files(folder, name))
        for name in team.robots
        if name not in there
    }
    names = [name for name in team.robots if name in there]
    if not names:
        raise mrclam.LogError(f"{folder}: has files for none of the robots {', '.join(left_out)}")
    for name in names:
        if (source := team.robots[name].source) != "mrclam":
            raise InputError(
                f'robots.{name}.source: {source}: reads no log; write source = "mrclam"'
            )
    truth = {name: mrclam.read_truth(folder, name) for name in names}
    spans = {name: mrclam.odometry_span_ns(folder, name) for name in names}
    robots = {
        name: msgspec.structs.replace(team.robots[name], start=_start(folder, name, truth[name]))
        for name in names
    }
    surveyed = mrclam.read_landmarks(folder)
    unsurveyed = {name: mark for name, mark in team.map.unsurveyed.items() if name in surveyed}
    known = {name: mark for name, mark in surveyed.items() if name not in unsurveyed}
    field = Field(landmarks=known, unsurveyed=unsurveyed)
    ready = msgspec.structs.replace(team, robots=robots, map=field, data=str(folder.resolve()))
    start_ns = min(first for first, _ in spans.values())
    return LoggedTeam(ready, truth, left_out, start_ns, max(last for _, last in spans.values()))


def with_duration(logged: LoggedTeam, duration_s: float | None) -> LoggedTeam:
    """The same log, of which only so much is used; None: all of it. Raises InputError."""
    if duration_s is None:
        return logged
    require_duration(duration_s, LEAST_S)
    return logged._replace(end_ns=min(logged.end_ns, logged.start_ns + int(duration_s * 1e9)))


def with_known_landmarks(logged: LoggedTeam, names: Collection[str] | None) -> LoggedTeam:
    """The same log, of whose landmarks only these are on the map (None: all); robots have to find
    the others. Raises InputError for an unknown name."""
    if names is None:
        return logged
    surveyed = logged.team.map.landmarks
    if unknown := [name for name in names if name not in surveyed]:
        raise InputError(
            f"--known-landmarks: {unknown[0]}: no such landmark; there are {', '.join(surveyed)}"
        )
    known = {name: mark for name, mark in surveyed.items() if name in names}
    unsurveyed = {name: Unsurveyed() for name in surveyed if name not in known}
    field = Field(landmarks=known, unsurveyed=unsurveyed)
    return logged._replace(team=msgspec.structs.replace(logged.team, map=field))


def with_unknown_starts(logged: LoggedTeam) -> LoggedTeam:
    """The same log, on which no robot knows where it starts."""
    robots = {
        name: msgspec.structs.replace(robot, start=None)
        for name, robot in logged.team.robots.items()
    }
    return logged._replace(team=msgspec.structs.replace(logged.team, robots=robots))


def _start(folder: Path, robot: str, truth: Floats) -> Start | None:
    """The true pose at the start of a robot's odometry, or None where truth begins long after it.

    Where truth begins a little later, its first row is carried back along the odometry, and a
    tenth of that way is added to sigma.
    """
    odometry_from_robot, way = Pose2(0.0, 0.0, 0.0), 0.0
    first_ns, _ = mrclam.odometry_span_ns(folder, robot)
    first_truth_ns = max(first_ns, int(truth[0, 0] * 1e9))
    if first_truth_ns - first_ns > LATEST_TRUTH_NS:
        return None
    for piece in mrclam.read_odometry(folder, robot):
        if piece.from_ns >= first_truth_ns:
            break
        whole_ns = piece.stamp_ns - piece.from_ns
        share = min(first_truth_ns - piece.from_ns, whole_ns) / whole_ns
        distance_m, turn_rad = share * piece.distance_m, share * piece.turn_rad
        odometry_from_robot = step(odometry_from_robot, distance_m, turn_rad)
        way += abs(distance_m)
    pose, _ = interpolated_truth(np.array([first_truth_ns * 1e-9]), truth)
    x, y, heading = Pose2(*pose[0].tolist()) @ odometry_from_robot.inverse()
    return Start(x_m=x, y_m=y, heading_deg=math.degrees(heading), sigma_m=0.05 + 0.1 * way)
