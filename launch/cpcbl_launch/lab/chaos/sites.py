"""Two sites, a router each, joined by a relay that can be cut; the simulated world is at both."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

from cpcbl_launch.lab.chaos.relay import Relay
from cpcbl_launch.lab.chaos.run_log import Notes, NoteTaker
from cpcbl_launch.lab.chaos.team import Plan, Site, TeamUnderTest, running
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_transport.zenoh_bus import open_bus

FAR = "far-router"


class TwoSites(NamedTuple):
    """A team at two sites."""

    team: TeamUnderTest
    link: Relay
    far_taker: NoteTaker

    @property
    def far_notes(self) -> Notes:
        """What is heard at the far site, with the truth, which is told at the near one only."""
        return self.far_taker.notes()._replace(truth=self.team.notes.truth)


@contextmanager
def two_sites(team: Team, seed: int, far: Sequence[str]) -> Iterator[TwoSites]:
    """A running team, some robots of which use another router."""
    near_at, far_at = free_endpoint(), free_endpoint()
    with ExitStack() as stack:
        link = stack.enter_context(Relay(near_at, seed))
        links, site = dict.fromkeys(far, far_at), Site(far_at, link.endpoint, far)
        plan = Plan(team, seed, links=links, endpoint=near_at, sites={FAR: site})
        run = stack.enter_context(running(plan))
        far_taker = NoteTaker(run.clock)
        far_taker.listen(stack.enter_context(open_bus(team.name, [far_at])))
        yield TwoSites(run, link, far_taker)
