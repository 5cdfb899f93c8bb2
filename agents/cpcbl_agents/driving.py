"""Steering along waypoints by the robot's own estimate (simulated robots only)."""

import math
from collections.abc import Sequence

from cpcbl_agents.agent import Located
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_transport.messages import Drive

REACHED_M = 0.25
MOST_TURN_RAD_S = 1.5
COMMAND_NS = 100_000_000


def steer(pose: Pose2, goal: tuple[float, float], speed_m_s: float) -> tuple[float, float]:
    """(speed, turn rate) towards a goal: turns on the spot first where it lies aside."""
    bearing = wrap_angle(math.atan2(goal[1] - pose.y, goal[0] - pose.x) - pose.heading)
    turn_rate = max(-MOST_TURN_RAD_S, min(MOST_TURN_RAD_S, 2.0 * bearing))
    return speed_m_s * max(0.0, math.cos(bearing)) ** 3, turn_rate


class Pilot:
    """Drives loops; stops while it is lost."""

    def __init__(
        self, robot: str, waypoints: Sequence[tuple[float, float]], speed_m_s: float
    ) -> None:
        self._robot, self._waypoints, self._speed = robot, tuple(waypoints), speed_m_s
        self._goal: int | None = None
        self._commanded_ns = 0

    def command(self, located: Located) -> list[Drive]:
        if not self._waypoints or located.stamp_ns < self._commanded_ns + COMMAND_NS:
            return []
        self._commanded_ns = located.stamp_ns
        if located.lost:  # looks around
            return [Drive(self._robot, located.stamp_ns, 0.0, 0.5)]
        pose = located.estimate.pose
        goal = self._waypoints[self._goal_from(pose)]
        return [Drive(self._robot, located.stamp_ns, *steer(pose, goal, self._speed))]

    def _goal_from(self, pose: Pose2) -> int:
        def distance(i: int) -> float:
            x, y = self._waypoints[i]
            return math.hypot(x - pose.x, y - pose.y)

        if self._goal is None:
            self._goal = 0
        if distance(self._goal) < REACHED_M:
            self._goal = (self._goal + 1) % len(self._waypoints)
        return self._goal
