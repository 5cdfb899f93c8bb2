"""What people and machines are told of robots that others do not believe."""

import io
from collections.abc import Sequence

import pytest
from rich.console import Console

from cpcbl_agents.robot_state import distrust_text
from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.reporting.statuses import (
    TrustReport,
    trust_remarks,
    trust_reports,
)
from cpcbl_launch.views.run import print_report
from cpcbl_launch.views.traffic import Arrival, traffic_from_statuses
from cpcbl_launch.views.traffic_tables import traffic_view
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, Trust, encode

BIASED = Trust("west", "biased", 3, 2)
HEALED = Trust("north", "", 5, 1, unconfirmed=True)
AHEAD = Trust("r4", "clock", late_s=-0.45)
CONTESTED = Trust("south", contested=True)
BEHIND = Trust("r5", "clock", late_s=3600.0)


def status(trust: Sequence[Trust], incarnation: str = "1") -> Status:
    return Status("scout", incarnation, 10, 0.1, 0.1, 3, "", {}, 0, 0, 0, 0, trust=tuple(trust))


@pytest.mark.parametrize(
    ("trust", "said"),
    [
        ([], ""),
        ([HEALED], ""),
        ([BIASED, HEALED], "distrusts west (biased)"),
        ([CONTESTED], "contested: south"),
        ([BIASED, CONTESTED], "distrusts west (biased); contested: south"),
        ([AHEAD, BEHIND], "distrusts r4 (clock 0.45 s ahead), r5 (3600.00 s late)"),
    ],
)
def test_who_is_not_believed_is_named_with_the_reason(trust: list[Trust], said: str) -> None:
    assert distrust_text(trust) == said


def test_a_report_sums_the_quarantines_of_all_processes() -> None:
    found = trust_reports([status([BIASED]), status([BIASED, HEALED], "2")])
    assert found[0] == TrustReport(
        peer="west", reason="biased", quarantines=4, unconfirmed=False, late_s=0.0
    )
    assert (found[1].quarantines, found[1].unconfirmed) == (1, True)
    assert trust_reports([]) == ()


def test_the_report_says_it_in_words() -> None:
    found = trust_reports([status([BIASED, HEALED, AHEAD])])
    assert list(trust_remarks("scout", found)) == [
        "robot scout does not believe west: biased",
        "robot scout did not believe north for a time (once)",
        "robot scout does not believe r4: clock 0.45 s ahead",
    ]


def report_of(trust: Sequence[Trust]) -> Report:
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    key = topics.STATUS.at(robot="scout")
    hub.session().publisher(key, topics.STATUS.qos).put(encode(status(trust)))
    return recorder.report({"scout": "joint"}, {})


def test_a_recorder_puts_it_into_the_report_and_the_report_on_the_screen() -> None:
    report = report_of([BIASED])
    assert report.robots["scout"].trust == trust_reports([status([BIASED])])
    text = io.StringIO()
    print_report(report, Console(file=text, width=80))
    assert "robot scout does not believe west: biased" in text.getvalue()


def test_traffic_shows_it_beside_whom_a_robot_helps() -> None:
    now = traffic_from_statuses(
        "t", ["scout"], {"scout": [Arrival(0.0, status([BIASED]))]}, 0.0, 1.0
    )
    assert now.robots["scout"].trust[0].peer == "west"
    text = io.StringIO()
    Console(file=text, width=80).print(traffic_view(now, "tcp/127.0.0.1:1"))
    assert "distrusts west (biased)" in text.getvalue()
