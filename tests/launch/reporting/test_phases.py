"""Before, during, after: windows of presence, and figures within them."""

import io
import math
import tracemalloc
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from support.buses import SECOND

from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.phases import (
    AWAY_S,
    MOST_GUESTS,
    Span,
    guest_reports,
    phase_report,
    presence_spans,
    split_by_presence,
)
from cpcbl_launch.reporting.recorder import MeanScore, Recorder, Report, TeamReport
from cpcbl_launch.run.processes import Supervisor
from cpcbl_launch.views.run import LiveTable, print_report
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Track, encode

NO_TRUTH: dict[str, Floats] = {}


class Said:
    """A recorder that hears tracks at 10 Hz; errors are along x."""

    def __init__(self) -> None:
        hub = MemoryHub()
        self.recorder, self._bus = Recorder(hub.session()), hub.session()

    def tracks(
        self, robot: str, from_s: float, until_s: float, error_m: float = 0.0, sigma_m: float = 0.1
    ) -> None:
        publisher = self._bus.publisher(topics.TRACK.at(robot=robot), topics.TRACK.qos)
        covariance = (sigma_m**2, 0.0, sigma_m**2, 0.0, 0.0, 0.01)
        for tenth in range(round(from_s * 10), round(until_s * 10)):
            stamp_ns = tenth * SECOND // 10
            publisher.put(encode(Track(robot, stamp_ns, error_m, 0.0, 0.0, covariance, 3)))


def standing_at_origin() -> Floats:
    return np.array([(0.1 * t, 0.0, 0.0, 0.0) for t in range(1001)])


@pytest.mark.parametrize(
    ("times_s", "spans"),
    [
        ([], []),
        ([3.0], [(3.0, 3.0)]),
        ([1.0, 1.1, 1.2], [(1.0, 1.2)]),
        ([1.0, 1.0 + AWAY_S], [(1.0, 1.0 + AWAY_S)]),
        ([1.0, 2.0, 5.0, 6.0, 60.0], [(1.0, 2.0), (5.0, 6.0), (60.0, 60.0)]),
    ],
)
def test_who_is_silent_for_long_was_away(
    times_s: Sequence[float], spans: list[tuple[float, float]]
) -> None:
    assert presence_spans(times_s) == spans


def test_a_run_is_split_at_comings_and_goings() -> None:
    before, during, after = split_by_presence([Span(20.0, 30.0), Span(50.0, 60.0)], 10.0)
    assert before == [(10.0, 20.0)]
    assert during == [(20.0, 30.0), (50.0, 60.0)]
    assert after == [(30.0, 50.0), (60.0, math.inf)]


def test_who_was_there_before_figures_begin_has_no_time_before() -> None:
    before, during, after = split_by_presence([Span(5.0, 30.0)], 10.0)
    said = Said()
    said.tracks("r1", 0.0, 40.0)
    assert phase_report(said.recorder, "r1", None, before).position_sigma_m is None
    assert during == [(10.0, 30.0)]
    assert after == [(30.0, math.inf)]


def test_figures_of_parts_of_a_run() -> None:
    said = Said()
    for from_s, error_m, sigma_m in ((0.0, 0.3, 0.2), (20.0, 0.02, 0.03), (40.0, 0.5, 0.4)):
        said.tracks("r1", from_s, from_s + 20.0, error_m, sigma_m)
    said.tracks("tripod", 20.0, 40.0, 0.01, 0.02)
    truth = {"r1": standing_at_origin(), "tripod": standing_at_origin()}
    report = guest_reports(said.recorder, ["r1"], truth, 5.0)
    assert report.keys() == {"tripod"}
    guest = report["tripod"]
    (present_s,) = guest.present_s
    assert present_s == pytest.approx((15.0, 34.9))
    assert guest.position_rmse_m == pytest.approx(0.01)
    effect = guest.robots["r1"]
    rmse_m = [p.position_rmse_m for p in (effect.before, effect.during, effect.after)]
    sigma = [p.position_sigma_m for p in (effect.before, effect.during, effect.after)]
    assert rmse_m == pytest.approx([0.3, 0.02, 0.5], abs=2e-3)
    assert sigma == pytest.approx([0.2, 0.03, 0.4], abs=2e-3)
    assert effect.before.samples == 200


