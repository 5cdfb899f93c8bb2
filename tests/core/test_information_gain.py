"""The information gain of help for the position, before it is sent."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.core import Matrix, diagonal, matrix2, product_of
from support.gains import (
    NOTHING,
    RULES,
    areas,
    covariances,
    displacements,
    either_rules,
    exact_or_not,
    exactness,
    fusions,
    round_covariance,
    tiers,
)

from cpcbl_team.config import CollaborationSettings, Fusion
from cpcbl_team.estimate import SMALLEST_VARIANCE, Covariance3, Estimate
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.geometry import Pose2
from cpcbl_team.information_gain import (
    FixMemory,
    Need,
    effective_age_s,
    information_gain,
    information_gain_of_belief,
    merged_covariance,
    need_of,
    removed_variance,
)
from cpcbl_team.inputs import Fix
from cpcbl_team.tiers import LOWEST_TIER


@given(covariances, covariances, covariances)
def test_naive_merging_is_the_product_of_the_gaussians(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2
) -> None:
    exact = Covariance2(-SMALLEST_VARIANCE, 0.0, -SMALLEST_VARIANCE)  # cancels the regularization
    product = product_of(Gaussian2(0.0, 0.0, prior), Gaussian2(0.0, 0.0, fresh + dependent))
    after = merged_covariance(prior + exact, fresh + exact, dependent, "naive")
    assert after == pytest.approx(product.covariance, rel=1e-6, abs=1e-9)


def best_intersection(prior: Matrix, fresh: Matrix, dependent: Matrix) -> float:
    """The least determinant by split covariance intersection, over a fine grid of weights."""
    inverse = np.linalg.inv
    weights = np.linspace(0.0005, 0.9995, 2000)[:, None, None]
    least = np.linalg.det(
        inverse(inverse(prior / weights) + inverse(fresh + dependent / (1.0 - weights)))
    )
    return float(np.min(least))


@given(covariances, covariances, covariances)
def test_the_merged_determinant_is_not_below_the_best_intersection(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2
) -> None:
    best = best_intersection(*map(matrix2, (prior, fresh, dependent)))
    assert merged_covariance(prior, fresh, dependent, "split-ci").determinant() >= best * 0.99


@given(covariances, covariances, covariances)
def test_the_merged_determinant_is_close_to_the_best_intersection(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2
) -> None:
    """The golden section finds a weight within a tenth of a nat of the best."""
    best = best_intersection(*map(matrix2, (prior, fresh, dependent)))
    after = merged_covariance(prior, fresh, dependent, "split-ci")
    assert 0.5 * math.log(after.determinant() / min(best, prior.determinant())) < 0.1


@given(covariances, covariances, covariances)
def test_help_never_loses_information(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2
) -> None:
    for fusion in ("split-ci", "naive"):
        assert information_gain(prior, merged_covariance(prior, fresh, dependent, fusion)) >= -1e-9


@given(covariances, covariances)
def test_repeated_dependent_evidence_gains_no_more_than_it_contains(
    prior: Covariance2, dependent: Covariance2
) -> None:
    """Repeated fixes of one observer contain no more than that observer knows."""
    assume(information_gain(prior, merged_covariance(prior, NOTHING, dependent, "split-ci")) > 0.1)
    once = merged_covariance(prior, NOTHING, dependent, "split-ci")
    gained = [once.determinant()]
    for _ in range(50):
        once = merged_covariance(once, NOTHING, dependent, "split-ci")
        gained.append(once.determinant())
    assert gained[-1] >= 0.99 * min(prior.determinant(), dependent.determinant(), *gained[:1])
    # A merge that gains nothing still adds the smallest variance to the prior.
    assert all(a >= b * (1.0 - exactness(prior, dependent)) for a, b in pairwise(gained))


def test_the_second_dependent_fix_gains_almost_nothing() -> None:
    for share in (0.01, 0.1, 0.5):
        prior, dependent = round_covariance(0.5), round_covariance(0.5 * share)
        once = merged_covariance(prior, NOTHING, dependent, "split-ci")
        twice = merged_covariance(once, NOTHING, dependent, "split-ci")
        assert information_gain(prior, once) > 0.5
        assert information_gain(once, twice) < 0.06


def test_a_second_independent_fix_gains_the_logarithm_of_two() -> None:
    prior, fresh = round_covariance(0.5), round_covariance(0.1)
    once = merged_covariance(prior, fresh, NOTHING, "naive")
    twice = merged_covariance(once, fresh, NOTHING, "naive")
    assert information_gain(once, twice) == pytest.approx(math.log(2.0), rel=0.05)


@given(covariances, covariances, covariances, st.floats(1.0, 10.0), st.sampled_from(["a", "b"]))
def test_a_fix_with_a_larger_covariance_never_gains_more(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2, factor: float, part: str
) -> None:
    worse = (fresh.scaled(factor), dependent) if part == "a" else (fresh, dependent.scaled(factor))
    for fusion in ("split-ci", "naive"):
        good, bad = (
            merged_covariance(prior, fresh, dependent, fusion),
            merged_covariance(prior, *worse, fusion),
        )
        assert information_gain(prior, bad) <= information_gain(prior, good) + 1e-9


@given(covariances, st.floats(1.0, 20.0))
def test_the_gain_is_the_logarithm_of_the_factor_by_which_the_ellipse_shrinks(
    prior: Covariance2, factor: float
) -> None:
    """Both axes shrink by `factor`, so the area shrinks by its square."""
    gained = information_gain(prior, prior.scaled(factor**-2))
    assert gained == pytest.approx(2.0 * math.log(factor), abs=exactness(prior))


def gain_of_belief(
    tier: int, sigma_m: float, sigma_rad: float, *, sensor_m: float = 0.03, range_m: float = 2.0
) -> float:
    """The gain for a robot that sees a teammate of this tier ahead."""
    estimate = Estimate(Pose2(1.0, 1.0, 0.0), diagonal(sigma_m, sigma_rad))
    seen = Fix(
        "mate", "me", 0, 1.0 + range_m, 1.0, round_covariance(sensor_m), round_covariance(sigma_m)
    )
    return information_gain_of_belief(seen, tier, estimate, RULES)


def test_a_much_worse_teammate_gains_nothing() -> None:
    assert 0.0 <= gain_of_belief(13, 0.02, math.radians(1.0)) < 0.001


def test_a_better_teammate_gains_position() -> None:
    assert gain_of_belief(2, 0.5, math.radians(1.0)) > 2.0


def test_a_better_teammate_gains_an_unknown_heading() -> None:
    assert gain_of_belief(2, 0.02, math.radians(60.0)) > 2.0
    assert gain_of_belief(2, 0.02, math.radians(60.0), range_m=8.0) > gain_of_belief(
        2, 0.02, math.radians(60.0)
    )


@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(0.01, 0.5))
def test_a_better_teammate_never_gains_less(m: float, rad: float, sensor_m: float) -> None:
    gains = [gain_of_belief(tier, m, rad, sensor_m=sensor_m) for tier in range(LOWEST_TIER)]
    assert all(a >= b - 1e-12 for a, b in pairwise(gains))
    assert gains[-1] >= 0.0


@given(areas, areas, areas, fusions)
def test_merged_covariances_and_their_gains_are_finite(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2, fusion: Fusion
) -> None:
    after = merged_covariance(prior, fresh, dependent, fusion)
    assert all(map(math.isfinite, after))
    assert after.xx > 0.0 < after.yy
    assert 0.0 <= information_gain(prior, after) + 1e-6 < math.inf


@given(areas, areas)
def test_the_gain_is_finite(prior: Covariance2, after: Covariance2) -> None:
    assert math.isfinite(information_gain(prior, after))


def test_an_exact_estimate_gains_nothing() -> None:
    assert information_gain(NOTHING, NOTHING) == 0.0
    for fusion in ("split-ci", "naive"):
        assert (
            information_gain(NOTHING, merged_covariance(NOTHING, NOTHING, NOTHING, fusion)) == 0.0
        )


@given(
    tiers, areas, areas, exact_or_not, displacements, displacements, st.sampled_from(either_rules)
)
def test_the_gain_of_a_belief_is_finite(
    tier: int,
    own: Covariance2,
    sensor: Covariance2,
    sigma_rad: float,
    dx: float,
    dy: float,
    rules: CollaborationSettings,
) -> None:
    covariance = Covariance3(*own, 0.0, 0.0, sigma_rad**2)
    seen = Fix("mate", "me", 0, 1.0 + dx, 2.0 + dy, sensor, own)
    gain = information_gain_of_belief(seen, tier, Estimate(Pose2(1.0, 2.0, 0.5), covariance), rules)
    assert 0.0 <= gain + 1e-6 < math.inf


def test_a_teammate_at_the_same_point_gains_no_heading() -> None:
    for range_m in (0.0, 1e-200, 1e-9, 1e-4):
        assert gain_of_belief(2, 0.02, math.radians(60.0), range_m=range_m) == gain_of_belief(
            2, 0.02, 0.0
        )


# The effective age, by which messages compete ---------------------------------------------------


def test_a_fix_removes_variance_of_the_position_and_of_the_next_metre() -> None:
    """From 0.5 m to 0.3 m on both axes removes a variance of 0.32 m^2; a heading counts by the
    error that it would make on the next metre."""
    prior, after = round_covariance(0.5), round_covariance(0.3)
    assert removed_variance(prior, after, 0.0) == pytest.approx(0.32)
    assert removed_variance(prior, after, 0.04) == pytest.approx(0.36)
    assert removed_variance(after, prior, 0.0) == 0.0


def test_a_teammate_needs_what_its_variance_grew_since_the_last_fix() -> None:
    last = FixMemory(0.0, 0.0, round_covariance(0.3))
    assert need_of(round_covariance(0.5), last, 20.0, 7) == pytest.approx((0.32, 20.0, 7))
    assert need_of(round_covariance(0.2), last, 20.0, 7) == (0.0, 20.0, 7)
    assert need_of(round_covariance(0.5), None, 20.0, 7) == pytest.approx((0.50, 20.0, 7))


def test_a_usual_message_is_as_old_as_it_is_and_one_that_removes_a_quarter_is_half_as_old() -> None:
    needs = [Need(0.2, 20.0, 0), Need(0.4, 40.0, 0)]
    assert effective_age_s(0.3, 30.0, needs) == pytest.approx(30.0)
    assert effective_age_s(0.3 / 4.0, 30.0, needs) == pytest.approx(15.0)
    assert effective_age_s(0.0, 30.0, needs) == 0.0
    assert effective_age_s(0.0, 30.0, [Need(0.0, 30.0, 0)]) == 30.0


@pytest.mark.parametrize(("growth", "cost"), [(0.01, 2.0), (0.3, 2.0), (0.01, 50.0)])
@pytest.mark.parametrize("ratio", [0.2, 1.0, 5.0])
def test_help_that_is_due_at_one_interval_costs_least_for_each_teammate(
    growth: float, cost: float, ratio: float
) -> None:
    """Of error and messages together, where variances grow evenly, one of them `ratio` times as
    fast as the mean, and each fix removes them."""
    interval_s, needs = math.sqrt(2.0 * cost / growth), [Need(growth * 50.0, 50.0, 0)]
    periods, own = [0.01 * n for n in range(1, 30_000)], ratio * growth
    cheapest = min(periods, key=lambda t: own * t / 2.0 + cost / t)
    due = next(t for t in periods if effective_age_s(own * t, t, needs) >= interval_s)
    assert due == pytest.approx(cheapest, abs=0.02)
