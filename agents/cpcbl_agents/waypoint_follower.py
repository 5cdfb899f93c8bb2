"""Steering along waypoints by the robot's own estimate (simulated robots only)."""

import math
from collections.abc import Sequence

from cpcbl_agents.agent import Located
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_transport.messages import Drive

REACHED_M = 0.25
MOST_TURN_RAD_S = 1.5
COMMAND_NS = 100_000_000


def pursue(pose: Pose2, goal: tuple[float, float], speed_m_s: float) -> tuple[float, float]:
    """(speed, turn rate) towards a goal: turns on the spot first where it lies aside."""
    bearing = wrap_angle(math.atan2(goal[1] - pose.y, goal[0] - pose.x) - pose.heading)
    turn_rate = max(-MOST_TURN_RAD_S, min(MOST_TURN_RAD_S, 2.0 * bearing))
    return speed_m_s * max(0.0, math.cos(bearing)) ** 3, turn_rate


class WaypointFollower:
    """Drives loops; stops while it is lost."""

    def __init__(
        self, robot: str, waypoints: Sequence[tuple[float, float]], speed_m_s: float
    ) -> None:
        self._robot, self._waypoints, self._speed = robot, tuple(waypoints), speed_m_s
        self._reached = 0
        self._commanded_ns = 0

    def command(self, located: Located) -> list[Drive]:
        if not self._waypoints or located.stamp_ns < self._commanded_ns + COMMAND_NS:
            return []
        self._commanded_ns = located.stamp_ns
        if located.lost:  # looks around
            return [Drive(self._robot, located.stamp_ns, 0.0, 0.5, self._reached)]
        pose = located.estimate.pose
        command = pursue(pose, self._goal_from(pose), self._speed)
        return [Drive(self._robot, located.stamp_ns, *command, self._reached)]

    def _goal_from(self, pose: Pose2) -> tuple[float, float]:
        x, y = self._goal
        if math.hypot(x - pose.x, y - pose.y) < REACHED_M:
            self._reached += 1
        return self._goal

    @property
    def _goal(self) -> tuple[float, float]:
        return self._waypoints[self._reached % len(self._waypoints)]
