"""From when a robot that was carried away can be expected to know it, when a blind one should be
helped again, and which quarantines should be over."""

import math

import pytest
from msgspec.structs import replace

from cpcbl_launch.lab.chaos.run_log import RunLog
from cpcbl_launch.lab.luck.history import Event
from cpcbl_launch.lab.luck.verdict import (
    ENOUGH_REPORTS,
    HELP_S,
    NOTICED,
    help_due_s,
    noticeable_s,
    quarantines,
)
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import BudgetSettings
from cpcbl_transport.messages import Flow, Status, Trust

CARRIED = Event(0, "kidnap", "guide1", 10.0, 10.0, 2.0)
STATUS = Status("guide1", "0", 0, 0.1, 0.1, 3, "", {}, 0, 0, 0, 0)


def log_of(*judged: int) -> RunLog:
    """The log of a robot that had judged so many measurements after each second."""
    counts = ({"accepted": number // 2, "gated": number - number // 2} for number in judged)
    statuses = [(float(s + 1), replace(STATUS, counts=c)) for s, c in enumerate(counts)]
    return RunLog(0, {}, {"guide1": tuple(statuses)}, (), {})


@pytest.mark.parametrize(
    ("later", "known_s"),
    [
        ([50] * 10, math.inf),  # nothing that it could know it by
        ([50] * 5 + [50 + NOTICED - 1, 50 + NOTICED], 17.0),
        ([0] * 4 + [NOTICED], 15.0),  # a new process counts from zero
    ],
)
def test_it_can_know_it_after_enough_measurements(later: list[int], known_s: float) -> None:
    assert noticeable_s(log_of(*[5 * s for s in range(1, 10)], 50, *later), CARRIED) == known_s


def test_other_events_wait_for_nothing() -> None:
    loss = replace(CARRIED, kind="lost-inputs")
    assert noticeable_s(log_of(*[50] * 20), loss) == loss.from_s


@pytest.mark.parametrize(
    ("reason", "reports", "is_judged"),
    [
        ("biased", ENOUGH_REPORTS, True),
        ("biased", ENOUGH_REPORTS - 1, False),
        ("clock", 0, True),  # which what it sends does not end
        ("", ENOUGH_REPORTS, False),
    ],
)
def test_a_quarantine_should_be_over_if_enough_was_reported(
    reason: str, reports: int, is_judged: bool
) -> None:
    trust = (Trust("guide2", reason), Trust("guide3"))
    statuses = tuple(
        (float(s), replace(STATUS, counts={"distrusted": 100 + reports * (s >= 50)}, trust=trust))
        for s in range(61)
    )
    log = RunLog(0, {}, {"guide1": statuses}, (), {})
    assert [t.peer for t in quarantines(log, "guide1", 60.0)] == ["guide2"] * is_judged


@pytest.mark.parametrize(
    ("held_back_until_s", "peer", "lost", "due_s"),
    [
        (55.0, "scout", "", HELP_S + 60.0),
        (40.0, "scout", "", HELP_S),  # not lately
        (55.0, "patrol", "", HELP_S),  # another robot
        (55.0, "scout", "kidnapped", HELP_S),  # for which budgets have a reserve
    ],
)
def test_help_may_be_a_window_late_where_a_budget_did_not_allow_it(
    held_back_until_s: float, peer: str, lost: str, due_s: float
) -> None:
    team = load_team(builtin_path("demo"))
    observer = team.robots["observer"]
    rules = replace(observer.collaboration, budget=BudgetSettings(messages_per_minute=60.0))
    team = replace(team, robots={**team.robots, "observer": replace(observer, collaboration=rules)})
    flows = ((Flow("fix", peer, over_budget=min(s, int(held_back_until_s))),) for s in range(61))
    sent = tuple((float(s), replace(STATUS, sent=flow)) for s, flow in enumerate(flows))
    helped = tuple((float(s), replace(STATUS, lost=lost)) for s in range(61))
    log = RunLog(0, {}, {"observer": sent, "scout": helped}, (), {})
    assert help_due_s(log, team, "scout", 60.0) == pytest.approx(due_s, abs=0.1)
