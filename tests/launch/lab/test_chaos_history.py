"""Faults that overlap: their plan, what holds of any history, and when a figure can be judged."""

import json
import random
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.buses import wait_until
from support.chaos import (
    hearing_at,
    run_log_of,
    spending_at,
    status_at,
    token_appeared,
    token_disappeared,
    tracks_of,
    unmet_checks,
)
from support.processes import command_line
from support.sweeps import thorough

from cpcbl_launch.lab.chaos.checks import Check, Outcome, at_most, equal_to, excused_by_load
from cpcbl_launch.lab.chaos.consistency import (
    chi_square_quantile,
    consistency,
    correlation_samples,
    poisson_quantile,
)
from cpcbl_launch.lab.chaos.history import (
    Span,
    invariants,
    longest_false_claim_s,
    spent_shares,
    uphill_messages,
    without,
    write_history,
)
from cpcbl_launch.lab.chaos.machine import MachineLog, MachineWatch
from cpcbl_launch.lab.chaos.nemesis import FAULTS, INSTANT
from cpcbl_launch.lab.chaos.runner import select_scenarios
from cpcbl_launch.lab.chaos.scenario import TeamFault
from cpcbl_launch.lab.chaos.schedule import largest_overlap, schedule
from cpcbl_launch.lab.experiments.runs import with_settings
from cpcbl_launch.reporting.metrics import Samples
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_transport.messages import Spending

ROBOTS = ["a", "b", "c"]
TARGETS = dict.fromkeys(FAULTS, ROBOTS)

# The plan -----------------------------------------------------------------------------------------


def test_a_seed_determines_the_faults_and_they_overlap() -> None:
    plan = schedule(4, 60.0, TARGETS, INSTANT)
    assert plan == schedule(4, 60.0, TARGETS, INSTANT) != schedule(5, 60.0, TARGETS, INSTANT)
    assert {fault.name for fault in plan} == FAULTS.keys()
    assert largest_overlap(plan) >= 3
    assert all(0.0 < f.from_s < f.until_s <= 60.0 for f in plan)


@pytest.mark.parametrize("seed", range(20))
def test_no_fault_begins_again_on_a_target_before_it_ended(seed: int) -> None:
    plan = schedule(seed, 300.0, TARGETS, INSTANT)
    for n, fault in enumerate(plan):
        same = [f for f in plan[:n] if (f.name, f.target) == (fault.name, fault.target)]
        assert all(f.until_s < fault.from_s for f in same)


# Invariants ---------------------------------------------------------------------------------------


def test_a_history_without_an_offence() -> None:
    tokens = [token_appeared(1.0, "a"), token_disappeared(2.0, "a"), token_appeared(3.0, "a", "2")]
    said = [hearing_at("a", 20.0, "b", 0), hearing_at("a", 21.0, "b", 9)]
    tracks = [tracks_of("a", tier=5), tracks_of("b", tier=3)]
    log = run_log_of(tracks, [*tokens, token_appeared(1.0, "b")], said)
    assert not unmet_checks(invariants(log, ["a", "b"], 60.0, 80.0))


def test_offences_of_a_history() -> None:
    tokens = [token_appeared(1.0, "a"), token_disappeared(2.0, "a"), token_appeared(1.0, "b")]
    budget = Spending("bytes", 10.0, 100.0, 90.0)
    said = [
        *(hearing_at("b", 20.0, "a", 0), hearing_at("b", 21.0, "a", 4)),
        *(spending_at("a", 30.0, 0, budget), spending_at("a", 35.0, 120, budget)),
    ]
    tracks = [tracks_of("a", lambda s: 0.9, tier=5), tracks_of("b", tier=3)]
    assert unmet_checks(invariants(run_log_of(tracks, tokens, said), ["a", "b"], 60.0, 80.0)) == {
        "from the last fault until all were localized",
        "robots without a token at the end",
        "messages that flowed uphill",
        "largest use of a budget in any window",
        "whole run, NEES",
        "longest claim that was false by 5 σ",
    }


def test_help_flows_uphill_only_if_its_sender_was_never_better() -> None:
    said = [hearing_at("a", 20.0, "b", 2), hearing_at("a", 21.0, "b", 7)]
    for own, theirs, uphill in ((5, 3, []), (3, 3, [5]), (3, 5, [5])):
        log = run_log_of([tracks_of("a", tier=own), tracks_of("b", tier=theirs)], (), said)
        assert list(uphill_messages(log, "a")) == uphill
        assert list(uphill_messages(log, "a", [Span("b", 10.0, 20.0)])) == []
    restarted = [said[0], status_at("a", 21.0, incarnation="2")]
    log = run_log_of([tracks_of("a"), tracks_of("b")], (), restarted)
    assert list(uphill_messages(log, "a")) == []


