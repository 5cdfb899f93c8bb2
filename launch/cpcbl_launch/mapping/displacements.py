"""Landmarks and walls that are not where they were, or are two, by where their sightings put them.

A sighting puts its landmark at a place on the field. The places of a landmark that does not move
scatter around one place. Two places, one after the other, are a landmark that was moved; two places
that take turns are two landmarks with one name.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import Integers, Mask
from cpcbl_launch.mapping.problem import BEARING, RANGE, Problem, wall_views
from cpcbl_launch.reporting.metrics import Floats

LEAST_APART_M = 0.15
LEAST_APART_SIGMAS = 5.0  # of the scatter within each group
LEAST_SHARE = 0.1  # of the sightings, in the smaller group
LEAST_SIGHTINGS = 10
SWITCHES_SHARE = 0.1  # of the smaller group, up to which the groups are one after the other
LARGEST_SIGMA_M = 1.0  # of the scatter of a landmark
MEDIAN_POINT, MEDIAN_LINE = 1.1774, 0.6745  # sigmas: of a Rayleigh distribution, of a half-normal
FAR_M, MOST_FAR = 0.5, 1.0 / 3.0  # the share of sightings that put it elsewhere


class SeenPlaces(NamedTuple):
    """Where the sightings of one landmark put it, or those of one wall the foot of a perpendicular
    from its pivot."""

    place: int  # of the landmark, or counted on behind the landmarks, of the wall
    places: Floats  # (n, 2), in the order of runs, and there of time
    stamp_s: Floats  # (n,)
    drive: Integers
    median_sigmas: float  # the median distance of normal places from their middle, in sigmas


def seen_places(problem: Problem, x: Floats, runs: Sequence[str]) -> Iterator[SeenPlaces]:
    """Of each landmark, those of its sightings with range and bearing; of each wall, those with a
    range. `runs`: that of each drive, in their order."""
    order = list(dict.fromkeys(runs))
    run_of_drive = np.array([order.index(run) for run in runs])
    readings = problem.readings
    places = _places_by_readings(problem, x)
    object_of = np.where(readings.wall >= 0, problem.landmarks + readings.wall, readings.landmark)
    object_of[readings.mate >= 0] = -1
    for index in range(problem.landmarks + problem.walls):
        mine = np.flatnonzero((object_of == index) & np.isfinite(places[:, 0]))
        run = run_of_drive[readings.drive[mine]]
        mine = mine[np.lexsort((readings.stamp_s[mine], run))]
        median = MEDIAN_POINT if index < problem.landmarks else MEDIAN_LINE
        yield SeenPlaces(index, places[mine], readings.stamp_s[mine], readings.drive[mine], median)


def _places_by_readings(problem: Problem, x: Floats) -> Floats:
    """Where each reading puts its object, shape (s, 2); NaN where it does not tell."""
    poses, _, constants = problem.parts(x)
    readings = problem.readings
    pose, drive = poses[readings.pose], readings.drive
    r = readings.range_m / (1.0 + constants[drive, RANGE])
    angle = pose[:, 2] + readings.bearing - constants[drive, BEARING]
    places = pose[:, :2] + r[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    mine = readings.wall >= 0
    if mine.any():
        views, wall = wall_views(problem, x), readings.wall[mine]
        offset, direction = problem.lines(x)[wall].T
        across = offset + views.distance_m - views.side * r[mine]
        normal = np.stack([-np.sin(direction), np.cos(direction)], axis=1)
        places[mine] = problem.pivots[wall] + across[:, None] * normal
    return np.asarray(places)


class Fault(NamedTuple):
    """What is wrong with a landmark or wall."""

    place: int
    words: str


def displaced_places(
    problem: Problem, x: Floats, names: Sequence[str], runs: Sequence[str]
) -> list[Fault]:
    """The landmarks and walls that must not be used. `runs`: the name of the run of each drive."""
    found = [
        (seen.place, _fault(seen, runs))
        for seen in seen_places(problem, x, runs)
        if len(seen.places) >= LEAST_SIGHTINGS
    ]
    kinds = ["landmark"] * problem.landmarks + ["wall"] * problem.walls
    return [Fault(i, f"{kinds[i]} {names[i]} {words}") for i, words in found if words]


def _fault(seen: SeenPlaces, runs: Sequence[str]) -> str:
    second = _second_group(seen.places)
    a, b = seen.places[~second], seen.places[second]
    if len(b) < max(LEAST_SHARE * len(seen.places), 3):
        return _scatter_fault(seen)
    here, there = np.median(a, axis=0), np.median(b, axis=0)
    apart = float(np.hypot(*(there - here)))
    each = [_scatter(places, seen.median_sigmas) for places in (a, b)]
    sigma = float(np.sqrt(np.mean(np.square(each))))
    if apart < max(LEAST_APART_M, LEAST_APART_SIGMAS * sigma):
        return _scatter_fault(seen)
    switches = np.flatnonzero(second[1:] != second[:-1])
    first, then = (there, here) if second[0] else (here, there)
    at = f"({first[0]:.2f}, {first[1]:.2f}) and ({then[0]:.2f}, {then[1]:.2f})"
    if len(switches) > max(1, SWITCHES_SHARE * min(len(a), len(b))):
        return (
            f"has two places, {at}, {apart:.2f} m apart, which take turns {len(switches)} times:"
            " two things have this name, or it is moved again and again; it is not used"
        )
    # The change after which the groups are best told apart: single sightings are in the wrong one.
    later = second != second[0]
    moved = 1 + int(np.argmin(np.cumsum(later)[:-1] + np.cumsum(~later[::-1])[::-1][1:]))
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


def _scatter(places: Floats, median_sigmas: float) -> float:
    """A robust standard deviation along an axis (m)."""
    distance = np.hypot(*(places - np.median(places, axis=0)).T)
    return float(np.median(distance)) / median_sigmas


def _scatter_fault(seen: SeenPlaces) -> str:
    places = seen.places
    sigma = _scatter(places, seen.median_sigmas)
    distance = np.hypot(*(places - np.median(places, axis=0)).T)
    far = int(np.sum(distance > max(FAR_M, LEAST_APART_SIGMAS * sigma)))
    if sigma <= LARGEST_SIGMA_M and far <= MOST_FAR * len(places):
        return ""
    return (
        f"is nowhere: its {len(places)} sightings scatter by {sigma:.2f} m, and {far} of them are"
        " elsewhere: others are misread as this one; it is not used"
    )
