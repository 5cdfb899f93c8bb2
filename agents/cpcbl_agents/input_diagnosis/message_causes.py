"""What a driver probably got wrong, judged by messages that it sent. Pure functions, no clock."""

import cmath
import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from statistics import median

from cpcbl_team.inputs import Odometry, Sighting, Sightings

YEAR_NS = 31_557_600_000_000_000
UNIX_NS = 1_000_000_000_000_000_000  # in 2001: a clock that is behind that counts from elsewhere
MOST_SPEED_M_S = 30.0
MOST_TURN_RATE_RAD_S = 15.0
RANGE_FACTOR = 5.0  # beyond so many times what the sensor sees, a range has another unit
LEAST_CASES, MANY_CASES = 5, 12
GROWING = 50  # pieces
BACK_SHARE = 0.15  # of messages that are older than the one before: a network does not do so
BURST, BURST_GAP_NS = 4, 900_000_000
LATEST_NS = 60_000_000_000
LEAST_GAPS = 3  # a driver may send nothing while its robot stands
GAP_SHARE = 0.1  # of a piece: stamps are rounded

_UNITS = (("seconds", 10**9), ("milliseconds", 10**6), ("microseconds", 10**3))


def stamp_cause(stamp_ns: int, now_ns: int) -> str:
    """Why a stamp is far from the time of its arrival; empty if it is not."""
    for unit, factor in _UNITS:
        if abs(stamp_ns * factor - now_ns) < YEAR_NS and now_ns > UNIX_NS:
            return f"stamps look like {unit} since 1970; they must be in nanoseconds"
    if 0 <= stamp_ns < UNIX_NS // 3 and now_ns > UNIX_NS:
        return "stamps look like a monotonic clock's, since its start; they must be Unix time"
    return offset_cause((now_ns - stamp_ns) * 1e-9)


def offset_cause(offset_s: float, ahead_s: float = 0.1, behind_s: float = 1.0) -> str:
    """`stamps are 2 s ahead of this robot's clock`; empty within the two limits."""
    hours = round(offset_s / 1800.0) / 2.0
    if 0.0 < abs(hours) <= 14.0 and abs(offset_s - 3600.0 * hours) < 60.0:
        side = "behind" if hours > 0.0 else "ahead of"
        apart = f"stamps are {abs(hours):g} h {side} this robot's clock"
        return f"{apart}: local time in place of UTC?"
    if offset_s < -ahead_s:
        return f"stamps are {-offset_s:.2g} s ahead of this robot's clock"
    if offset_s > behind_s:
        return f"stamps are {offset_s:.3g} s behind this robot's clock, or messages arrive so late"
    return ""


def arrival_cause(times: Sequence[tuple[int, int]]) -> str:
    """What is wrong with when messages arrive, by their times of arrival and stamps; empty if
    nothing is."""
    times = [t for t in times if abs(t[0] - t[1]) < LATEST_NS]  # others have another cause
    if len(times) < MANY_CASES:
        return ""
    back = sum(b[1] < a[1] for a, b in pairwise(times))
    if back > BACK_SHARE * len(times):
        return "messages come out of order; send each when it was measured"
    begins = [b[0] for a, b in pairwise(times) if b[0] - a[0] > BURST_GAP_NS]
    gaps = [b - a for a, b in pairwise(begins)]
    late = [arrived - stamp_ns for arrived, stamp_ns in times]
    is_held_back = max(late) - min(late) > 0.5 * BURST_GAP_NS  # else nothing was measured meanwhile
    if gaps and is_held_back and len(times) > BURST * (len(begins) + 1):
        return f"messages come in bursts every {median(gaps) * 1e-9:.1f} s; send each at once"
    return ""


def bearing_cause(frames: Iterable[Sightings]) -> str:
    """What bearings beyond π look like; empty if there are none."""
    largest = max((abs(s.bearing_rad or 0.0) for f in frames for s in f.sightings), default=0.0)
    if largest <= math.pi + 1e-9:
        return ""
    if largest <= 2.0 * math.pi + 1e-6:
        return "bearings go up to 2π; they must be between -π and π"
    return "bearings look like degrees; they must be in radians"


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
        # A robot that turns evenly has even turns in degrees, one that drives ahead even headings
        return f"turns of {turning[-1]:.0f} rad/s: they look like degrees, or like headings"
    return ""


