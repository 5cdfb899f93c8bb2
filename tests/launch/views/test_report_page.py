"""The page of a report: whole, by itself, and useful whatever the run was."""

import re
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path

import pytest
from msgspec.structs import replace
from support.simulated import record_run, simulate_recorded

from cpcbl_launch.recordings.summary import RunSummary, summarize
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.views.report.charts import binned
from cpcbl_launch.views.report.page import SECTIONS, report_page
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, Tagged, Track, encode

DEMO = load_team(builtin_path("demo"))
VOID = {"meta", "path", "rect", "ellipse"}
LARGEST = 150_000  # bytes of the page of a short run of four robots


class Page(HTMLParser):
    """Fails on tags that do not match; keeps what would be asked of the network."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self._open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.words = ""
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.links += [str(v) for k, v in attrs if k in ("src", "href", "data", "action")]
        self.ids += [str(found["id"])] if "id" in found else []
        assert tag != "script"
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in VOID

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data


def page_of(*runs: RunSummary) -> Page:
    text = report_page(runs)
    page = Page(text)
    assert all(link.startswith("#") for link in page.links)
    assert "url(" not in text
    assert "@import" not in text
    assert not any("nan" in path for path in re.findall(r' d="([^"]*)"', text.lower()))
    assert not re.search(r'="[^"]*\b(nan|inf)\b', text)
    return page


def said(path: Path, team: Team, messages: Sequence[Tagged]) -> RunSummary:
    """The summary of a recording of these messages."""
    hub = MemoryHub()
    speaker = hub.session()
    with Recording(path, team, hub.session()):
        for message in messages:
            topic = topics.topic_of(type(message))
            key = topic.at(robot=getattr(message, "robot", ""))
            speaker.publisher(key, topic.qos).put(encode(message))
    return summarize(path)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    path = tmp_path_factory.mktemp("demo") / "demo.mcap"
    simulate_recorded(DEMO, 1, 12.0, path)
    return summarize(path)


def test_the_page_has_all_of_a_run_and_needs_nothing_else(demo: RunSummary) -> None:
    text = report_page([demo])
    page = page_of(demo)
    assert [i for i in page.ids if i in {s.name for s in SECTIONS}] == [s.name for s in SECTIONS]
    rmse_m = demo.report.robots["scout"].position_rmse_m
    assert f"RMSE {rmse_m:.3f} m" in page.words
    assert text.count("<svg") == 1 + len(DEMO.robots)
    assert "observer helped scout: " in text
    assert "Nothing was refused." in page.words
    assert 'name = "demo"' in page.words
    assert "True poses are not known" not in page.words
    assert len(text.encode()) < LARGEST


def test_two_runs_are_side_by_side_on_the_same_axes(demo: RunSummary, tmp_path: Path) -> None:
    robots = {
        n: replace(r, localizer=replace(r.localizer, variant="weighted"))
        for n, r in DEMO.robots.items()
    }
    simulate_recorded(replace(DEMO, robots=robots), 1, 2.0, tmp_path / "other.mcap")
    other = summarize(tmp_path / "other.mcap")
    page = page_of(demo, other)
    ours, theirs = (run.report.team.position_rmse_m for run in (demo, other))
    assert ours is not None
    assert theirs is not None
    assert f"team: RMSE m{ours:.3f}{theirs:.3f}{theirs - ours:+.3f}" in page.words
    assert "A: demo.mcap" in page.words
    assert "B: other.mcap" in page.words
    assert "states no σ" in page.words


def test_without_truth_it_shows_what_robots_state(tmp_path: Path) -> None:
    record_run(tmp_path / "run", DEMO, 1, 2.0)
    run = summarize(tmp_path / "run")
    page = page_of(run)
    assert "True poses are not known" in page.words
    assert "RMSE" not in page.words.replace("RMSE m", "")
    assert "σ that robots state" in page.words


def test_faults_restarts_refusals_and_silence_are_named(tmp_path: Path) -> None:
    """And what a driver wrote is text, never HTML."""
    second, covariance = 10**9, (0.01, 0.0, 0.01, 0.0, 0.0, 0.001)
    start = 1_700_000_000 * second
    tracks = [
        Track("scout", start + i * second // 10, 0.1 * i, 1.0, 0.0, covariance, 3, lost)
        for i in (*range(50), *range(150, 200))
        for lost in ["position sigma 2.1 m" if 20 <= i < 30 else ""]
    ]
    empty = Status("scout", "a1", start + second, 0.1, 0.1, 3, "", {}, 0, 0, 0, 0)
    wrong = replace(empty, counts={"garbage": 7}, problems=("its <b>odometry</b> stands still",))
    again = replace(empty, incarnation="b2", stamp_ns=start + 15 * second)
    page = page_of(said(tmp_path / "run.mcap", DEMO, [*tracks, wrong, again]))
    assert "its <b>odometry</b> stands still" in page.words
    assert "was started again" in page.words
    assert "nothing was heard of it (once, 10.1 s at most)" in page.words
    assert "lost: position sigma 2.1 m (once" in page.words
    assert "garbage7" in page.words
    assert "Nothing was heard of navigator, observer, patrol." in page.words
    assert "2023-11-14 22:13:20 UTC" in page.words


def test_a_run_of_nothing_is_a_page_that_says_so(tmp_path: Path) -> None:
    run = said(tmp_path / "run.mcap", DEMO, [])
    page = page_of(run, run)
    assert "No pose of any robot of the team is in this recording." in page.words


def test_a_robot_with_a_clock_of_another_year_does_not_stretch_the_run(tmp_path: Path) -> None:
    tracks = [
        Track(robot, (at_s + i) * 10**9, 1.0, 1.0, 0.0, None, 3)
        for robot, at_s in (("scout", 1_700_000_000), ("patrol", 1_700_000_000), ("navigator", 5))
        for i in range(20)
    ]
    run = said(tmp_path / "run.mcap", DEMO, tracks)
    assert run.duration_s == pytest.approx(19.0)
    assert "20 estimates have stamps outside of the run" in page_of(run).words


def test_bins_keep_the_largest_and_the_gaps() -> None:
    import numpy as np

    times_s = np.concatenate([np.arange(0.0, 100.0, 0.1), np.arange(200.0, 300.0, 0.1)])
    values = np.ones(len(times_s))
    values[777] = 9.0
    at_s, most = binned(times_s, values)
    assert np.nanmax(most) == 9.0
    assert len(at_s) <= 260
    assert np.isnan(most[(at_s > 102.0) & (at_s < 198.0)]).all()
    assert np.nanmax(binned(times_s, values, is_mean=True)[1]) < 3.0
