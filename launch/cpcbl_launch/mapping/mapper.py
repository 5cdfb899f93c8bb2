"""The map of some runs: from what robots reported to landmarks with their covariance."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.assemble import ConstantErrors, Frame
from cpcbl_launch.mapping.contradictions import are_wrong, contradiction_words, contradictions
from cpcbl_launch.mapping.displacements import displaced_places
from cpcbl_launch.mapping.doubled_names import doubled_names
from cpcbl_launch.mapping.drives import Drive, Drives, RunInputs, build_drives
from cpcbl_launch.mapping.first_estimate import FirstEstimate, Request, first_estimate
from cpcbl_launch.mapping.noise import Noise, estimate_noise, with_noise
from cpcbl_launch.mapping.problem import Problem
from cpcbl_launch.mapping.sensor_check import sensor_fault
from cpcbl_launch.mapping.solve import CONVERGED_M, Solution, covariances, solve
from cpcbl_launch.mapping.stated import stated_places
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
    walls: tuple[str, ...]  # of the walls
    frame: Frame
    frame_words: str
    problem: Problem
    first_x: Floats  # the unknowns from which least squares began
    solution: Solution
    places: (
        Floats  # (landmarks + walls, 2): x, y; then offset from its pivot and direction of walls
    )
    covariance: Floats  # of `places` in this order, with the error of where things seem to be
    information: Floats  # of the border of the problem (see `covariances`)
    constant_sigmas: Floats  # (drives, 4)
    noise: Noise
    notes: tuple[str, ...]
    left_out: Mapping[str, int]  # sightings, by reason
    runs: tuple[str, ...] = ()  # their identities

    @property
    def new_names(self) -> list[str]:
        """The landmarks whose places are not known exactly."""
        return [name for name in self.names if name not in self.frame.known_names]

    def landmark(self, name: str) -> tuple[Floats, Floats]:
        """The place of a landmark (2,) and its covariance (2, 2)."""
        return self._place(self.names.index(name))

    def wall(self, name: str) -> tuple[Floats, Floats]:
        """The offset (m) and direction (rad) of a wall, (2,), and their covariance (2, 2). The
        offset is from the wall's pivot (see `Problem`), to the left of its direction."""
        return self._place(len(self.names) + self.walls.index(name))

    def pivot(self, name: str) -> Floats:
        """The point (2,) from which the offset of a wall counts."""
        return np.asarray(self.problem.pivots[self.walls.index(name)])

    def _place(self, i: int) -> tuple[Floats, Floats]:
        part = slice(2 * i, 2 * i + 2)
        return self.places[i], self.covariance[part, part]

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
    doubled = doubled_names(runs, team.map.all_walls)
    rare = _rare(everything, doubled)
    ignored = {*doubled, *rare}
    notes = [*everything.notes, *doubled.values()]
    notes += [
        f"{_noun(team, name)} {name} has {number} usable sightings, fewer than {LEAST_SIGHTINGS}:"
        " not used"
        for name, number in rare.items()
    ]
    notes += [
        f"{_noun(team, name)} {name} is known, but no robot saw it"
        for name in (*request.known, *request.rough, *request.walls)
        if name not in everything.landmarks and name not in everything.walls
    ]
    drives = []
    for drive in everything.drives:
        if fault := sensor_fault(drive, frozenset(team.robots), team.map.all_walls):
            notes.append(f"{fault}: this drive is not used")
        else:
            drives.append(_without(drive, ignored))
    while True:  # with fewer known places each time
        drives, request, first, rough = _settled(team, drives, request, notes, progress)
        mapped = _finished(first, rough, (*notes, *first.notes), everything, request, progress)
        bad = contradictions(mapped.problem, mapped.solution.x, mapped.information)
        words = [contradiction_words(bad, first.names)] if bad else []
        if not are_wrong(bad):
            return mapped._replace(notes=(*mapped.notes, *words))
        notes += words
        request = request.without([first.names[each.place] for each in bad])


def _settled(
    team: Team,
    drives: list[Drive],
    request: Request,
    notes: list[str],
    progress: Progress,
) -> tuple[list[Drive], Request, FirstEstimate, Solution]:
    """A first solution without what was moved, and the drives and the request without that. Adds to
    the notes. Raises InputError."""
    for _ in range(MOST_ROUNDS):
        progress(0.1)
        first = _first_or_notes(team, drives, request, notes)
        progress(0.25)
        rough = solve(first.problem, first.x, ROUGHLY_M)
        of_drives = [drive.run for drive in first.drives]
        faults = displaced_places(first.problem, rough.x, first.names, of_drives)
        if not faults:
            break
        if len(faults) > MOST_FAULTY * len(first.names):
            raise InputError(_does_not_fit([first.names[fault.place] for fault in faults]))
        names = {first.names[fault.place] for fault in faults}
        notes += [fault.words for fault in faults]
        drives = [_without(drive, names) for drive in drives]
        request = request.without(names)
    progress(0.5)
    return drives, request, first, rough


def _noun(team: Team, name: str) -> str:
    return "wall" if name in team.map.all_walls else "landmark"


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
    if set(first.names) <= first.frame.known_names:
        notes = (*notes, "no place is new: choose with --known or --withhold what is estimated")
    notes = (*notes, *_unusual(first.drives, problem.parts(solution.x)[2], request.errors))
    if not solution.converged:
        notes = (*notes, f"least squares did not converge in {solution.iterations} steps")
    progress(0.95)
    found = covariances(problem, solution)
    stated = stated_places(problem, solution.x, found.places, first.names, first.frame)
    return Mapped(
        first.drives,
        first.names[: problem.landmarks],
        first.names[problem.landmarks :],
        first.frame,
        first.frame_words,
        problem,
        first.x,
        solution,
        *stated,
        found.information,
        found.constants,
        noise,
        notes,
        dict(everything.left_out),
    )


def _rare(everything: Drives, others: Collection[str]) -> dict[str, int]:
    names = (*everything.landmarks, *everything.walls)
    number = {name: 0 for name in names if name not in others}
    for drive in everything.drives:
        for used in drive.sightings:
            if used.sighting.id in number:
                number[used.sighting.id] += 1
    return {name: n for name, n in number.items() if n < LEAST_SIGHTINGS}


def _without(drive: Drive, names: set[str] | frozenset[str]) -> Drive:
    kept = tuple(used for used in drive.sightings if used.sighting.id not in names)
    return drive._replace(sightings=kept)
