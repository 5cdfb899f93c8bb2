"""Tiers: how accurate a robot is, and whose help it accepts."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpcbl_team.config import CollaborationSettings
from cpcbl_team.tiers import LOWEST_TIER, TIER_ZERO_SIGMA_M, accepted_tiers, next_tier, tier_of

RULES = CollaborationSettings(tier_width=2.0, tier_hysteresis=1.2)
sigmas = st.floats(1e-4, 100.0)


@pytest.mark.parametrize(
    ("sigma_m", "tier"),
    [(0.0, 0), (0.01, 0), (0.011, 1), (0.02, 1), (0.021, 2), (0.08, 3), (0.16, 4), (1e9, 15)],
)
def test_each_tier_is_a_factor_in_sigma(sigma_m: float, tier: int) -> None:
    assert tier_of(sigma_m, 2.0) == tier


@given(sigmas, sigmas, st.floats(1.05, 4.0))
def test_a_smaller_sigma_is_never_a_worse_tier(a: float, b: float, width: float) -> None:
    assert tier_of(min(a, b), width) <= tier_of(max(a, b), width)


@given(st.none() | st.integers(0, LOWEST_TIER), sigmas, sigmas)
def test_the_next_tier_is_monotone_in_sigma(present: int | None, a: float, b: float) -> None:
    better, worse = (next_tier(present, s, False, RULES) for s in (min(a, b), max(a, b)))
    assert better <= worse


@given(st.integers(0, LOWEST_TIER), st.lists(st.floats(0.0, 1.0), min_size=2, max_size=20))
def test_a_sigma_near_an_edge_does_not_toggle_the_tier(edge: int, shares: list[float]) -> None:
    """Sigma stays within the hysteresis, so the tier changes once at most."""
    middle = TIER_ZERO_SIGMA_M * RULES.tier_width**edge
    tier = next_tier(None, middle, False, RULES)
    announced = []
    for share in shares:
        sigma = middle * (RULES.tier_hysteresis * 0.999) ** (2.0 * share - 1.0)
        tier = next_tier(tier, sigma, False, RULES)
        announced.append(tier)
    assert sum(a != b for a, b in pairwise(announced)) <= 1


@given(st.integers(0, LOWEST_TIER), sigmas)
def test_a_tier_follows_a_sigma_that_leaves_it(present: int, sigma: float) -> None:
    tier = next_tier(present, sigma, False, RULES)
    slack = RULES.tier_hysteresis
    assert tier_of(sigma / slack, 2.0) <= tier <= tier_of(sigma * slack, 2.0)


@given(st.none() | st.integers(0, LOWEST_TIER), sigmas)
def test_a_lost_robot_has_the_lowest_tier(present: int | None, sigma: float) -> None:
    assert next_tier(present, sigma, True, RULES) == LOWEST_TIER


def test_a_robot_that_was_lost_returns_to_the_tier_of_its_sigma() -> None:
    assert next_tier(LOWEST_TIER, 0.05, False, RULES) == tier_of(0.05, RULES.tier_width)


@given(st.integers(0, LOWEST_TIER), st.integers(0, LOWEST_TIER))
def test_one_way_accepts_only_better_tiers(own: int, other: int) -> None:
    """Of two robots only one accepts help, so no information circulates (rows 29, 30, d)."""
    accepted = accepted_tiers(own, CollaborationSettings(direction="one-way"))
    assert (other in accepted) is (other < own)


@given(st.integers(0, LOWEST_TIER))
def test_both_ways_accepts_all_tiers(own: int) -> None:
    accepted = accepted_tiers(own, CollaborationSettings(direction="both-ways"))
    assert list(accepted) == list(range(LOWEST_TIER + 1))


@given(st.none() | st.integers(0, LOWEST_TIER), sigmas, st.integers(0, LOWEST_TIER))
def test_no_robot_announces_more_than_its_best_tier(
    present: int | None, sigma_m: float, best: int
) -> None:
    limited = CollaborationSettings(tier_width=2.0, tier_hysteresis=1.2, best_tier=best)
    free = next_tier(present, sigma_m, False, RULES)
    assert next_tier(present, sigma_m, False, limited) == max(best, free)
    assert next_tier(present, sigma_m, True, limited) == LOWEST_TIER
