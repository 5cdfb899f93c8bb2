"""Which mistake of a driver explains what landmarks show of the robot's motion. Pure functions.

A landmark that stands still is seen from two places. Odometry says how the robot came from the
one to the other, so it says where the landmark is seen next. If that is wrong most of the time, the
same odometry is tried with each mistake that drivers make (degrees, headings in place of turns, a
wrong sign, ...): the one that explains what was seen is the likely cause. This needs no pose. While
a robot is near its start, the map says the same without a motion.
"""

import cmath
import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations, pairwise
from operator import attrgetter
from statistics import mean, median
from typing import NamedTuple

from cpcbl_agents.input_diagnosis.rays import ray_error
from cpcbl_team import sensor_mistakes as mistakes
from cpcbl_team.config import Landmark
from cpcbl_team.geometry import Pose2, phase
from cpcbl_team.inputs import Odometry, Sighting, Sightings

LEAST_CASES = 5
MOST = 0.8
"""The share of resightings that a mistake must explain, or that show a driver to be right."""
SPACING_NS = 500_000_000  # from one resighting to the next
SOON_NS = 1_000_000_000, 2_000_000_000  # from sighting to sighting: if they show a motion, or not
LATER_NS = 4_000_000_000, 4_000_000_000  # a slow motion shows later
NOTABLE = 0.3  # a change of where a landmark is seen, as a share of its range
TIE = 1.25  # mistakes that fit nearly as well as the best one are named with it
NEAR_M, NEAR_RAD = 2.0, 0.2  # moved since the start
LEAST_AREA = 0.1  # of a triangle, as a share of the square of its longest side


class Step(NamedTuple):
    """The motion over some 0.1 s, and the last piece in it as the driver sent it."""

    from_ns: int
    stamp_ns: int
    distance_m: float
    turn_rad: float
    last: Odometry


SeenPlace = tuple[str, int, complex, bool]  # name, stamp, place, whether it is only a bearing


class Resighting(NamedTuple):
    """A landmark that was seen again, as complex numbers in the robot's frame (m)."""

    since_ns: int
    until_ns: int
    before: complex
    after: complex
    is_ray: bool = False  # only its bearing was measured: it was there or nearer


class Mistake(NamedTuple):
    """What a driver may have done, and what undoes it."""

    text: str
    distance: Callable[[Step], float] | None = None  # None: a total, in the last piece
    turn: Callable[[Step], float] | None = None
    direction: complex = 1.0 + 0.0j  # multiplies the displacement: rotates and scales it
    turn_total: float = 0.0  # the unit of a heading that stands in the place of a turn


_turn, _distance = attrgetter("turn_rad"), attrgetter("distance_m")  # of a step


def _seconds(step: Step) -> float:
    return (step.last.stamp_ns - step.last.from_ns) * 1e-9


def _turn_of_rate(step: Step) -> float:
    return step.turn_rad * _seconds(step)


def _distance_of_speed(step: Step) -> float:
    return step.distance_m * _seconds(step)


def _in_degrees(step: Step) -> float:
    return math.radians(step.turn_rad)


DEGREE = math.radians(1.0)
MIRRORED = "turns or bearings have the wrong sign; left is positive"
FIXED = mistakes.FIXED
_SINCE = "distances look like distances since the start, not of each piece"
_HEADINGS = "turns look like headings, not turns of each piece"
_MM, _CM = "distances look like millimetres", "distances look like centimetres"
AS_IT_CAME = Mistake("", _distance, _turn)
MISTAKES = (
    Mistake(_HEADINGS, _distance, turn_total=1.0),
    Mistake("turns look like headings in degrees", _distance, turn_total=DEGREE),
    Mistake("turns look like degrees", _distance, _in_degrees),
    Mistake(MIRRORED, _distance, lambda s: -s.turn_rad),
    Mistake("turns look like rates (rad/s)", _distance, _turn_of_rate),
    Mistake(_SINCE, None, _turn),
    Mistake(_MM, _distance, _turn, 1e-3),
    Mistake(_CM, _distance, _turn, 1e-2),
    Mistake("distances look like feet, or come from km/h", _distance, _turn, 0.29),
    Mistake("distances look like speeds (m/s)", _distance_of_speed, _turn),
    Mistake("ranges look like millimetres", _distance, _turn, 1e3),
    Mistake("ranges look like centimetres", _distance, _turn, 1e2),
    Mistake("ranges look like feet", _distance, _turn, 1.0 / 0.3048),
    Mistake(
        "distances have the wrong sign or frame, or bearings are 180° off", _distance, _turn, -1.0
    ),
    Mistake(mistakes.QUARTER_OFF, _distance, _turn, 1.0j),
    Mistake(mistakes.QUARTER_OFF, _distance, _turn, -1.0j),
    Mistake(f"{_HEADINGS}, and {_SINCE}", None, turn_total=1.0),
    Mistake(f"turns look like headings in degrees, and {_SINCE}", None, turn_total=DEGREE),
    Mistake("distances and turns look like speeds (m/s, rad/s)", _distance_of_speed, _turn_of_rate),
    Mistake(f"turns look like degrees, and {_MM}", _distance, _in_degrees, 1e-3),
    Mistake(f"turns look like degrees, and {_CM}", _distance, _in_degrees, 1e-2),
    Mistake("distances and turns are swapped", lambda s: s.turn_rad, lambda s: s.distance_m),
)
"""Those of one kind come before those of two, and win a tie."""
CONTRADICTION = "odometry and sightings contradict each other: another frame, unit or time?"
MANY_CASES, MANY = 12, 0.75