def test_a_budget_is_judged_in_every_window_of_each_process() -> None:
    budget = Spending("bytes", 10.0, 100.0, 100.0)
    slow = [spending_at("a", float(s), 9 * s, budget) for s in range(60)]
    assert max(spent_shares(run_log_of([tracks_of("a")], (), slow), "a")) == 1.0
    burst = [*slow, spending_at("a", 60.0, 9 * 59 + 100, budget)]
    assert max(spent_shares(run_log_of([tracks_of("a")], (), burst), "a")) > 1.0
    admitted = [spending_at("a", 1.0, 0, Spending("bytes", 10.0, 100.0, 130.0))]
    assert max(spent_shares(run_log_of([tracks_of("a")], (), admitted), "a")) == 1.3


def test_a_robot_that_says_that_it_is_lost_claims_nothing() -> None:
    wrong = tracks_of("a", lambda s: 1.0 if 20.0 <= s < 30.0 else 0.0)
    assert longest_false_claim_s(run_log_of([wrong]), "a") == pytest.approx(9.9)
    honest = tracks_of("a", lambda s: 1.0 if 20.0 <= s < 30.0 else 0.0, lost=(22.0, 30.0))
    assert longest_false_claim_s(run_log_of([honest]), "a") == pytest.approx(1.9)
    left_out = without(run_log_of([wrong]), [Span("a", 20.0, 31.0)])
    assert longest_false_claim_s(left_out, "a") == 0.0


def test_a_claim_does_not_go_on_through_a_time_that_is_not_judged() -> None:
    wrong = tracks_of("a", lambda s: 1.0 if 20.0 <= s < 40.0 else 0.0)
    judged = without(run_log_of([wrong]), [Span("a", 22.0, 37.0)])
    assert longest_false_claim_s(judged, "a") == pytest.approx(2.9)  # from 37 s on
    twice = without(judged, [Span("a", 38.0, 39.0)])
    assert longest_false_claim_s(twice, "a") == pytest.approx(1.9)  # before 22 s
    lost_between = tracks_of("a", lambda s: 1.0 if 20.0 <= s < 40.0 else 0.0, lost=(22.0, 37.0))
    assert longest_false_claim_s(run_log_of([lost_between]), "a") == pytest.approx(2.9)


def test_a_history_is_written_as_lines_of_json(tmp_path: Path) -> None:
    (fault, *_), path = schedule(1, 60.0, TARGETS, INSTANT), tmp_path / "what.jsonl"
    log = run_log_of([tracks_of("a")], [token_appeared(1.0, "a")], [status_at("a", 2.0)])
    write_history(path, 7, [fault], log, [equal_to("uphill", 3, 0)])
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert rows[0] == {"seed": 7}
    assert rows[1]["fault"]["name"] == fault.name
    assert rows[2] == {"check": "uphill 3 (= 0)", "held": False}
    assert rows[3]["token"]["robot"] == rows[4]["status"]["robot"] == rows[5]["track"]["robot"]
    assert rows[-1]["truth"] == "a"
    assert len(rows[-1]["rows"]) == len(log.truth["a"])


# Consistency --------------------------------------------------------------------------------------


def drifting(seed: int, count: int, memory: float, scale: float = 1.0) -> Samples:
    """Samples of a robot whose errors have so much memory from track to track."""
    dice = random.Random(seed)
    errors, error = [], np.array([dice.gauss(), dice.gauss()])
    for _ in range(count):
        noise = np.array([dice.gauss(), dice.gauss()])
        error = memory * error + (1.0 - memory**2) ** 0.5 * noise
        errors.append([*(0.1 * scale * error), 0.0])
    covariance = np.tile([0.01, 0.0, 0.01, 0.0, 0.0, 0.01], (count, 1))
    return Samples(np.array(errors), np.zeros((count, 3)), covariance)


def test_correlated_errors_are_fewer_independent_samples() -> None:
    assert correlation_samples(drifting(1, 4000, 0.0)) == pytest.approx(1.0, abs=0.3)
    assert correlation_samples(drifting(1, 4000, 0.9)) == pytest.approx(19.0, rel=0.3)


def test_a_consistent_robot_is_within_its_bounds_and_a_bold_one_is_not() -> None:
    for seed in range(30):
        honest = drifting(seed, 600, 0.95)
        known = consistency("a", honest, honest, 10.0)
        assert known is not None
        assert known.nees <= known.nees_bound
        assert known.outside <= known.outside_bound
        bold = drifting(seed, 600, 0.95, scale=3.0)
        known = consistency("a", bold, bold, 10.0)
        assert known is not None
        assert known.nees > known.nees_bound


