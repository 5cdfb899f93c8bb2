"""Drives simulated robots along waypoints by their own estimates."""

import math
from collections.abc import Sequence

from cpcbl_agents.agent import PoseEstimate
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_transport.messages import Drive

REACHED_M = 0.25
MOST_TURN_RAD_S = 1.5
COMMAND_NS = 100_000_000


def pursue(pose: Pose2, goal: tuple[float, float], speed_m_s: float) -> tuple[float, float]:
    """Pursues a goal: (speed, turn rate). The robot turns on the spot if the goal is beside it."""
    bearing = wrap_angle(math.atan2(goal[1] - pose.y, goal[0] - pose.x) - pose.heading)
    turn_rate = max(-MOST_TURN_RAD_S, min(MOST_TURN_RAD_S, 2.0 * bearing))
    return speed_m_s * max(0.0, math.cos(bearing)) ** 3, turn_rate


class WaypointFollower:
    """Drives loops through the waypoints; while the robot is lost it turns on the spot."""

    def __init__(
        self, robot: str, waypoints: Sequence[tuple[float, float]], speed_m_s: float
    ) -> None:
        self._robot, self._waypoints, self._speed = robot, tuple(waypoints), speed_m_s
        self._reached = 0
        self._commanded_ns = 0

    def change_frame(self, new_from_old: Pose2 | None) -> None:
        """The robot's poses are in another frame from now on; its goals stay where they are."""
        if new_from_old is not None:
            self._waypoints = tuple(new_from_old.transform(x, y) for x, y in self._waypoints)

    def command(self, now: PoseEstimate) -> list[Drive]:
        if not self._waypoints or now.stamp_ns < self._commanded_ns + COMMAND_NS:
            return []
        self._commanded_ns = now.stamp_ns
        if now.lost:  # it turns until it sees landmarks
            return [Drive(self._robot, now.stamp_ns, 0.0, 0.5, self._reached)]
        pose, goals = now.estimate.pose, self._waypoints
        x, y = goals[self._reached % len(goals)]
        if math.hypot(x - pose.x, y - pose.y) < REACHED_M:
            self._reached += 1
        command = pursue(pose, goals[self._reached % len(goals)], self._speed)
        return [Drive(self._robot, now.stamp_ns, *command, self._reached)]