def _grows(pieces: Sequence[Odometry]) -> bool:
    """Whether nearly every distance is larger than the one before, for long enough: a robot that
    speeds up does so for less."""
    steps = [abs(b.distance_m) - abs(a.distance_m) for a, b in pairwise(pieces)]
    return sum(step >= 0.0 for step in steps) > 0.95 * len(steps) > 0.95 * GROWING


def range_cause(
    frames: Iterable[Sightings], max_range_m: float, field_m: float, scale: float
) -> str:
    """What ranges look like that are far beyond the sensor's reach and the field's diagonal (m), or
    that make distances between landmarks `scale` times as long as on the map."""
    if unit := unit_of(scale):
        return (
            f"ranges look like {unit}: landmarks are {scale:.1f} times as far apart as on the map"
        )
    if unit := unit_of(1.0 / scale if scale > 0.0 else 0.0):
        times = f"{1.0 / scale:.1f} times as far apart as they are seen"
        return f"the map looks as if it were in {unit}: its landmarks are {times}"
    ranges = [s.range_m for f in frames for s in f.sightings if s.range_m is not None]
    if len(ranges) < LEAST_CASES:
        return ""
    range_m = median(ranges)
    if range_m <= max(RANGE_FACTOR * max_range_m, field_m):
        return ""
    unit = "millimetres" if range_m > 100.0 * max_range_m else "millimetres or centimetres"
    return f"ranges of {range_m:.0f}, but the sensor sees {max_range_m:g} m: they look like {unit}"


def twice_cause(frames: Iterable[Sightings]) -> str:
    """Which object frames have twice, and how far apart (m, median): two with one name, or one that
    is detected twice. Empty without any."""
    apart: dict[str, list[float]] = {}
    for frame in frames:
        seen: dict[str, Sighting] = {}
        for s in frame.sightings:
            first = seen.setdefault(s.id, s)
            if first is not s:
                apart.setdefault(s.id, []).append(_apart_m(first, s))
    if not apart:
        return ""
    name, distances_m = max(apart.items(), key=lambda item: len(item[1]))
    between_m = median(distances_m)
    far = f", {between_m:.1f} m apart" if between_m > 0.0 else ""
    return f"`{name}` comes twice in one message{far}; do two objects have this name?"


def _apart_m(a: Sighting, b: Sighting) -> float:
    """How far apart two sightings put an object (m); 0 if neither has a range."""
    if a.range_m is None or b.range_m is None:
        return 0.0
    if a.bearing_rad is None or b.bearing_rad is None:
        return abs(a.range_m - b.range_m)
    p, q = cmath.rect(a.range_m, a.bearing_rad), cmath.rect(b.range_m, b.bearing_rad)
    return abs(p - q)


def unit_of(scale: float) -> str:
    """The unit of lengths that are so many times as long as they should be in metres."""
    for unit, least, most in (("millimetres", 400, 2500), ("centimetres", 40, 250)):
        if least < scale < most:
            return unit
    return "feet" if 2.8 < scale < 3.9 else ""


def piece_s(pieces: Sequence[Odometry]) -> float:
    """For how long pieces of odometry last (s, median); 0 for too few to tell."""
    if len(pieces) < LEAST_CASES:
        return 0.0
    return median((p.stamp_ns - p.from_ns) * 1e-9 for p in pieces)


def overlap_s(pieces: Sequence[Odometry]) -> float:
    """The median overlap of a piece with the one before (s), negative for a gap."""
    if len(pieces) < LEAST_CASES:
        return 0.0
    pieces = sorted(pieces, key=lambda p: p.stamp_ns)
    return median((a.stamp_ns - b.from_ns) * 1e-9 for a, b in pairwise(pieces))


def covered_share(pieces: Sequence[Odometry], least_gaps: int = LEAST_GAPS) -> float:
    """The share of the time that pieces of odometry cover, from the first to the last one; 1 where
    they leave fewer gaps, or overlap."""
    pieces = sorted(pieces, key=lambda p: p.stamp_ns)
    gaps = [b.from_ns - a.stamp_ns for a, b in pairwise(pieces)]
    lasts = [p.stamp_ns - p.from_ns for p in pieces]
    often = sum(gap > GAP_SHARE * last for gap, last in zip(gaps, lasts[1:], strict=True))
    if often < least_gaps or min(gaps) < 0:
        return 1.0
    return sum(lasts) / (sum(lasts) + sum(gaps))
