"""Which object of the map stands elsewhere: the one whose readings are wrong time after time.

An error of the map may be within the gates. But readings of a right map err about zero, so their
mean tells what no single one does: the offset of an object from its place, by least squares. The
wrong place moves the robot's estimate too, and with it the offsets of all other objects; the
largest is that of the wrong one, if it was seen from many sides.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from cpcbl_team.constraints import NEAREST_M, circle, heading
from cpcbl_team.geometry import new

KEPT: Final = 1.0 - 1.5 / 120.0  # of all sums, after a block of 1.5 s
PRIOR: Final = 1.0  # 1/m^2: of an offset before anything was read
LEAST_CHI_SQUARE: Final = 40.0  # of an offset, against none,
LEAST_RATIO: Final = 1.5  # and against that of any other object
FARTHEST: Final = 100.0  # squared sigmas: beyond, a reading is an outlier


class Reading(NamedTuple):
    """A landmark as it was seen from an estimated pose; the sensor's sigmas."""

    name: str
    dx: float  # from the robot to its place on the map, in the field's frame, m
    dy: float
    heading: float  # of the robot, rad
    range_m: float | None
    bearing_rad: float | None
    range_sigma_m: float
    bearing_sigma_rad: float


class Offset(NamedTuple):
    """The normal equations of the offset of one object."""

    xx: float = PRIOR
    xy: float = 0.0
    yy: float = PRIOR
    x: float = 0.0
    y: float = 0.0
    readings: float = 0.0
    squares: float = 0.0  # the sum of their residuals' squares, in sigmas

    def plus(self, r: Reading) -> "Offset":
        """With one more reading."""
        distance = math.hypot(r.dx, r.dy)
        if distance < NEAREST_M:
            return self
        rows = []
        if r.range_m is not None:
            rows.append((circle(r.dx, r.dy, distance, r.range_m), r.range_sigma_m))
        if r.bearing_rad is not None:
            row = heading(r.dx, r.dy, distance * distance, r.bearing_rad, r.heading)
            rows.append((row, r.bearing_sigma_rad))
        xx, xy, yy, x, y, readings, squares = self
        for (u, v, residual), sigma in rows:
            weight = 1.0 / max(sigma * sigma, 1e-12)
            if weight * residual * residual > FARTHEST:
                return self
            xx, xy, yy = xx + weight * u * u, xy + weight * u * v, yy + weight * v * v
            x, y = x + weight * u * residual, y + weight * v * residual
            readings, squares = readings + 1.0, squares + weight * residual * residual
        return new(Offset, (xx, xy, yy, x, y, readings, squares))

    def faded(self) -> "Offset":
        """With all that was read before the present block counting less."""
        xx, xy, yy, *rest = (KEPT * n for n in self)
        prior = (1.0 - KEPT) * PRIOR
        return new(Offset, (xx + prior, xy, yy + prior, *rest))

    @property
    def chi_square(self) -> float:
        """How much better the offset explains the readings than none does."""
        xx, xy, yy, x, y, _, _ = self
        return (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)


_NONE: Final[Mapping[str, Offset]] = {}


class MapResiduals(NamedTuple):
    """The offsets of the objects of a map from their places."""

    of_object: Mapping[str, Offset] = _NONE

    def plus(self, readings: Iterable[Reading]) -> "MapResiduals":
        """With the readings of one more block."""
        of_object = {name: offset.faded() for name, offset in self.of_object.items()}
        for reading in readings:
            of_object[reading.name] = of_object.get(reading.name, Offset()).plus(reading)
        return MapResiduals(of_object)

    def misplaced(self) -> str:
        """The object that must stand elsewhere than on the map; empty if there is none."""
        if len(self.of_object) < 3:  # of two that contradict each other either one may be wrong
            return ""
        ranked = sorted((o.chi_square, name) for name, o in self.of_object.items())
        (second, _), (most, name) = ranked[-2:]
        others = [o for other, o in self.of_object.items() if other != name]
        unit = sum(o.squares for o in others) / max(sum(o.readings for o in others), 1.0)
        least = max(LEAST_CHI_SQUARE * max(unit, 1.0), LEAST_RATIO * second)
        return name if most > least else ""


NO_RESIDUALS: Final = MapResiduals()
