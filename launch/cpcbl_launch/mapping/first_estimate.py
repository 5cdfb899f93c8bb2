"""The first estimate of all unknowns, in the frame that is asked for."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.align import Rigid, join_drives
from cpcbl_launch.mapping.assemble import ConstantErrors, Frame, Gauge, Start, assemble
from cpcbl_launch.mapping.drives import Drive, natural
from cpcbl_launch.mapping.explore import LocalMap, explore
from cpcbl_launch.mapping.known_map import check_known
from cpcbl_launch.mapping.problem import Problem
from cpcbl_launch.mapping.triangulate import add_triangulated
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Landmark, Team
from cpcbl_team.errors import InputError

PLACE_SIGMA_M = 0.006


class Request(NamedTuple):
    """What the map shall stand on."""

    known: Mapping[str, Landmark]  # that fix the frame
    start: str = ""  # the robot whose start in the team file fixes the frame
    place_sigma_m: float = PLACE_SIGMA_M
    """How far a landmark seems to be from where it was measured, along each axis."""
    errors: ConstantErrors = ConstantErrors()


class FirstEstimate(NamedTuple):
    """The problem, the unknowns from which its solution begins, and what they are about."""

    drives: tuple[Drive, ...]
    names: tuple[str, ...]  # of the landmarks, in the order of the unknowns
    frame: Frame
    frame_words: str
    problem: Problem
    x: Floats
    notes: tuple[str, ...]


def first_estimate(team: Team, drives: Sequence[Drive], request: Request) -> FirstEstimate:
    """The problem of these drives. Raises InputError where there is nothing to map."""
    robots = frozenset(team.robots)
    maps = [explore(drive, robots) for drive in drives]
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
    landmarks = add_triangulated(used, poses, joined.landmarks, robots)
    if not landmarks:
        why = "; ".join(notes) or "no robot has usable sightings of landmarks"
        raise InputError(f"calibrate map: nothing to map: {why}")
    missing = {s.sighting.id for d in used for s in d.sightings} - landmarks.keys() - robots
    notes += [
        f"landmark {name} cannot be placed: it was not seen from two sides, or with range and"
        " bearing: it is not used"
        for name in sorted(missing)
    ]
    start = Start(poses, {name: landmarks[name] for name in sorted(landmarks, key=natural)})
    start, frame, words, remarks = _in_frame(team, used, start, kept.index(first), request)
    problem, x, names = assemble(used, start, frame, request.errors)
    return FirstEstimate(used, names, frame, words, problem, x, (*notes, *remarks))


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
    checked = check_known(request.known, start.landmarks)
    known, drive = checked.landmarks, drives[reference]
    if checked.rigid is not None:
        words = f"the known landmarks {', '.join(known)}"
        frame = Frame(known, request.place_sigma_m)
        return _transformed(start, checked.rigid), frame, words, checked.notes
    pose = start.poses[reference][0]
    own = team.robots[drive.robot].start if request.start else None
    if own is not None:
        target = np.array([own.x_m, own.y_m, np.radians(own.heading_deg)])
        sigmas = own.sigma_m, float(np.radians(own.heading_sigma_deg))
        words = f"the start of robot {drive.robot} in {drive.run}"
    else:
        target, sigmas = np.zeros(3), (0.0, 0.0)
        words = (
            f"its own: the origin is the first pose of robot {drive.robot} in {drive.run}, x its"
            " heading there, y to its left"
        )
    rigid = _rigid_between(pose, target)
    start = _transformed(start, rigid)
    position_sigma: float | None = sigmas[0]
    if len(known) == 1:
        ((name, mark),) = known.items()
        shift = np.array([mark.x_m, mark.y_m]) - start.landmarks[name]
        start, target = _transformed(start, Rigid(0.0, shift)), target + np.array([*shift, 0.0])
        turned = "stated" if own is not None else "own"
        words = (
            f"the known landmark {name}; the direction is that of robot {drive.robot}'s {turned}"
            f" heading at its first pose in {drive.run}"
        )
        position_sigma = None
    frame = Frame(known, request.place_sigma_m, Gauge(reference, target, position_sigma, sigmas[1]))
    return start, frame, words, checked.notes


def _rigid_between(pose: Floats, target: Floats) -> Rigid:
    turned = Rigid(float(target[2] - pose[2]), np.zeros(2))
    return turned._replace(shift=target[:2] - turned.points(pose[None, :2])[0])


def _transformed(start: Start, rigid: Rigid) -> Start:
    landmarks = {n: rigid.points(p[None])[0] for n, p in start.landmarks.items()}
    return Start(tuple(rigid.poses(p) for p in start.poses), landmarks)