@pytest.mark.parametrize(
    ("fusion", "seed"),
    [thorough("split-ci", 1), thorough("split-ci", 2), ("naive", 1)],
)
def test_a_rumour_shows_naive_fusion_and_no_other(fusion: str, seed: int) -> None:
    (rumour,) = select_scenarios(["rumour"])
    assert isinstance(rumour.run, TeamFault)
    plan, (from_s, until_s) = rumour.run.plan(), rumour.run.simulated_s or (0.0, 0.0)
    team = with_settings(plan.team, None, collaboration={"fusion": fusion})
    robots = {name: r for name, r in team.robots.items() if name not in plan.left_out}
    _, recorder = simulate(msgspec.structs.replace(team, robots=robots), seed, until_s)
    truth = recorder.simulated_truth()
    known = []
    for name in robots:
        times_s, samples = recorder.timed_samples(name, truth[name])
        assert samples.covariance is not None
        hidden = times_s >= from_s
        columns = samples.estimate[hidden], samples.truth[hidden], samples.covariance[hidden]
        known.append(consistency(name, Samples(*columns), samples, 10.0))
    is_bold = any(c is not None and c.nees > c.nees_bound for c in known)
    assert is_bold is (fusion == "naive")


def test_quantiles() -> None:
    assert chi_square_quantile(10.0, 0.999) == pytest.approx(29.59, rel=0.01)
    assert chi_square_quantile(2.0, 0.9999) == pytest.approx(18.42, rel=0.06)
    assert [poisson_quantile(m, 0.999) for m in (0.01, 1.0, 10.0)] == [1, 5, 21]


# The machine --------------------------------------------------------------------------------------

TENTHS = tuple(0.1 * n for n in range(200))
CALM = MachineLog(TENTHS, (0.01,) * 200, tuple((float(n), 0.1) for n in range(20)))
LATE = tuple(s for s in TENTHS if not 5.0 < s < 7.0)
BUSY = MachineLog(LATE, (0.5,) * len(LATE), tuple((float(n), 0.6) for n in range(20)))


def test_a_machine_is_too_busy_if_others_use_it_and_the_control_robot_is_late() -> None:
    assert CALM.late_s(1.0, 19.0) == pytest.approx(0.0, abs=1e-6)
    assert BUSY.late_s(1.0, 19.0) == pytest.approx(1.9, abs=0.2)
    assert BUSY.late_s(10.0, 19.0) == pytest.approx(0.0, abs=1e-6)
    assert not CALM.too_busy(0.0, 20.0)
    assert BUSY.too_busy(0.0, 20.0).startswith("the machine was too busy: other programs used 60%")
    assert not BUSY._replace(others=CALM.others).too_busy(0.0, 20.0)  # its own faults did that
    assert BUSY._replace(zero_s=100.0).late_s(1.0, 19.0) == pytest.approx(17.9)


def outcome(*checks: Check) -> Outcome:
    return Outcome(scenario="s", done="d", expectation="e", checks=checks)


def test_what_a_busy_machine_may_have_caused_is_not_judged() -> None:
    late, bold = at_most("gap", 2.0, 1.0, "s"), equal_to("uphill", 3, 0)
    met = at_most("gap", 0.5, 1.0, "s")
    assert excused_by_load(outcome(late), "").is_met is False
    assert excused_by_load(outcome(late), "too busy").not_judged == "too busy"
    assert excused_by_load(outcome(late), "too busy").is_met is None
    assert excused_by_load(outcome(late, bold), "too busy").is_met is False
    assert excused_by_load(outcome(met), "too busy").is_met is True
    assert at_most("gap", 2.0, 1.0, "s", machine=1.2).is_met
    assert "the machine 1.2 s" in str(at_most("gap", 2.0, 1.0, "s", machine=1.2))


@pytest.mark.process
def test_the_control_robot_runs_and_leaves_nothing() -> None:
    with MachineWatch() as machine:
        wait_until(lambda: len(machine.log().arrivals_s) > 5)
        wait_until(lambda: bool(machine.log().others))
    assert all(0.0 <= share <= 1.0 for _, share in machine.log().others)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("soak", "--duration", "60"), "--duration 60: too short to judge whether memory grows"),
        (("nemesis", "--duration", "5"), "--duration 5: too short to judge"),
    ],
)
def test_what_is_too_short_to_be_judged_is_refused(words: tuple[str, ...], said: str) -> None:
    ran = command_line("chaos", *words)
    assert ran.returncode == 2
    assert said in ran.stderr
