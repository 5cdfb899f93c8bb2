"""Histories that the simulator of bad luck found, as short as they became."""

import pytest

from cpcbl_launch.lab.luck.history import Event, History
from cpcbl_launch.lab.luck.simulator import Simulation
from cpcbl_launch.lab.luck.teams import team_of

FOUND = {
    # A robot with a camera of 90 degrees at 2 Hz turned by 180 degrees: the errors of its heading
    # in the frames of that time made a correct observer `biased`, by a mean of its own sensors that
    # was wrong by 0.15 m and said 0.015 m.
    205: (20.0, (Event(2, "cut", "blind1", 9.62, 11.29),)),
}


@pytest.mark.parametrize("seed", FOUND)
def test_nobody_is_in_quarantine_where_nobody_is_wrong(seed: int) -> None:
    duration_s, events = FOUND[seed]
    history = History(seed, duration_s, tuple(team_of(seed).robots), events)
    log = Simulation(history).run().log
    statuses = [status for found in log.statuses.values() for _, status in found]
    assert len(statuses) > 4 * len(history.robots)
    assert {(s.robot, t.peer) for s in statuses for t in s.trust if t.quarantines} == set()