def motion_cause(
    resightings: Sequence[Resighting],
    steps: Sequence[Step],
    as_it_came: Sequence[float],
    tolerance: float,
) -> str:
    """Which mistake explains the resightings; empty if the motion as it came does, or nothing does.

    `as_it_came`: the errors of that motion. `tolerance`: how far off a landmark may be seen, as a
    share of its range.
    """
    if len(resightings) < LEAST_CASES:
        return ""
    wrong = [i for i, error in enumerate(as_it_came) if error > tolerance]
    if len(wrong) < max(LEAST_CASES, 0.5 * len(resightings)):
        return ""
    found = []
    fits = [(FIXED, fixed_errors(resightings, steps, sign)) for sign in (1, -1)]
    fits += [(m.text, errors(resightings, steps, m)) for m in MISTAKES]
    for text, fit in fits:
        explained = sum(fit[i] < min(tolerance, 0.5 * as_it_came[i]) for i in wrong)
        spoilt = sum(e > tolerance for i, e in enumerate(fit) if as_it_came[i] <= tolerance)
        if explained >= LEAST_CASES and explained - spoilt > MOST * len(wrong):
            found.append((_typical(fit, resightings), text))
    if found:
        best = min(found)[0]
        return next(text for fit, text in found if fit <= TIE * best)
    return ""


def _typical(fit: Sequence[float], resightings: Sequence[Resighting]) -> float:
    """The median error; of rays the mean, for many motions agree with more than half of them."""
    if any(seen.is_ray for seen in resightings):
        return mean(min(error, 1.0) for error in fit)
    return median(fit)


def contradicts(as_it_came: Sequence[float], tolerance: float) -> bool:
    """Whether landmarks are mostly seen where the motion says that they are not, by its errors."""
    far = [error for error in as_it_came if error > tolerance]
    return len(as_it_came) >= MANY_CASES and len(far) > MANY * len(as_it_came)


def errors(
    resightings: Sequence[Resighting], steps: Sequence[Step], mistake: Mistake = AS_IT_CAME
) -> list[float]:
    """How far off each landmark is seen again, as a share of its range."""
    if not resightings:
        return []
    stamps, poses = _track(steps, mistake)
    times_ns = {ns for r in resightings for ns in r[:2]}  # a frame has several landmarks
    at = {ns: _pose_at(ns, stamps, poses) for ns in times_ns}
    found = []
    for seen in resightings:
        (a, h), (b, k) = at[seen.since_ns], at[seen.until_ns]
        displacement = (b - a) * cmath.rect(1.0, -h) * mistake.direction
        found.append(_error(seen, displacement, seen.after * cmath.rect(1.0, k - h)))
    return found


def _error(seen: Resighting, displacement: complex, after: complex) -> float:
    """How far off a landmark is seen again, as a share of its range; `after` in the frame that the
    robot had before."""
    if seen.is_ray:
        return ray_error(seen.before, after, displacement)
    reach_m = max(abs(seen.before), abs(after), 1.0)
    return abs(seen.before - displacement - after) / reach_m


