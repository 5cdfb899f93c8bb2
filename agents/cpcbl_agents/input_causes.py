"""What a driver probably got wrong, judged by messages that it sent. Pure functions, no clock."""

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate, combinations, pairwise
from statistics import median
from typing import NamedTuple

from cpcbl_team.config import Landmark
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Odometry, Sighting, Sightings

YEAR_NS = 31_557_600_000_000_000
UNIX_NS = 1_000_000_000_000_000_000  # in 2001: a clock that is behind that counts from elsewhere
MOST_SPEED_M_S = 30.0
MOST_TURN_RATE_RAD_S = 15.0
RANGE_FACTOR = 5.0  # beyond so many times what the sensor sees, a range has another unit
LEAST_AREA = 0.1  # of a triangle, as a share of the square of its longest side
LEAST_TURN_RAD, LEAST_DIFFERENCE_RAD = math.radians(10.0), math.radians(5.0)
LEAST_CASES = 5

_UNITS = (("seconds", 10**9), ("milliseconds", 10**6), ("microseconds", 10**3))


def stamp_cause(stamp_ns: int, now_ns: int) -> str:
    """Why a stamp is far from the time of its arrival; empty if it is not."""
    for unit, factor in _UNITS:
        if abs(stamp_ns * factor - now_ns) < YEAR_NS and now_ns > UNIX_NS:
            return f"stamps look like {unit} since 1970; nanoseconds are due"
    if 0 <= stamp_ns < UNIX_NS // 3 and now_ns > UNIX_NS:
        return "stamps look like a monotonic clock's, since its start; Unix time is due"
    return offset_cause((now_ns - stamp_ns) * 1e-9)


def offset_cause(offset_s: float, ahead_s: float = 0.1, behind_s: float = 1.0) -> str:
    """`stamps are 2 s ahead of this robot's clock`; empty within the two limits."""
    if offset_s < -ahead_s:
        return f"stamps are {-offset_s:.2g} s ahead of this robot's clock"
    if offset_s > behind_s:
        return f"stamps are {offset_s:.3g} s behind this robot's clock, or messages arrive so late"
    return ""


def bearing_cause(frames: Iterable[Sightings]) -> str:
    """What bearings beyond π look like; empty if there are none."""
    largest = max((abs(s.bearing_rad or 0.0) for f in frames for s in f.sightings), default=0.0)
    if largest <= math.pi + 1e-9:
        return ""
    if largest <= 2.0 * math.pi + 1e-6:
        return "bearings go up to 2π; they are due from -π to π"
    return "bearings look like degrees; radians are due"


