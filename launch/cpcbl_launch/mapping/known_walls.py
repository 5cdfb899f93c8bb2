"""Whether known walls fit what robots measured, and the frame that known walls give."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.align import Rigid
from cpcbl_launch.mapping.known_map import LARGEST_M, LARGEST_SIGMAS, KnownMap, check_known
from cpcbl_launch.mapping.sensor_check import unit_words
from cpcbl_launch.mapping.wall_lines import (
    LEAST_LEVER_M,
    PARALLEL,
    Line,
    Pairs,
    errors_m,
    fit_frames,
    line_of,
    sees_from_inside,
)
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Landmark, Wall

CLEARLY = 2.0  # times as far off is one of two hypotheses


class KnownPlaces(NamedTuple):
    """Known landmarks and walls that can be used, and how the measured map lies on them."""

    landmarks: dict[str, Landmark]
    walls: dict[str, Wall]
    rigid: Rigid | None  # None: too few
    free: Floats | None  # (2,), the direction of walls along which they leave the position open
    notes: tuple[str, ...]


class Measured(NamedTuple):
    """What robots measured, in a frame of its own."""

    landmarks: Mapping[str, Floats]
    lines: Mapping[str, Line]
    poses: Sequence[Floats]


def check_places(
    landmarks: Mapping[str, Landmark], walls: Mapping[str, Wall], measured: Measured
) -> KnownPlaces:
    """The known places that fit what robots measured."""
    checked = check_known(landmarks, measured.landmarks)
    seen = {name: wall for name, wall in walls.items() if name in measured.lines}
    if checked.rigid is not None:
        good, notes = _beside_landmarks(seen, checked.rigid, measured)
        unseen = {name: wall for name, wall in walls.items() if name not in seen}
        notes = (*checked.notes, *notes)
        return KnownPlaces(checked.landmarks, good | unseen, checked.rigid, None, notes)
    if not seen:
        return KnownPlaces(checked.landmarks, {}, None, None, checked.notes)
    return _by_walls(checked, walls, seen, measured)


def _allowed_m(wall: Wall, line: Line) -> float:
    turned = math.radians(wall.direction_sigma_deg) * max(line.half_m, LEAST_LEVER_M)
    return max(LARGEST_M, LARGEST_SIGMAS * math.hypot(wall.sigma_m, turned))


def _beside_landmarks(
    walls: Mapping[str, Wall], rigid: Rigid, measured: Measured
) -> tuple[dict[str, Wall], tuple[str, ...]]:
    """The walls that are where the known landmarks let expect them."""
    good, notes = dict(walls), []
    for name, wall in walls.items():
        here, there = measured.lines[name].in_frame(rigid), line_of(wall)
        pair = Pairs(np.empty((0, 2)), np.empty((0, 2)), [here], [there])
        if errors_m(pair, Rigid(0.0, np.zeros(2)))[0] > _allowed_m(wall, here):
            del good[name]
            notes.append(f"{_off_words(name, here, there)}, beside the known landmarks")
    return good, tuple(f"{note}: its place is not used" for note in notes)


def _off_words(name: str, here: Line, there: Line) -> str:
    offset = abs(float(there.normal @ (here.point - there.point)))
    turned = math.degrees(math.asin(min(abs(math.sin(here.direction - there.direction)), 1.0)))
    return f"wall {name} is {offset:.2f} m and {turned:.0f} deg from where the team file has it"


# Without two landmarks ----------------------------------------------------------------------------


def _by_walls(
    checked: KnownMap, walls: Mapping[str, Wall], seen: Mapping[str, Wall], measured: Measured
) -> KnownPlaces:
    """The frame of walls, with at most one landmark. Raises nothing: what does not fit is left
    out."""
    landmarks, notes, good = dict(checked.landmarks), list(checked.notes), dict(seen)
    while good:
        pairs = _pairs(landmarks, good, measured)
        fits = fit_frames(pairs)
        errors = errors_m(pairs, fits[0])
        allowed = [LARGEST_M] * len(landmarks)
        allowed += [_allowed_m(w, measured.lines[n]) for n, w in good.items()]
        if np.all(errors <= allowed):
            break
        names = [*landmarks, *good]
        wrong = _contradicting(pairs, allowed)
        notes.append(_contradiction([names[i] for i in wrong], pairs, wrong))
        landmarks = {n: m for n, m in landmarks.items() if n not in {names[i] for i in wrong}}
        good = {n: w for n, w in good.items() if n not in {names[i] for i in wrong}}
    if not good:
        return KnownPlaces(landmarks, {}, None, None, tuple(notes))
    rigid, remark = _from_inside(pairs, fits, measured)
    notes += [f"the known walls {', '.join(good)} {remark}"] if remark else []
    free = None if pairs.fixes_position else pairs.targets[0].along
    unseen = {name: wall for name, wall in walls.items() if name not in seen}
    return KnownPlaces(landmarks, good | unseen, rigid, free, tuple(notes))


def _pairs(
    landmarks: Mapping[str, Landmark], walls: Mapping[str, Wall], measured: Measured
) -> Pairs:
    points = np.array([measured.landmarks[n] for n in landmarks]).reshape(-1, 2)
    places = np.array([(m.x_m, m.y_m) for m in landmarks.values()]).reshape(-1, 2)
    lines = [measured.lines[name] for name in walls]
    return Pairs(points, places, lines, [line_of(wall) for wall in walls.values()])


def _contradicting(pairs: Pairs, allowed: Sequence[float]) -> list[int]:
    """The places that do not fit the others: those without any of which the rest would fit (one of
    them is wrong, and nothing says which), or all where there are none."""
    number = len(pairs.points) + len(pairs.targets)
    found = []
    for i in range(number):
        rest = pairs.without(i)
        if rest.targets and _fits(rest, [a for j, a in enumerate(allowed) if j != i]):
            found.append(i)
    return found if 0 < len(found) < number or number == 1 else list(range(number))


def _fits(pairs: Pairs, allowed: Sequence[float]) -> bool:
    return bool(np.all(errors_m(pairs, fit_frames(pairs)[0]) <= allowed))


def _contradiction(names: Sequence[str], pairs: Pairs, wrong: Sequence[int]) -> str:
    """Which places contradict each other or the rest, with the distances of parallel walls."""
    first, apart = len(pairs.points), []
    lines = [(n, i - first) for n, i in zip(names, wrong, strict=True) if i >= first]
    factors = []
    for k, (name, i) in enumerate(lines):
        for other, j in lines[k + 1 :]:
            there = pairs.targets[i], pairs.targets[j]
            known, read = _apart_m(*there), _apart_m(pairs.measured[i], pairs.measured[j])
            is_parallel = abs(math.sin(there[0].direction - there[1].direction)) < PARALLEL
            if is_parallel and abs(known - read) > LARGEST_M:
                apart.append(f"{name} and {other} are {known:.2f} m apart there, and {read:.2f} m")
                factors.append(known / max(read, 1e-6))
    numbers = f" ({'; '.join(apart)} as robots measured)" if apart else ""
    numbers += unit_words(float(np.median(factors))) if factors else ""
    if len(names) == 1:
        return (
            f"{names[0]} does not fit the other known places of the team file{numbers}: its place"
            " is not used"
        )
    if _is_mirrored(pairs):
        return (
            f"the known places {', '.join(names)} are the mirror image of what the robots measured:"
            " was y measured to the right? None of these is used"
        )
    return (
        f"the known places {', '.join(names)} of the team file contradict what robots"
        f" measured{numbers}: one of them, or more, is elsewhere; none of these is used"
    )


def _is_mirrored(pairs: Pairs) -> bool:
    """Whether the mirror image of what was measured fits all known places."""
    lines = [
        line._replace(point=line.point * (1.0, -1.0), direction=-line.direction)
        for line in pairs.measured
    ]
    mirrored = pairs._replace(points=pairs.points * (1.0, -1.0), measured=lines)
    number = len(pairs.points) + len(lines)
    return number > 2 and _fits(mirrored, [LARGEST_M] * number)


def _apart_m(one: Line, other: Line) -> float:
    return abs(float(one.normal @ (other.point - one.point)))


def _from_inside(pairs: Pairs, fits: Sequence[Rigid], measured: Measured) -> tuple[Rigid, str]:
    """The best transform. Where one that is turned by half fits as well, robots are taken to be on
    the side of the first wall on which the rest of the known places is."""
    if len(fits) == 1:
        return fits[0], ""
    worst = [float(np.max(errors_m(pairs, rigid))) for rigid in fits[:2]]
    if worst[1] > max(LARGEST_M, CLEARLY * worst[0]):
        return fits[0], ""
    rest = [*pairs.places, *(line.point for line in pairs.targets[1:])]
    line = pairs.targets[0]
    middle = np.mean(rest, axis=0) if rest else line.point + line.normal
    side = "the other known places are" if rest else "their left (seen from from_m to to_m) is"
    rigid = next((f for f in fits if sees_from_inside(line, f, measured.poses, middle)), fits[0])
    return rigid, (
        "do not tell on which side of them the robots were: it is taken to be that where"
        f" {side}; name a landmark, or --start, if that is wrong"
    )
