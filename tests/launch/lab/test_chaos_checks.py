"""Checks of fault scenarios, and the figures that are computed from the log of a run."""

import pytest
from msgspec.structs import replace
from support.chaos import (
    run_log_of,
    status_at,
    token_appeared,
    token_disappeared,
    tracks_of,
)

from cpcbl_launch.lab.chaos.checks import ChaosReport, Check, Outcome, report_data

AT_S = 10.0
GOOD = run_log_of([tracks_of("a"), tracks_of("b")])


def outcome(*checks: Check) -> Outcome:
    return Outcome(scenario="s", done="d", expectation="e", checks=checks)


@pytest.mark.parametrize(
    ("check", "held", "said"),
    [
        (Check(what="gap", seen=0.5, unit="s", at_most=1.0), True, "gap 0.5 s (≤ 1 s)"),
        (Check(what="gap", seen=1.5, unit="s", at_most=1.0), False, "gap 1.5 s (≤ 1 s)"),
        (Check(what="gap", seen=None, unit="s", at_most=1.0), False, "gap not seen (≤ 1 s)"),
        (Check(what="gap", seen=float("nan"), at_most=1.0), False, "gap nan (≤ 1)"),
        (Check(what="in", seen=0.95, unit="%", at_least=0.9), True, "in 95 % (≥ 90 %)"),
        (Check(what="n", seen=3, at_least=3, at_most=3), True, "n 3 (= 3)"),
        (Check(what="n", seen=4, at_least=3, at_most=3), False, "n 4 (= 3)"),
    ],
)
def test_a_check_is_met_within_its_bounds_and_shows_both(
    check: Check, held: bool, said: str
) -> None:
    assert check.is_met is held
    assert str(check) == said


def test_an_outcome_without_a_check_is_not_met() -> None:
    good = outcome(Check(what="n", seen=1, at_least=1))
    assert good.is_met is True
    assert outcome().is_met is False
    assert replace(good, failed="no router").is_met is False
    assert replace(outcome(), not_run="needs root").is_met is None


def test_a_scenario_that_was_not_run_violates_nothing_and_is_in_the_report() -> None:
    skipped = replace(outcome(), not_run="needs root")
    good = ChaosReport(version="1", seed=1, machine="m", outcomes=(skipped,))
    assert good.is_met
    bad = outcome(Check(what="n", seen=0, at_least=1))
    data = report_data(replace(good, outcomes=(skipped, bad)))
    assert data["held"] is False
    assert [o["held"] for o in data["outcomes"]] == [None, False]
    assert data["outcomes"][1]["checks"][0]["held"] is False


# Figures ------------------------------------------------------------------------------------------


def test_a_robot_is_gone_when_its_last_token_is() -> None:
    tokens = [
        token_appeared(0, "a"),
        token_appeared(9, "a", tier="4"),
        token_disappeared(9.1, "a"),
        token_disappeared(10.5, "a", tier="4"),
    ]
    assert run_log_of([], tokens).token_gone_after_s("a", AT_S) == pytest.approx(0.5)
    assert run_log_of([], tokens[:3]).token_gone_after_s("a", AT_S) is None


def test_a_robot_is_back_with_another_process() -> None:
    tokens = [
        token_appeared(0, "a"),
        token_appeared(11.0, "a"),
        token_appeared(12.0, "a", "2"),
        token_appeared(11.5, "b", "2"),
    ]
    assert run_log_of([], tokens).token_back_after_s("a", AT_S, "1") == pytest.approx(2.0)
    assert run_log_of([], tokens[:2]).token_back_after_s("a", AT_S, "1") is None


def test_a_robot_is_localized_when_it_stays_correct_for_a_second() -> None:
    flickers = tracks_of("a", lambda s: 1.0 if s < 12.0 or 12.5 < s < 14.0 else 0.1)
    assert run_log_of([flickers]).localized_after_s("a", AT_S, 0.3) == pytest.approx(4.0)
    lost = tracks_of("a", lost=(0.0, 15.0))
    assert run_log_of([lost]).localized_after_s("a", AT_S, 0.3) == pytest.approx(5.0)
    assert run_log_of([lost]).reported_lost_after_s("a", AT_S) == pytest.approx(0.0)
    said = [status_at("a", 9.5, {"lost": 1}), status_at("a", 10.5, {"lost": 2})]
    assert run_log_of([tracks_of("a")], (), said).reported_lost_after_s("a", AT_S) == pytest.approx(
        0.5
    )
    assert run_log_of([tracks_of("a")], (), said[:1]).reported_lost_after_s("a", AT_S) is None
    never = tracks_of("a", lambda s: 1.0)
    assert run_log_of([never]).localized_after_s("a", AT_S, 0.3) is None


def test_gap_error_and_delay_are_those_of_the_window() -> None:
    notes = run_log_of(
        [tracks_of("a", lambda s: 3.0 if s >= 20.0 else 0.3, (12.0, 15.0), late_s=0.2)]
    )
    assert notes.longest_track_gap_s("a", AT_S, 20.0) == pytest.approx(3.1, abs=0.11)
    assert notes.longest_track_gap_s("a", 16.0, 20.0) == pytest.approx(0.1, abs=0.11)
    assert notes.longest_track_gap_s("nobody", 16.0, 20.0) == pytest.approx(4.0)
    assert notes.position_rmse_m("a", AT_S, 20.0) == pytest.approx(0.3)
    assert notes.position_rmse_m("a", 20.0) == pytest.approx(3.0)
    assert notes.track_delay_s("a", AT_S, 20.0) == pytest.approx(0.2)


def test_counts_are_those_of_the_window_over_all_processes() -> None:
    statuses = [
        status_at("a", 9.0, {"garbage": 5}),
        status_at("a", 11.0, {"garbage": 7}),
        status_at("a", 13.0, {"garbage": 3}, incarnation="2"),
        status_at("a", 30.0, {"garbage": 99}, incarnation="2"),
    ]
    assert run_log_of([], (), statuses).counts_between("a", AT_S, 20.0)["garbage"] == 2 + 3
