"""Budgets of the command line: for all robots, in simulations and on logs."""

import io
import json
from pathlib import Path

import pytest
from rich.console import Console
from support.logs import write_log
from support.processes import command_line
from support.traffic import TEAM, status

from cpcbl_launch.cli import main
from cpcbl_launch.team.file import parse_team
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_launch.views.traffic import (
    Arrival,
    traffic_from_statuses,
)
from cpcbl_launch.views.traffic_tables import traffic_view


def test_budgets_of_a_command_line_are_those_of_all_robots() -> None:
    team = parse_team(TEAM)
    assert with_overrides(team, Overrides()) == team
    limited = with_overrides(
        team, Overrides(bytes_per_s=50.0, messages_per_minute=2.5, match_messages=1200)
    )
    for robot in limited.robots.values():
        budget = robot.collaboration.budget
        assert (budget.bytes_per_s, budget.messages_per_minute) == (50.0, 2.5)
    assert limited.match.messages == 1200
    assert limited.messages_per_s("driver") == pytest.approx(1200 / 3 / 1200)
    free = with_overrides(limited, Overrides(bytes_per_s=0.0, match_messages=0)).robots["miser"]
    assert free.collaboration.budget.bytes_per_s == 0.0
    assert free.collaboration.budget.messages_per_minute == 2.5


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["simulate", "demo", "--bytes-per-s", "inf"], "--bytes-per-s inf"),
        (["up", "demo", "--messages-per-minute", "inf"], "--messages-per-minute inf"),
        (["traffic", "demo", "--duration", "0"], "--duration 0"),
        (["traffic", "nowhere.toml"], "nowhere.toml: no such file"),
    ],
)
def test_what_the_user_can_mend_is_one_line(
    arguments: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("sys.argv", ["cpcbl-team", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_simulated_team_keeps_to_a_tiny_budget(tmp_path: Path) -> None:
    path = tmp_path / "trio.toml"
    path.write_text(TEAM)
    options = ["--bytes-per-s", 20, "--match-messages", 6000, "--duration", 25]
    ran = command_line("simulate", path, *options, "--json")
    assert ran.returncode == 0, ran.stderr
    report = json.loads(ran.stdout)
    assert report["team"]["within_budget"] is True
    for robot in report["robots"].values():
        window, match = robot["spending"]
        assert (window["unit"], window["allowed"], window["window_s"]) == ("bytes", 500.0, 25.0)
        assert robot["bytes_sent"] <= window["most"] <= window["allowed"]
        assert (match["unit"], match["window_s"]) == ("messages", 0.0)
        assert robot["messages_sent"] <= match["most"] <= match["allowed"] <= 42
    for name in ("giver", "miser"):
        assert sum(f["over_budget"] for f in report["robots"][name]["sent"]) > 50
    assert sum(r["messages_sent"] for r in report["robots"].values()) > 0


def test_a_log_is_evaluated_with_a_budget(tmp_path: Path) -> None:
    write_log(tmp_path, ("1", "2"), seconds=20.0)
    options = ["--blind", "2", "--messages-per-minute", 375.5]
    ran = command_line("evaluate", "mrclam-uncalibrated", tmp_path, *options, "--json")
    assert ran.returncode == 0, ran.stderr
    report = json.loads(ran.stdout)
    (limit,) = report["robots"]["1"]["spending"]
    assert (limit["window_s"], limit["allowed"]) == (60.0 * 376 / 375.5, 376.0)
    assert 0 < report["robots"]["1"]["messages_sent"] <= limit["most"] <= 376.0
    assert sum(f["over_budget"] for f in report["robots"]["1"]["sent"]) > 0


def test_who_is_not_in_the_team_file_is_shown_as_a_guest() -> None:
    seen = {name: [Arrival(1.0, status(name, 1, 3))] for name in ("r1", "tripod")}
    now = traffic_from_statuses("t", ["r1"], seen, 0.0, 1.0)
    assert now.guests == ("tripod",)
    console = Console(file=io.StringIO(), width=80)
    with console.capture() as capture:
        console.print(traffic_view(now, "here"))
    assert "tripod, guest" in capture.get()
    assert traffic_from_statuses("t", [], seen, 0.0, 1.0).guests == ()  # nobody knows
