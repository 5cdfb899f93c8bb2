"""Two sites, a router each, joined by a relay that can be cut; the simulated world is not cut.

The field stands at the near site. Real robots have their drivers with them, so while the sites are
apart a bridge carries to the far robots what they sense, and to the field what they command.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

from cpcbl_launch.chaos.notes import Notes, NoteTaker
from cpcbl_launch.chaos.relay import Relay
from cpcbl_launch.chaos.team import Plan, Site, TeamUnderTest, running
from cpcbl_launch.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.topics import Topic
from cpcbl_transport.zenoh_bus import open_bus

MEMORY = 2_000
FAR = "far-router"


class Bridge:
    """Carries payloads under some keys from one bus to another, each payload once: where the buses
    are joined, what it carries comes round again."""

    def __init__(self, source: Bus, sink: Bus, topic: Topic, robots: Sequence[str]) -> None:
        self._sink, self._qos = sink, topic.qos
        self._publishers: dict[str, Publisher] = {}
        self._carried: deque[bytes] = deque(maxlen=MEMORY)
        self._handles = [source.subscribe(topic.at(robot=name), self._carry) for name in robots]

    def _carry(self, key: str, payload: bytes) -> None:
        if payload in self._carried:
            return
        self._carried.append(payload)
        if key not in self._publishers:
            self._publishers[key] = self._sink.publisher(key, self._qos)
        self._publishers[key].put(payload)

    def close(self) -> None:
        for handle in self._handles:
            handle.close()


class TwoSites(NamedTuple):
    """A team at two sites."""

    team: TeamUnderTest
    link: Relay
    far: Sequence[str]
    far_taker: NoteTaker
    near_bus: Bus
    far_bus: Bus

    def carry_the_world(self) -> list[Bridge]:
        """What the far robots sense and command goes by itself, until these are closed."""
        down = [Bridge(self.near_bus, self.far_bus, t, self.far) for t in topics.INPUTS]
        return [*down, Bridge(self.far_bus, self.near_bus, topics.DRIVE, self.far)]

    @property
    def far_notes(self) -> Notes:
        """What is heard at the far site, with the truth, which is known at the near one only."""
        return self.far_taker.notes()._replace(truth=self.team.notes.truth)


@contextmanager
def two_sites(team: Team, seed: int, far: Sequence[str]) -> Iterator[TwoSites]:
    """A running team, some robots of which use another router."""
    near_at, far_at = free_endpoint(), free_endpoint()
    with ExitStack() as stack:
        link = stack.enter_context(Relay(near_at, seed))
        plan = Plan(
            team,
            seed,
            links=dict.fromkeys(far, far_at),
            endpoint=near_at,
            sites={FAR: Site(far_at, link.endpoint)},
        )
        run = stack.enter_context(running(plan))
        far_bus = stack.enter_context(open_bus(team.name, [far_at]))
        near_bus = stack.enter_context(open_bus(team.name, [near_at]))
        taker = NoteTaker(run.clock)
        taker.listen(far_bus)
        yield TwoSites(run, link, far, taker, near_bus, far_bus)
