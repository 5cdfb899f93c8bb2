"""What is badly known of a map, why, and which drive would mend it."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.mapper import Mapped
from cpcbl_launch.mapping.wall_advice import wall_advice
from cpcbl_launch.reporting.metrics import Ellipse, Floats

WEAK_M = 0.05  # of the major sigma, from which on a landmark is badly known
WEAK_TIMES = 3.0  # or times the median of all, where that is more than
WORTH_M = 0.02
OF_FRAME = 0.7  # the share of a sigma that turns of the whole map explain
ONE_SIDE = 0.7  # the resultant length of the directions from which it was seen
FEW = 30  # sightings
NEAR_M = 1.5  # how near a robot should pass


class _View(NamedTuple):
    """From where a landmark was seen."""

    number: int
    direction: float  # mean, from the landmark to the robots (rad)
    length: float  # of the resultant: 1 where all were in one direction
    distance_m: float  # median


def advice(mapped: Mapped) -> Iterator[str]:
    """One line for each landmark and wall that is badly known, and one for the frame."""
    shapes = {n: mapped.ellipse(n) for n in mapped.new_names}
    typical = float(np.median([shape.major_m for shape in shapes.values()])) if shapes else WEAK_M
    limit = min(WEAK_M, max(WORTH_M, WEAK_TIMES * typical))
    weak = {name: shape for name, shape in shapes.items() if shape.major_m > limit}
    turning = _turning_sigma(mapped) if shapes else 0.0
    by_frame = [n for n in weak if _turned_m(mapped, n, turning) > OF_FRAME * weak[n].major_m]
    if by_frame:
        yield _frame_advice(mapped, by_frame, weak, turning)
    for name, shape in weak.items():
        if name not in by_frame:
            yield _landmark_advice(mapped, name, shape)
    if mapped.frame.gauge is not None and mapped.frame.gauge.along is not None:
        yield (
            "nothing that is known tells the position along the known walls: measure the place of a"
            " landmark, or of a wall across them"
        )
    yield from wall_advice(mapped, turning)


def _centre(mapped: Mapped) -> Floats:
    """Around which the map may turn: the middle of the known landmarks, else the first pose of the
    drive that fixes the frame."""
    known = [mapped.landmark(n)[0] for n in mapped.names if n in mapped.frame.known_names]
    if known:
        return np.asarray(np.mean(known, axis=0))
    gauge = mapped.frame.gauge
    return np.zeros(2) if gauge is None else gauge.pose[:2]


def _turning_sigma(mapped: Mapped) -> float:
    """The sigma (rad) of the turn of the whole map around its centre: of the mean angle by which
    its landmarks may be turned. One that is badly known alone moves it little."""
    offset = mapped.problem.parts(mapped.solution.x)[1] - _centre(mapped)
    squared = np.sum(offset**2, axis=1)
    across = np.stack([-offset[:, 1], offset[:, 0]], axis=1)
    new = [name not in mapped.frame.known_names for name in mapped.names]
    counts = np.array(new) & (squared > NEAR_M**2)
    gain = np.where(counts[:, None], across / np.maximum(squared, 1e-9)[:, None], 0.0).ravel()
    gain /= max(int(counts.sum()), 1)
    of_landmarks = mapped.covariance[: len(gain), : len(gain)]
    return math.sqrt(max(float(gain @ of_landmarks @ gain), 0.0))


def _turned_m(mapped: Mapped, name: str, turning: float) -> float:
    return turning * float(np.hypot(*(mapped.landmark(name)[0] - _centre(mapped))))


def _frame_advice(
    mapped: Mapped, names: list[str], weak: dict[str, Ellipse], turning: float
) -> str:
    far = max(names, key=lambda name: weak[name].major_m)
    return (
        f"the direction of the map is known to {math.degrees(turning):.2f} deg, which makes"
        f" {', '.join(names)} uncertain (up to {weak[far].major_m:.2f} m): measure the place of one"
        f" that is far from the known landmarks, such as {far}, and name it with --known"
    )


def _view(mapped: Mapped, name: str) -> _View:
    poses, landmarks, _ = mapped.problem.parts(mapped.solution.x)
    index = mapped.names.index(name)
    mine = mapped.problem.readings.landmark == index
    dx, dy = (poses[mapped.problem.readings.pose[mine], :2] - landmarks[index]).T
    unit = np.exp(1j * np.arctan2(dy, dx))
    mean = complex(unit.mean())
    direction = math.atan2(mean.imag, mean.real)
    return _View(int(mine.sum()), direction, abs(mean), float(np.median(np.hypot(dx, dy))))


def _landmark_advice(mapped: Mapped, name: str, shape: Ellipse) -> str:
    sigma, _, turn = shape
    view, place = _view(mapped, name), mapped.landmark(name)[0]
    sight = np.array([math.cos(view.direction), math.sin(view.direction)])
    if view.length < ONE_SIDE:
        why = f"it was seen {view.number} times, from {view.distance_m:.1f} m"
        return (
            f"landmark {name} is known to {sigma:.2f} m: {why}; drive past it more often, within"
            f" {NEAR_M:g} m"
        )
    along = abs(math.cos(turn - view.direction)) > math.sqrt(0.5)
    how = "along" if along else "across"
    side = _side(mapped, place, sight)
    near = place + NEAR_M * side
    few = f" {view.number} times and" if view.number < FEW else ""
    return (
        f"landmark {name} is known to {sigma:.2f} m {how} the line of sight: it was seen{few} from"
        f" one side only; drive past it on its {_side_words(side)} side, near"
        f" ({near[0]:.1f}, {near[1]:.1f})"
    )


def _side(mapped: Mapped, place: Floats, sight: Floats) -> Floats:
    """The direction across the line of sight that leads to the middle of the map."""
    across = np.array([-sight[1], sight[0]])
    middle = mapped.problem.parts(mapped.solution.x)[1].mean(axis=0)
    return across if (middle - place) @ across >= 0.0 else -across


def _side_words(side: Floats) -> str:
    axis = "x" if abs(side[0]) > abs(side[1]) else "y"
    return ("+" if side["xy".index(axis)] > 0.0 else "-") + axis
