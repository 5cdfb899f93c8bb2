"""The judgement of a robot that lies on purpose, on logs of invented runs."""

from support.chaos import run_log_of, run_of, status_at, tracks_of, unmet_checks

from cpcbl_launch.lab.chaos import expectations as expect
from cpcbl_launch.lab.chaos.checks import Check

LIAR = "w"
CORRECT = [tracks_of("a"), tracks_of("b"), tracks_of("c"), tracks_of(LIAR)]
FOUND = [status_at(name, 14.0, trust=[(LIAR, "biased")]) for name in "ab"]


def judged(tracks: object = CORRECT, said: object = FOUND) -> list[Check]:
    log = run_log_of(tracks, (), said)  # type: ignore[arg-type]
    return expect.lying_robot(run_of(log, LIAR, 40.0), ["a", "b"], within_s=20.0)


def test_a_liar_that_is_found_and_does_no_harm_meets_all_expectations() -> None:
    assert not unmet_checks(judged())


def test_a_liar_that_nobody_finds_leads_a_robot_astray() -> None:
    astray = [tracks_of("a", lambda s: 0.5), *CORRECT[1:]]
    assert unmet_checks(judged(astray, FOUND[:1])) == {
        "robots that quarantined it",
        "quarantined by enough robots after",
        "worst RMSE during the lie",
        "during the lie, NEES",
    }


def test_a_correct_robot_in_quarantine_is_noticed_but_an_accomplice_may_be() -> None:
    said = [*FOUND, status_at("a", 15.0, trust=[("c", "outvoted")])]
    assert unmet_checks(judged(said=said)) == {"correct robots in quarantine"}
    run = run_of(run_log_of(CORRECT, (), said), LIAR, 40.0)
    both = expect.lying_robot(run, ["a", "b"], within_s=20.0, accomplices=["c"])
    assert not unmet_checks(both)


def test_what_the_liar_did_is_judged_whatever_the_load_of_the_machine_was() -> None:
    by_load = {check.what for check in judged() if check.by_load}
    assert "worst RMSE during the lie" not in by_load
    assert "during the lie, NEES" not in by_load
    assert "during the lie, share outside 3 σ" not in by_load
