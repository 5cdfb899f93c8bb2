"""The walls of a map: their ends, and how well they are known."""

import math
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.mapper import Mapped
from cpcbl_launch.mapping.stated import wall_extents
from cpcbl_launch.reporting.metrics import Floats

LEAST_LENGTH_M = 0.5  # of a wall that is written, however short the part is that robots saw


class MappedWall(NamedTuple):
    """A wall from one end to the other, which are those of the team file, or of what robots saw."""

    ends: Floats  # (2, 2)
    covariance: Floats  # (2, 2): of the offset of its middle (m^2), and of its direction (rad^2)
    seen_m: tuple[float, float]  # the part that robots saw, from its middle along its direction

    @property
    def length_m(self) -> float:
        return math.dist(*self.ends)

    @property
    def sigmas(self) -> tuple[float, float]:
        """Of the offset of its middle (m) and of its direction (rad)."""
        offset, direction = np.sqrt(np.diag(self.covariance)).tolist()
        return offset, direction

    @property
    def independent_sigmas(self) -> tuple[float, float]:
        """The same for somebody who takes them as independent: so much larger that no combination
        of the two looks more certain than it is."""
        offset, direction = self.sigmas
        k = math.sqrt(1.0 + abs(float(self.covariance[0, 1])) / max(offset * direction, 1e-300))
        return k * offset, k * direction

    def sigma_at(self, along_m: float) -> float:
        """Of the wall across itself (m), so far from its middle."""
        row = np.array([1.0, along_m])
        return math.sqrt(max(float(row @ self.covariance @ row), 0.0))

    def point_at(self, along_m: float) -> Floats:
        unit = (self.ends[1] - self.ends[0]) / self.length_m
        return np.asarray(self.ends.mean(axis=0) + along_m * unit)


def mapped_wall(mapped: Mapped, name: str) -> MappedWall:
    """A wall of the map, by its name."""
    (offset, direction), covariance = mapped.wall(name)
    pivot = mapped.pivot(name)
    along = np.array([math.cos(direction), math.sin(direction)])
    foot = pivot + offset * np.array([-along[1], along[0]])
    low, high = wall_extents(mapped.problem, mapped.solution.x)[mapped.walls.index(name)].tolist()
    known = mapped.frame.walls.get(name)
    if known is not None:
        begin, end = ((np.subtract(p, pivot) @ along) for p in (known.from_m, known.to_m))
    else:
        longer = max(LEAST_LENGTH_M - (high - low), 0.0)
        begin, end = low - 0.5 * longer, high + 0.5 * longer
    middle = 0.5 * (begin + end)
    moved = np.array([[1.0, middle], [0.0, 1.0]])
    ends = foot + np.outer((begin, end), along)
    return MappedWall(ends, moved @ covariance @ moved.T, (low - middle, high - middle))
