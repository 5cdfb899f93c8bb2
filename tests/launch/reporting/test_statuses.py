"""What robots sent and did not send, in a report, with their limits."""

import pytest
from support.traffic import flow, recorded, shown, status

from cpcbl_launch.reporting.statuses import (
    SpendingReport,
    are_limits_kept,
    summed_flows,
    summed_spending,
)
from cpcbl_launch.views.traffic_tables import limit_text
from cpcbl_transport.messages import Spending


def test_flows_of_all_processes_are_added_by_topic_and_peer() -> None:
    first = (flow("fix", "b", 3, over_budget=1), flow("belief", "", 2, silent=4))
    second = (flow("fix", "b", 5, worthless=7), flow("fix", "c", 1))
    belief, to_b, to_c = summed_flows([first, (), second])
    assert (belief.topic, belief.peer, belief.messages, belief.silent) == ("belief", "", 2, 4)
    assert (to_b.peer, to_b.messages, to_b.bytes) == ("b", 8, 336)
    assert (to_b.over_budget, to_b.worthless, to_b.silent) == (1, 7, 0)
    assert (to_c.peer, to_c.messages) == ("c", 1)


def test_windows_report_the_fullest_one_and_a_match_its_sum() -> None:
    first = (Spending("bytes", 10.0, 500.0, 412.0), Spending("messages", 0.0, 6.5, 4.0))
    second = (Spending("bytes", 10.0, 500.0, 90.0), Spending("messages", 0.0, 2.5, 2.0))
    window, match = summed_spending([first, second])
    assert (window.unit, window.window_s, window.allowed, window.most) == ("bytes", 10, 500, 412)
    assert (match.unit, match.window_s, match.allowed, match.most) == ("messages", 0, 9, 6)


@pytest.mark.parametrize(
    ("unit", "window_s", "allowed", "most", "said", "held"),
    [
        ("bytes", 10.0, 500.0, 412.0, "412 of 500 B in 10 s", True),
        ("bytes", 10.0, 500.0, 500.0, "500 of 500 B in 10 s", True),
        ("messages", 72.0, 3.0, 4.0, "4 of 3 msg in 72 s", False),
        ("messages", 0.0, 2.5, 2.0, "2 of 2.5 msg so far", True),
    ],
)
def test_a_limit_in_words(
    unit: str, window_s: float, allowed: float, most: float, said: str, held: bool
) -> None:
    limit = SpendingReport(unit=unit, window_s=window_s, allowed=allowed, most=most)
    assert (limit_text(limit).plain, limit.is_kept) == (said, held)
    assert limit_text(limit).style == ("green" if held else "bold red")
    assert are_limits_kept([limit]) is held
    assert are_limits_kept([]) is None


def test_the_report_adds_the_processes_of_a_robot_and_says_that_limits_held() -> None:
    spent = (Spending("bytes", 10.0, 500.0, 412.0),)
    full = (Spending("bytes", 10.0, 500.0, 500.0),)
    report = recorded(
        status("a", 1, 0, "1", sent=(flow("fix", "b", 2),), spending=spent),
        status("a", 4, 0, "1", sent=(flow("fix", "b", 9, over_budget=6),), spending=spent),
        status("a", 8, 0, "2", sent=(flow("fix", "b", 1, worthless=5),), spending=full),
        status("b", 8, 3, heard=(flow("fix", "a", 10),)),
    )
    (sent,) = report.robots["a"].sent
    assert (sent.messages, sent.bytes, sent.over_budget, sent.worthless) == (10, 420, 6, 5)
    (limit,) = report.robots["a"].spending
    assert (limit.most, limit.allowed) == (500.0, 500.0)
    assert report.robots["b"].heard[0].messages == 10
    assert report.team.within_budget is True
    text = shown(report)
    (row,) = (line.split() for line in text.splitlines() if "500 B in 10 s" in line)
    assert row[:10] == ["a", "10", "0", "42", "6", "5", "0", "500", "of", "500"]
    assert "Every robot kept every limit" in text
    assert max(map(len, text.splitlines())) <= 80


def test_the_report_says_which_limit_did_not_hold() -> None:
    broken = (Spending("messages", 60.0, 3.0, 4.0),)
    report = recorded(
        status("a", 1, 0, spending=broken),
        status("b", 1, 0, spending=(Spending("messages", 60.0, 3.0, 3.0),)),
    )
    assert report.team.within_budget is False
    assert "Limits were exceeded: a: 4 of 3 msg in 60 s" in shown(report)


def test_a_report_without_help_or_limits_has_no_table_of_them() -> None:
    report = recorded(status("a", 1, 0))
    assert report.team.within_budget is None
    assert "not sent" not in shown(report)
