"""A team on a log, and its evaluation."""

import math
import re
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console
from support.logs import EPOCH_MS, LANDMARKS, STARTS, STEP_MS, log_team, write_log
from support.sweeps import thorough

from cpcbl_agents.robot_state import miscalibration_text
from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.lab.evaluation import evaluate_log
from cpcbl_launch.lab.experiments import budget
from cpcbl_launch.reporting.recorder import LearnedReport, Report
from cpcbl_launch.run.logged_team import (
    LoggedTeam,
    builtin_for,
    is_calibrated_on,
    load_logged_team,
    with_duration,
    with_unknown_starts,
)
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.team.overrides import Overrides, with_blind_robots, with_overrides
from cpcbl_launch.views.run import print_report
from cpcbl_team.config import (
    LocalizerSettings,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
)
from cpcbl_team.errors import InputError
from cpcbl_transport.compact import BELIEF_BYTES, FIX_BYTES, sent_bytes

MILLIMETRE = 1e-3
OF_FIXES_M = 0.002  # a fix stands farther than its reading, for noisy ones are too near on average
TURNING_MATE_M = 0.03  # a teammate that stops is believed to drive on until that is half a sigma
EPOCH_NS = EPOCH_MS * 1_000_000
ALL = ("1", "2", "3", "4", "5")


def logged(folder: Path, *robots: str, **options: Any) -> LoggedTeam:
    write_log(folder, robots or ("1", "2"), **options)
    return load_logged_team(log_team(*ALL), folder)


def report(team: LoggedTeam, duration_s: float | None = None) -> Any:
    """The evaluation as a reader of its JSON sees it."""
    return msgspec.json.decode(
        msgspec.json.encode(evaluate_log(with_duration(team, duration_s)).report)
    )


# The team on the log ----------------------------------------------------------------------------


def test_robots_start_at_their_true_poses_on_the_logs_map(tmp_path: Path) -> None:
    on = logged(tmp_path)
    assert list(on.team.robots) == ["1", "2"]
    assert {n: (m.x_m, m.y_m) for n, m in on.team.map.landmarks.items()} == LANDMARKS
    for name, robot in on.team.robots.items():
        assert robot.start is not None
        assert (robot.start.x_m, robot.start.y_m) == pytest.approx(STARTS[name][:2])
        heading = math.radians(robot.start.heading_deg)
        assert math.remainder(heading - STARTS[name].heading, math.tau) == pytest.approx(0.0)
    assert (on.start_ns, on.end_ns) == (EPOCH_NS, EPOCH_NS + 10_000_000_000)


def test_robots_without_a_log_are_left_out_by_name(tmp_path: Path) -> None:
    on = logged(tmp_path, "1", "3", "4", "5")
    assert on.left_out == {
        "2": "no Robot2_Odometry.dat, Robot2_Measurement.dat, Robot2_Groundtruth.dat"
    }
    assert report(on, 1.0)["left_out"] == on.left_out


def test_a_robot_that_is_left_out_may_be_blind(tmp_path: Path) -> None:
    on = logged(tmp_path, "1", "3", "4", "5")
    team = with_blind_robots(on.team, ["2", "3"], on.left_out)
    assert [n for n, r in team.robots.items() if not r.sensor.sees_landmarks] == ["3"]
    with pytest.raises(InputError, match="has no robot 9"):
        with_blind_robots(on.team, ["2", "9"], on.left_out)


def test_robots_find_themselves_on_a_log_whose_starts_they_do_not_know(tmp_path: Path) -> None:
    on = logged(tmp_path)
    assert report(on, 1.0)["starts"] == "robots started at the true pose, with a σ of 0.05 m"
    figures = report(with_unknown_starts(on))
    assert figures["starts"] == "no robot knew where it started"
    for robot in figures["robots"].values():
        assert robot["lost_at_end"] == ""
        assert robot["counts"]["found_again"] == 1


