"""Whether known places fit what robots measured: their unit, a reflection, single landmarks."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.align import LEAST_SPREAD_M, Rigid, fit_rigid, spread_m
from cpcbl_launch.mapping.sensor_check import unit_words
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Landmark

NEAREST_M = 0.05  # spread of known landmarks, below which they give no direction at all
LARGEST_FACTOR = 1.25  # between distances as known and as measured
FLOOR_M, SHARE = 0.3, 0.05  # of two landmarks: how far their distance may differ from the measured
LARGEST_M, LARGEST_TIMES = 0.3, 5.0  # a known landmark is farther off, also in medians of the rest


class KnownMap(NamedTuple):
    """Known landmarks that can be used, and how the measured map lies on them (None: too few)."""

    landmarks: dict[str, Landmark]
    rigid: Rigid | None
    notes: tuple[str, ...]


def check_known(known: Mapping[str, Landmark], measured: Mapping[str, Floats]) -> KnownMap:
    """The known landmarks that fit the measured map, which is in a frame of its own."""
    usable = {name: mark for name, mark in known.items() if name in measured}
    notes = list[str]()
    while len(usable) >= 2:
        points = np.array([measured[name] for name in usable])
        places = np.array([(mark.x_m, mark.y_m) for mark in usable.values()])
        if min(spread_m(points), spread_m(places)) < NEAREST_M:
            notes.append(
                f"the known landmarks {', '.join(usable)} are at one place, which gives no"
                " direction: they are not used"
            )
            return KnownMap({}, None, tuple(notes))
        worst, error_m = _worst(points, places)
        if worst < 0:
            is_wide = spread_m(points) > LEAST_SPREAD_M
            if is_wide and (fault := _whole_fault(tuple(usable), points, places)):
                return KnownMap({}, None, (*notes, fault))
            return KnownMap(usable, fit_rigid(points, places), tuple(notes))
        name = tuple(usable)[worst]
        del usable[name]
        notes.append(
            f"landmark {name} is {error_m:.2f} m from where the team file has it, beside the other"
            f" {len(usable)} known ones: its place is not used"
        )
    return KnownMap(usable, None, tuple(notes))


def _worst(points: Floats, places: Floats) -> tuple[int, float]:
    """The landmark that does not fit the others, with its distance (m) from where they put it;
    -1 if all fit, or if nothing says which one does not."""
    if len(points) < 3:
        return -1, 0.0
    best, found = math.inf, (-1, 0.0)
    for i in range(len(points)):
        rest = np.arange(len(points)) != i
        rigid = fit_rigid(points[rest], places[rest])
        errors = np.hypot(*(rigid.points(points) - places).T)
        typical = float(np.max(errors[rest]))
        if typical < best and errors[i] > max(LARGEST_M, LARGEST_TIMES * typical):
            best, found = typical, (i, float(errors[i]))
    return found


def _whole_fault(names: tuple[str, ...], points: Floats, places: Floats) -> str:
    """What is wrong with the known map as a whole; empty if nothing is."""
    factor = _ratio_of_distances(points, places)
    if len(names) == 2:
        known, measured = (float(np.hypot(*(p[1] - p[0]))) for p in (places, points))
        if 1.0 / LARGEST_FACTOR < factor < LARGEST_FACTOR and (
            abs(known - measured) > FLOOR_M + SHARE * measured
        ):
            return (
                f"the known landmarks {' and '.join(names)} are {known:.2f} m apart in the team"
                f" file, and {measured:.2f} m as robots measured: one of them is elsewhere, or the"
                " ranges are not calibrated; their places are not used"
            )
    if abs(math.log(factor)) > math.log(LARGEST_FACTOR):
        return (
            f"the distances between the known landmarks {', '.join(names)} are {factor:.3g} times"
            f" what the robots measured{unit_words(factor)}: their places are not used"
        )
    if len(names) < 3:
        return ""
    plain = np.hypot(*(fit_rigid(points, places).points(points) - places).T)
    mirrored = points * (1.0, -1.0)
    mirror = np.hypot(*(fit_rigid(mirrored, places).points(mirrored) - places).T)
    if np.median(plain) > LARGEST_M and np.median(mirror) < np.median(plain) / 3.0:
        return (
            f"the known map is the mirror image of what the robots measured (median error"
            f" {np.median(plain):.2f} m, mirrored {np.median(mirror):.2f} m): was y measured to the"
            " right? Its places are not used"
        )
    return ""


def _ratio_of_distances(points: Floats, places: Floats) -> float:
    """The median ratio of all distances between two places: one wrong place does not move it."""
    i, j = np.triu_indices(len(points), 1)
    measured = np.hypot(*(points[i] - points[j]).T)
    known = np.hypot(*(places[i] - places[j]).T)
    return float(np.median(np.maximum(known, 1e-6) / np.maximum(measured, 1e-6)))
