import math
from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.core import (
    SECOND,
    belief,
    covariance3,
    diagonal,
    least_eigenvalue,
    matrix2,
    random_matrix,
)

from cpcbl_team.beliefs import ObjectPosition, teammate_at
from cpcbl_team.config import CollaborationSettings, SensorSettings
from cpcbl_team.estimate import Estimate
from cpcbl_team.fixes import fix_for, without_heading
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Fix, Sighting
from cpcbl_team.tiers import LOWEST_TIER, TIER_ZERO_SIGMA_M, accepted_tiers, next_tier, tier_of

SENSOR = SensorSettings(range_share=0.05, range_floor_m=0.0, bearing_sigma_deg=5.0)
RULES = CollaborationSettings(tier_width=2.0, tier_hysteresis=1.2)
sigmas = st.floats(1e-4, 100.0)


def observed(sighting: Sighting, estimate: Estimate, sensor: SensorSettings = SENSOR) -> Fix | None:
    return fix_for("me", "mate", 7, estimate, sighting, sensor)


def an_observer(seed: int) -> Estimate:
    rng = np.random.default_rng(seed)
    return Estimate(Pose2(1.0, -2.0, rng.uniform(-3.0, 3.0)), covariance3(random_matrix(rng, 3)))


# Active -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_a_fix_is_the_sighting_compounded_with_the_observers_pose(seed: int) -> None:
    """Row 40, by finite differences of pose and measurement; its two parts stay apart."""
    observer = an_observer(seed)
    pose = observer.pose
    r, a = 3.0, 0.4 * seed - 0.9

    def place(x: float, y: float, h: float, along: float, across: float) -> tuple[float, float]:
        c, s = math.cos(a), math.sin(a)
        sight = (r + along) * c - across * s, (r + along) * s + across * c
        return Pose2(x, y, h).transform(*sight)

    h = 1e-6
    v = np.array([*pose, 0.0, 0.0])
    J = np.stack(
        [(np.array(place(*(v + d))) - place(*(v - d))) / (2 * h) for d in h * np.eye(5)], axis=1
    )
    sensor = np.diag([0.05 * r, r * math.sin(math.radians(5.0))]) ** 2
    P = np.array(observer.covariance)[[[0, 1, 3], [1, 2, 4], [3, 4, 5]]]

    sent = observed(Sighting("me", r, a), observer)
    assert sent is not None
    assert (sent.robot, sent.observer, sent.stamp_ns) == ("me", "mate", 7)
    np.testing.assert_allclose((sent.x_m, sent.y_m), place(*v), atol=1e-9)
    own = matrix2(Covariance2(*sent.sensor_covariance))
    np.testing.assert_allclose(own, J[:, 3:] @ sensor @ J[:, 3:].T, atol=1e-6)
    theirs = matrix2(Covariance2(*sent.observer_covariance))
    np.testing.assert_allclose(theirs, J[:, :3] @ P @ J[:, :3].T, atol=1e-6)


@pytest.mark.parametrize(
    "sighting",
    [
        Sighting("me", 3.0),
        Sighting("me", None, 0.1),
        Sighting("me", math.nan, 0.1),
        Sighting("me", -1.0, 0.1),
        Sighting("me", 3.0, 9.0),
        Sighting("me", 3.0, 0.1, None, None, 0.4),
    ],
)
def test_a_fix_needs_a_good_range_and_bearing(sighting: Sighting) -> None:
    assert observed(sighting, an_observer(0)) is None


def test_a_range_that_is_too_long_to_be_good_makes_no_fix() -> None:
    sensor = SensorSettings(max_range_for_range_m=2.0)  # row 3
    assert observed(Sighting("me", 1.9, 0.1), an_observer(0), sensor) is not None
    assert observed(Sighting("me", 2.1, 0.1), an_observer(0), sensor) is None


@given(st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi), st.floats(0.001, 1.0))
def test_a_heading_that_was_seen_is_told_in_the_fields_frame(
    own: float, seen: float, sigma: float
) -> None:
    observer = Estimate(Pose2(1.0, -2.0, own), diagonal(0.1, 0.03))
    sighting = Sighting("me", 3.0, 0.4)
    plain = observed(sighting, observer)
    sent = observed(replace(sighting, heading_rad=seen, heading_sigma_rad=sigma), observer)
    assert sent is not None
    assert sent.heading_rad is not None
    assert abs(sent.heading_rad) <= math.pi
    assert math.remainder(sent.heading_rad - own - seen, math.tau) == pytest.approx(0.0, abs=1e-9)
    variances = sent.heading_sensor_variance, sent.heading_observer_variance
    assert variances == pytest.approx((sigma**2, 0.03**2))
    assert without_heading(sent) == plain


# Passive ------------------------------------------------------------------------------------------


def there(place: ObjectPosition | None) -> ObjectPosition:
    assert place is not None
    return place