def start_with_truth_after(folder: Path, seconds: float) -> Start | None:
    """The start of robot 1 when its truth begins later than its odometry."""
    write_log(folder, seconds=seconds + 2.0)
    path = folder / "Robot1_Groundtruth.dat"
    rows = [row for row in path.read_text().splitlines() if not row.startswith("#")]
    path.write_text("\n".join(rows[round(seconds * 1000) // STEP_MS :]))
    return load_logged_team(log_team("1", "2"), folder).team.robots["1"].start


@pytest.mark.parametrize("seconds", [0.1, 0.34, 2.0, 5.5])
def test_truth_that_begins_late_is_carried_back_along_the_odometry(
    tmp_path: Path, seconds: float
) -> None:
    start, true = start_with_truth_after(tmp_path, seconds), STARTS["1"]
    assert start is not None
    assert (start.x_m, start.y_m) == pytest.approx((true.x, true.y), abs=MILLIMETRE)
    assert start.heading_deg == pytest.approx(math.degrees(true.heading), abs=0.1)
    assert start.sigma_m > 0.05


def test_a_robot_whose_truth_begins_too_late_does_not_know_its_start(tmp_path: Path) -> None:
    assert start_with_truth_after(tmp_path, 31.0) is None


def test_a_log_with_none_of_the_robots_is_an_error(tmp_path: Path) -> None:
    write_log(tmp_path, ("1", "2"), seconds=1.0)
    with pytest.raises(LogError, match=r"none of the robots 4, 5"):
        load_logged_team(log_team("4", "5"), tmp_path)


def test_a_robot_that_would_not_read_its_log_is_refused(tmp_path: Path) -> None:
    write_log(tmp_path, ("1", "2"), seconds=1.0)
    team = log_team("1", "2", "3")
    robots = {**team.robots, "3": RobotSettings()}  # without files: left out, whatever it reads
    assert load_logged_team(
        msgspec.structs.replace(team, robots=robots), tmp_path
    ).left_out.keys() == {"3"}
    robots["2"] = RobotSettings(source="external")
    with pytest.raises(InputError, match=r'robots\.2\.source: external: .* source = "mrclam"'):
        load_logged_team(msgspec.structs.replace(team, robots=robots), tmp_path)


@pytest.mark.parametrize("duration_s", [-1.0, 0.0, math.inf, math.nan])
def test_so_much_of_a_log_cannot_be_used(duration_s: float, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least 1 seconds of robot time"):
        with_duration(logged(tmp_path), duration_s)


def test_a_budget_is_not_held_where_nothing_can_be_scored(tmp_path: Path) -> None:
    on, case = logged(tmp_path, seconds=8.0), budget.cases()[0]
    assert budget.measure_point(budget.runs_of_log(on), case).position_rmse_m < MILLIMETRE
    late = {name: rows[rows[:, 0] > EPOCH_MS * 1e-3 + 6.0] for name, rows in on.truth.items()}
    with pytest.raises(InputError, match=r"no truth in these 2 s; take more of the log"):
        budget.measure_point(budget.runs_of_log(with_duration(on._replace(truth=late), 2.0)), case)


def test_blinding_takes_landmarks_from_the_named_robots_only(tmp_path: Path) -> None:
    team = with_blind_robots(log_team("1", "2", "3"), ["3", "1"])
    assert [r.sensor.sees_landmarks for r in team.robots.values()] == [False, True, False]
    assert with_blind_robots(team, []) == team


def test_blinding_an_unknown_robot_names_it_and_those_there_are() -> None:
    with pytest.raises(InputError, match=r"has no robot 7, x; there are 1, 2"):
        with_blind_robots(log_team("1", "2"), ["x", "1", "7"])


def test_choices_are_made_for_all_robots_and_nothing_else() -> None:
    team = log_team("1", "2")
    assert with_overrides(team, Overrides()) == team
    choice = Overrides(None, None, None, "oval", "passive", "naive", "both-ways")
    picked = with_overrides(team, choice)
    for robot in picked.robots.values():
        rules = robot.collaboration
        assert robot.localizer.variant == "oval"
        assert (rules.passive, rules.active) == (True, False)
        assert (rules.fusion, rules.direction) == ("naive", "both-ways")
    assert picked.robots.keys() == team.robots.keys()


# Its evaluation ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [{}, *map(thorough, ({"recovered": ALL}, {"backwards": True}, {"unknown_barcode": True}))],
    ids=["plain", "recovered truth", "backwards stamps", "unknown barcode"],
)
@pytest.mark.parametrize(
    ("kinds", "limit_m"),
    [
        pytest.param("none", MILLIMETRE, marks=pytest.mark.thorough),
        pytest.param("active", OF_FIXES_M, marks=pytest.mark.thorough),
        ("both", TURNING_MATE_M),
    ],
)
@pytest.mark.parametrize("blind", [[], ["2"]], ids=["full map", "blind"])
def test_a_log_without_noise_gives_no_errors(
    tmp_path: Path, options: dict[str, Any], kinds: str, limit_m: float, blind: list[str]
) -> None:
    on = logged(tmp_path, **options)
    team = with_overrides(with_blind_robots(on.team, blind), Overrides(collaboration=kinds))
    for name, robot in report(on._replace(team=team))["robots"].items():
        assert robot["samples"] > 90
        assert robot["position_max_m"] < limit_m
        assert robot["heading_rmse_deg"] < 0.5
        assert robot["inside_3_sigma"] == 1.0
        assert robot["lost_share"] == 0.0
        assert (robot["counts"].get("accepted", 0) > 20) is (name not in blind or kinds != "none")


def test_barcodes_that_nobody_carries_are_in_the_report(tmp_path: Path) -> None:
    counts = report(logged(tmp_path, unknown_barcode=True))["robots"]["1"]["counts"]
    assert counts["unknown_object"] == counts["sightings"] > 40


def test_an_evaluation_sees_errors_where_there_are_some(tmp_path: Path) -> None:
    on = logged(tmp_path)
    truth = {name: rows + np.array([0.0, 0.3, 0.4, 0.1]) for name, rows in on.truth.items()}
    team = with_overrides(on.team, Overrides(collaboration="none"))
    robot = report(on._replace(team=team, truth=truth))["robots"]["1"]
    for figure in ("position_rmse_m", "position_mean_m", "position_max_m"):
        assert robot[figure] == pytest.approx(0.5, abs=MILLIMETRE)
    assert robot["heading_rmse_deg"] == pytest.approx(math.degrees(0.1), abs=0.01)
    assert robot["inside_3_sigma"] < 0.5


def test_times_far_from_any_truth_are_not_scored(tmp_path: Path) -> None:
    on = logged(tmp_path)
    truth = {name: rows[rows[:, 0] < EPOCH_MS * 1e-3 + 2.0] for name, rows in on.truth.items()}
    everywhere, scored = (report(x)["robots"]["1"] for x in (on, on._replace(truth=truth)))
    assert everywhere["samples"] == pytest.approx(100, abs=2)
    assert scored["samples"] == pytest.approx(21, abs=2)
    assert everywhere["scored_share"] == pytest.approx(1.0, abs=0.02)
    assert scored["scored_share"] == pytest.approx(0.21, abs=0.02)


def test_the_report_has_the_promised_keys(tmp_path: Path) -> None:
    figures = report(logged(tmp_path, seconds=3.0))
    assert set(figures) >= {"robots", "team"}
    assert set(figures["robots"]) == {"1", "2"}
    for robot in figures["robots"].values():
        assert set(robot) >= {
            "position_rmse_m",
            "position_mean_m",
            "position_max_m",
            "heading_rmse_deg",
            "inside_3_sigma",
            "nees",
            "messages_sent",
            "bytes_sent",
        }
        assert all(robot[k] is not None for k in robot if k.endswith(("_m", "_deg", "nees")))
    assert figures["team"]["position_rmse_m"] == pytest.approx(
        np.mean([r["position_rmse_m"] for r in figures["robots"].values()])
    )
    assert figures["duration_s"] == pytest.approx(3.0)


def test_what_one_robot_sends_another_receives(tmp_path: Path) -> None:
    on = logged(tmp_path)
    poor = msgspec.structs.replace(
        on.team.robots["2"],
        sensor=msgspec.structs.replace(
            RobotSettings().sensor, range_share=0.3, bearing_sigma_deg=20.0
        ),
    )
    team = msgspec.structs.replace(on.team, robots={**on.team.robots, "2": poor})
    better, worse = report(on._replace(team=team))["robots"].values()
    assert worse["messages_received"] > 20
    assert worse["messages_received"] == pytest.approx(better["messages_sent"], abs=10)
    least, most = sent_bytes(FIX_BYTES), sent_bytes(BELIEF_BYTES)
    assert least <= better["bytes_sent"] / better["messages_sent"] <= most


def wrong_about_wheels(on: LoggedTeam, *learners: str) -> LoggedTeam:
    """The team believes in 5 % more of way and turn than there is; some of its robots learn."""
    replace = msgspec.structs.replace
    robots = {
        name: replace(
            robot,
            odometry=OdometrySettings(distance_scale=1.05, turn_scale=1.05),
            sensor=SensorSettings(range_share=0.005, bearing_sigma_deg=0.5),
            localizer=LocalizerSettings(self_calibration=name in learners),
        )
        for name, robot in on.team.robots.items()
    }
    return on._replace(team=replace(on.team, robots=robots))


def printed(evaluation: Report) -> list[str]:
    """The lines of the report for people."""
    paper = StringIO()
    print_report(evaluation, Console(file=paper, width=80))
    return paper.getvalue().splitlines()


def test_what_robots_have_learned_is_in_the_report(tmp_path: Path) -> None:
    on = wrong_about_wheels(logged(tmp_path, seconds=30.0), "1")
    evaluation = evaluate_log(on).report
    learned = {name: robot.learned for name, robot in evaluation.robots.items()}
    found = learned["1"]
    assert learned == {"1": found, "2": None}
    assert found is not None
    assert (found.distance_scale, found.turn_scale) == pytest.approx((1 / 1.05, 1 / 1.05), abs=0.01)
    assert found.bearing_bias_deg == pytest.approx(0.0, abs=0.3)
    figures = msgspec.json.decode(msgspec.json.encode(evaluation))["robots"]
    assert figures["1"]["learned"] == msgspec.structs.asdict(found)
    assert figures["2"]["learned"] is None
    (line,) = [row for row in printed(evaluation) if "calibrated itself" in row]
    assert re.fullmatch(
        r"Robot 1 calibrated itself: distance × 0\.9\d, turn × 0\.9\d, bearings [+-]0\.\d°\.", line
    )


def test_the_remark_says_what_is_done_to_readings(tmp_path: Path) -> None:
    evaluation = evaluate_log(logged(tmp_path, seconds=1.0)).report
    found = LearnedReport(distance_scale=0.976, turn_scale=0.96, bearing_bias_deg=0.62)
    robots = {"1": msgspec.structs.replace(evaluation.robots["1"], learned=found)}
    said = "Robot 1 calibrated itself: distance × 0.98, turn × 0.96, bearings -0.6°."
    assert said in printed(msgspec.structs.replace(evaluation, robots=robots))


def test_the_remark_says_what_is_wrong_with_the_settings(tmp_path: Path) -> None:
    evaluation = evaluate_log(logged(tmp_path, seconds=1.0)).report
    counts = {"accepted": 985, "gated": 15, "miscalibrated": 2, "odometry_sigma_percent": 210}
    counts["misplaced_m2"] = 1
    robots = {"1": msgspec.structs.replace(evaluation.robots["1"], counts=counts)}
    text = (
        "Robot 1 is miscalibrated: σ of its odometry × 2.1, 1.5% of observations rejected."
        " Run `cpcbl-team calibrate`."
        " Robot 1 finds m2 elsewhere than on the map: not used. Measure its place again."
    )
    shown = " ".join(printed(msgspec.structs.replace(evaluation, robots=robots)))
    assert text in " ".join(shown.split())


def test_a_robot_whose_settings_fit_again_is_not_called_miscalibrated() -> None:
    """The count tells of every change since the start, the other counts of what differs now."""
    counts = {"accepted": 985, "gated": 15, "miscalibrated": 2}
    assert miscalibration_text(counts, None) == ""
    assert miscalibration_text(counts | {"odometry_sigma_percent": 210}, None) != ""
    assert miscalibration_text(counts, (0.9, 1.0, 0.0)) == "1.5% of observations rejected"
    assert miscalibration_text(counts, (0.99, 1.01, -0.01)) == ""  # as any robot that drives
    assert miscalibration_text(counts, (1.0, 1.0, -0.05)) != ""


def test_an_evaluation_can_stop_early(tmp_path: Path) -> None:
    figures = report(logged(tmp_path), 2.0)
    assert figures["duration_s"] == pytest.approx(2.0)
    assert figures["robots"]["1"]["samples"] == pytest.approx(20, abs=1)


def test_progress_rises_to_the_end(tmp_path: Path) -> None:
    shown: list[float] = []
    evaluate_log(logged(tmp_path, seconds=2.0), progress=shown.append)
    assert shown == sorted(shown)
    assert shown[-1] == 1.0


def test_two_evaluations_give_equal_reports(tmp_path: Path) -> None:
    on = logged(tmp_path, *ALL, seconds=5.0, unknown_barcode=True)
    first, second = (msgspec.json.encode(evaluate_log(on).report) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("folder", ["MRCLAM2", "MRCLAM_Dataset4", "somewhere/MRCLAM6", "MRCLAM9"])
def test_a_built_in_team_is_not_judged_on_what_it_was_calibrated_on(folder: str) -> None:
    number, file = folder[-1], builtin_for(Path(folder))
    team = load_team(file)
    assert file.stem == ("mrclam" if number == "9" else f"mrclam-without-{number}")
    assert not is_calibrated_on(team, Path(folder))
    assert is_calibrated_on(load_team(builtin_path("mrclam")), Path(folder)) == (number != "9")


@pytest.mark.parametrize("named", [".", "../MRCLAM6/", "../latest"])
def test_a_data_set_is_known_however_its_folder_is_named(
    named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "MRCLAM6").mkdir()
    (tmp_path / "latest").symlink_to("MRCLAM6")
    monkeypatch.chdir(tmp_path / "MRCLAM6")
    assert builtin_for(Path(named)).stem == "mrclam-without-6"
    assert is_calibrated_on(load_team(builtin_path("mrclam")), Path(named))
