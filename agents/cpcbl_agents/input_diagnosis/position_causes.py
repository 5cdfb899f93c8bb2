"""What a driver of a position sensor probably got wrong. Pure functions, no clock."""

import math
from collections.abc import Callable, Sequence
from statistics import median

from cpcbl_agents.input_diagnosis.message_causes import LEAST_CASES, unit_of
from cpcbl_agents.input_diagnosis.motion_causes import OR_START, Step, places_at
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Position

GAP_NS = 1_000_000_000
LEAST_DISTANCE_M = 0.3
WAIT_NS = 7_500_000_000
FAR_FIELDS, FAR_M = 3.0, 20.0  # from the map: nobody drives so far away from it
LEAST_TURN = 0.15
LARGEST_DEGREE = 1e-4  # for a metre
AGREE = 0.35  # how much distances by odometry and by positions may differ
OTHER_ORIGIN = "are far from the map: another origin, or latitude and longitude in place of metres"
OTHER_PLACE = "do not fit odometry since the start: another origin, or latitude and longitude"
DEGREES = "look like latitude and longitude; they must be metres of the field"


def position_cause(
    positions: Sequence[Position],
    steps: Sequence[Step],
    bounds: tuple[float, float, float, float],
    pose: Pose2 | None,
    start: Pose2 | None,
    is_from_start: bool,
) -> str:
    """`bounds`: of the map (least x, y, greatest x, y). `pose`: that the robot has without them.
    `start`: of the team file; whether the steps began there. Empty where they agree with each
    other, or nothing is known."""
    if len(positions) < LEAST_CASES:
        return ""
    x, y = (median(p.x_m for p in positions), median(p.y_m for p in positions))
    outside_m, field_m = _outside(x, y, bounds)
    is_far = field_m > 0.0 and outside_m > max(FAR_M, FAR_FIELDS * field_m)
    if cause := _cause_from_distances(positions, steps, is_far):
        return cause
    if pose is not None and (cause := _cause_from_pose(positions[-3:], pose, start)):
        return cause
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2)):
        is_large = is_far and max(abs(x), abs(y)) > 180.0  # no degrees
        if is_large and _outside(factor * x, factor * y, bounds)[0] <= field_m:
            return f"positions look like {unit}"
    if is_far:
        return f"positions {OTHER_ORIGIN}"
    return _cause_from_start(x, y, steps, start) if start is not None and is_from_start else ""


def _outside(x: float, y: float, bounds: tuple[float, float, float, float]) -> tuple[float, float]:
    """How far a point is from the map, and the map's diagonal (m)."""
    left, low, right, high = bounds
    far = abs(complex(max(left - x, 0.0, x - right), max(low - y, 0.0, y - high)))
    return far, abs(complex(right - left, high - low))


def _cause_from_distances(
    positions: Sequence[Position], steps: Sequence[Step], is_far: bool
) -> str:
    """The cause by how far the robot drove, and to which side it turned, according to odometry."""
    times, turned = list[float](), [0, 0]
    places = places_at(steps, [p.stamp_ns for p in positions])
    before: tuple[Position, complex] | None = None
    its_last = own_last = 0j
    for p, place in zip(positions, places, strict=True):
        if place is None:
            continue
        if before is None:
            before = p, place
        own = place - before[1]
        sigma_m = max(before[0].covariance[0], p.covariance[0]) ** 0.5
        if p.stamp_ns - before[0].stamp_ns < GAP_NS or abs(own) < max(
            LEAST_DISTANCE_M, 5.0 * sigma_m
        ):
            continue
        its = complex(p.x_m - before[0].x_m, p.y_m - before[0].y_m)
        times.append(abs(its) / abs(own))
        if its_last and own_last:
            a, b = (its / its_last).imag, (own / own_last).imag
            if min(abs(a), abs(b)) > LEAST_TURN:
                turned[a * b > 0.0] += 1
        before, its_last, own_last = (p, place), its, own
    if len(times) >= LEAST_CASES - 1:
        scale = median(times)
        if sum(abs(t / scale - 1.0) < AGREE for t in times) > 0.8 * len(times):
            if unit := unit_of(scale):
                return f"positions look like {unit}"
            if scale < LARGEST_DEGREE:
                return f"positions {DEGREES}"
    if turned[0] >= LEAST_CASES - 1 and turned[0] > 4 * turned[1]:
        return "positions look mirrored, such as x and y swapped, or turns have the wrong sign"
    return ""


_VIEWS: tuple[tuple[str, Callable[[complex, complex], complex]], ...] = (
    ("positions look as if x and y were swapped", lambda p, s: complex(p.imag, p.real)),
    ("positions look mirrored: y has the wrong sign", lambda p, s: p.conjugate()),
    ("positions look mirrored: x has the wrong sign", lambda p, s: -p.conjugate()),
    ("positions look like feet", lambda p, s: p * 0.3048),
    ("positions look like centimetres", lambda p, s: p * 0.01),
    ("positions look like millimetres", lambda p, s: p * 0.001),
    ("positions count from the robot's start, not from the field's origin", lambda p, s: p + s),
)


def _cause_from_pose(positions: Sequence[Position], pose: Pose2, start: Pose2 | None) -> str:
    """The cause by the pose that the robot has from its other inputs."""
    due = complex(pose.x, pose.y)
    begun = complex(start.x, start.y) if start else 0j
    seen = complex(median(p.x_m for p in positions), median(p.y_m for p in positions))
    sigma_m = max(p.covariance[0] + p.covariance[2] for p in positions) ** 0.5
    off = abs(seen - due)
    if off < max(0.6, 5.0 * sigma_m):
        return ""
    found = [(abs(undo(seen, begun) - due), text) for text, undo in _VIEWS]
    best, text = min(found)
    if best < max(0.3, 3.0 * sigma_m) and best < 0.4 * off:
        return f"{text}; {OR_START}"
    return f"positions {OTHER_PLACE}; {OR_START}" if off > max(1.0, 8.0 * sigma_m) else ""


def _cause_from_start(x: float, y: float, steps: Sequence[Step], start: Pose2) -> str:
    """The cause by how far the robot can have come. Distances tell more, but later."""
    reach_m = sum(abs(step.distance_m) for step in steps)
    if not steps or (
        reach_m > LEAST_DISTANCE_M and steps[-1].stamp_ns - steps[0].from_ns < WAIT_NS
    ):
        return ""
    is_near = math.hypot(x - start.x, y - start.y) < FAR_M + 2.0 * reach_m
    return "" if is_near else f"positions {OTHER_PLACE}; {OR_START}"