def odometry_cause(pieces: Sequence[Odometry]) -> str:
    """What is beyond belief in the motion that these pieces report; empty if nothing is."""
    timed = [(p, (p.stamp_ns - p.from_ns) * 1e-9) for p in pieces if p.stamp_ns > p.from_ns]
    if len(timed) < LEAST_CASES:
        return ""
    speed_m_s = median(abs(p.distance_m) / seconds for p, seconds in timed)
    turning = sorted(abs(p.turn_rad) / seconds for p, seconds in timed)
    if speed_m_s > MOST_SPEED_M_S:
        what = "distances since the start, not of each piece" if _grows(pieces) else "millimetres"
        return f"a speed of {speed_m_s:.0f} m/s: distances look like {what}"
    if turning[len(turning) * 3 // 4] > MOST_TURN_RATE_RAD_S:
        what = "headings, not turns of each piece" if _turns_on(pieces) else "degrees"
        return f"turns of {turning[-1]:.0f} rad/s: they look like {what}"
    return ""


def _grows(pieces: Sequence[Odometry]) -> bool:
    """Whether nearly every distance is larger than the one before."""
    steps = [abs(b.distance_m) - abs(a.distance_m) for a, b in pairwise(pieces)]
    return sum(step > 0.0 for step in steps) > 0.9 * len(steps)


def _turns_on(pieces: Sequence[Odometry]) -> bool:
    """Whether nearly every turn is the one before and a little more, as headings are."""
    steps = [wrap_angle(b.turn_rad - a.turn_rad) for a, b in pairwise(pieces)]
    grew, shrank = (sum(sign * step > 1e-9 for step in steps) for sign in (1, -1))
    return max(grew, shrank) > 0.9 * len(steps)


def range_cause(frames: Iterable[Sightings], max_range_m: float, field_m: float) -> str:
    """What ranges far beyond the sensor's reach and the field's diagonal (m) look like."""
    ranges = [s.range_m for f in frames for s in f.sightings if s.range_m is not None]
    if len(ranges) < LEAST_CASES:
        return ""
    range_m = median(ranges)
    if range_m <= max(RANGE_FACTOR * max_range_m, field_m):
        return ""
    unit = "millimetres" if range_m > 100.0 * max_range_m else "millimetres or centimetres"
    return f"ranges of {range_m:.0f}, but the sensor sees {max_range_m:g} m: they look like {unit}"


def overlap_s(pieces: Sequence[Odometry]) -> float:
    """The median overlap of a piece with the one before (s), negative for a gap."""
    if len(pieces) < LEAST_CASES:
        return 0.0
    return median((a.stamp_ns - b.from_ns) * 1e-9 for a, b in pairwise(pieces))


# Signs ----------------------------------------------------------------------------------------


class Votes(NamedTuple):
    """How many cases speak for a sign, and how many against it."""

    good: int
    bad: int

    @property
    def is_wrong(self) -> bool:
        return self.bad >= LEAST_CASES and self.bad > 4 * self.good

    @property
    def is_right(self) -> bool:
        return self.good >= LEAST_CASES and self.good > 4 * self.bad


def sign_cause(
    frames: Sequence[Sightings], pieces: Sequence[Odometry], landmarks: Mapping[str, Landmark]
) -> str:
    """Which of bearings and turns has the wrong sign, or turns the wrong unit; empty if none is
    known to have.

    Three landmarks of one frame stand in the same order around as on the map, unless bearings are
    mirrored. A landmark that stands still moves in the robot's frame against the robot's turn,
    unless one of the two has the wrong sign. Neither needs a pose.
    """
    order = _order_votes(frames[-10:], landmarks)
    if _turn_votes(frames, pieces, landmarks, math.radians(1.0)).is_wrong:
        return "turns look like degrees"
    turns = _turn_votes(frames, pieces, landmarks, -1.0)
    if order.is_wrong:
        both = " and turns" if turns.is_right else ""
        return f"bearings{both} look mirrored; left is positive"
    if not turns.is_wrong:
        return ""
    what = "turns" if order.is_right else "turns or bearings"
    return f"{what} have the wrong sign; left is positive"


def _order_votes(frames: Iterable[Sightings], landmarks: Mapping[str, Landmark]) -> Votes:
    votes = []
    for frame in frames:
        seen = [s for s in frame.sightings if s.id in landmarks and _place(s) is not None]
        for three in combinations(seen[:4], 3):
            here = _area([p for s in three if (p := _place(s)) is not None])
            there = _area([(landmarks[s.id].x_m, landmarks[s.id].y_m) for s in three])
            if here * there != 0.0:
                votes.append(here * there > 0.0)
    return Votes(sum(votes), len(votes) - sum(votes))


def _place(s: Sighting) -> tuple[float, float] | None:
    """Where the robot's frame has what it saw (m)."""
    if s.range_m is None or s.bearing_rad is None:
        return None
    return s.range_m * math.cos(s.bearing_rad), s.range_m * math.sin(s.bearing_rad)


def _area(corners: Sequence[tuple[float, float]]) -> float:
    """Twice the signed area of a triangle (m^2); 0 if it is nearly a line."""
    (ax, ay), (bx, by), (cx, cy) = corners
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    longest = max(math.dist(a, b) for a, b in combinations(corners, 2))
    return area if abs(area) > LEAST_AREA * longest**2 else 0.0


def _turn_votes(
    frames: Sequence[Sightings],
    pieces: Sequence[Odometry],
    landmarks: Mapping[str, Landmark],
    factor: float,
) -> Votes:
    """For turns as they are, against turns times `factor`."""
    votes = []
    for s, t, distance_m, turn in _seen_again(frames, pieces, landmarks):
        turns = turn, factor * turn
        errors = [abs(wrap_angle(_bearing_after(s, distance_m, x) - t)) for x in turns]
        if min(errors) < 0.5 * abs(turn) and abs(errors[0] - errors[1]) > LEAST_DIFFERENCE_RAD:
            votes.append(errors[0] < errors[1])
    return Votes(sum(votes), len(votes) - sum(votes))


def _seen_again(
    frames: Sequence[Sightings], pieces: Sequence[Odometry], landmarks: Mapping[str, Landmark]
) -> Iterator[tuple[Sighting, float, float, float]]:
    """A landmark's sighting, its later bearing, and the distance and turn between the two."""
    if not pieces:
        return
    stamps = [p.stamp_ns for p in pieces]
    moved_m = [0.0, *accumulate(p.distance_m for p in pieces)]
    turned = [0.0, *accumulate(p.turn_rad for p in pieces)]
    before: dict[str, tuple[int, Sighting]] = {}
    for frame in frames:
        if not pieces[0].from_ns <= frame.stamp_ns <= stamps[-1]:
            continue
        after = bisect_right(stamps, frame.stamp_ns)  # pieces that had ended by then
        for s in frame.sightings:
            if s.id not in landmarks or s.bearing_rad is None:
                continue
            since, first = before.setdefault(s.id, (after, s))
            turn = turned[after] - turned[since]
            if abs(turn) > LEAST_TURN_RAD:
                yield first, s.bearing_rad, moved_m[after] - moved_m[since], turn
                before[s.id] = after, s


def _bearing_after(s: Sighting, distance_m: float, turn: float) -> float:
    """The bearing (rad) of what was seen, after the robot moved; far away if no range is known."""
    bearing = s.bearing_rad or 0.0
    if s.range_m is None:
        return bearing - turn
    x = s.range_m * math.cos(bearing) - distance_m * math.cos(0.5 * turn)
    y = s.range_m * math.sin(bearing) - distance_m * math.sin(0.5 * turn)
    return math.atan2(y, x) - turn
