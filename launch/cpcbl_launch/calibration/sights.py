"""What robots' eyes say of their sightings, beside where everything truly was.

From recordings of robots with cameras, or from pictures that were taken at known poses.
"""

import csv
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.calibration.logs import Placed, placed
from cpcbl_launch.calibration.robot_log import RobotLog, wrapped
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.recording import read_recording
from cpcbl_team.config import CameraSettings, Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Sightings

APART_S = 100.0  # pictures have no time; so far apart nothing is taken for alike, or a motion
STANDING_S = 0.1  # for so long before and after a picture all stand still
COLUMNS = ("file", "x_m", "y_m", "heading_deg")


class Sights(NamedTuple):
    """The sightings of one robot in one log; `stated` and `headings` go with `log.sightings`."""

    log: RobotLog
    stated: Floats
    """(n, 2): sigmas of range (m) and bearing (rad) as the eyes say them; NaN: not said."""
    headings: Floats
    """(n, 3): a teammate's heading in the robot's frame, its sigma, the true one (rad); NaN."""


class Looked(NamedTuple):
    """All that some eyes saw where the truth is known, and the camera that they looked through."""

    robots: tuple[str, ...]
    camera: CameraSettings
    sights: list[Sights]
    notes: tuple[str, ...] = ()


class _Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A line of poses: where a robot was when a picture was taken; none: the one that took it."""

    file: str
    x_m: float
    y_m: float
    heading_deg: float
    robot: str = ""


def recorded(paths: Sequence[Path], robot: str | None) -> Looked:
    """What this robot, or every one with a camera, saw. Raises LogError, InputError."""
    found: list[tuple[str, CameraSettings, Sights]] = []  # cameras without where frames come from
    for path in paths:
        if path.suffix != ".mcap":
            raise InputError(f"{path}: no recording of `up --record` (.mcap)")
        recording = read_recording(path)
        if not recording.truth:
            raise LogError(f"{path}: holds no truth; publish poses on field/truth")
        where, team = placed(recording.team.map.landmarks, recording.truth), recording.team
        for name in [robot] if robot else team.cameras:
            said = [i for i in recording.inputs.get(name, ()) if isinstance(i, Sightings)]
            if said and len(where.truth.get(name, ())) > 1:
                if name not in team.robots:
                    there = ", ".join(team.cameras)
                    raise InputError(f"--robot {name}: a guest of {path}; with a camera: {there}")
                camera = replace(team.robots[name].camera, frames="")
                found.append((name, camera, sights_of(name, said, where)))
    if not found:
        who = robot or "robots with cameras"
        raise InputError(f"{paths[0]}: no sightings of {who} where the truth is known")
    names = tuple(dict.fromkeys(name for name, _, _ in found))
    if len({camera for _, camera, _ in found}) > 1:
        raise InputError(
            f"{', '.join(names)}: unlike cameras, which err each in their way; name one robot by"
            " --robot, and recordings of one camera"
        )
    return Looked(names, found[0][1], [sights for _, _, sights in found])


def viewer(team: Team, robot: str | None) -> str:
    """Whose camera it is: the one that is named, or the only one. Raises InputError."""
    there = team.cameras
    if robot is None and len(there) == 1:
        return there[0]
    if robot not in there:
        known = ", ".join(there) or 'none; write sensing = "camera"'
        raise InputError(f"--robot: say whose camera took the pictures; with a camera: {known}")
    return robot


def photographed(
    folder: Path,
    poses: Path,
    robot: str,
    team: Team,
    progress: Callable[[float], None] = lambda done: None,
) -> Looked:
    """What a robot's eyes see in pictures at known poses. Raises InputError. Needs OpenCV."""
    from cpcbl_agents.vision.detector import CameraEyes
    from cpcbl_launch.calibration.pictures import read_picture

    rows = read_poses(poses, team)
    names = list(dict.fromkeys(row.file for row in rows))
    eyes = CameraEyes(robot, team)
    frames: list[Sightings] = []
    refused: dict[str, str] = {}
    doubts: Counter[str] = Counter()
    for i, name in enumerate(names):
        pixels = read_picture(folder / name).pixels
        seen = pixels if isinstance(pixels, str) else eyes.glimpses(pixels)
        if isinstance(seen, str):
            refused[name] = seen
        else:
            doubts.update(doubt.reason for doubt in seen.doubts)
            frames.append(Sightings(_stamp_ns(i), tuple(one.sighting for one in seen.found)))
        progress((i + 1) / len(names))
    if not frames:
        name, reason = next(iter(refused.items()))
        raise InputError(f"{folder}: no picture can be used: {name}: {reason}")
    where = placed(team.map.landmarks, _standing(rows, names, robot))
    notes = [f"{name}: {reason}" for name, reason in refused.items()]
    if doubts:
        said = ", ".join(f"{reason} {n}" for reason, n in doubts.most_common())
        notes.append(f"seen, but not reported: {said}")
    camera = team.robots[robot].camera
    return Looked((robot,), camera, [sights_of(robot, frames, where)], tuple(notes))


