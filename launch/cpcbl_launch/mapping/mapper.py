"""The map of some runs: from what robots reported to landmarks with their covariance."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.assemble import ConstantErrors, Frame
from cpcbl_launch.mapping.displacements import displaced_landmarks
from cpcbl_launch.mapping.doubled_names import doubled_names
from cpcbl_launch.mapping.drives import Drive, Drives, RunInputs, build_drives
from cpcbl_launch.mapping.first_estimate import FirstEstimate, Request, first_estimate
from cpcbl_launch.mapping.noise import Noise, estimate_noise, with_noise
from cpcbl_launch.mapping.problem import Problem
from cpcbl_launch.mapping.sensor_check import sensor_fault
from cpcbl_launch.mapping.solve import CONVERGED_M, Solution, covariances, solve
from cpcbl_launch.reporting.metrics import Ellipse, Floats, ellipse_of
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError

LEAST_SIGHTINGS = 10  # used ones, of a landmark
ROUGHLY_M = 1e-3  # the step at which a first solution is good enough to judge its residuals
MOST_SIGMAS = 5.0  # of the prior of a constant error
MOST_FAULTY = 0.5  # of the landmarks: with more it is the paths that are wrong
MOST_ROUNDS = 4  # of leaving out landmarks that moved

Progress = Callable[[float], None]


class Mapped(NamedTuple):
    """The solution, and all that is needed to describe it."""

    drives: tuple[Drive, ...]
    names: tuple[str, ...]  # of the landmarks, in the order of the unknowns
    frame: Frame
    frame_words: str
    problem: Problem
    first_x: Floats  # the unknowns from which least squares began
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

    def ellipse(self, name: str) -> Ellipse:
        """That of one sigma of the place of a landmark (m, rad)."""
        (xx, xy), (_, yy) = self.landmark(name)[1].tolist()
        return ellipse_of(xx, xy, yy)


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
        progress(0.1)
        first = _first_or_notes(team, drives, request, notes)
        progress(0.25)
        rough = solve(first.problem, first.x, ROUGHLY_M)
        of_drives = [drive.run for drive in first.drives]
        faults = displaced_landmarks(first.problem, rough.x, first.names, of_drives)
        if not faults:
            break
        if len(faults) > MOST_FAULTY * len(first.names):
            raise InputError(_does_not_fit([first.names[fault.landmark] for fault in faults]))
        names = {first.names[fault.landmark] for fault in faults}
        notes += [fault.words for fault in faults]
        drives = [_without(drive, names) for drive in drives]
        known = {name: mark for name, mark in request.known.items() if name not in names}
        request = request._replace(known=known)
    progress(0.5)
    return _finished(first, rough, (*notes, *first.notes), everything, request, progress)


def _unusual(drives: Sequence[Drive], constants: Floats, errors: ConstantErrors) -> Iterator[str]:
    """A line for each drive with a constant error that its settings do not let expect."""
    words = "distances %+.0f %%", "turns %+.0f %%", "bearings %+.1f deg", "ranges %+.0f %%"
    units = np.array([100.0, 100.0, np.degrees(1.0), 100.0])
    for drive, values in zip(drives, constants, strict=True):
        beyond = np.flatnonzero(np.abs(values) > MOST_SIGMAS * errors.sigmas)
        if len(beyond):
            said = ", ".join(words[i] % (values[i] * units[i]) for i in beyond)
            yield (
                f"{drive.name} reads other than its settings say: {said}: calibrate it; the map may"
                " be wrong"
            )


def _does_not_fit(names: Sequence[str]) -> str:
    return (
        f"calibrate map: sightings put most landmarks ({', '.join(names)}) at several places:"
        " odometry or sensors are not as the robots' settings say; calibrate them first, and check"
        " that the clocks of sightings and odometry agree"
    )


def _first_or_notes(
    team: Team, drives: Sequence[Drive], request: Request, notes: Sequence[str]
) -> FirstEstimate:
    """The first estimate; an error says what was not used besides. Raises InputError."""
    try:
        return first_estimate(team, drives, request)
    except InputError as error:
        raise InputError("; ".join((str(error), *notes))) from error


def _finished(
    first: FirstEstimate,
    rough: Solution,
    notes: tuple[str, ...],
    everything: Drives,
    request: Request,
    progress: Progress,
) -> Mapped:
    """With the noise that the residuals show, and the covariance."""
    noise = estimate_noise(first.problem, rough)
    problem = with_noise(first.problem, noise)
    progress(0.6)
    solution = solve(problem, rough.x, CONVERGED_M)
    if set(first.names) <= first.frame.known.keys():
        notes = (*notes, "no landmark is new: choose with --known or --withhold what is estimated")
    notes = (*notes, *_unusual(first.drives, problem.parts(solution.x)[2], request.errors))
    if not solution.converged:
        notes = (*notes, f"least squares did not converge in {solution.iterations} steps")
    progress(0.95)
    found = covariances(problem, solution)
    new = [name not in first.frame.known for name in first.names]
    covariance = found.landmarks + np.diag(np.repeat(new, 2) * request.place_sigma_m**2)
    return Mapped(
        first.drives,
        first.names,
        first.frame,
        first.frame_words,
        problem,
        first.x,
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
