"""What a robot's process logs for people: each thing once, when it begins or ends."""

import logging
from collections import Counter
from collections.abc import Sequence

from cpcbl_agents.input_diagnosis.problems import without_numbers
from cpcbl_agents.robot_state import RobotState, robot_state
from cpcbl_team.config import Team
from cpcbl_team.frames import FIELD, frame_text
from cpcbl_transport.messages import InputHealth, Status

log = logging.getLogger(__name__)


class RobotLogger:
    """Logs the first inputs and help, changes of the pose's state, and problems, from the robot's
    statuses."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._fed: set[str] = set()
        self._heard: set[str] = set()
        self._lost: str | None = None
        self._frame = FIELD
        self._unconfirmed = ""
        self._problems: dict[str, str] = {}
        self._initial_poses: Counter[str] = Counter()  # by the reason of a refusal

    def log_connected(self, team: Team, endpoints: Sequence[str]) -> None:
        """Logs that a router answered, and what the robot waits for now."""
        where = ", ".join(endpoints)
        log.info("%s: connected to team %s at %s", self._robot, team.name, where)
        if team.robots[self._robot].source != "mrclam":
            log.info("%s: waiting for its inputs on in/%s/*", self._robot, self._robot)

    def log_status(self, status: Status) -> None:
        """To be called with each status, once a second."""
        for health in status.inputs:
            if health.input == "initial_pose":
                self._log_initial_poses(health)
            elif health.taken and health.input not in self._fed:
                self._fed.add(health.input)
                log.info("%s: first %s", self._robot, health.input)
        for flow in status.heard:
            if flow.peer not in self._heard:
                self._heard.add(flow.peer)
                log.info("%s: first help from %s", self._robot, flow.peer)
        if status.frame != self._frame:
            self._frame = status.frame
            log.info("%s: is in frame %s", self._robot, frame_text(status.frame))
        state = robot_state(status)
        lost = without_numbers(state.why) if state.word == "lost" else ""
        if lost != self._lost:
            self._lost = lost
            self._log_pose(state, status.position_sigma_m)
        if (what := without_numbers(state.unconfirmed)) != self._unconfirmed and not lost:
            self._unconfirmed = what
            log.info("%s: %s", self._robot, state.unconfirmed or "its pose is confirmed")
        problems = {without_numbers(text): text for text in state.problems}
        for what, text in problems.items():
            if what not in self._problems:
                log.warning("%s: %s", self._robot, text)
        for what, text in self._problems.items():
            if what not in problems:
                log.info("%s: over: %s", self._robot, text)
        self._problems = problems

    def _log_initial_poses(self, health: InputHealth) -> None:
        """Each that somebody gives is meant to count, so each is said."""
        now = Counter({"": health.taken, **health.refused})
        for reason in now - self._initial_poses:
            if reason:
                log.warning("%s: a pose that somebody gave is refused: %s", self._robot, reason)
            else:
                log.info("%s: somebody has set its pose", self._robot)
        self._initial_poses = now

    def _log_pose(self, state: RobotState, sigma_m: float) -> None:
        if state.word == "lost":
            log.warning("%s: does not know its pose: %s", self._robot, state.why)
        else:
            log.info("%s: knows its pose, position σ %.2f m", self._robot, sigma_m)
