"""Whether known landmarks fit what robots measured: their unit, a reflection, single places."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.align import LEAST_SPREAD_M, Rigid, fit_rigid, spread_m
from cpcbl_launch.mapping.sensor_check import unit_words
from cpcbl_launch.reporting.metrics import Floats, ellipse_of
from cpcbl_team.config import Landmark

NEAREST_M = 0.05  # spread of known landmarks, below which they give no direction at all
LARGEST_FACTOR = 1.25  # between distances as known and as measured
FLOOR_M, SHARE = 0.3, 0.05  # of two landmarks: how far their distance may differ from the measured
LARGEST_M, LARGEST_TIMES = 0.3, 5.0  # a known landmark is farther off, also in medians of the rest
ALIKE_M = 0.1  # of how well the rest fits without one landmark or without another
LARGEST_SIGMAS = 5.0  # of a place with a sigma


class KnownMap(NamedTuple):
    """Known landmarks that can be used, and how the measured map lies on them (None: too few)."""

    landmarks: dict[str, Landmark]
    rigid: Rigid | None
    notes: tuple[str, ...]


def sigma_of(mark: Landmark) -> float:
    """The standard deviation (m) of a place in the direction in which it is known worst."""
    xx, xy, yy = mark.covariance_m2 or (mark.sigma_m**2, 0.0, mark.sigma_m**2)
    return ellipse_of(xx, xy, yy).major_m


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
        allowed = np.array([max(LARGEST_M, LARGEST_SIGMAS * sigma_of(m)) for m in usable.values()])
        sigmas = np.array([sigma_of(mark) for mark in usable.values()])
        allowed = np.maximum(LARGEST_M, LARGEST_SIGMAS * sigmas)
        worst = _worst(points, places, sigmas)
        if not worst:
            wrong = _minority(points, places, allowed)
            if wrong:
                minority = [name for i, name in enumerate(usable) if i in wrong]
                notes.append(_minority_words(minority, wrong, points, places))
                usable = {name: mark for name, mark in usable.items() if name not in minority}
                continue
            is_wide = spread_m(points) > LEAST_SPREAD_M
            slack = float(np.sum(allowed - LARGEST_M))
            if is_wide and (fault := _whole_fault(tuple(usable), points, places, slack)):
                return KnownMap({}, None, (*notes, fault))
            return KnownMap(usable, fit_rigid(points, places), tuple(notes))
        names = {tuple(usable)[i]: error_m for i, error_m in worst.items()}
        usable = {name: mark for name, mark in usable.items() if name not in names}
        notes.append(_off_words(names, len(usable)))
    return KnownMap(usable, None, tuple(notes))


def _off_words(names: Mapping[str, float], others: int) -> str:
    if len(names) == 1:
        ((name, error_m),) = names.items()
        return (
            f"landmark {name} is {error_m:.2f} m from where the team file has it, beside the other"
            f" {others} known ones: its place is not used"
        )
    each = ", ".join(f"{name} by {error_m:.2f} m" for name, error_m in names.items())
    return (
        f"one of the known landmarks {', '.join(names)} is elsewhere, and nothing says which (the"
        f" one that is: {each}): none of these places is used"
    )


def _worst(points: Floats, places: Floats, sigmas: Floats) -> dict[int, float]:
    """The landmark that does not fit the others, with its distance (m) from where they put it; all
    of which that may be said, where it may be said of several, and none is less certain (`sigmas`,
    (n,)). Empty if all fit, or if without any single one the others still do not fit."""
    found = list[tuple[float, int, float]]()
    for i in range(len(points) if len(points) > 2 else 0):
        rest = np.arange(len(points)) != i
        rigid = fit_rigid(points[rest], places[rest])
        errors = np.hypot(*(rigid.points(points) - places).T)
        typical = float(np.max(errors[rest]))
        # An error of the rest turns it, which moves a landmark far from it by more.
        far = float(np.hypot(*(points[i] - points[rest].mean(axis=0))))
        lever = 1.0 + far / max(spread_m(points[rest]), LEAST_SPREAD_M)
        sigma = math.hypot(float(sigmas[i]), lever * float(sigmas[rest].max()))
        allowed_m = max(LARGEST_M, LARGEST_SIGMAS * sigma, LARGEST_TIMES * typical)
        if errors[i] > allowed_m:
            found.append((typical, i, float(errors[i])))
    best = min((typical for typical, _, _ in found), default=0.0)
    alike = {i: error_m for typical, i, error_m in found if typical < best + ALIKE_M}
    roughest = max((float(sigmas[i]) for i in alike), default=0.0)
    rough = {i: error_m for i, error_m in alike.items() if sigmas[i] == roughest > 0.0}
    return rough or alike


def _minority(points: Floats, places: Floats, allowed: Floats) -> dict[int, float]:
    """How far (m) from the others those landmarks are that do not fit a clear majority: at least
    half of all, and three. (A consensus over all pairs, as in Fischler & Bolles 1981.)"""
    best = np.full(len(points), np.inf)
    for i, j in zip(*np.triu_indices(len(points), 1), strict=True):
        pair = [int(i), int(j)]
        if spread_m(points[pair]) < LEAST_SPREAD_M or spread_m(places[pair]) < LEAST_SPREAD_M:
            continue
        z, w = points @ (1.0, 1.0j), places @ (1.0, 1.0j)
        angle = float(np.angle((w[j] - w[i]) / (z[j] - z[i])))
        turned = np.exp(1j * angle) * z
        errors = np.abs(turned + np.mean(w[pair] - turned[pair]) - w)
        if np.sum(errors < allowed) > np.sum(best < allowed):
            best = errors
    fits = best < allowed
    if fits.all() or fits.sum() < max(3, 0.5 * len(points) + 0.5):
        return {}
    rigid = fit_rigid(points[fits], places[fits])
    errors = np.hypot(*(rigid.points(points) - places).T)
    return {int(i): float(errors[i]) for i in np.flatnonzero(~fits & (errors > allowed))}


def _minority_words(
    names: list[str], wrong: Mapping[int, float], points: Floats, places: Floats
) -> str:
    each = ", ".join(f"{n} by {e:.2f} m" for n, e in zip(names, wrong.values(), strict=True))
    fits = [i for i in range(len(points)) if i not in wrong]
    index = list(wrong)
    seen = fit_rigid(points[fits], places[fits]).points(points)[index]
    apart = np.hypot(*(seen[:, None] - places[index][None]).transpose(2, 0, 1))
    swapped = len(names) == 2 and apart[0, 1] < LARGEST_M and apart[1, 0] < LARGEST_M
    why = ": these two are where the other one should be" if swapped else ""
    return (
        f"landmarks {', '.join(names)} are not where the team file has them, beside the other"
        f" {len(fits)} known ones ({each}){why}; their places are not used"
    )


def _whole_fault(names: tuple[str, ...], points: Floats, places: Floats, slack_m: float) -> str:
    """What is wrong with the known map as a whole; empty if nothing is. `slack_m`: how much more
    two places may be apart, because they are uncertain."""
    factor = _ratio_of_distances(points, places)
    if len(names) == 2:
        known, measured = (float(np.hypot(*(p[1] - p[0]))) for p in (places, points))
        if abs(known - measured) < slack_m:
            return ""
        if 1.0 / LARGEST_FACTOR < factor < LARGEST_FACTOR and (
            abs(known - measured) > FLOOR_M + slack_m + SHARE * measured
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
