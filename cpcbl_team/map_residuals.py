"""Which object of the map stands elsewhere: the one whose readings are wrong time after time.

An error of the map may be within the gates. But readings of a right map err about zero, so their
mean tells what no single one does: the offset of an object from its place, by least squares. The
wrong place moves the robot's estimate too, and with it the offsets of all other objects; the
largest is that of the wrong one, if it was seen from many sides.

The robot's own error is in all readings of a block alike: however many there are, they do not tell
the offset better than the robot knows its pose.
"""

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

from cpcbl_team.constraints import NEAREST_M, circle, heading
from cpcbl_team.estimate import Covariance3
from cpcbl_team.geometry import new

KEPT: Final = 1.0 - 1.5 / 120.0  # of all sums, after a block of 1.5 s
PRIOR: Final = 1.0  # 1/m^2: of an offset before anything was read
LEAST_CHI_SQUARE: Final = 40.0  # of an offset, against none,
LEAST_RATIO: Final = 1.5  # and against that of any other object
FARTHEST: Final = 100.0  # squared sigmas: beyond, a reading is an outlier


class Offset(NamedTuple):
    """The normal equations of the offset of one object."""

    xx: float = PRIOR
    xy: float = 0.0
    yy: float = PRIOR
    x: float = 0.0
    y: float = 0.0
    readings: float = 0.0
    squares: float = 0.0  # the sum of their residuals' squares, in sigmas

    @property
    def chi_square(self) -> float:
        """How much better the offset explains the readings than none does."""
        xx, xy, yy, x, y, _, _ = self
        return (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)

    @property
    def distance_m(self) -> float:
        """How far from its place the object stands by all readings."""
        xx, xy, yy, x, y, _, _ = self
        return math.hypot(yy * x - xy * y, xx * y - xy * x) / (xx * yy - xy * xy)


NO_OFFSET: Final = Offset()
_NONE: Final[Mapping[str, Offset]] = {}


class MapResiduals(NamedTuple):
    """The offsets of the objects of a map from their places."""

    of_object: Mapping[str, Offset] = _NONE
    misplaced: str = ""
    """The object that must stand elsewhere than on the map; empty if there is none."""


NO_RESIDUALS: Final = MapResiduals()


def misplaced_object(offsets: Mapping[str, Offset]) -> str:
    """The object that must stand elsewhere than on the map; empty if there is none."""
    if len(offsets) < 3:  # of two that contradict each other either one may be wrong
        return ""
    ranked = sorted((o.chi_square, name) for name, o in offsets.items())
    (second, _), (most, name) = ranked[-2:]
    others = [o for other, o in offsets.items() if other != name]
    unit = sum(o.squares for o in others) / max(sum(o.readings for o in others), 1.0)
    least = max(LEAST_CHI_SQUARE * max(unit, 1.0), LEAST_RATIO * second)
    return name if most > least else ""


class OffsetSums:
    """The normal equations of the offset of one object, to which blocks are added."""

    def __init__(self, before: Offset) -> None:
        self.xx, self.xy, self.yy, self.x, self.y, self.readings, self.squares = before

    def fade(self) -> None:
        """Makes all that was read before the present block count less."""
        prior = (1.0 - KEPT) * PRIOR
        self.xx, self.xy, self.yy = KEPT * self.xx + prior, KEPT * self.xy, KEPT * self.yy + prior
        self.x, self.y = KEPT * self.x, KEPT * self.y
        self.readings, self.squares = KEPT * self.readings, KEPT * self.squares

    def add_block(self, block: "BlockSums", pose: Covariance3) -> None:
        """Adds the readings of a block, in which the error of the pose is one for all.

        With the information I and the vector b of the readings, and the covariance P of where the
        pose puts the object, they tell (I^-1 + P)^-1 = (1 + I P)^-1 I and (1 + I P)^-1 b.
        """
        xx, xy, yy, n = block.xx, block.xy, block.yy, max(block.readings, 1.0)
        east, north = block.east / n, block.north / n
        pxx, pxy, pyy = pose.projected(((1.0, 0.0, -north), (0.0, 1.0, east)))
        a, b = 1.0 + xx * pxx + xy * pxy, xx * pxy + xy * pyy
        c, d = xy * pxx + yy * pxy, 1.0 + xy * pxy + yy * pyy
        k = 1.0 / (a * d - b * c)
        self.xx += k * (d * xx - b * xy)
        self.xy += k * (d * xy - b * yy)
        self.yy += k * (a * yy - c * xy)
        self.x += k * (d * block.x - b * block.y)
        self.y += k * (a * block.y - c * block.x)
        self.readings += block.readings
        self.squares += block.squares

    def offset(self) -> Offset:
        sums = self.xx, self.xy, self.yy, self.x, self.y, self.readings, self.squares
        return new(Offset, sums)


