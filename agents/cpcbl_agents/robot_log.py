"""What a robot's process says to people in its own log: each thing once, when it begins or ends."""

import logging
from collections.abc import Sequence

from cpcbl_agents.input_problems import without_numbers
from cpcbl_team.config import Team
from cpcbl_transport.messages import Status

log = logging.getLogger(__name__)


class RobotLog:
    """Tells of first inputs and help, of the pose, and of problems, by the robot's status."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._fed: set[str] = set()
        self._heard: set[str] = set()
        self._lost: str | None = None
        self._problems: dict[str, str] = {}

    def connected(self, team: Team, endpoints: Sequence[str]) -> None:
        """A router answered; what the robot waits for now."""
        where = ", ".join(endpoints)
        log.info("%s: connected to team %s at %s", self._robot, team.name, where)
        if team.robots[self._robot].source != "mrclam":
            log.info("%s: waiting for its inputs on in/%s/*", self._robot, self._robot)

    def tell(self, status: Status) -> None:
        """To be called with each status, once a second."""
        for health in status.inputs:
            if health.taken and health.input not in self._fed:
                self._fed.add(health.input)
                log.info("%s: first %s", self._robot, health.input)
        for flow in status.heard:
            if flow.peer not in self._heard:
                self._heard.add(flow.peer)
                log.info("%s: first help from %s", self._robot, flow.peer)
        if (lost := without_numbers(status.lost)) != self._lost:
            self._lost = lost
            self._tell_pose(status)
        problems = {without_numbers(text): text for text in status.problems}
        for what, text in problems.items():
            if what not in self._problems:
                log.warning("%s: %s", self._robot, text)
        for what, text in self._problems.items():
            if what not in problems:
                log.info("%s: over: %s", self._robot, text)
        self._problems = problems

    def _tell_pose(self, status: Status) -> None:
        if status.lost:
            log.warning("%s: does not know its pose: %s", self._robot, status.lost)
        else:
            sigma_m = status.position_sigma_m
            log.info("%s: knows its pose, position σ %.2f m", self._robot, sigma_m)