def sights_of(robot: str, frames: Iterable[Sightings], where: Placed) -> Sights:
    """A robot's sightings as arrays."""
    number = {name: i for i, name in enumerate(where.objects)}
    turned = {name: (rows[:, 0], np.unwrap(rows[:, 3])) for name, rows in where.truth.items()}
    rows = [
        (
            *(frame.stamp_ns * 1e-9, number[s.id]),
            *map(_given, (s.range_m, s.bearing_rad, s.range_sigma_m, s.bearing_sigma_rad)),
            *map(_given, (s.heading_rad, s.heading_sigma_rad)),
            _true_heading(turned, robot, s.id, frame.stamp_ns * 1e-9),
        )
        for frame in frames
        for s in frame.sightings
        if s.id in number
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 9)
    objects = tuple(where.objects.values())
    log = RobotLog(where.truth[robot], np.empty((0, 4)), table[:, :4], objects, where.teammates)
    return Sights(log, table[:, 4:6], table[:, 6:])


def read_poses(path: Path, team: Team) -> list[_Row]:
    """A CSV file: file, x_m, y_m, heading_deg, and robot for teammates. Raises InputError."""
    try:
        lines = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        given = [{k: (v or "").strip() for k, v in line.items() if k} for line in lines]
        rows = msgspec.convert(given, list[_Row], strict=False)
    except FileNotFoundError:
        raise InputError(f"--poses {path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--poses {path}: cannot be read: {error}") from error
    except (csv.Error, msgspec.ValidationError) as error:
        columns = ",".join(COLUMNS)
        raise InputError(f"--poses {path}: {error}; its columns are {columns},robot") from error
    if not rows:
        raise InputError(f"--poses {path}: no poses; its columns are {','.join(COLUMNS)},robot")
    for row in rows:
        if row.robot and row.robot not in team.robots:
            known = ", ".join(team.robots)
            raise InputError(f"--poses {path}: no robot {row.robot!r} in the team; known: {known}")
    return rows


def _stamp_ns(picture: int) -> int:
    return int((picture + 1) * APART_S * 1e9)


def _standing(rows: Sequence[_Row], names: Sequence[str], viewer: str) -> dict[str, Floats]:
    """Poses as a log has them, in which all stand still while a picture is taken."""
    truth: dict[str, list[tuple[float, float, float, float]]] = {viewer: []}
    for row in rows:
        at = _stamp_ns(names.index(row.file)) * 1e-9
        pose = row.x_m, row.y_m, math.radians(row.heading_deg)
        log = truth.setdefault(row.robot or viewer, [])
        log += [(at - STANDING_S, *pose), (at + STANDING_S, *pose)]
    return {name: np.array(sorted(log)) for name, log in truth.items()}


def _true_heading(
    turned: Mapping[str, tuple[Floats, Floats]], viewer: str, seen: str, at_s: float
) -> float:
    """Where a teammate looks in the viewer's frame; NaN for a landmark."""
    if seen not in turned:
        return math.nan
    own, other = (np.interp(at_s, *turned[name]) for name in (viewer, seen))
    return float(wrapped(np.asarray(other - own)))


def _given(value: float | None) -> float:
    return math.nan if value is None else value
