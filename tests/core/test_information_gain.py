"""What help is worth before it is sent."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.core import Matrix, belief, diagonal, least_eigenvalue, matrix2, product_of

from cpcbl_team.collaboration import LOWEST_TIER, TIER_ZERO_SIGMA_M, next_tier
from cpcbl_team.config import CollaborationSettings, Fusion
from cpcbl_team.estimate import SMALLEST_VARIANCE, Covariance3, Estimate
from cpcbl_team.gaussian import Covariance2, Gaussian2, oriented
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.information_gain import (
    LOST_SIGMA_M,
    USUAL_HEADING_SIGMA_RAD,
    Helped,
    Turned,
    expected,
    expected_heading,
    heading_worth,
    merged,
    merged_heading,
    sigma_range_m,
    staleness,
    use_of,
    worth,
)
from cpcbl_team.inputs import Belief, Fix

RULES = CollaborationSettings()
SECOND = 1_000_000_000
NOTHING = Covariance2(0.0, 0.0, 0.0)
sigmas = st.floats(0.005, 2.0)
covariances = st.builds(oriented, sigmas, sigmas, st.floats(-math.pi, math.pi))
fusions = st.sampled_from(["split-ci", "naive"])
tiers = st.integers(0, LOWEST_TIER)
coordinates = st.floats(-20.0, 20.0)


def round_(sigma_m: float) -> Covariance2:
    return Covariance2(sigma_m**2, 0.0, sigma_m**2)


def sigma_of(covariance: Covariance2) -> float:
    return math.sqrt(0.5 * (covariance.xx + covariance.yy))


def exactness(*covariances: Covariance2) -> float:
    """By how much at most the determinant of the smallest grows, as a share, because nothing is
    exact."""
    least = min(least_eigenvalue(matrix2(c)) for c in covariances)
    return 2.0 * SMALLEST_VARIANCE / least * (1.0 + SMALLEST_VARIANCE / least)


# Merging ------------------------------------------------------------------------------------------


@given(covariances, covariances, covariances)
def test_naive_merging_is_the_product(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2
) -> None:
    exact = Covariance2(-SMALLEST_VARIANCE, 0.0, -SMALLEST_VARIANCE)  # is called so, and raised
    product = product_of(Gaussian2(0.0, 0.0, prior), Gaussian2(0.0, 0.0, fresh + dependent))
    after = merged(prior + exact, fresh + exact, dependent, "naive")
    assert after == pytest.approx(product.covariance, rel=1e-6, abs=1e-9)


def intersected(prior: Matrix, fresh: Matrix, dependent: Matrix) -> float:
    """The least determinant by split covariance intersection, over a fine grid of weights."""
    inverse = np.linalg.inv
    weights = np.linspace(0.0005, 0.9995, 2000)[:, None, None]
    least = np.linalg.det(
        inverse(inverse(prior / weights) + inverse(fresh + dependent / (1.0 - weights)))
    )
    return float(np.min(least))


@given(covariances, covariances, covariances)
def test_no_more_is_claimed_than_the_best_intersection_gives(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2
) -> None:
    best = intersected(*map(matrix2, (prior, fresh, dependent)))
    assert merged(prior, fresh, dependent, "split-ci").determinant() >= best * 0.99


@given(covariances, covariances, covariances)
def test_little_less_is_claimed_than_the_best_intersection_gives(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2
) -> None:
    """With weights in steps of 0.05: within a tenth of a nat."""
    best = intersected(*map(matrix2, (prior, fresh, dependent)))
    after = merged(prior, fresh, dependent, "split-ci")
    assert 0.5 * math.log(after.determinant() / min(best, prior.determinant())) < 0.1


@given(covariances, covariances, covariances)
def test_help_never_makes_worse(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2
) -> None:
    for fusion in ("split-ci", "naive"):
        assert worth(prior, merged(prior, fresh, dependent, fusion)) >= -1e-9


@given(covariances, covariances)
def test_what_all_depends_on_what_was_told_is_worth_nothing_again(
    prior: Covariance2, dependent: Covariance2
) -> None:
    """Told over and over, it comes to no more than the dependent evidence itself says."""
    assume(worth(prior, merged(prior, NOTHING, dependent, "split-ci")) > 0.1)
    once = merged(prior, NOTHING, dependent, "split-ci")
    gained = [once.determinant()]
    for _ in range(50):
        once = merged(once, NOTHING, dependent, "split-ci")
        gained.append(once.determinant())
    assert gained[-1] >= 0.99 * min(prior.determinant(), dependent.determinant(), *gained[:1])
    # A merge that gains nothing still makes what is taken as known less exact.
    assert all(a >= b * (1.0 - exactness(prior, dependent)) for a, b in pairwise(gained))


def test_the_second_fix_of_a_round_ellipse_is_worth_next_to_nothing() -> None:
    for share in (0.01, 0.1, 0.5):
        prior, dependent = round_(0.5), round_(0.5 * share)
        once = merged(prior, NOTHING, dependent, "split-ci")
        twice = merged(once, NOTHING, dependent, "split-ci")
        assert worth(prior, once) > 0.5
        assert worth(once, twice) < 0.06


def test_fresh_evidence_is_worth_as_much_the_second_time_as_independence_gives() -> None:
    prior, fresh = round_(0.5), round_(0.1)
    once = merged(prior, fresh, NOTHING, "naive")
    twice = merged(once, fresh, NOTHING, "naive")
    assert worth(once, twice) == pytest.approx(math.log(2.0), rel=0.05)


@given(covariances, covariances, covariances, st.floats(1.0, 10.0), st.sampled_from(["a", "b"]))
def test_a_worse_fix_is_never_worth_more(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2, factor: float, part: str
) -> None:
    worse = (fresh.scaled(factor), dependent) if part == "a" else (fresh, dependent.scaled(factor))
    for fusion in ("split-ci", "naive"):
        good, bad = merged(prior, fresh, dependent, fusion), merged(prior, *worse, fusion)
        assert worth(prior, bad) <= worth(prior, good) + 1e-9


@given(covariances, st.floats(1.0, 20.0))
def test_worth_is_the_factor_by_which_the_ellipse_shrinks(
    prior: Covariance2, factor: float
) -> None:
    """Both axes by `factor`: its square in area."""
    gained = worth(prior, prior.scaled(factor**-2))
    assert gained == pytest.approx(2.0 * math.log(factor), abs=exactness(prior))


# What a teammate is expected to know --------------------------------------------------------------


@given(
    st.floats(1.05, 4.0),
    st.floats(1.0, 1.5),
    st.lists(st.floats(1e-4, LOST_SIGMA_M), min_size=1, max_size=10),
)
def test_every_sigma_of_a_tier_is_in_its_range(
    width: float, hysteresis: float, sigmas_m: list[float]
) -> None:
    """Whatever way it came to the tier."""
    rules = CollaborationSettings(tier_width=width, tier_hysteresis=hysteresis)
    tier: int | None = None
    for sigma in sigmas_m:
        tier = next_tier(tier, sigma, False, rules)
        least, most = sigma_range_m(tier, rules)
        assert least * (1.0 - 1e-6) <= sigma <= most * (1.0 + 1e-6)


@given(tiers)
def test_the_ranges_of_neighbouring_tiers_overlap_by_the_hysteresis(tier: int) -> None:
    assume(tier < LOWEST_TIER)
    _, most = sigma_range_m(tier, RULES)
    least, _ = sigma_range_m(tier + 1, RULES)
    edge = TIER_ZERO_SIGMA_M * RULES.tier_width**tier
    assert (least, most) == pytest.approx((edge / 1.1, edge * 1.1))


@given(tiers, st.none() | st.builds(Helped, coordinates, coordinates, covariances), coordinates)
def test_a_teammate_is_expected_within_the_bounds_of_its_tier(
    tier: int, helped: Helped | None, x: float
) -> None:
    least, most = sigma_range_m(tier, RULES)
    sigma = sigma_of(expected(tier, helped, x, 0.0, RULES))
    assert least * (1.0 - 1e-9) <= sigma <= most * (1.0 + 1e-9)


def test_who_is_lost_may_be_anywhere() -> None:
    assert expected(LOWEST_TIER, None, 3.0, 4.0, RULES) == pytest.approx(round_(LOST_SIGMA_M))


@given(tiers, covariances, st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_a_teammate_is_expected_to_know_less_the_farther_it_has_driven(
    tier: int, covariance: Covariance2, a: float, b: float
) -> None:
    helped = Helped(0.0, 0.0, covariance)
    near, far = (sigma_of(expected(tier, helped, way, 0.0, RULES)) for way in sorted((a, b)))
    assert near <= far * (1.0 + 1e-9)


@given(covariances)
def test_what_the_last_fix_left_is_believed_within_the_bounds(covariance: Covariance2) -> None:
    tier = next_tier(None, sigma_of(covariance), False, RULES)
    after = expected(tier, Helped(1.0, 2.0, covariance), 1.0, 2.0, RULES)
    assert after == pytest.approx(covariance, abs=1.01 * SMALLEST_VARIANCE)


# What a heading is worth --------------------------------------------------------------------------

GOOD, USUAL = 5, USUAL_HEADING_SIGMA_RAD**2
variances = st.floats(1e-6, math.pi**2)


def seen_at(way: float, sensor_m: float = 0.0) -> Fix:
    """A teammate that far from (1, 2), where it was last told its heading."""
    return Fix("mate", "me", 0, 1.0 + way, 2.0, round_(sensor_m), NOTHING)


def test_a_robot_that_stands_does_not_drift_for_the_noise_with_which_it_is_seen() -> None:
    told = Turned(1.0, 2.0, 0.001)
    assert expected_heading(GOOD, told, seen_at(0.2, sensor_m=0.1)) == 0.001
    assert expected_heading(GOOD, told, seen_at(0.2)) > 0.002


def headed(sensor_variance: float, observer_variance: float) -> Fix:
    place = Fix("mate", "me", 0, 1.0, 2.0, NOTHING, NOTHING)
    return replace(
        place,
        heading_rad=0.5,
        heading_sensor_variance=sensor_variance,
        heading_observer_variance=observer_variance,
    )


def test_what_a_heading_is_worth_by_hand() -> None:
    """From 10 degrees to 5 is a factor of two; for who is lost, from any to nearly 5."""
    after = merged_heading(USUAL, headed(USUAL / 3.0, 0.0), "naive")
    assert heading_worth(USUAL, after) == pytest.approx(math.log(2.0), rel=1e-6)
    lost = expected_heading(LOWEST_TIER, None, seen_at(0.0))
    assert lost == pytest.approx(math.pi**2 / 3.0)
    after = merged_heading(lost, headed(math.radians(5.0) ** 2, 0.0), "naive")
    assert heading_worth(lost, after) == pytest.approx(math.log(1.8138 / 0.08716), rel=1e-3)


@given(variances, variances, variances, fusions)
def test_a_heading_never_makes_worse_nor_better_than_it_is_known(
    prior: float, sensor: float, observer: float, fusion: Fusion
) -> None:
    after = merged_heading(prior, headed(sensor, observer), fusion)
    assert -1e-9 <= heading_worth(prior, after) < math.inf
    assert after >= 0.99 / (1.0 / prior + 1.0 / (sensor + observer))


@given(variances, variances)
def test_the_observers_own_heading_is_told_once(prior: float, observer: float) -> None:
    """By split covariance intersection: what all depends on it comes to no more than it is."""
    once = merged_heading(prior, headed(0.0, observer), "split-ci")
    twice = merged_heading(once, headed(0.0, observer), "split-ci")
    assert twice >= 0.99 * min(prior, observer)
    assert heading_worth(once, twice) < 0.05


@given(variances, st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_a_heading_is_news_again_after_a_way_but_no_more_than_at_first(
    left: float, a: float, b: float
) -> None:
    told = Turned(1.0, 2.0, min(left, USUAL))
    near, far = (expected_heading(GOOD, told, seen_at(way)) for way in sorted((a, b)))
    assert told.variance <= near <= far <= expected_heading(GOOD, None, seen_at(a))
    assert expected_heading(LOWEST_TIER, told, seen_at(a)) > USUAL


def test_a_heading_is_news_after_a_metre_or_two() -> None:
    """Of an observer that knows its own to 1 degree, by a marker good to 3."""
    said = headed(math.radians(3.0) ** 2, math.radians(1.0) ** 2)
    left, gained = USUAL, []
    for way in (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0):
        prior = expected_heading(GOOD, Turned(1.0, 2.0, left), seen_at(way))
        left = merged_heading(prior, said, "split-ci")
        gained.append(heading_worth(prior, left))
    assert gained[0] > 1.0
    assert gained[5] < 0.1
    assert gained[6] > 0.3


# Whose belief is of use ---------------------------------------------------------------------------


def use(
    tier: int, sigma_m: float, sigma_rad: float, *, sensor_m: float = 0.03, range_m: float = 2.0
) -> float:
    """To a robot that sees a teammate of this tier ahead."""
    estimate = Estimate(Pose2(1.0, 1.0, 0.0), diagonal(sigma_m, sigma_rad))
    seen = Fix("mate", "me", 0, 1.0 + range_m, 1.0, round_(sensor_m), round_(sigma_m))
    return use_of(seen, tier, estimate, RULES)


def test_a_teammate_that_knows_much_less_is_of_no_use() -> None:
    assert 0.0 <= use(13, 0.02, math.radians(1.0)) < 0.001


def test_a_teammate_that_knows_better_is_of_use_for_the_position() -> None:
    assert use(2, 0.5, math.radians(1.0)) > 2.0


def test_a_teammate_is_of_use_for_a_heading_that_is_not_known() -> None:
    assert use(2, 0.02, math.radians(60.0)) > 2.0
    assert use(2, 0.02, math.radians(60.0), range_m=8.0) > use(2, 0.02, math.radians(60.0))


@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(0.01, 0.5))
def test_a_better_teammate_is_of_no_less_use(m: float, rad: float, sensor_m: float) -> None:
    uses = [use(tier, m, rad, sensor_m=sensor_m) for tier in range(LOWEST_TIER)]
    assert all(a >= b - 1e-12 for a, b in pairwise(uses))
    assert uses[-1] >= 0.0


# When listeners are told again --------------------------------------------------------------------

seconds = st.floats(0.0, 5.0)


def later(copy: Belief, age_s: float) -> Belief:
    """The belief of a robot that has driven on as it said."""
    pose = Pose2(copy.x_m, copy.y_m, copy.heading_rad)
    pose = step(pose, copy.speed_m_s * age_s, copy.turn_rate_rad_s * age_s)
    stamp_ns = copy.stamp_ns + round(age_s * SECOND)
    return replace(copy, stamp_ns=stamp_ns, x_m=pose.x, y_m=pose.y, heading_rad=pose.heading)


@given(seconds, st.floats(-1.0, 1.0), st.floats(0.01, 2.0), st.floats(-3.0, 3.0))
def test_a_robot_that_drives_on_as_it_said_has_no_news(
    age_s: float, speed: float, turn_rate: float, heading: float
) -> None:
    copy = belief(1.0, 2.0, 0, heading=heading, speed_m_s=speed, turn_rate_rad_s=turn_rate)
    assert staleness(copy, later(copy, age_s)) == pytest.approx(0.0, abs=1e-4)


def test_without_a_copy_all_is_news() -> None:
    assert staleness(None, belief(1.0, 2.0)) == math.inf


@given(st.floats(0.0, 3.0), st.floats(0.0, 3.0), st.floats(-3.0, 3.0))
def test_the_error_of_the_copy_is_in_sigmas(a: float, b: float, direction: float) -> None:
    copy = belief(1.0, 2.0, sigma_m=0.2)
    near, far = (
        staleness(
            copy,
            replace(copy, x_m=1.0 + d * math.cos(direction), y_m=2.0 + d * math.sin(direction)),
        )
        for d in sorted((a, b))
    )
    assert near <= far + 1e-9
    assert far == pytest.approx(max(a, b) / 0.2, rel=1.01 * exactness(round_(0.2)))


def test_a_robot_that_has_stopped_has_news() -> None:
    copy = belief(0.0, 0.0, sigma_m=0.1, speed_m_s=0.5)
    stopped = replace(copy, stamp_ns=SECOND // 2, speed_m_s=0.0)
    assert staleness(copy, stopped) == pytest.approx(2.5)


@given(st.floats(0.05, 2.0), st.floats(0.05, 2.0))
def test_news_of_the_sigma_is_worth_the_same_either_way(a: float, b: float) -> None:
    better, worse = belief(0.0, 0.0, sigma_m=a), belief(0.0, 0.0, sigma_m=b)
    assert staleness(better, worse) == pytest.approx(staleness(worse, better))
    tolerance = exactness(round_(min(a, b)))
    assert staleness(better, worse) == pytest.approx(2.0 * abs(math.log(a / b)), abs=tolerance)


@given(covariances)
def test_news_of_the_sigma_is_of_the_ellipse_whatever_its_direction(shape: Covariance2) -> None:
    def believed(area: Covariance2) -> Belief:
        return replace(belief(0.0, 0.0), covariance=(area.xx, area.xy, area.yy, 0.0, 0.0, 0.01))

    twice = staleness(believed(shape), believed(shape.scaled(4.0)))
    assert twice == pytest.approx(2.0 * math.log(2.0), abs=exactness(shape))


# What is exact, at the same place, or known along one line only ----------------------------------

exact_or_not = st.just(0.0) | st.floats(1e-9, 20.0)
areas = st.builds(oriented, exact_or_not, exact_or_not, st.floats(-math.pi, math.pi))
ways = st.just(0.0) | st.floats(-20.0, 20.0)
either_rules = CollaborationSettings(fusion="split-ci"), CollaborationSettings(fusion="naive")


@given(areas, areas, areas, fusions)
def test_merging_and_its_worth_are_finite(
    prior: Covariance2, fresh: Covariance2, dependent: Covariance2, fusion: Fusion
) -> None:
    after = merged(prior, fresh, dependent, fusion)
    assert all(map(math.isfinite, after))
    assert after.xx > 0.0 < after.yy
    assert 0.0 <= worth(prior, after) + 1e-6 < math.inf


@given(areas, areas)
def test_worth_is_finite(prior: Covariance2, after: Covariance2) -> None:
    assert math.isfinite(worth(prior, after))


def test_what_is_exact_gains_nothing() -> None:
    assert worth(NOTHING, NOTHING) == 0.0
    for fusion in ("split-ci", "naive"):
        assert worth(NOTHING, merged(NOTHING, NOTHING, NOTHING, fusion)) == 0.0


@given(tiers, areas, ways, ways)
def test_what_is_expected_is_finite(tier: int, area: Covariance2, x: float, y: float) -> None:
    after = expected(tier, Helped(0.0, 0.0, area), x, y, RULES)
    assert all(map(math.isfinite, after))
    least, most = sigma_range_m(tier, RULES)
    assert least * (1.0 - 1e-9) <= sigma_of(after) <= most * (1.0 + 1e-9)


@given(tiers, areas, areas, exact_or_not, ways, ways, st.sampled_from(either_rules))
def test_use_is_finite(
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
    use = use_of(seen, tier, Estimate(Pose2(1.0, 2.0, 0.5), covariance), rules)
    assert 0.0 <= use + 1e-6 < math.inf


def test_a_teammate_at_the_same_place_says_nothing_of_the_heading() -> None:
    for range_m in (0.0, 1e-200, 1e-9, 1e-4):
        assert use(2, 0.02, math.radians(60.0), range_m=range_m) == use(2, 0.02, 0.0)


@given(areas, areas, ways, ways, exact_or_not)
def test_staleness_is_finite(
    a: Covariance2, b: Covariance2, dx: float, dy: float, sigma_rad: float
) -> None:
    copy, now = (
        replace(belief(0.0, 0.0), covariance=(*area, 0.0, 0.0, sigma_rad**2)) for area in (a, b)
    )
    assert math.isfinite(staleness(copy, replace(now, x_m=dx, y_m=dy)))
    assert staleness(copy, copy) == 0.0
