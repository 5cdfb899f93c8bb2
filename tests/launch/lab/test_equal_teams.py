"""Nobody's own information comes back to it as new: teams of equals claim no more than they know.

Position NEES (2 is consistent) of the whole chain, mean over the robots of a team and over a third
of the run; the bounds are those of so many independent runs (`nees_bounds`). Teams of equals, whose
robots all see landmarks or none do, are within both. Where one sees landmarks for all, the others
claim too little by split covariance intersection: there only the upper one holds.
"""

import numpy as np
import pytest
from support.equal_teams import SHAPES, START_SIGMA_M, Sighted, equal_team, nees_bounds, team_nees

from cpcbl_launch.lab.experiments.runs import Case, run_case
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import Team

SPLIT = Overrides()
MUTUAL = Overrides(direction="both-ways")
MUTUAL_NAIVE = Overrides(direction="both-ways", fusion="naive")


def first_and_last_third(team: Team, seeds: int, duration_s: float) -> tuple[float, float]:
    """The mean NEES of the first and of the last third of this many runs."""
    case = Case(team, tuple(team.robots), duration_s, loops=0)
    nees = team_nees(run_case(case, seed) for seed in range(1, seeds + 1))
    third = nees.shape[1] // 3
    return float(nees[:, :third].mean()), float(nees[:, -third:].mean())


def test_the_bounds_are_those_of_chi_square() -> None:
    """Tables: 74.22 and 129.56 for 100 degrees of freedom, 6.91 and 28.85 for 16."""
    assert nees_bounds(50) == pytest.approx((74.22 / 50.0, 129.56 / 50.0), rel=1e-3)
    assert nees_bounds(8) == pytest.approx((6.91 / 8.0, 28.85 / 8.0), rel=3e-3)


@pytest.mark.parametrize(
    ("choice", "honest"),
    [
        pytest.param(SPLIT, True, marks=pytest.mark.long),
        pytest.param(MUTUAL, True, marks=pytest.mark.thorough),
        pytest.param(MUTUAL_NAIVE, False, marks=pytest.mark.long),
    ],
)
def test_information_that_circulates_between_two_robots_is_used_once(
    choice: Overrides, honest: bool
) -> None:
    team = with_overrides(equal_team("pair", "none"), choice)
    _, last = first_and_last_third(team, 4, 40.0)
    assert (last <= nees_bounds(4)[1]) is honest


@pytest.mark.parametrize(
    ("choice", "honest"),
    [
        pytest.param(SPLIT, True, marks=pytest.mark.thorough),
        (MUTUAL, True),
        pytest.param(MUTUAL_NAIVE, False, marks=pytest.mark.thorough),
    ],
)
def test_standing_robots_that_see_only_each_other_know_no_more_than_all_starts_together(
    choice: Overrides, honest: bool
) -> None:
    """What they see of each other says nothing of where all of them are: its sigma stays that of
    the mean of their starts, and no robot's can be less."""
    team = with_overrides(equal_team("clique", "none", drives=False), choice)
    _, recorder = simulate(team, 1, 20.0)
    claimed = [recorder.trajectory(name).covariance for name in team.robots]
    every = np.concatenate([c for c in claimed if c is not None])
    least = np.linalg.eigvalsh(every[:, [0, 1, 1, 2]].reshape(-1, 2, 2)).min()
    due = START_SIGMA_M**2 / SHAPES["clique"].robots
    assert bool(least >= due) is honest


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("shape", "sighted", "duration_s"),
    [
        ("alone", "all", 60.0),
        ("alone", "none", 60.0),
        ("pair", "all", 60.0),
        ("pair", "one", 60.0),
        ("pair", "none", 60.0),
        ("ring", "all", 40.0),
        ("ring", "one", 40.0),
        ("ring", "none", 40.0),
        ("clique", "all", 40.0),
        ("clique", "one", 40.0),
        ("clique", "none", 40.0),
    ],
)
def test_fifty_teams_of_equals_are_within_the_bounds(
    shape: str, sighted: Sighted, duration_s: float
) -> None:
    low, high = nees_bounds(50)
    first, last = first_and_last_third(equal_team(shape, sighted), 50, duration_s)
    assert first <= high
    assert last <= high
    if sighted != "one":
        assert low <= min(first, last)
