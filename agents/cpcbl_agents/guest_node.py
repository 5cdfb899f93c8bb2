"""The node of a guest. On a simulated field it also asks, again and again, to be simulated."""

import logging
from collections.abc import Callable

from cpcbl_agents.composition import build_robot
from cpcbl_agents.node import Node
from cpcbl_agents.sources import OwnCamera
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import Join, encode
from cpcbl_transport.robot_model import SimulatedRobotModel, model_from_settings

log = logging.getLogger(__name__)

ASK_NS = 500_000_000
RETRY_NS = 50_000_000  # while no field subscribes
WARN_AFTER_NS = 3_000_000_000  # without any input


class GuestNode(Node):
    """Runs a guest, which `team` holds beside its own robots, from `start_ns` until `leave`."""

    def __init__(
        self,
        name: str,
        team: Team,
        bus: Bus,
        start_ns: int,
        incarnation: str,
        on_arrival: Callable[[], None] = lambda: None,
        speed: float = 1.0,
        camera: OwnCamera | None = None,
    ) -> None:
        robot = build_robot(name, team, start_ns, camera=camera)
        super().__init__(robot, team, bus, start_ns, incarnation, on_arrival, speed)
        self._ask_ns = start_ns
        self._warn_ns: int | None = start_ns + WARN_AFTER_NS
        self._model = model_from_settings(team.robots[name])
        self._join = bus.publisher(topics.JOIN.at(robot=name), topics.JOIN.qos)

    @property
    def next_ns(self) -> int:
        return super().next_ns if self._model is None else min(super().next_ns, self._ask_ns)

    @property
    def missing_input(self) -> str:
        """Why nothing has been sensed so far; empty if something has been sensed."""
        if self.robot.sensing.counts:
            return ""
        if self._model is None:
            keys = topics.IN_SIGHTINGS.at(robot=self.robot.name)
            return f"senses nothing: nothing came on {keys}; is its driver there?"
        return (
            "senses nothing: no field gives it a body; is the team simulated in real time, and does"
            " its file let guests in?"
        )

    def step(self, now_ns: int) -> None:
        """Asks the field when that is due, and steps the node."""
        if self._warn_ns is not None and now_ns >= self._warn_ns:
            self._warn_ns = None
            if self.missing_input:
                log.warning("%s %s", self.robot.name, self.missing_input)
        if self._model is not None and now_ns >= self._ask_ns:
            self._ask_ns = now_ns + (ASK_NS if self._ask(now_ns, self._model) else RETRY_NS)
        super().step(now_ns)

    def leave(self, now_ns: int) -> None:
        """Tells the field that the guest leaves. All else ends with the session."""
        if self._model is not None:
            self._ask(now_ns, None)

    def _ask(self, now_ns: int, model: SimulatedRobotModel | None) -> bool:
        """Asks the field; whether a field subscribes."""
        if not self._join.matching:
            return False
        self._join.put(encode(Join(self.robot.name, self._incarnation, now_ns, model)))
        return True
