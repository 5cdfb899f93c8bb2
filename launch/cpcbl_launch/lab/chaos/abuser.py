"""A member that abuses its team: whose name and keys it has, and whom it concerns."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from cpcbl_team.config import Team
from cpcbl_transport.security import Identity, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus


class Abuser(NamedTuple):
    """The member that abuses its team."""

    team: Team
    robot: str
    endpoint: str
    targets: Sequence[str]  # the other robots
    stop: Callable[[], bool]

    def session(self) -> ZenohBus:
        """A new session of the member: of a robot of the file, or else of an observer."""
        role = Role.ROBOT if self.robot in self.team.robots else Role.OBSERVER
        link = link_of(self.team, Identity(role, self.robot), [self.endpoint])
        return open_bus(self.team.name, link.endpoints, self.stop, link.credentials)