def test_a_teammate_that_stands_is_where_it_said() -> None:
    place = there(teammate_at([belief(1.0, 2.0, sigma_m=0.2)], SECOND // 2, RULES))
    assert (place.x, place.y) == (1.0, 2.0)
    assert place.covariance == pytest.approx((0.04, 0.0, 0.04))


def test_a_teammate_that_drives_is_carried_along() -> None:
    """Resolution e: 0.5 s at 1 m/s to the north; a third of the way is added to its sigma."""
    told = belief(1.0, 2.0, heading=0.5 * math.pi, sigma_m=0.2, speed_m_s=1.0)
    place = there(teammate_at([told], SECOND // 2, RULES))
    assert (place.x, place.y) == pytest.approx((1.0, 2.5))
    doubt = (0.5 / 3.0) ** 2
    sideways = 0.04 + (0.5 * 0.05) ** 2 + doubt  # with its heading's sigma of 0.05
    assert place.covariance == pytest.approx((sideways, 0.0, 0.04 + doubt))


def test_a_teammate_that_turns_is_carried_along_its_arc() -> None:
    told = belief(0.0, 0.0, speed_m_s=1.0, turn_rate_rad_s=0.4)
    place = there(teammate_at([told], SECOND // 2, RULES))
    assert (place.x, place.y) == pytest.approx((0.5 * math.cos(0.1), 0.5 * math.sin(0.1)))


def test_a_teammate_that_was_seen_before_it_spoke_is_carried_back() -> None:
    told = belief(1.0, 2.0, SECOND, sigma_m=0.2, speed_m_s=1.0)
    place = there(teammate_at([told], SECOND - SECOND // 4, RULES))
    assert (place.x, place.y) == pytest.approx((0.75, 2.0))
    doubt = (0.25 / 3.0) ** 2
    sideways = 0.04 + (0.25 * 0.05) ** 2 + doubt
    assert place.covariance == pytest.approx((0.04 + doubt, 0.0, sideways))


@pytest.mark.parametrize(
    ("age_s", "used"),
    [(-0.6, False), (-0.5, True), (-0.1, True), (0.0, True), (1.5, True), (1.6, False)],
)
def test_a_belief_is_used_from_half_a_second_before_it_up_to_its_greatest_age(
    age_s: float, used: bool
) -> None:
    found = teammate_at([belief(1.0, 2.0, 5 * SECOND)], int((5.0 + age_s) * SECOND), RULES)
    assert (found is not None) is used


@pytest.mark.parametrize(
    ("ages_s", "nearest"),
    [
        ((0.3, 0.1, 0.2), 0.1),
        ((0.3, -0.2, -0.4), -0.2),
        ((0.7, -0.6), 0.7),  # that of 0.6 s later is nearer, but of no use
        ((1.5, 1.6), 1.5),
        ((1.6, -0.6), None),
        ((), None),
    ],
)
def test_of_several_beliefs_the_nearest_that_is_of_use_is_taken(
    ages_s: tuple[float, ...], nearest: float | None
) -> None:
    for ages in permutations(ages_s):
        beliefs = [belief(age, 2.0, 5 * SECOND - round(age * SECOND)) for age in ages]
        place = teammate_at(beliefs, 5 * SECOND, RULES)
        assert (place.x if place else None) == nearest


@given(st.none() | st.integers(0, LOWEST_TIER), sigmas, st.integers(0, LOWEST_TIER))
def test_no_robot_claims_more_than_its_best_tier(
    present: int | None, sigma_m: float, best: int
) -> None:
    limited = CollaborationSettings(tier_width=2.0, tier_hysteresis=1.2, best_tier=best)
    free = next_tier(present, sigma_m, False, RULES)
    assert next_tier(present, sigma_m, False, limited) == max(best, free)
    assert next_tier(present, sigma_m, True, limited) == LOWEST_TIER


@given(st.floats(-0.5, 1.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_a_place_is_never_more_certain_for_being_farther_in_time(
    age_s: float, speed: float, turn_rate: float
) -> None:
    told = belief(1.0, 2.0, speed_m_s=speed, turn_rate_rad_s=turn_rate)
    later = matrix2(there(teammate_at([told], int(age_s * SECOND), RULES)).covariance)
    assert (
        least_eigenvalue(later - matrix2(there(teammate_at([told], 0, RULES)).covariance)) > -1e-12
    )


# Tiers --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sigma_m", "tier"),
    [(0.0, 0), (0.01, 0), (0.011, 1), (0.02, 1), (0.021, 2), (0.08, 3), (0.16, 4), (1e9, 15)],
)
def test_a_tier_is_a_factor_in_sigma(sigma_m: float, tier: int) -> None:
    assert tier_of(sigma_m, 2.0) == tier


@given(sigmas, sigmas, st.floats(1.05, 4.0))
def test_a_better_sigma_is_never_a_worse_tier(a: float, b: float, width: float) -> None:
    assert tier_of(min(a, b), width) <= tier_of(max(a, b), width)


@given(st.none() | st.integers(0, LOWEST_TIER), sigmas, sigmas)
def test_the_next_tier_is_monotone_too(present: int | None, a: float, b: float) -> None:
    better, worse = (next_tier(present, s, False, RULES) for s in (min(a, b), max(a, b)))
    assert better <= worse


@given(st.integers(0, LOWEST_TIER), st.lists(st.floats(0.0, 1.0), min_size=2, max_size=20))
def test_a_sigma_about_an_edge_does_not_change_the_tier_to_and_fro(
    edge: int, shares: list[float]
) -> None:
    """It wanders within the hysteresis, so that from the second time on nothing changes."""
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
def test_who_is_lost_helps_nobody(present: int | None, sigma: float) -> None:
    assert next_tier(present, sigma, True, RULES) == LOWEST_TIER


def test_who_was_lost_comes_back_to_the_tier_of_its_sigma() -> None:
    assert next_tier(LOWEST_TIER, 0.05, False, RULES) == tier_of(0.05, RULES.tier_width)


@given(st.integers(0, LOWEST_TIER), st.integers(0, LOWEST_TIER))
def test_one_way_hears_only_what_is_better(own: int, other: int) -> None:
    """Never both of two robots, so nothing goes in circles (rows 29, 30, resolution d)."""
    heard = accepted_tiers(own, CollaborationSettings(direction="one-way"))
    assert (other in heard) is (other < own)


@given(st.integers(0, LOWEST_TIER))
def test_both_ways_hears_all(own: int) -> None:
    heard = accepted_tiers(own, CollaborationSettings(direction="both-ways"))
    assert list(heard) == list(range(LOWEST_TIER + 1))
