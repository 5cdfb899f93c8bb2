"""Landmarks that are not where they were, or are two, by where their sightings put them.

A sighting puts its landmark at a place on the field. The places of a landmark that does not move
scatter around one place. Two places, one after the other, are a landmark that was moved; two places
that take turns are two landmarks with one name.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import Integers, Mask
from cpcbl_launch.mapping.problem import Problem
from cpcbl_launch.reporting.metrics import Floats

LEAST_APART_M = 0.15
LEAST_APART_SIGMAS = 5.0  # of the scatter within each group
LEAST_SHARE = 0.1  # of the sightings, in the smaller group
LEAST_SIGHTINGS = 10
SWITCHES_SHARE = 0.1  # of the smaller group, up to which the groups are one after the other
LARGEST_SIGMA_M = 1.0  # of the scatter of a landmark
FAR_M, MOST_FAR = 0.5, 1.0 / 3.0  # the share of sightings that put it elsewhere


class SeenPlaces(NamedTuple):
    """Where the sightings of one landmark put it."""

    landmark: int
    places: Floats  # (n, 2), in the order of runs, and there of time
    stamp_s: Floats  # (n,)
    drive: Integers


def seen_places(problem: Problem, x: Floats, runs: Sequence[str]) -> Iterator[SeenPlaces]:
    """Of each landmark, those of its sightings with range and bearing. `runs`: that of each drive,
    in their order."""
    order = list(dict.fromkeys(runs))
    run_of_drive = np.array([order.index(run) for run in runs])
    poses, _, constants = problem.parts(x)
    readings = problem.readings
    both = np.isfinite(readings.range_m) & np.isfinite(readings.bearing)
    for landmark in range(problem.landmarks):
        mine = np.flatnonzero((readings.landmark == landmark) & both & (readings.mate < 0))
        run = run_of_drive[readings.drive[mine]]
        mine = mine[np.lexsort((readings.stamp_s[mine], run))]
        drive, pose = readings.drive[mine], poses[readings.pose[mine]]
        r = readings.range_m[mine] / (1.0 + constants[drive, 3])
        angle = pose[:, 2] + readings.bearing[mine] - constants[drive, 2]
        places = pose[:, :2] + r[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        yield SeenPlaces(landmark, places, readings.stamp_s[mine], drive)


class Fault(NamedTuple):
    """What is wrong with a landmark."""

    landmark: int
    words: str


def displaced_landmarks(
    problem: Problem, x: Floats, names: Sequence[str], runs: Sequence[str]
) -> list[Fault]:
    """The landmarks that must not be used. `runs`: the name of the run of each drive."""
    found = [
        (seen.landmark, _fault(seen, runs))
        for seen in seen_places(problem, x, runs)
        if len(seen.places) >= LEAST_SIGHTINGS
    ]
    return [Fault(i, f"landmark {names[i]} {words}") for i, words in found if words]


def _fault(seen: SeenPlaces, runs: Sequence[str]) -> str:
    second = _second_group(seen.places)
    a, b = seen.places[~second], seen.places[second]
    if len(b) < max(LEAST_SHARE * len(seen.places), 3):
        return _scatter_fault(seen.places)
    here, there = np.median(a, axis=0), np.median(b, axis=0)
    apart = float(np.hypot(*(there - here)))
    sigma = float(np.sqrt(0.5 * (_scatter(a) ** 2 + _scatter(b) ** 2)))
    if apart < max(LEAST_APART_M, LEAST_APART_SIGMAS * sigma):
        return _scatter_fault(seen.places)
    switches = np.flatnonzero(second[1:] != second[:-1])
    first, then = (there, here) if second[0] else (here, there)
    at = f"({first[0]:.2f}, {first[1]:.2f}) and ({then[0]:.2f}, {then[1]:.2f})"
    if len(switches) > max(1, SWITCHES_SHARE * min(len(a), len(b))):
        return (
            f"has two places, {at}, {apart:.2f} m apart, which take turns {len(switches)} times:"
            " two landmarks have this name, or it is moved again and again; it is not used"
        )
    moved = int(np.argmax(second != second[0]))
    before, after = runs[seen.drive[moved - 1]], runs[seen.drive[moved]]
    begin = seen.stamp_s[seen.drive == seen.drive[moved]].min()
    when = (
        f"between {before} and {after}"
        if before != after
        else f"in {after}, {seen.stamp_s[moved] - begin:.0f} s after it was first seen there"
    )
    return f"was moved by {apart:.2f} m {when}: it was at {at}; it is not used"


def _second_group(places: Floats) -> Mask:
    """Which places (n, 2) belong to the smaller of two groups (k-means from the two ends of the
    longest axis), shape (n,)."""
    centred = places - np.median(places, axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    along = centred @ axes[:, -1]
    second = along > 0.5 * (np.quantile(along, 0.02) + np.quantile(along, 0.98))
    for _ in range(20):
        if second.all() or not second.any():
            break
        centres = np.median(places[~second], axis=0), np.median(places[second], axis=0)
        distance = [np.hypot(*(places - centre).T) for centre in centres]
        before, second = second, distance[1] < distance[0]
        if (before == second).all():
            break
    return np.asarray(~second if second.sum() > 0.5 * len(second) else second)


def _scatter(places: Floats) -> float:
    """A robust standard deviation along an axis (m)."""
    distance = np.hypot(*(places - np.median(places, axis=0)).T)
    return float(np.median(distance)) / 1.1774


def _scatter_fault(places: Floats) -> str:
    distance = np.hypot(*(places - np.median(places, axis=0)).T)
    far = int(np.sum(distance > max(FAR_M, LEAST_APART_SIGMAS * _scatter(places))))
    sigma = _scatter(places)
    if sigma <= LARGEST_SIGMA_M and far <= MOST_FAR * len(places):
        return ""
    return (
        f"is nowhere: its {len(places)} sightings scatter by {sigma:.2f} m, and {far} of them are"
        " elsewhere: other landmarks are misread as this one; it is not used"
    )