def fixed_errors(
    resightings: Sequence[Resighting], steps: Sequence[Step], sign: int
) -> list[float]:
    """The same if bearings do not turn with the robot, but count from a direction of the field,
    which is chosen to fit best. `sign` -1: they grow to the right."""
    stamps, poses = _track(steps)
    ends = [
        (_pose_at(r.since_ns, stamps, poses), _pose_at(r.until_ns, stamps, poses))
        for r in resightings
    ]
    if median(abs(b[1] - a[1]) for a, b in ends) < NEAR_RAD:  # another mistake says the same
        return [math.inf for _ in resightings]
    driven = [b[0] - a[0] for a, b in ends]
    driven = driven if sign > 0 else [d.conjugate() for d in driven]
    seen = [r.before - r.after for r in resightings]
    fitted = phase(sum(p * d.conjugate() for p, d in zip(seen, driven, strict=True)) or 1.0)
    turned = cmath.rect(1.0, fitted)
    return [_error(r, d * turned, r.after) for r, d in zip(resightings, driven, strict=True)]


def _track(
    steps: Sequence[Step], mistake: Mistake = AS_IT_CAME
) -> tuple[list[int], list[tuple[complex, float]]]:
    """Places and headings at the ends of the steps, with a mistake undone."""
    where, heading, before = 0.0 + 0.0j, 0.0, steps[0].last
    stamps, poses = [steps[0].from_ns], [(where, heading)]
    for step in steps:
        if mistake.distance is not None:
            distance = mistake.distance(step)
        else:
            distance = step.last.distance_m - before.distance_m
        if mistake.turn is not None:
            turn = mistake.turn(step)
        else:
            difference = mistake.turn_total * (step.last.turn_rad - before.turn_rad)
            turn = math.remainder(difference, math.tau)
        where += cmath.rect(distance, heading + 0.5 * turn)
        heading += turn
        stamps.append(step.stamp_ns)
        poses.append((where, heading))
        before = step.last
    return stamps, poses


def places_at(steps: Sequence[Step], times_ns: Sequence[int]) -> list[complex | None]:
    """Where odometry says the robot was at these times, in a frame of its own (m); None where it
    does not know."""
    if not steps:
        return [None for _ in times_ns]
    (stamps, poses), begin_ns, end_ns = _track(steps), steps[0].from_ns, steps[-1].stamp_ns
    return [_pose_at(ns, stamps, poses)[0] if begin_ns <= ns <= end_ns else None for ns in times_ns]


def poses_at(steps: Sequence[Step], times_ns: Sequence[int]) -> list[tuple[complex, float]]:
    """Where odometry says the robot was (m), and its heading (rad), in a frame of its own."""
    stamps, poses = _track(steps)
    return [_pose_at(ns, stamps, poses) for ns in times_ns]


def _pose_at(
    stamp_ns: int, stamps: Sequence[int], poses: Sequence[tuple[complex, float]]
) -> tuple[complex, float]:
    after = bisect_left(stamps, stamp_ns, 1, len(stamps) - 1)
    (a, h), (b, k), since_ns = poses[after - 1], poses[after], stamps[after - 1]
    share = (stamp_ns - since_ns) / ((stamps[after] - since_ns) or 1)
    if not 0.0 <= share <= 1.0:
        share = min(max(share, 0.0), 1.0)
    return a + share * (b - a), h + share * (k - h)


def places_seen(
    frames: Iterable[Sightings],
    steps: Sequence[Step],
    names: Mapping[str, Landmark],
    reach_m: float,
) -> list[SeenPlace]:
    """Each sighting of a landmark in the time of the steps. `reach_m`: how far the sensor sees."""
    if len(steps) < 2:
        return []
    # The first step is left out: a total in its last piece has nothing before it
    begin_ns, end_ns = steps[0].stamp_ns, steps[-1].stamp_ns
    return [
        (seen.id, frame.stamp_ns, place, seen.range_m is None)
        for frame in frames
        if begin_ns <= frame.stamp_ns <= end_ns
        for seen in frame.sightings
        if seen.id in names and (place := place_of(seen, reach_m)) is not None
    ]


def resightings(
    seen: Iterable[SeenPlace], least_ns: int = SOON_NS[0], most_ns: int = SOON_NS[1]
) -> Iterator[Resighting]:
    """Each landmark and a later sighting of it: as soon as it shows a motion, or after so long."""
    begun: dict[str, list[tuple[int, complex]]] = {}
    for name, stamp_ns, place, is_ray in seen:
        waiting, range_m = begun.setdefault(name, []), abs(place)
        for since_ns, before in waiting[:]:
            gap_ns = stamp_ns - since_ns
            if gap_ns < least_ns:
                break  # those after it began later
            if gap_ns >= most_ns or abs(place - before) > NOTABLE * max(range_m, abs(before)):
                yield Resighting(since_ns, stamp_ns, before, place, is_ray)
                waiting.remove((since_ns, before))
        if not waiting or stamp_ns - waiting[-1][0] >= SPACING_NS:
            waiting.append((stamp_ns, place))