class BlockSums:
    """The same of the readings of one block alone, and the sum of the object's displacements from
    the robot (m)."""

    def __init__(self) -> None:
        self.xx = self.xy = self.yy = self.x = self.y = self.readings = self.squares = 0.0
        self.east = self.north = 0.0

    def add(
        self, u: float, v: float, residual: float, weight: float, east: float, north: float
    ) -> None:
        """Adds a reading that the offset (x, y) changes by u x + v y."""
        self.xx += weight * u * u
        self.xy += weight * u * v
        self.yy += weight * v * v
        self.x += weight * u * residual
        self.y += weight * v * residual
        self.readings += 1.0
        self.squares += weight * residual * residual
        self.east += east
        self.north += north


class ResidualSums:
    """Adds the readings of one more block to what the blocks before have told."""

    def __init__(self, before: MapResiduals) -> None:
        self._of_object = {name: OffsetSums(offset) for name, offset in before.of_object.items()}
        self._of_block: dict[str, BlockSums] = {}
        for sums in self._of_object.values():
            sums.fade()

    def add(
        self,
        name: str,
        dx: float,
        dy: float,
        heading_rad: float,
        range_m: float | None,
        bearing_rad: float | None,
        range_sigma_m: float,
        bearing_sigma_rad: float,
    ) -> None:
        """Adds what was read of an object that is (dx, dy) from the robot on the map (m, in the
        field's frame), with the robot's heading there and the sigmas of the sensor. An outlier,
        and an object that is too near to have a direction, tell nothing."""
        sums = self._of_block.get(name)
        if sums is None:
            sums = self._of_block[name] = BlockSums()
        distance = math.hypot(dx, dy)
        if distance < NEAREST_M:
            return
        u, v, residual, weight = 0.0, 0.0, 0.0, 0.0
        if range_m is not None:
            u, v, residual = circle(dx, dy, distance, range_m)
            weight = 1.0 / max(range_sigma_m * range_sigma_m, 1e-12)
            if weight * residual * residual > FARTHEST:
                return
        if bearing_rad is not None:
            across, along, turn = heading(dx, dy, distance * distance, bearing_rad, heading_rad)
            of_bearing = 1.0 / max(bearing_sigma_rad * bearing_sigma_rad, 1e-12)
            if of_bearing * turn * turn > FARTHEST:
                return
            sums.add(across, along, turn, of_bearing, dx, dy)
        if range_m is not None:
            sums.add(u, v, residual, weight, dx, dy)

    def residuals(self, pose: Covariance3) -> MapResiduals:
        """What the blocks tell, this one with the covariance of the robot's pose."""
        for name, block in self._of_block.items():
            sums = self._of_object.get(name)
            if sums is None:
                sums = self._of_object[name] = OffsetSums(NO_OFFSET)
            sums.add_block(block, pose)
        offsets = {name: sums.offset() for name, sums in self._of_object.items()}
        return MapResiduals(offsets, misplaced_object(offsets))
