"""The simulator of bad luck: usual histories hold, planted bugs are found and shrunk."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace
from support.planted_bugs import BUGS, planted
from support.sweeps import sampled

from cpcbl_launch.lab.luck.history import history_text
from cpcbl_launch.lab.luck.outcome import run_history, run_seed
from cpcbl_launch.lab.luck.plan import history_of, read_history
from cpcbl_launch.lab.luck.shrink import fails_like, shrink
from cpcbl_launch.lab.luck.sweep import summed
from cpcbl_launch.lab.luck.teams import OBSERVER, team_of
from cpcbl_launch.lab.luck.verdict import tracks_hz
from cpcbl_team.errors import InputError

FOUND = {
    "ordering": ("in order", 0),
    "kept states": ("in order", 0),
    "double count": ("used once", 0),
    "subscriptions kept": ("not uphill", 0),
    "late not counted": ("counted", 0),
    "late data": ("not too late", 5),
    "refusal not counted": ("counted", 1),
    "budget leak": ("in budget", 12),
    "fresh budget": ("in budget", 1),
    "free beliefs": ("in budget", 12),
    "quarantine ignored": ("quarantined", 26),
}
"""Planted bugs, by the invariant that finds each, and a seed whose history shows it."""
MOST_SEEDS, MOST_EVENTS = 27, 20
IN_SUM = {"naive fusion": range(10), "trust off": range(10, 24)}
DIGEST = "from cpcbl_launch.lab.luck.outcome import run_seed; print(run_seed(4, 8.0).digest)"


def found_by(bug: str, invariant: str, seeds: int) -> int | None:
    """The first seed whose history shows the bug by this invariant."""
    with planted(bug):
        for seed in range(seeds):
            broken = run_history(history_of(seed), stop_early=True).violations
            if invariant in {violation.invariant for violation in broken}:
                return seed
    return None


def test_a_usual_history_holds_and_its_outcome_can_be_sent() -> None:
    outcome = run_seed(0, 12.0)
    assert outcome.violations == ()
    assert outcome.used > 100
    assert pickle.loads(pickle.dumps(outcome)) == outcome


def test_the_digest_does_not_depend_on_the_hash_seed() -> None:
    """That of this process is random."""
    environment = {**os.environ, "PYTHONHASHSEED": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", DIGEST], env=environment, capture_output=True, check=True, text=True
    )
    assert done.stdout.strip() == run_seed(4, 8.0).digest


@pytest.mark.parametrize("bug", sampled(FOUND, ["ordering"]))
def test_a_planted_bug_is_found(bug: str) -> None:
    invariant, seed = FOUND[bug]
    with planted(bug):
        broken = run_history(history_of(seed), stop_early=True).violations
    assert invariant in {violation.invariant for violation in broken}


@pytest.mark.long
@pytest.mark.parametrize("bug", FOUND)
def test_a_planted_bug_is_found_by_who_does_not_know_the_seed(bug: str) -> None:
    assert found_by(bug, FOUND[bug][0], MOST_SEEDS) is not None


@pytest.mark.long
@pytest.mark.parametrize("bug", IN_SUM)
def test_fusion_that_is_too_certain_shows_in_the_sum_of_histories(bug: str) -> None:
    with planted(bug):
        found = summed([run_seed(seed, 60.0) for seed in IN_SUM[bug]])
    assert found.blind_nees > found.blind_nees_bound
    assert found.has_failed


def test_every_planted_bug_has_an_invariant() -> None:
    assert {*FOUND, *IN_SUM} == {*BUGS}


@pytest.mark.long
def test_a_failing_history_shrinks_and_fails_again_from_its_file(tmp_path: Path) -> None:
    history, file = history_of(0), tmp_path / "luck-0.json"
    with planted("double count"):
        shrunk = shrink(history, fails_like("used once"))
        file.write_bytes(history_text(shrunk))
        broken = run_history(read_history(file), stop_early=True).violations
    assert len(shrunk.events) <= MOST_EVENTS
    assert len(shrunk.sentences()) == 1 + len(shrunk.events)
    assert broken[0].invariant == "used once"
    assert run_history(shrunk).violations == ()


def test_teams_differ_in_their_rates_and_are_judged_by_them() -> None:
    teams = [team_of(seed) for seed in range(20)]
    rates = {tracks_hz(team, name) for team in teams for name in team.robots}
    assert rates == {2.0, 4.0, 5.0, 10.0}
    assert {tracks_hz(team, OBSERVER) for team in teams} == {10.0}


def test_a_file_that_is_no_history_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "other.json"
    file.write_text('{"seed": "x"}')
    with pytest.raises(InputError, match="not a history"):
        read_history(file)
    history = history_of(0)
    for other, problem in (
        (replace(history, robots=("r2",)), "not those of its seed"),
        (replace(history, duration_s=1e9), "duration_s must be above 0"),
        (replace(history, events=(replace(history.events[0], until_s=-1.0),)), "before it ends"),
        (replace(history, events=(replace(history.events[0], robot="r2"),)), "cannot happen"),
    ):
        file.write_bytes(history_text(other))
        with pytest.raises(InputError, match=problem):
            read_history(file)
