"""What is near a place, without asking everything on the field: square cells with their content."""

import math
from collections.abc import Iterable
from typing import Generic, Protocol, TypeVar


class HasPosition(Protocol):
    """Something with a place in the field's frame, in metres."""

    @property
    def x(self) -> float: ...

    @property
    def y(self) -> float: ...


Item = TypeVar("Item", bound=HasPosition)
_MARGIN_M = 1e-3  # so that rounding moves nothing beyond the next cell


class Grid(Generic[Item]):
    """Things by cell; a cell is as wide as anybody can reach, so that nine of them are enough."""

    def __init__(self, reach_m: float, things: Iterable[Item]) -> None:
        self._side_m = reach_m + _MARGIN_M
        self._cells: dict[tuple[int, int], list[tuple[int, Item]]] = {}
        for numbered in enumerate(things):
            cell = self._cell(numbered[1].x, numbered[1].y)
            self._cells.setdefault(cell, []).append(numbered)

    def near(self, x: float, y: float) -> list[Item]:
        """All within reach of a place (metres) and some beyond, in the order they were given."""
        column, row = self._cell(x, y)
        found: list[tuple[int, Item]] = []
        for i in (column - 1, column, column + 1):
            for j in (row - 1, row, row + 1):
                found += self._cells.get((i, j), ())
        found.sort()  # by number: no two are the same
        return [thing for _, thing in found]

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        return math.floor(x / self._side_m), math.floor(y / self._side_m)
