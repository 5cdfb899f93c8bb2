"""What is known of the field before the robots start: its landmarks and walls."""

import math
from typing import Literal

import msgspec

from cpcbl_team.config.table import Table

Gives = Literal["both", "range", "bearing", "none"]
Bands = tuple[str, str]
"""The names of two colours, the upper one first."""


class Landmark(Table, frozen=True, kw_only=True):
    """A point whose position in the field's frame is known beforehand."""

    x_m: float
    y_m: float
    gives: Gives = "both"
    """Which measurements of it the robots use."""
    colours: Bands | None = None
    """The colour bands of the cylinder that stands there, by which a camera recognises it."""


class Wall(Table, frozen=True, kw_only=True):
    """A straight surface from one point of the field to another."""

    from_m: tuple[float, float]
    to_m: tuple[float, float]
    gives: Gives = "both"

    @property
    def direction_rad(self) -> float:
        """The direction from the first point to the second, in the field's frame."""
        return math.atan2(self.to_m[1] - self.from_m[1], self.to_m[0] - self.from_m[0])


class Field(Table, frozen=True, kw_only=True):
    """The map: all landmarks and walls by their names."""

    landmarks: dict[str, Landmark] = msgspec.field(default_factory=dict)
    walls: dict[str, Wall] = msgspec.field(default_factory=dict)

    def bounds(self) -> tuple[float, float, float, float]:
        """(least x, least y, greatest x, greatest y) in metres of what is on the map; zeros for an
        empty map."""
        points = [(p.x_m, p.y_m) for p in self.landmarks.values()]
        points += [end for wall in self.walls.values() for end in (wall.from_m, wall.to_m)]
        if not points:
            return 0.0, 0.0, 0.0, 0.0
        xs, ys = [p[0] for p in points], [p[1] for p in points]
        return min(xs), min(ys), max(xs), max(ys)
