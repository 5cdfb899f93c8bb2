"""Frames in which poses hold: that of the field, or those that robots begin from nothing.

In a team whose frame is agreed, a robot that knows nothing of the field begins a frame of its own,
whose origin is its pose at that time. All robots order frames alike, by the name of a frame and the
team file alone: the field's first, then the one whose origin robot maps best, then the older one,
then by name. So robots that meet need no messages to agree which of them joins the other's frame.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Final

from cpcbl_team.config import RobotSettings, Start, Team
from cpcbl_team.sensors import range_sigma_m

FIELD: Final = ""
"""The frame of the field, that of the map and of stated starts. It has no name in keys."""
ORIGIN: Final = Start(x_m=0.0, y_m=0.0, heading_deg=0.0, sigma_m=0.0, heading_sigma_deg=0.0)
"""Where a robot is that begins a frame: exactly, for this is what the frame is."""
TICK_NS: Final = 100_000_000  # of the age in a frame's name
DIGITS: Final = "0123456789abcdefghijklmnopqrstuvwxyz"
AGE_DIGITS: Final = 7  # 248 years
WAY_M, RANGE_M = 1.0, 3.0  # robots are compared by a landmark at this range, after this way
STEPS_PER_OCTAVE: Final = 8  # of its sigma; rounded, so that nearly equal robots are equal

Rank = tuple[int, int, str, str]


def frame_name(robot: str, begun_ns: int) -> str:
    """The name of the frame that a robot begins at this time of its clock: `r1.00k3x9a`. Names of
    one robot are in the order of their ages."""
    ticks, digits = max(begun_ns, 0) // TICK_NS, ""
    for _ in range(AGE_DIGITS):
        ticks, digit = divmod(ticks, len(DIGITS))
        digits = DIGITS[digit] + digits
    return f"{robot}.{digits}"


def origin_robot(frame: str) -> str:
    """The robot that began a frame; empty for the field's."""
    return frame.rpartition(".")[0]


def frame_text(frame: str) -> str:
    """The name of a frame for people."""
    return frame or "field"


def knows_map(team: Team, robot: str) -> bool:
    """Whether this robot can find its pose on the field by itself, without its start."""
    field, settings = team.map_of(robot), team.robots[robot]
    return field.has_surveyed or settings.position_sensor is not None


def knows_field(team: Team, robot: str) -> bool:
    """Whether this robot knows anything of the field's frame at its start."""
    start = team.robots[robot].start
    return (start is not None and start.known) or knows_map(team, robot)


def begins_frame(team: Team, robot: str) -> bool:
    """Whether this robot begins a frame of its own at its start."""
    return team.map.is_frame_agreed and not knows_field(team, robot)


def mapping_sigma_m(settings: RobotSettings) -> float:
    """How well a robot maps: the sigma (m) of a landmark that it sees at `RANGE_M`, after a
    straight way of `WAY_M` from an exact pose."""
    sensor, wheels = settings.sensor, settings.odometry
    variance = range_sigma_m(sensor, RANGE_M) ** 2 + (RANGE_M * sensor.bearing_sigma_rad) ** 2
    if wheels.moves:
        variance += WAY_M * wheels.distance_sigma_m_per_sqrt_m**2
        levers = WAY_M * RANGE_M**2 + WAY_M**2 * RANGE_M + WAY_M**3 / 3.0
        variance += levers * wheels.turn_sigma_rad_per_sqrt_m**2
    return math.sqrt(variance)


class FrameOrder:
    """The order of the frames of one team: less is better."""

    def __init__(self, robots: Mapping[str, RobotSettings]) -> None:
        self._qualities = {name: _quality(settings) for name, settings in robots.items()}

    def rank(self, frame: str) -> Rank:
        """The place of a frame in the order. Frames of robots that the file does not name come
        last."""
        if frame == FIELD:
            return -1, 0, "", ""
        robot, _, age = frame.rpartition(".")
        quality = self._qualities.get(robot)
        return (1, 0, age, robot) if quality is None else (0, quality, age, robot)

    def is_better(self, one: str, other: str) -> bool:
        """Whether one frame is better than the other."""
        return self.rank(one) < self.rank(other)

    def better(self, frames: Iterable[str], than: str) -> list[str]:
        """Those of the frames that are better than this one, the best first."""
        limit = self.rank(than)
        return sorted({f for f in frames if self.rank(f) < limit}, key=self.rank)


def _quality(settings: RobotSettings) -> int:
    """Less is better. A robot that sees no landmarks maps nothing: it comes after all that do."""
    octaves = math.log2(max(mapping_sigma_m(settings), 1e-6))
    blind = 0 if settings.sensor.sees_landmarks else 1000
    return blind + round(STEPS_PER_OCTAVE * octaves)
