"""Which guests have a body on the simulated field: those that ask for one, and ask again."""

from collections.abc import Mapping

from cpcbl_team.config import Team
from cpcbl_transport.messages import Join, SimulatedRobotModel

REQUEST_LASTS_NS = 2_000_000_000  # who has not asked again for so long is gone
LONGEST_DELAY_S = 10.0  # what is sensed with a delay is kept so long


class GuestBodies:
    """What guests have asked for, by the team's rules. Times are the field's."""

    def __init__(self, team: Team) -> None:
        self._robots, self._rules = frozenset(team.robots), team.guests
        self._requests: dict[str, tuple[int, Join]] = {}

    def request(self, join: Join, now_ns: int) -> str:
        """Takes a guest's word; the reason if it is refused."""
        name = join.robot
        if join.model is None:
            self._requests.pop(name, None)
            return ""
        if not self._rules.allowed:
            return "guests.allowed is false"
        if name in self._robots:
            return "a robot of the team has this name"
        if len(self._requests) >= self._rules.most and name not in self._requests:
            return f"there are {self._rules.most} guests, guests.most"
        if not (reason := unsupported_delay(join.model)):
            self._requests[name] = now_ns, join
        return reason

    def present(self, now_ns: int) -> Mapping[str, Join]:
        """The guests that have a body now, with what each asked for last."""
        self._requests = {
            name: (asked_ns, join)
            for name, (asked_ns, join) in self._requests.items()
            if now_ns - asked_ns <= REQUEST_LASTS_NS
        }
        return {name: join for name, (_, join) in self._requests.items()}


def unsupported_delay(model: SimulatedRobotModel) -> str:
    """Why the field cannot give a guest this body; empty if it can."""
    for key in ("sensor", "odometry", "position_sensor"):
        device = getattr(model, key)
        if device is not None and abs(device.delay_s) > LONGEST_DELAY_S:
            return f"{key}.delay_s: {device.delay_s:g} s; at most {LONGEST_DELAY_S:g} s"
    return ""
