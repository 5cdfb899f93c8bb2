"""Real robots, whose errors are correlated and unmodelled, are honest: they are believed."""

import os
from functools import cache, partial
from pathlib import Path

import msgspec
import pytest

from cpcbl_launch.lab.evaluation import evaluate_log
from cpcbl_launch.lab.faulty_robot import Fault, FaultyBus
from cpcbl_launch.reporting.metrics import score
from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.run import logged_team
from cpcbl_launch.simulation.in_process import robot_nodes, run_nodes
from cpcbl_launch.team.file import load_team
from cpcbl_launch.team.overrides import with_blind_robots
from cpcbl_team.config import Team, TrustSettings
from cpcbl_transport.memory_bus import MemoryHub

pytestmark = [pytest.mark.log, pytest.mark.timeout(900)]
LOGS = Path(os.environ.get("CPCBL_MRCLAM", "."))


def judging(team: Team, enabled: bool) -> Team:
    replace, trust = msgspec.structs.replace, TrustSettings(enabled=enabled)
    robots = {
        name: replace(robot, collaboration=replace(robot.collaboration, trust=trust))
        for name, robot in team.robots.items()
    }
    return replace(team, robots=robots)


def logged(name: str, enabled: bool) -> logged_team.LoggedTeam:
    folder = LOGS / name
    found = logged_team.load_logged_team(
        judging(load_team(logged_team.builtin_for(folder)), enabled), folder
    )
    return found._replace(team=with_blind_robots(found.team, ["3", "4", "5"]))


@cache
def judged(name: str) -> Report:
    return evaluate_log(logged(name, True)).report


def quarantines(report: Report) -> int:
    return sum(robot.counts.get("quarantined", 0) for robot in report.robots.values())


@pytest.mark.parametrize("name", ["MRCLAM2", "MRCLAM4", "MRCLAM6"])
def test_honest_robots_are_hardly_ever_quarantined_and_nobody_gets_worse(name: str) -> None:
    report, believing = judged(name), evaluate_log(logged(name, False)).report
    assert quarantines(report) <= 1  # in five robots' quarter of an hour and more
    assert not any(trust.reason for robot in report.robots.values() for trust in robot.trust)
    assert report.team.position_rmse_m is not None
    assert believing.team.position_rmse_m is not None
    assert report.team.position_rmse_m <= 1.01 * believing.team.position_rmse_m


def test_a_robot_that_sees_landmarks_is_not_harmed_by_a_liar() -> None:
    """The blind ones are, here: one liar and one honest robot help them, and they each other."""
    log = logged("MRCLAM6", True)
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    fault = Fault.parse("bias:1.0,1.0@300-900")
    through = {"1": partial(FaultyBus, fault=fault, name="1", start_ns=log.start_ns)}
    nodes = robot_nodes(log.team, hub, log.start_ns, through)
    run_nodes(nodes, log.start_ns, log.start_ns + 600 * 10**9)
    assert [t.peer for t in recorder.status["2"].trust if t.quarantines] == ["1"]
    lied_s = log.start_ns * 1e-9 + 300.0
    figures = score(recorder.samples("2", log.truth["2"], from_s=lied_s))
    assert figures.position_rmse_m is not None
    assert figures.position_rmse_m < 0.1  # 0.07 m where it believes all, too: docs/attacks.md
