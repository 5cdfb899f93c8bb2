"""The map of some runs: from what robots reported to landmarks with their covariance."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.align import Rigid, join_drives
from cpcbl_launch.mapping.assemble import ConstantErrors, Frame, Gauge, Start, assemble
from cpcbl_launch.mapping.displacements import displaced_landmarks
from cpcbl_launch.mapping.doubled_names import doubled_names
from cpcbl_launch.mapping.drives import Drive, Drives, RunInputs, build_drives, natural
from cpcbl_launch.mapping.explore import LocalMap, explore
from cpcbl_launch.mapping.known_map import check_known
from cpcbl_launch.mapping.noise import Noise, estimate_noise, with_noise
from cpcbl_launch.mapping.problem import Problem
from cpcbl_launch.mapping.sensor_check import sensor_fault
from cpcbl_launch.mapping.solve import (
    CONVERGED_M,
    Solution,
    covariances,
    solve,
)
from cpcbl_launch.mapping.triangulate import add_triangulated
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Landmark, Team
from cpcbl_team.errors import InputError

LEAST_SIGHTINGS = 10  # used ones, of a landmark
PLACE_SIGMA_M = 0.006
ROUGHLY_M = 1e-3  # the step at which a first solution is good enough to judge its residuals
MOST_ROUNDS = 4  # of leaving out landmarks that moved

Progress = Callable[[float], None]


class Request(NamedTuple):
    """What the map shall stand on."""

    known: Mapping[str, Landmark]  # that fix the frame
    start: str = ""  # the robot whose start in the team file fixes the frame
    place_sigma_m: float = PLACE_SIGMA_M
    """How far a landmark seems to be from where it was measured, along each axis."""
    errors: ConstantErrors = ConstantErrors()


class Mapped(NamedTuple):
    """The solution, and all that is needed to describe it."""

    drives: tuple[Drive, ...]
    names: tuple[str, ...]  # of the landmarks, in the order of the unknowns
    frame: Frame
    frame_words: str
    problem: Problem
    solution: Solution
    covariance: Floats  # (2 landmarks, 2 landmarks), with the error of where a landmark seems to be
    constant_sigmas: Floats  # (drives, 4)
    noise: Noise
    notes: tuple[str, ...]
    left_out: Mapping[str, int]  # sightings, by reason

    def landmark(self, name: str) -> tuple[Floats, Floats]:
        """The place of a landmark (2,) and its covariance (2, 2)."""
        i = self.names.index(name)
        part = slice(2 * i, 2 * i + 2)
        return self.problem.parts(self.solution.x)[1][i], self.covariance[part, part]


def build_map(
    team: Team, runs: Sequence[RunInputs], request: Request, progress: Progress = lambda done: None
) -> Mapped:
    """The map of these runs. Raises InputError where there is nothing to map."""
    progress(0.0)
    everything = build_drives(team, runs)
    doubled = doubled_names(runs)
    rare = _rare(everything, doubled)
    ignored = {*doubled, *rare}
    notes = [*everything.notes, *doubled.values()]
    notes += [
        f"landmark {name} has {number} usable sightings, fewer than {LEAST_SIGHTINGS}: not used"
        for name, number in rare.items()
    ]
    notes += [
        f"landmark {name} is known, but no robot saw it"
        for name in request.known
        if name not in everything.landmarks
    ]
    robots = frozenset(team.robots)
    drives = []
    for drive in everything.drives:
        if fault := sensor_fault(drive, robots):
            notes.append(f"{fault}: this drive is not used")
        else:
            drives.append(_without(drive, ignored))
    for _ in range(MOST_ROUNDS):
        attempt = _attempt(team, tuple(drives), request, progress)
        if not attempt.faults:
            break
        names = {name for name, _ in attempt.faults}
        notes += [words for _, words in attempt.faults]
        drives = [_without(drive, names) for drive in drives]
        known = {name: mark for name, mark in request.known.items() if name not in names}
        request = request._replace(known=known)
    return _finished(attempt, (*notes, *attempt.notes), everything, request, progress)


class _Attempt(NamedTuple):
    """A first solution, and the landmarks that it shows to be wrong."""

    drives: tuple[Drive, ...]
    names: tuple[str, ...]
    frame: Frame
    frame_words: str
    problem: Problem
    solution: Solution
    notes: tuple[str, ...]
    faults: tuple[tuple[str, str], ...]


def _attempt(
    team: Team, drives: tuple[Drive, ...], request: Request, progress: Progress
) -> _Attempt:
    robots = frozenset(team.robots)
    progress(0.1)
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
        raise InputError(
            "calibrate map: nothing to map: no landmark was seen often enough; the notes say why: "
            + ("; ".join(notes) or "no sightings of landmarks")
        )
    missing = {s.sighting.id for d in used for s in d.sightings} - landmarks.keys() - robots
    notes += [
        f"landmark {name} cannot be placed: it was not seen from two sides, or with range and"
        " bearing: it is not used"
        for name in sorted(missing)
    ]
    landmarks = {name: landmarks[name] for name in sorted(landmarks, key=natural)}
    start = Start(poses, landmarks)
    start, frame, words, remarks = _in_frame(team, used, start, kept.index(first), request)
    notes += remarks
    problem, x, names = assemble(used, start, frame, request.errors)
    progress(0.25)
    solution = solve(problem, x, ROUGHLY_M)
    runs = [drive.run for drive in used]
    faults = displaced_landmarks(problem, solution.x, names, runs)
    named = tuple((names[fault.landmark], fault.words) for fault in faults)
    return _Attempt(used, names, frame, words, problem, solution, tuple(notes), named)


def _finished(
    attempt: _Attempt,
    notes: tuple[str, ...],
    everything: Drives,
    request: Request,
    progress: Progress,
) -> Mapped:
    """With the noise that the residuals show, and the covariance."""
    progress(0.5)
    noise = estimate_noise(attempt.problem, attempt.solution)
    problem = with_noise(attempt.problem, noise)
    progress(0.6)
    solution = solve(problem, attempt.solution.x, CONVERGED_M)
    if not solution.converged:
        notes = (*notes, f"least squares did not converge in {solution.iterations} steps")
    progress(0.95)
    found = covariances(problem, solution)
    new = [name not in attempt.frame.known for name in attempt.names]
    covariance = found.landmarks + np.diag(np.repeat(new, 2) * request.place_sigma_m**2)
    return Mapped(
        attempt.drives,
        attempt.names,
        attempt.frame,
        attempt.frame_words,
        problem,
        solution,
        covariance,
        found.constants,
        noise,
        notes,
        dict(everything.left_out),
    )


def _rare(everything: Drives, others: Collection[str]) -> dict[str, int]:
    number = {name: 0 for name in everything.landmarks if name not in others}
    for drive in everything.drives:
        for used in drive.sightings:
            if used.sighting.id in number:
                number[used.sighting.id] += 1
    return {name: n for name, n in number.items() if n < LEAST_SIGHTINGS}


def _without(drive: Drive, names: set[str] | frozenset[str]) -> Drive:
    kept = tuple(used for used in drive.sightings if used.sighting.id not in names)
    return drive._replace(sightings=kept)


def _reference(drives: Sequence[Drive], maps: Sequence[LocalMap], robot: str) -> int:
    """The drive in whose frame the others are joined: of the robot whose start is known, else that
    with the most sightings of landmarks. Raises InputError."""
    if not drives:
        raise InputError("calibrate map: no robot of these runs can be used; see the notes")
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
