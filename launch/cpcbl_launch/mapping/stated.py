"""What is stated of places: where landmarks and walls are, beside where they seem to be.

Robots see a place where it seems to be. What a team file says of it, and what is written into it,
is where somebody would measure it. The difference has the sigma `place_sigma_m`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.assemble import (
    Frame,
    landmark_covariance,
    seen_landmark_covariance,
    seen_wall_covariance,
    wall_covariance,
)
from cpcbl_launch.mapping.problem import Problem, wall_views
from cpcbl_launch.mapping.wall_lines import line_of
from cpcbl_launch.reporting.metrics import Floats


class Stated(NamedTuple):
    """Places (n, 2) of landmarks, then walls, and the covariance (2 n, 2 n) of their errors."""

    places: Floats
    covariance: Floats


def stated_places(
    problem: Problem, x: Floats, covariance: Floats, names: Sequence[str], frame: Frame
) -> Stated:
    """From where places seem to be, with the covariance of that. A place that is not known gets the
    error of the difference, too. One that is known roughly is between what is known and what is
    seen. That of one that is known exactly stays as it seems."""
    seen = np.concatenate([problem.parts(x)[1], problem.lines(x)])
    places, gains, added = seen.copy(), np.eye(2 * len(seen)), np.zeros_like(covariance)
    extents = wall_extents(problem, x)
    for i, name in enumerate(names):
        part, wall = slice(2 * i, 2 * i + 2), frame.walls.get(name)
        if name in frame.known_names:
            continue
        if i < problem.landmarks:
            apart = seen_landmark_covariance(frame.place_sigma_m)
            mark = frame.rough.get(name)
            prior = None if mark is None else landmark_covariance(mark)
            value = None if mark is None else np.array([mark.x_m, mark.y_m])
        else:
            half_m = 0.5 * float(np.ptp(extents[i - problem.landmarks]))
            half_m = half_m if wall is None else line_of(wall).half_m
            apart = seen_wall_covariance(frame.place_sigma_m, half_m)
            prior = None if wall is None else wall_covariance(wall)
            value = None if wall is None else np.array([0.0, wall.direction_rad])
        if prior is None or value is None:
            added[part, part] = apart
        elif apart.any():
            gain = prior @ np.linalg.inv(prior + apart)
            gains[part, part], added[part, part] = gain, gain @ apart
            places[i] = value + gain @ (seen[i] - value)
    return Stated(places, gains @ covariance @ gains.T + added)


def wall_extents(problem: Problem, x: Floats) -> Floats:
    """The part of each wall that robots saw, along its direction from its pivot, shape (w, 2)."""
    wall = problem.readings.wall[problem.readings.wall >= 0]
    along = wall_views(problem, x).along_m if len(wall) else np.empty(0)
    each = [along[wall == i] for i in range(problem.walls)]
    ends = [np.quantile(a, (0.02, 0.98)) if len(a) else np.zeros(2) for a in each]
    return np.array(ends).reshape(-1, 2)