def test_without_truth_a_robots_own_sigma_is_left() -> None:
    said = Said()
    said.tracks("r1", 0.0, 10.0, 0.3, 0.2)
    part = phase_report(said.recorder, "r1", None, [Span(2.0, 4.0)])
    assert part.samples == 0
    assert part.position_rmse_m is None
    assert part.position_sigma_m == pytest.approx(0.2)


def test_robots_of_the_team_are_no_guests() -> None:
    said = Said()
    said.tracks("r1", 0.0, 10.0)
    assert guest_reports(said.recorder, ["r1"], NO_TRUTH, 0.0) == {}


def test_a_report_is_not_flooded_by_names() -> None:
    said = Said()
    for number in range(2 * MOST_GUESTS):
        said.tracks(f"garbage{number}", 0.0, 0.1)
    said.tracks("tripod", 0.0, 1.0)
    found = guest_reports(said.recorder, ["r1"], NO_TRUTH, 0.0)
    assert len(found) == MOST_GUESTS
    assert "tripod" in found


def test_the_report_shows_guests_beside_the_team() -> None:
    said = Said()
    said.tracks("r1", 0.0, 60.0)
    said.tracks("tripod", 20.0, 30.0)
    truth = {"r1": standing_at_origin()}
    report: Report = said.recorder.report({"r1": "joint"}, truth)
    guests = guest_reports(said.recorder, ["r1"], truth, 0.0)
    shown = Report(robots=report.robots, team=report.team, guests=guests)
    out = io.StringIO()
    print_report(shown, Console(file=out, width=100))
    text = out.getvalue()
    assert "tripod, guest" in text
    assert "guest tripod, present from 20.0 to 29.9 s" in text
    for column in ("RMSE before", "RMSE during", "RMSE after", "σ before", "σ after"):
        assert column in text
    assert max(map(len, text.splitlines())) <= 80
    assert isinstance(report.team, TeamReport)
    assert isinstance(report.team, MeanScore)
    assert report.team.position_rmse_m == 0.0


class NoProcesses(Supervisor):
    """The robots run on other machines."""

    def __init__(self) -> None:
        super().__init__([], Path())


def test_the_live_table_shows_who_is_a_guest_and_who_has_left() -> None:
    said, out = Said(), io.StringIO()
    said.tracks("r1", 0.0, 30.0)
    said.tracks("a-guest", 10.0, 30.0)
    said.tracks("another", 10.0, 20.0)
    with LiveTable("team", ["r1"], Console(file=out, width=80)) as view:
        view.show(said.recorder, NoProcesses(), 30.0)
    rows = [line.split() for line in out.getvalue().splitlines()[3:]]
    assert [(row[0], row[1], row[-1]) for row in rows if row] == [
        ("r1", "away", "ok"),
        ("a-guest", "guest", "ok"),
        ("another", "guest", "left"),
    ]


class FarOn(NoProcesses):
    """A robot whose machine has started many processes."""

    @property
    def names(self) -> list[str]:
        return ["robot-navigator"]

    @property
    def pids(self) -> dict[str, int]:
        return {"robot-navigator": 4_194_303}


def test_a_live_table_moves_together_before_it_folds_a_state() -> None:
    said = Said()
    said.tracks("navigator", 0.0, 30.0)
    for width, begin in (
        (80, "navigator  4194303  "),
        (62, "navigator 4194303 "),
        (60, "navigator 0.00"),
        (50, "navigator 0.00"),
    ):
        out = io.StringIO()
        with LiveTable("team", ["navigator"], Console(file=out, width=width)) as view:
            view.show(said.recorder, FarOn(), 30.0)
        _, _, _, row = out.getvalue().splitlines()
        assert row.startswith(begin)
        assert row.split()[-1] == "ok"


def test_a_recorder_takes_little_room_for_what_it_hears_over_days() -> None:
    said = Said()
    said.tracks("r1", 0.0, 0.1)
    tracemalloc.start()
    said.tracks("r1", 0.1, 100.0)
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    tracks = list(said.recorder.tracks["r1"])
    assert [track.stamp_ns for track in tracks] == [n * SECOND // 10 for n in range(1000)]
    assert taken < 250 * len(tracks)
