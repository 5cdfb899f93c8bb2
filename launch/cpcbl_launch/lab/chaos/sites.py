"""Two sites with one router each, joined by a relay that can be cut; the field serves both."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

from cpcbl_launch.lab.chaos.relay import Relay
from cpcbl_launch.lab.chaos.run_log import RunLog, RunRecorder
from cpcbl_launch.lab.chaos.team import RunPlan, Site, TeamUnderTest, run_team_under_test
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_transport.zenoh_bus import open_bus

FAR = "far-router"


class TwoSites(NamedTuple):
    """A team at two sites."""

    team: TeamUnderTest
    link: Relay
    far_recorder: RunRecorder

    @property
    def far_log(self) -> RunLog:
        """The log of the far site, with the ground truth, which is published at the near site
        only."""
        return self.far_recorder.run_log()._replace(truth=self.team.run_log.truth)


@contextmanager
def run_at_two_sites(team: Team, seed: int, far: Sequence[str]) -> Iterator[TwoSites]:
    """A running team, some robots of which use another router."""
    near_at, far_at = free_endpoint(), free_endpoint()
    with ExitStack() as stack:
        link = stack.enter_context(Relay(near_at, seed))
        links, site = dict.fromkeys(far, far_at), Site(far_at, link.endpoint, far)
        plan = RunPlan(team, seed, links=links, endpoint=near_at, sites={FAR: site})
        run = stack.enter_context(run_team_under_test(plan))
        far_taker = RunRecorder(run.clock)
        far_taker.listen(stack.enter_context(open_bus(team.name, [far_at])))
        yield TwoSites(run, link, far_taker)
