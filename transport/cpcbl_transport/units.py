"""Numbers that cannot be right in their unit, found before they are sent.

Each function returns what is wrong, for people, or an empty text. All else that can be wrong with a
number is left to the robot, which refuses and counts it: a NaN of a sensor must not end a driver.
"""

import math

from cpcbl_team.inputs import InitialPose, Sighting

DAY_NS = 86_400 * 10**9
SCALES = {"seconds": 10**9, "milliseconds": 10**6, "microseconds": 10**3}
FASTEST_M_S = 50.0
FASTEST_TURN_RAD_S = 30.0  # five turns a second
FARTHEST_M = 1000.0


def stamp_problem(stamp_ns: object, now_ns: int) -> str:
    """A stamp must be Unix time in whole nanoseconds; `now_ns` is this machine's."""
    if not isinstance(stamp_ns, int):
        return f"stamp_ns={stamp_ns!r}: write whole nanoseconds, such as time.time_ns()"
    if abs(stamp_ns - now_ns) < DAY_NS:
        return ""
    for unit, factor in SCALES.items():
        if abs(stamp_ns * factor - now_ns) < 365 * DAY_NS:
            return f"stamp_ns={stamp_ns}: looks like {unit}; write nanoseconds (x {factor})"
    if 0 <= stamp_ns < 10 * 365 * DAY_NS:
        return f"stamp_ns={stamp_ns}: looks like a clock since the start; use time.time_ns()"
    days = (stamp_ns - now_ns) / DAY_NS
    return f"stamp_ns={stamp_ns}: is {days:+.0f} days from this machine's clock; set the clock"


def odometry_problem(distance_m: float, turn_rad: float, duration_s: float) -> str:
    """A motion must be one that a robot on wheels can make in this time."""
    if abs(turn_rad) > max(1.0, FASTEST_TURN_RAD_S * duration_s):
        return f"turn_rad={turn_rad:g} in {duration_s:g} s: looks like degrees; write radians"
    if abs(distance_m) > max(1.0, FASTEST_M_S * duration_s):
        return f"distance_m={distance_m:g} in {duration_s:g} s: looks like mm; write metres"
    return ""


def sighting_problem(seen: Sighting) -> str:
    """Angles must be within two turns, ranges within a kilometre."""
    for name in ("bearing_rad", "bearing_sigma_rad", "heading_rad"):
        angle = getattr(seen, name)
        if angle is not None and abs(angle) > 2.0 * math.pi:
            return f"sighting of {seen.id!r}: {name}={angle:g}: looks like degrees; write radians"
    if seen.range_m is not None and seen.range_m > FARTHEST_M:
        return f"sighting of {seen.id!r}: range_m={seen.range_m:g}: looks like mm; write metres"
    return ""


def initial_pose_problem(given: InitialPose) -> str:
    """A heading must be within two turns, as bearings."""
    if abs(given.heading_rad) > 2.0 * math.pi:
        return f"heading_rad={given.heading_rad:g}: looks like degrees; write radians"
    return ""
