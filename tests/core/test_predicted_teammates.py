"""What a sender predicts about a teammate from its tier and the last fix."""

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.gains import (
    RULES,
    areas,
    coordinates,
    covariances,
    displacements,
    round_covariance,
    sigma_of,
    tiers,
)

from cpcbl_team.config import CollaborationSettings
from cpcbl_team.estimate import SMALLEST_VARIANCE
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.information_gain import (
    LOST_SIGMA_M,
    FixMemory,
    predicted_teammate_covariance,
    sigma_limits_m,
)
from cpcbl_team.tiers import LOWEST_TIER, TIER_ZERO_SIGMA_M, next_tier


@given(
    st.floats(1.05, 4.0),
    st.floats(1.0, 1.5),
    st.lists(st.floats(1e-4, LOST_SIGMA_M), min_size=1, max_size=10),
)
def test_every_sigma_of_a_tier_is_within_its_limits(
    width: float, hysteresis: float, sigmas_m: list[float]
) -> None:
    """This holds for every sequence of sigmas that leads to the tier."""
    rules = CollaborationSettings(tier_width=width, tier_hysteresis=hysteresis)
    tier: int | None = None
    for sigma in sigmas_m:
        tier = next_tier(tier, sigma, False, rules)
        least, most = sigma_limits_m(tier, rules)
        assert least * (1.0 - 1e-6) <= sigma <= most * (1.0 + 1e-6)


@given(tiers)
def test_the_limits_of_adjacent_tiers_overlap_by_the_hysteresis(tier: int) -> None:
    assume(tier < LOWEST_TIER)
    _, most = sigma_limits_m(tier, RULES)
    least, _ = sigma_limits_m(tier + 1, RULES)
    edge = TIER_ZERO_SIGMA_M * RULES.tier_width**tier
    assert (least, most) == pytest.approx((edge / 1.1, edge * 1.1))


@given(tiers, st.none() | st.builds(FixMemory, coordinates, coordinates, covariances), coordinates)
def test_the_predicted_sigma_is_within_the_limits_of_the_tier(
    tier: int, last_fix: FixMemory | None, x: float
) -> None:
    least, most = sigma_limits_m(tier, RULES)
    sigma = sigma_of(predicted_teammate_covariance(tier, last_fix, x, 0.0, RULES))
    assert least * (1.0 - 1e-9) <= sigma <= most * (1.0 + 1e-9)


def test_the_predicted_sigma_of_a_lost_teammate_is_the_largest() -> None:
    assert predicted_teammate_covariance(LOWEST_TIER, None, 3.0, 4.0, RULES) == pytest.approx(
        round_covariance(LOST_SIGMA_M)
    )


@given(tiers, covariances, st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_the_predicted_sigma_grows_with_the_distance_driven(
    tier: int, covariance: Covariance2, a: float, b: float
) -> None:
    last_fix = FixMemory(0.0, 0.0, covariance)
    near, far = (
        sigma_of(predicted_teammate_covariance(tier, last_fix, distance, 0.0, RULES))
        for distance in sorted((a, b))
    )
    assert near <= far * (1.0 + 1e-9)


@given(covariances)
def test_at_the_place_of_the_last_fix_its_covariance_is_predicted(covariance: Covariance2) -> None:
    tier = next_tier(None, sigma_of(covariance), False, RULES)
    after = predicted_teammate_covariance(tier, FixMemory(1.0, 2.0, covariance), 1.0, 2.0, RULES)
    assert after == pytest.approx(covariance, abs=1.01 * SMALLEST_VARIANCE)


@given(tiers, areas, displacements, displacements)
def test_the_predicted_covariance_is_finite(
    tier: int, area: Covariance2, x: float, y: float
) -> None:
    after = predicted_teammate_covariance(tier, FixMemory(0.0, 0.0, area), x, y, RULES)
    assert all(map(math.isfinite, after))
    least, most = sigma_limits_m(tier, RULES)
    assert least * (1.0 - 1e-9) <= sigma_of(after) <= most * (1.0 + 1e-9)
