"""What is badly known of the walls of a map, why, and which drive would mend it."""

import math
from collections.abc import Iterator

import numpy as np

from cpcbl_launch.mapping.mapped_walls import MappedWall, mapped_wall
from cpcbl_launch.mapping.mapper import Mapped

WEAK_M = 0.05  # of the sigma at an end, from which on a wall is badly known
WEAK_RAD = math.radians(2.0)
OF_FRAME = 0.7  # the share of a direction's sigma that turns of the whole map explain
SHORT = 0.5  # the share of a wall that robots saw
SHORT_M = 2.0  # or the length of what they saw of it
NEAR_M = 1.5


def wall_advice(mapped: Mapped, turning_sigma: float) -> Iterator[str]:
    """One line for each wall that is badly known. `turning_sigma` (rad): of the whole map, for
    which there is advice already."""
    for name in mapped.walls:
        wall = mapped_wall(mapped, name)
        ends = [wall.sigma_at(side * 0.5 * wall.length_m) for side in (-1.0, 1.0)]
        is_weak = max(ends) > WEAK_M or wall.sigmas[1] > WEAK_RAD
        is_turned = turning_sigma > OF_FRAME * wall.sigmas[1] and wall.sigmas[0] < WEAK_M
        if name not in mapped.frame.known_names and is_weak and not is_turned:
            yield _advice(mapped, name, wall, ends)


def _advice(mapped: Mapped, name: str, wall: MappedWall, ends: list[float]) -> str:
    readings = mapped.problem.readings
    mine = readings.wall == mapped.walls.index(name)
    known = (
        f"wall {name} is known to {max(ends):.2f} m at its ends and"
        f" {math.degrees(wall.sigmas[1]):.1f} deg"
    )
    if not np.isfinite(readings.range_m[mine]).any():
        return (
            f"{known}: bearings tell its direction alone, never where it is; let robots measure"
            " its distance, or measure its place"
        )
    low, high = wall.seen_m
    if high - low < max(SHORT * wall.length_m, SHORT_M):
        first, last = 0.5 * wall.length_m + low, 0.5 * wall.length_m - high
        side = 1.0 if last >= first else -1.0
        there = wall.point_at(side * max(0.5 * wall.length_m, abs(0.5 * (low + high)) + NEAR_M))
        return (
            f"{known}: robots saw {max(high - low, 0.0):.1f} m of it; drive along it, within"
            f" {NEAR_M:g} m, to ({there[0]:.1f}, {there[1]:.1f})"
        )
    return f"{known}: it was seen {int(mine.sum())} times; drive along it more often, and nearer"