def place_of(seen: Sighting, far_m: float = 1.0) -> complex | None:
    """Where the robot's frame has what it saw (m); so far away if only the bearing is known."""
    if seen.bearing_rad is None:
        return None
    range_m = far_m if seen.range_m is None else seen.range_m
    return cmath.rect(range_m, seen.bearing_rad) if range_m > 0.0 else None


# Without a motion -------------------------------------------------------------------------------


def order_votes(frames: Iterable[Sightings], landmarks: Mapping[str, Landmark]) -> tuple[int, int]:
    """How often three landmarks of one frame stand around the robot in the order of the map, and
    how often in the reverse."""
    right = wrong = 0
    for frame in frames:
        seen = [
            (place, complex(landmarks[s.id].x_m, landmarks[s.id].y_m))
            for s in frame.sightings
            if s.id in landmarks and s.range_m is not None and (place := place_of(s)) is not None
        ]
        for three in combinations(seen[:4], 3):
            order = _area([p for p, _ in three]) * _area([q for _, q in three])
            right, wrong = right + (order > 0.0), wrong + (order < 0.0)
    return right, wrong


def is_order_right(frames: Iterable[Sightings], landmarks: Mapping[str, Landmark]) -> bool:
    """Whether three landmarks of one frame clearly stand in the order of the map: bearings are not
    mirrored."""
    right, wrong = order_votes(frames, landmarks)
    return right >= LEAST_CASES and right > 4 * wrong


def _area(corners: Sequence[complex]) -> float:
    """Twice the signed area of a triangle (m^2); 0 if it is nearly a line."""
    a, b, c = corners
    area = ((b - a).conjugate() * (c - a)).imag
    longest = max(abs(b - a), abs(c - a), abs(c - b))
    return area if abs(area) > LEAST_AREA * longest**2 else 0.0


def scale_of(frames: Iterable[Sightings], landmarks: Mapping[str, Landmark]) -> float:
    """The measured distance between two landmarks of one frame over that on the map (the median); 1
    if too few were seen."""
    times = []
    for frame in frames:
        seen = [s for s in frame.sightings if s.id in landmarks and s.range_m is not None]
        for a, b in pairwise(seen[:4]):
            p, q = place_of(a), place_of(b)
            m, n = landmarks[a.id], landmarks[b.id]
            map_m = math.hypot(m.x_m - n.x_m, m.y_m - n.y_m)
            if p is not None and q is not None and map_m > 0.5:
                times.append(abs(p - q) / map_m)
    return median(times) if len(times) >= LEAST_CASES else 1.0


# Against the map, near the start ----------------------------------------------------------------

OR_START = "or the robot is not where its `start` says"
_VIEWS: tuple[tuple[str, mistakes.View], ...] = (
    ("", lambda p, h: p),
    *((mistake.text, mistake.view) for mistake in mistakes.MISTAKES),
)


def pose_near_start(steps: Sequence[Step], start: Pose2) -> Pose2 | None:
    """Where odometry says the robot is, by steps since it was at its start; None where it has moved
    so much that mistakes in odometry count."""
    _, poses = _track(steps) if steps else ([], [(0j, 0.0)])
    where, turned = poses[-1]
    if abs(where) > NEAR_M or max(abs(turn) for _, turn in poses) > NEAR_RAD:
        return None
    return start @ Pose2(where.real, where.imag, turned)


def view_cause(
    frames: Iterable[Sightings], pose: Pose2, marks: Mapping[str, Landmark], tolerance: float
) -> str:
    """Which mistake in sightings agrees with the map at a pose; empty if they agree as they are, or
    none does."""
    own, turned = complex(pose.x, pose.y), cmath.rect(1.0, -pose.heading)
    due = []
    for s in (s for frame in frames for s in frame.sightings if s.id in marks):
        q = (complex(marks[s.id].x_m, marks[s.id].y_m) - own) * turned
        if (p := place_of(s, abs(q))) is not None:
            due.append((p, q))
    if len(due) < LEAST_CASES:
        return ""
    found = []
    for text, undo in _VIEWS:
        far = sorted(abs(undo(p, pose.heading) - q) / max(abs(q), 1.0) for p, q in due)
        if not text and far[len(far) // 2] <= 1.5 * tolerance:
            return ""
        found.append((far[int(MOST * (len(far) - 1))], text))
    best, text = min(found)
    return f"{text}; {OR_START}" if text and best <= tolerance else ""
