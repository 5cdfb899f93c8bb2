"""The first estimate of all unknowns, in the frame that is asked for."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.align import Rigid, join_drives
from cpcbl_launch.mapping.assemble import ConstantErrors, Frame, Gauge, Start, assemble
from cpcbl_launch.mapping.drives import Drive, natural
from cpcbl_launch.mapping.explore import LocalMap, explore
from cpcbl_launch.mapping.known_walls import Measured, check_places
from cpcbl_launch.mapping.problem import Problem
from cpcbl_launch.mapping.triangulate import add_triangulated
from cpcbl_launch.mapping.wall_lines import Line, first_lines, line_of
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Landmark, Team, Wall
from cpcbl_team.config import Start as StartPose
from cpcbl_team.errors import InputError

PLACE_SIGMA_M = 0.006


class Request(NamedTuple):
    """What the map shall stand on."""

    known: Mapping[str, Landmark]  # whose places are exact
    start: str = ""  # the robot whose start in the team file fixes the frame
    place_sigma_m: float = PLACE_SIGMA_M
    """How far a landmark seems to be from where it was measured, along each axis."""
    errors: ConstantErrors = ConstantErrors()
    rough: Mapping[str, Landmark] = {}  # whose places are known with their sigma or covariance
    walls: Mapping[str, Wall] = {}  # whose places are known, exactly or with their sigmas

    def without(self, names: Collection[str]) -> "Request":
        """Without what is known of the places of these."""
        known, rough = (
            {name: mark for name, mark in marks.items() if name not in names}
            for marks in (self.known, self.rough)
        )
        walls = {name: wall for name, wall in self.walls.items() if name not in names}
        return self._replace(known=known, rough=rough, walls=walls)


class FirstEstimate(NamedTuple):
    """The problem, the unknowns from which its solution begins, and what they are about."""

    drives: tuple[Drive, ...]
    names: tuple[str, ...]  # of the landmarks, then of the walls, in the order of the unknowns
    frame: Frame
    frame_words: str
    problem: Problem
    x: Floats
    notes: tuple[str, ...]


def first_estimate(team: Team, drives: Sequence[Drive], request: Request) -> FirstEstimate:
    """The problem of these drives. Raises InputError where there is nothing to map."""
    robots, walls = frozenset(team.robots), frozenset(team.map.all_walls)
    maps = [explore(drive, robots, walls) for drive in drives]
    first = _reference(drives, maps, request.start)
    joined = join_drives(drives, maps, first)
    notes = [
        f"{drives[i].name} has too little in common with the other drives: it is not used"
        for i, found in enumerate(joined.poses)
        if found is None
    ]
    kept = [i for i, found in enumerate(joined.poses) if found is not None]
    used = tuple(drives[i] for i in kept)
    poses = tuple(p for p in joined.poses if p is not None)
    landmarks = add_triangulated(used, poses, joined.landmarks, robots | walls)
    lines = first_lines(used, poses, walls)
    if not landmarks and not lines:
        seen = {s.sighting.id for drive in used for s in drive.sightings} - robots
        why = (
            "; ".join((*notes, *_not_placed(sorted(seen), walls)))
            or "no robot has usable sightings of landmarks or walls"
        )
        raise InputError(f"calibrate map: nothing to map: {why}")
    start = Start(
        poses,
        {n: landmarks[n] for n in sorted(landmarks, key=natural)},
        dict(sorted(lines.items())),
    )
    start, frame, words, remarks = _in_frame(team, used, start, kept.index(first), request)
    seen = {s.sighting.id for drive in used for s in drive.sightings}
    notes += _not_placed(sorted(seen - robots - start.landmarks.keys() - start.lines.keys()), walls)
    problem, x, names = assemble(used, start, frame, request.errors)
    return FirstEstimate(used, names, frame, words, problem, x, (*notes, *remarks))


def _not_placed(names: Sequence[str], walls: Collection[str]) -> Iterator[str]:
    for name in names:
        if name in walls:
            yield (
                f"wall {name} cannot be placed: bearings tell only its direction, and ranges alone"
                " only where a robot drives along and across; write roughly where it is under"
                " [map.walls], with sigma_m and direction_sigma_deg: it is not used"
            )
        else:
            yield (
                f"landmark {name} cannot be placed: it was not seen from two sides, or with range"
                " and bearing: it is not used"
            )


def _reference(drives: Sequence[Drive], maps: Sequence[LocalMap], robot: str) -> int:
    """The drive in whose frame the others are joined: of the robot whose start is known, else that
    with the most sightings of landmarks. Raises InputError."""
    if not drives:
        raise InputError("calibrate map: no robot of these runs can be used")
    mine = [i for i, drive in enumerate(drives) if not robot or drive.robot == robot]
    if not mine:
        raise InputError(f"--start {robot}: no run has odometry and sightings of this robot")
    return mine[0] if robot else max(mine, key=lambda i: maps[i].sightings)


def _in_frame(
    team: Team, drives: Sequence[Drive], start: Start, reference: int, request: Request
) -> tuple[Start, Frame, str, tuple[str, ...]]:
    """The first estimates in the frame of what is known, that frame, and what it is in words."""
    places = {**request.known, **request.rough}
    measured = Measured(start.landmarks, start.lines, start.poses)
    checked = check_places(places, request.walls, measured)
    frame = Frame(
        {n: mark for n, mark in checked.landmarks.items() if n in request.known},
        request.place_sigma_m,
        None,
        {n: mark for n, mark in checked.landmarks.items() if n in request.rough},
        checked.walls,
    )
    gauge, free, drive = None, checked.free, drives[reference]
    robot, run = drive.robot, drive.run
    own = team.robots[robot].start if request.start else None
    pose = start.poses[reference][0]
    if checked.rigid is not None:
        start, words = _transformed(start, checked.rigid), _places_words(frame)
        if free is not None:
            start, target = _along(start, reference, free, own)
            gauge = Gauge(reference, target, along=free)
            words += _along_words(len(frame.walls), f"robot {robot}", run, own)
        start = start._replace(lines=_with_known(start.lines, frame.walls, drives))
        return start, frame._replace(gauge=gauge), words, checked.notes
    if own is not None:
        target = np.array([own.x_m, own.y_m, np.radians(own.heading_deg)])
        sigmas = own.sigma_m, float(np.radians(own.heading_sigma_deg))
        words = f"the start of robot {robot} in {run}"
    else:
        target, sigmas = np.zeros(3), (0.0, 0.0)
        words = (
            f"its own: the origin is the first pose of robot {robot} in {run}, x its heading there,"
            " y to its left"
        )
    start = _transformed(start, _rigid_between(pose, target))
    position_sigma: float | None = sigmas[0]
    if len(checked.landmarks) == 1:
        ((name, mark),) = checked.landmarks.items()
        shift = np.array([mark.x_m, mark.y_m]) - start.landmarks[name]
        start, target = _transformed(start, Rigid(0.0, shift)), target + np.array([*shift, 0.0])
        turned = "stated" if own is not None else "own"
        words = (
            f"the known landmark {name}; the direction is that of robot {robot}'s {turned} heading"
            f" at its first pose in {run}"
        )
        position_sigma = None
    gauge = Gauge(reference, target, position_sigma, sigmas[1])
    return start, frame._replace(gauge=gauge), words, checked.notes


def _places_words(frame: Frame) -> str:
    """Which places fix the frame: the exact ones, and those with a sigma where there are fewer than
    two exact ones."""
    names = [name for name in frame.known if name not in frame.walls]
    walls = [name for name, wall in frame.walls.items() if wall.is_exact]
    rough = [*frame.rough, *(name for name, wall in frame.walls.items() if not wall.is_exact)]
    parts = [f"the known landmarks {', '.join(names)}"] if names else []
    parts += [f"the known walls {', '.join(walls)}"] if walls else []
    if rough and len(names) + len(walls) < 2:
        parts.append(f"the roughly known {', '.join(rough)}")
    return " and ".join(parts)


def _along_words(walls: int, robot: str, run: str, own: StartPose | None) -> str:
    where = "where its start is" if own is not None else "at 0"
    why, them = ("they are parallel, so ", "them") if walls > 1 else ("", "it")
    return (
        f"; {why}nothing known tells the position along {them}: the first pose of {robot} in {run}"
        f" is taken to be {where}, seen along {them}"
    )


def _along(
    start: Start, reference: int, direction: Floats, own: StartPose | None
) -> tuple[Start, Floats]:
    """Moved along the known walls, so that the first pose of a drive is where its start is, or at 0
    along them; and that pose."""
    pose = start.poses[reference][0]
    there = np.zeros(2) if own is None else np.array([own.x_m, own.y_m])
    shift = float(direction @ (there - pose[:2])) * direction
    return _transformed(start, Rigid(0.0, shift)), pose + np.array([*shift, 0.0])


def _with_known(
    lines: Mapping[str, Line], walls: Mapping[str, Wall], drives: Sequence[Drive]
) -> dict[str, Line]:
    """The lines, looking as the known walls do, and those known ones that robots saw, but not so
    that it places them."""
    seen = {used.sighting.id for drive in drives for used in drive.sightings}
    known = {name: line_of(wall) for name, wall in walls.items() if name in seen}
    found = {n: line.like(known[n]) if n in known else line for n, line in lines.items()}
    return {n: known[n] if n not in found else found[n] for n in sorted({*known, *found})}


def _rigid_between(pose: Floats, target: Floats) -> Rigid:
    turned = Rigid(float(target[2] - pose[2]), np.zeros(2))
    return turned._replace(shift=target[:2] - turned.points(pose[None, :2])[0])


def _transformed(start: Start, rigid: Rigid) -> Start:
    landmarks = {n: rigid.points(p[None])[0] for n, p in start.landmarks.items()}
    lines = {n: line.in_frame(rigid) for n, line in start.lines.items()}
    return Start(tuple(rigid.poses(p) for p in start.poses), landmarks, lines)
