"""What each robot sensed in each run, as motions between the times at which it matters.

A run is one recording or log. One robot in one run is a drive. Its poses are estimated at the times
of the sightings that are used, and so often in between that motions stay short.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.odometry_track import OdometryTrack
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import LocalizationSettings, Team, Unsurveyed
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_team.object_timers import ObjectTimers
from cpcbl_team.sensors import (
    corrected_odometry,
    corrected_sighting,
    sighting_fault,
    without_duplicates,
)
from cpcbl_team.state import Updates

LONGEST_STEP_NS = 500_000_000  # between two poses of a robot
FLOOR_M, FLOOR_RAD = 1e-4, 1e-5  # of a motion's sigma: a wheel without noise in one direction


class RunInputs(NamedTuple):
    """What robots reported in one run, as they reported it."""

    name: str
    odometry: Mapping[str, Sequence[Odometry]]
    frames: Mapping[str, Sequence[Sightings]]


class UsedSighting(NamedTuple):
    """A sighting that is used, at the pose with this index of its drive."""

    pose: int
    sighting: Sighting  # corrected
    inflation: float  # of its variance, because its errors resemble those of the one before
    stamp_ns: int


class Drive(NamedTuple):
    """One robot in one run."""

    robot: str
    run: str
    settings: LocalizationSettings
    stamps_ns: tuple[int, ...]  # of the poses
    pose_of: Mapping[int, int]  # the index of the pose at a time; while it stands it has one pose
    motions: (
        Floats  # (n - 1, 3): x, y (m), heading (rad) of each pose in the frame of the one before
    )
    noises: Floats  # (n - 1, 3, 3): their covariances
    sightings: tuple[UsedSighting, ...]

    @property
    def name(self) -> str:
        return f"{self.robot} in {self.run}"


class Drives(NamedTuple):
    """All drives of all runs, and what was not used."""

    drives: tuple[Drive, ...]
    landmarks: tuple[str, ...]  # names of what is seen and is neither robot nor wall
    walls: tuple[str, ...]  # names of the walls that are seen
    left_out: Counter[str]  # sightings, by reason
    notes: tuple[str, ...]  # whole drives that are not used, and why


def build_drives(team: Team, runs: Sequence[RunInputs], ignored: Iterable[str] = ()) -> Drives:
    """The drives of all runs. `ignored`: names of objects whose sightings are not used."""
    drives, left_out, notes = list[Drive](), Counter[str](), list[str]()
    named = {robot for run in runs for robot in (*run.odometry, *run.frames)}
    strangers = named - set(team.robots)  # guests, which are seen, too
    for run in runs:
        found, lost, remarks = _drives_of_run(team, run, strangers.union(ignored))
        drives += found
        left_out += lost
        notes += remarks
    seen = {used.sighting.id for drive in drives for used in drive.sightings}
    landmarks = seen - set(team.robots) - team.map.all_walls.keys()
    walls = seen & team.map.all_walls.keys()
    marks, lines = (tuple(sorted(names, key=natural)) for names in (landmarks, walls))
    return Drives(tuple(drives), marks, lines, left_out, tuple(notes))


def natural(name: str) -> tuple[int, int, str]:
    """The key of a name for an order in which numbers come first, by their size."""
    return (0, int(name), name) if name.isdigit() else (1, 0, name)


def _drives_of_run(
    team: Team, run: RunInputs, ignored: Collection[str]
) -> tuple[list[Drive], Counter[str], list[str]]:
    left_out, notes = Counter[str](), list[str]()
    odometry: dict[str, list[Odometry]] = {}
    for robot in sorted({*run.odometry, *run.frames}, key=natural):
        if robot not in team.robots:
            notes.append(f"{run.name}: robot {robot} is not in the team, so it is not used")
            continue
        settings = team.robots[robot]
        pieces = [corrected_odometry(p, settings.odometry) for p in run.odometry.get(robot, ())]
        if settings.odometry.moves and not pieces:
            notes.append(
                f"{run.name}: robot {robot} has no odometry, so it is not used; record in/{robot}/"
                "odometry, or set odometry.moves = false if it stands"
            )
            continue
        odometry[robot] = pieces
    used: dict[str, list[tuple[int, Sighting, float]]] = {}
    for robot in odometry:
        frames = run.frames.get(robot, ())
        used[robot] = _used_sightings(team, robot, frames, ignored, left_out)
    drives = [
        _make_drive(team.robots[robot], robot, run.name, pieces, used)
        for robot, pieces in odometry.items()
        if pieces or used[robot]
    ]
    return drives, left_out, notes


def _used_sightings(
    team: Team,
    robot: str,
    frames: Iterable[Sightings],
    ignored: Collection[str],
    left_out: Counter[str],
) -> list[tuple[int, Sighting, float]]:
    """The corrected sightings of one robot that are used: stamp (ns), sighting, inflation."""
    settings, last_ns, found = team.robots[robot], dict[str, int](), []
    sensor, timers, uses = settings.sensor, ObjectTimers(settings), Updates(objects_ns=last_ns)
    delay_ns = int(sensor.delay_s * 1e9)
    for frame in sorted(frames, key=lambda frame: frame.stamp_ns):
        stamp_ns = frame.stamp_ns - delay_ns
        for read in without_duplicates(frame.sightings):
            is_robot = read.id in team.robots
            sighting = corrected_sighting(read, sensor, is_robot)
            if reason := _reason_against(team, robot, sighting, is_robot, ignored):
                left_out[reason] += 1
                continue
            if timers.is_cooling_down(uses, sighting.id, stamp_ns):
                continue
            inflation = timers.inflation(uses, sighting.id, stamp_ns)
            last_ns[sighting.id] = stamp_ns
            found.append((stamp_ns, _usable(team, robot, sighting), inflation))
    return found


def _reason_against(
    team: Team, robot: str, sighting: Sighting, is_robot: bool, ignored: Collection[str]
) -> str:
    if sighting.id in ignored:
        return "of robots that are not in the team"
    sensor = team.robots[robot].sensor
    if sighting.id == robot or not (sensor.sees_robots if is_robot else sensor.sees_landmarks):
        return "of what the robot does not see by its settings"
    if fault := sighting_fault(sighting):
        return f"with a fault: {fault}"
    used = _usable(team, robot, sighting)
    if used.range_m is None and used.bearing_rad is None:
        return "without a range or bearing that is used"
    return ""


def _usable(team: Team, robot: str, sighting: Sighting) -> Sighting:
    """The sighting with those of its readings that the settings allow."""
    wall = team.map.all_walls.get(sighting.id)
    gives = (wall or team.map.all_landmarks.get(sighting.id, Unsurveyed())).gives
    far = (sighting.range_m or 0.0) > team.robots[robot].sensor.max_range_for_range_m
    return Sighting(
        sighting.id,
        sighting.range_m if gives in ("both", "range") and not far else None,
        sighting.bearing_rad if gives in ("both", "bearing") else None,
        sighting.range_sigma_m,
        sighting.bearing_sigma_rad,
    )


def _make_drive(
    settings: LocalizationSettings,
    robot: str,
    run: str,
    odometry: Sequence[Odometry],
    used: Mapping[str, list[tuple[int, Sighting, float]]],
) -> Drive:
    own = used[robot]
    first_ns, last_ns = _span_ns(odometry, own)
    stamps = {first_ns, last_ns, *(stamp_ns for stamp_ns, _, _ in own)}
    for mate, sightings in used.items():
        if mate != robot:
            stamps |= {ns for ns, seen, _ in sightings if seen.id == robot}
    times = _often_enough([ns for ns in sorted(stamps) if first_ns <= ns <= last_ns])
    track, kept, pose_of = OdometryTrack(settings, first_ns, odometry), [times[0]], {times[0]: 0}
    motions, noises = list[Floats](), list[Floats]()
    for stamp_ns in times[1:]:
        motion = track.until(stamp_ns)
        xx, xy, yy, xh, yh, hh = motion.covariance
        noise, moved = np.array(((xx, xy, xh), (xy, yy, yh), (xh, yh, hh))), np.array(motion.pose)
        if noise.any() or moved.any():
            motions.append(moved)
            noises.append(noise + np.diag((FLOOR_M**2, FLOOR_M**2, FLOOR_RAD**2)))
            kept.append(stamp_ns)
        pose_of[stamp_ns] = len(kept) - 1
    return Drive(
        robot,
        run,
        settings,
        tuple(kept),
        pose_of,
        np.array(motions).reshape(-1, 3),
        np.array(noises).reshape(-1, 3, 3),
        tuple(
            UsedSighting(pose_of[ns], seen, inflation, ns)
            for ns, seen, inflation in own
            if ns in pose_of
        ),
    )


def _span_ns(
    odometry: Sequence[Odometry], own: Sequence[tuple[int, Sighting, float]]
) -> tuple[int, int]:
    """The first and the last time at which the robot's pose can be known: from its odometry, of a
    robot that stands from its sightings."""
    if odometry:
        return min(p.from_ns for p in odometry), max(p.stamp_ns for p in odometry)
    return min(ns for ns, _, _ in own), max(ns for ns, _, _ in own)


def _often_enough(stamps_ns: Sequence[int]) -> list[int]:
    times = [stamps_ns[0]]
    for stamp_ns in stamps_ns[1:]:
        before_ns, between_ns = times[-1], stamp_ns - times[-1]
        steps = math.ceil(between_ns / LONGEST_STEP_NS)
        times += [before_ns + i * between_ns // steps for i in range(1, steps)]
        times.append(stamp_ns)
    return times
