"""What bearings show beside the map while odometry leads back to the robot's start. Pure functions.

As `motion_causes.view_cause`, for a robot that has turned, but hardly moved: if bearings are off by
an angle, all landmarks stand off by it, whichever way the robot looks.
"""

import cmath
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import median

from cpcbl_agents.input_diagnosis.motion_causes import OR_START, Step, place_of, poses_at
from cpcbl_team.config import Landmark
from cpcbl_team.geometry import Pose2, phase
from cpcbl_team.inputs import Sightings

LEAST_VIEWS = 8
LEAST_TURN_RAD = 0.8  # for what turns with the robot is told from what does not
LEAST_OFF_RAD = math.radians(25.0)
SPREAD_RAD = 0.25
SHARE = 0.75
MOST_MOVED = 0.15  # since the start, as a share of the range


def turned_view_cause(
    frames: Iterable[Sightings], steps: Sequence[Step], start: Pose2, marks: Mapping[str, Landmark]
) -> str:
    """By how much bearings are off, if all of them are alike; empty if they are not, or are right.
    `steps`: of odometry since the start."""
    if len(steps) < 2:
        return ""
    within = [f for f in frames if steps[0].from_ns <= f.stamp_ns <= steps[-1].stamp_ns]
    views = list(_views(within, steps, start, marks))
    if len(views) < LEAST_VIEWS:
        return ""
    headings = [heading for heading, _ in views]
    if max(headings) - min(headings) < LEAST_TURN_RAD:
        return ""
    middle = phase(sum(off for _, off in views))
    aside = [phase(off * cmath.rect(1.0, -middle)) for _, off in views]
    off_rad = math.remainder(middle + median(aside), math.tau)
    near = sum(abs(a - median(aside)) < SPREAD_RAD for a in aside)
    if near < SHARE * len(views) or abs(off_rad) < LEAST_OFF_RAD:
        return ""
    return f"{bearings_off(off_rad)}; {OR_START}"


def bearings_off(angle_rad: float) -> str:
    """`bearings are 90° off`; by a whole quarter of a turn where it is nearly one."""
    degrees = abs(math.degrees(math.remainder(angle_rad, math.tau)))
    quarter = 90.0 * round(degrees / 90.0)
    degrees = quarter if abs(degrees - quarter) < 12.0 else degrees
    left = "" if degrees == 180.0 else ", left is positive"
    return f"bearings are {degrees:.0f}° off; ahead is 0{left}"


def _views(
    frames: Iterable[Sightings], steps: Sequence[Step], start: Pose2, marks: Mapping[str, Landmark]
) -> Iterator[tuple[float, complex]]:
    """The robot's heading since the start, and the direction in which a landmark is seen against
    that in which the map has it, of each sighting."""
    frames = list(frames)
    poses = poses_at(steps, [frame.stamp_ns for frame in frames])
    ahead = cmath.rect(1.0, start.heading)
    for frame, (moved, heading) in zip(frames, poses, strict=True):
        own = complex(start.x, start.y) + moved * ahead
        for seen in frame.sightings:
            place = place_of(seen)
            if place is None or (mark := marks.get(seen.id)) is None:
                continue
            due = (complex(mark.x_m, mark.y_m) - own) * cmath.rect(1.0, -heading) / ahead
            if abs(moved) < MOST_MOVED * abs(due):
                off = place * due.conjugate()
                yield heading, off / (abs(off) or 1.0)
