"""Whether a drive's ranges and bearings agree with its own odometry: their unit and their sign.

Between two sightings of one landmark the robot moved by what odometry says, and by what the change
of the sighting says. As complex numbers the second is k times the first. |k| is the unit of ranges,
the angle of k is an error of all bearings, and readings of which only the mirror image fits have
bearings with the wrong sign.
"""

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cpcbl_launch.mapping.drives import Drive
from cpcbl_launch.reporting.metrics import Floats

Complexes = NDArray[np.complex128]

LEAST_S, MOST_S = 3.0, 20.0  # between two sightings
LEAST_MOVED_M = 0.4
LEAST_PAIRS = 20
COHERENT = 0.8  # a correlation from which on two motions are the same
BETTER = 2.5  # times as far from 1 is the correlation of what is the mirror image of the truth
LARGEST_FACTOR = 1.3
LARGEST_TURN = math.radians(20.0)
UNITS = {3.2808: "feet", 39.37: "inches", 100.0: "centimetres", 1000.0: "millimetres"}
"""Usual units by how many of them a metre has."""


class _Fit(NamedTuple):
    coherence: float
    factor: float  # ranges as numbers, by metres of odometry
    angle: float  # rad


def odometry_path(drive: Drive) -> Floats:
    """The path by odometry alone, in the frame of the first pose, shape (n, 3)."""
    heading = np.concatenate([[0.0], np.cumsum(drive.motions[:, 2])])
    shift = drive.motions[:, :2] @ (1.0, 1.0j) * np.exp(1j * heading[:-1])
    place = np.concatenate([[0.0j], np.cumsum(shift)])
    return np.column_stack([place.real, place.imag, heading])


def sensor_fault(drive: Drive, robots: frozenset[str], walls: Collection[str] = ()) -> str:
    """What is wrong with all ranges or bearings of a drive; empty if nothing shows."""
    moved, seen, other_moved, mirrored = _pairs(drive, odometry_path(drive), robots, walls)
    if len(moved) < LEAST_PAIRS:
        return ""
    plain, mirror = _fit(moved, seen), _fit(other_moved, mirrored)
    is_better = BETTER * (1.0 - mirror.coherence) < 1.0 - plain.coherence
    if mirror.coherence > COHERENT and is_better:
        return (
            f"{drive.name}: its bearings have the wrong sign: mirrored, its sightings agree with"
            f" its odometry (correlation {mirror.coherence:.2f}; as they are {plain.coherence:.2f})"
        )
    if plain.coherence < COHERENT:
        return ""
    if abs(math.log(plain.factor)) > math.log(LARGEST_FACTOR):
        return (
            f"{drive.name}: its ranges are {plain.factor:.3g} times what its odometry says"
            f"{unit_words(plain.factor)}"
        )
    if abs(plain.angle) > LARGEST_TURN:
        turned = math.degrees(plain.angle)
        return f"{drive.name}: all of its bearings are {turned:.0f} deg too large"
    return ""


def unit_words(factor: float) -> str:
    """A guess of the unit of numbers that are this many times too large; empty if there is none."""
    for known, name in UNITS.items():
        if abs(math.log(factor / known)) < math.log(1.15):
            return f"; they look like {name}"
        if abs(math.log(factor * known)) < math.log(1.15):
            return f"; those of the other side look like {name}"
    return ""


def _pairs(
    drive: Drive, path: Floats, robots: frozenset[str], walls: Collection[str]
) -> Sequence[Complexes]:
    """Motions by odometry and by sightings, and the same with mirrored bearings; complex, shapes
    (pairs,). By two sightings of a wall only a motion towards it is seen."""
    last: dict[str, tuple[int, int, complex]] = {}
    rows = list[tuple[complex, complex, complex, complex]]()
    for used in drive.sightings:
        name, r, b = used.sighting.id, used.sighting.range_m, used.sighting.bearing_rad
        if name in robots or r is None or b is None:
            continue
        now = r * complex(math.cos(b), math.sin(b))
        if name in last:
            ns, pose, before = last[name]
            seconds = (used.stamp_ns - ns) * 1e-9
            if seconds < LEAST_S:
                continue
            moved = complex(*(path[used.pose, :2] - path[pose, :2]))
            if seconds < MOST_S and abs(moved) > LEAST_MOVED_M:
                u, v = np.exp(1j * path[[pose, used.pose], 2]).tolist()
                plain, mirror = (
                    _motion(moved, u * a, v * b, name in walls)
                    for a, b in ((before, now), (before.conjugate(), now.conjugate()))
                )
                if min(abs(plain[0]), abs(mirror[0])) > LEAST_MOVED_M:
                    rows.append((*plain, *mirror))
        last[name] = used.stamp_ns, used.pose, now
    return list(np.array(rows, dtype=np.complex128).reshape(-1, 4).T)


def _motion(
    moved: complex, before: complex, now: complex, is_wall: bool
) -> tuple[complex, complex]:
    """A motion, and the same by two sightings of a landmark; or its part towards a wall, and the
    same by the wall's distances."""
    if not is_wall:
        return moved, before - now
    mean = before / abs(before) + now / abs(now)
    unit = mean / max(abs(mean), 1e-9)
    return (unit.conjugate() * moved).real * unit, (abs(before) - abs(now)) * unit


def _fit(moved: Complexes, seen: Complexes) -> _Fit:
    """Robust against single wrong names: pairs of very different length do not count."""
    ratio = np.maximum(np.abs(seen) / np.abs(moved), 1e-9)
    near = np.abs(np.log(ratio / np.median(ratio))) < math.log(3.0)
    a, b = moved[near], seen[near]
    product = np.sum(np.conj(a) * b)
    square_a, square_b = np.sum(np.abs(a) ** 2), np.sum(np.abs(b) ** 2)
    coherence = float(np.abs(product) / np.sqrt(square_a * square_b))
    return _Fit(coherence, float(np.median(ratio)), float(np.angle(product)))
