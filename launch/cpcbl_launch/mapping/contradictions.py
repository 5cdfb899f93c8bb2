"""Known places that contradict what robots measured, or each other.

A place is compared with where everything else puts it (leave one out): the difference, in units of
its own sigma, is normal if the place is right. (Baarda 1968, "A testing procedure for use in
geodetic networks".) It needs no second solution: the information of the border without a prior is
that with it, less the prior's own.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.problem import Problem
from cpcbl_launch.reporting.metrics import Floats

WRONG, DOUBTFUL = 5.0, 4.0  # sigmas, from which on a place is not used, or is named
LEAST_OFF = 0.02  # m, rad: what is nearer is no error that matters
ALIKE = 0.9  # of the largest sum of squares: then nothing says which of two is wrong
LARGEST_VARIANCE = 0.25  # m^2, rad^2: a direction in which the rest says nothing


class Contradiction(NamedTuple):
    """One known place beside where everything else puts it."""

    place: int  # of the landmark, or counted on behind the landmarks, of the wall
    off: Floats  # (2,): x, y (m); of a wall its offset (m) and direction (rad)
    is_wall: bool
    sigmas: float  # the root of the normalized innovation squared


def contradictions(problem: Problem, x: Floats, information: Floats) -> list[Contradiction]:
    """The known place that fits worst, if it fits badly (`DOUBTFUL`), with those that fit as badly.
    Without it others may fit: what is left must be looked at again. `information`: of the border,
    as `covariances` returns it."""
    found = [c for c in _innovations(problem, x, information) if np.abs(c.off).max() > LEAST_OFF]
    worst = max((each.sigmas for each in found), default=0.0)
    return [c for c in found if c.sigmas**2 >= ALIKE * worst**2 and worst > DOUBTFUL]


def are_wrong(found: Sequence[Contradiction]) -> bool:
    """Whether these places must not be used."""
    return any(each.sigmas > WRONG for each in found)


def contradiction_words(found: Sequence[Contradiction], names: Sequence[str]) -> str:
    """A line that names the places. `names`: of landmarks, then walls."""
    each = "; ".join(_off_words(c, names[c.place]) for c in found)
    if len(found) == 1:
        (only,) = found
        end = (
            "its place is not used"
            if are_wrong(found)
            else "its place is used all the same: measure it again, or withhold it"
        )
        what = "wall" if only.is_wall else "landmark"
        return (
            f"{what} {names[only.place]} is not where the team file has it, by all that robots"
            f" measured ({each}): {end}"
        )
    end = (
        "one of them, or more, is wrong, and nothing says which; none of these is used"
        if are_wrong(found)
        else "they are used all the same: measure them again, or withhold one"
    )
    said = ", ".join(names[c.place] for c in found)
    return (
        f"the known places of {said} contradict each other, by all that robots measured ({each}):"
        f" {end}"
    )


def _off_words(c: Contradiction, name: str) -> str:
    far_m = float(np.hypot(*c.off)) if not c.is_wall else abs(float(c.off[0]))
    turned = f" and {abs(np.degrees(c.off[1])):.1f} deg" if c.is_wall else ""
    return f"{name} by {far_m:.2f} m{turned}, {c.sigmas:.0f} σ"


def _innovations(problem: Problem, x: Floats, information: Floats) -> Iterator[Contradiction]:
    shift = problem.size - len(information)  # of the border's columns
    for index, (value, prior) in _known(problem).items():
        column = problem.landmark_column() + 2 * index
        own = slice(column - shift, column - shift + 2)
        without = information.copy()
        without[own, own] -= prior
        try:
            others = np.linalg.inv(without)[own, own]
        except np.linalg.LinAlgError:
            continue
        pulled = prior @ (x[column : column + 2] - value)
        off = x[column : column + 2] - value + others @ pulled
        variances, axes = np.linalg.eigh(0.5 * (others + others.T))
        known_axes = axes[:, (variances > 0.0) & (variances < LARGEST_VARIANCE)]
        if known_axes.shape[1] == 0:
            continue
        along = known_axes.T @ off
        spread = known_axes.T @ (others + np.linalg.inv(prior)) @ known_axes
        nis = float(along @ np.linalg.solve(spread, along))
        yield Contradiction(
            index, known_axes @ along, index >= problem.landmarks, float(np.sqrt(max(nis, 0.0)))
        )


def _known(problem: Problem) -> Mapping[int, tuple[Floats, Floats]]:
    """The value (2,) and the information (2, 2) of each place that has a prior, by its index."""
    priors, first = problem.priors, problem.landmark_column()
    found: dict[int, tuple[Floats, Floats]] = {}
    for columns, values, factors in zip(*priors, strict=True):
        if first <= columns[0] < problem.constant_column():
            index = (int(columns[0]) - first) // 2
            _, before = found.get(index, (values, np.zeros((2, 2))))
            found[index] = values, before + np.outer(factors, factors)
    return found
