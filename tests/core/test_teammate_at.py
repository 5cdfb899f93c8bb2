"""Passive collaboration: a teammate as a landmark, by its beliefs."""

import math
from collections.abc import Sequence
from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import (
    SECOND,
    belief,
    least_eigenvalue,
    matrix2,
)

from cpcbl_team.config import CollaborationSettings
from cpcbl_team.inputs import Belief
from cpcbl_team.measurements import nearest_belief, position_by_belief
from cpcbl_team.places import ObjectPosition

RULES = CollaborationSettings(tier_width=2.0, tier_hysteresis=1.2)


def teammate_at(
    beliefs: Sequence[Belief], at_ns: int, rules: CollaborationSettings
) -> ObjectPosition | None:
    nearest = nearest_belief(beliefs, at_ns, rules)
    return None if nearest is None else position_by_belief(nearest[1], at_ns)


def found(position: ObjectPosition | None) -> ObjectPosition:
    assert position is not None
    return position


def test_a_standing_teammate_is_at_the_position_of_its_belief() -> None:
    position = found(teammate_at([belief(1.0, 2.0, sigma_m=0.2)], SECOND // 2, RULES))
    assert (position.x, position.y) == (1.0, 2.0)
    assert position.covariance == pytest.approx((0.04, 0.0, 0.04))


def test_a_driving_teammate_is_extrapolated() -> None:
    """Resolution e: 0.5 s at 1 m/s to the north; a third of the distance is added to sigma."""
    sent = belief(1.0, 2.0, heading=0.5 * math.pi, sigma_m=0.2, speed_m_s=1.0)
    position = found(teammate_at([sent], SECOND // 2, RULES))
    assert (position.x, position.y) == pytest.approx((1.0, 2.5))
    growth = (0.5 / 3.0) ** 2
    sideways = 0.04 + (0.5 * 0.05) ** 2 + growth  # the sigma of its heading is 0.05
    assert position.covariance == pytest.approx((sideways, 0.0, 0.04 + growth))


def test_a_turning_teammate_is_extrapolated_along_its_arc() -> None:
    sent = belief(0.0, 0.0, speed_m_s=1.0, turn_rate_rad_s=0.4)
    position = found(teammate_at([sent], SECOND // 2, RULES))
    assert (position.x, position.y) == pytest.approx((0.5 * math.cos(0.1), 0.5 * math.sin(0.1)))


def test_a_teammate_is_extrapolated_backwards_to_an_earlier_sighting() -> None:
    sent = belief(1.0, 2.0, SECOND, sigma_m=0.2, speed_m_s=1.0)
    position = found(teammate_at([sent], SECOND - SECOND // 4, RULES))
    assert (position.x, position.y) == pytest.approx((0.75, 2.0))
    growth = (0.25 / 3.0) ** 2
    sideways = 0.04 + (0.25 * 0.05) ** 2 + growth
    assert position.covariance == pytest.approx((0.04 + growth, 0.0, sideways))


@pytest.mark.parametrize(
    ("age_s", "used"),
    [(-0.6, False), (-0.5, True), (-0.1, True), (0.0, True), (1.5, True), (1.6, False)],
)
def test_a_belief_is_used_from_half_a_second_before_it_up_to_its_greatest_age(
    age_s: float, used: bool
) -> None:
    position = teammate_at([belief(1.0, 2.0, 5 * SECOND)], int((5.0 + age_s) * SECOND), RULES)
    assert (position is not None) is used


@pytest.mark.parametrize(
    ("ages_s", "nearest"),
    [
        ((0.3, 0.1, 0.2), 0.1),
        ((0.3, -0.2, -0.4), -0.2),
        ((0.7, -0.6), 0.7),  # the belief of 0.6 s later is nearer, but too late
        ((1.5, 1.6), 1.5),
        ((1.6, -0.6), None),
        ((), None),
    ],
)
def test_the_nearest_usable_belief_is_used(
    ages_s: tuple[float, ...], nearest: float | None
) -> None:
    for ages in permutations(ages_s):
        beliefs = [belief(age, 2.0, 5 * SECOND - round(age * SECOND)) for age in ages]
        position = teammate_at(beliefs, 5 * SECOND, RULES)
        assert (position.x if position else None) == nearest


@given(st.floats(-0.5, 1.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_extrapolation_never_reduces_the_covariance(
    age_s: float, speed: float, turn_rate: float
) -> None:
    sent = belief(1.0, 2.0, speed_m_s=speed, turn_rate_rad_s=turn_rate)
    later = matrix2(found(teammate_at([sent], int(age_s * SECOND), RULES)).covariance)
    assert (
        least_eigenvalue(later - matrix2(found(teammate_at([sent], 0, RULES)).covariance)) > -1e-12
    )


@pytest.mark.parametrize(("age_s", "driven_m"), [(0.1, 0.08), (0.4, 0.32)])
def test_a_teammate_that_turned_may_have_driven_on(age_s: float, driven_m: float) -> None:
    """It turned at 1.5 rad/s when it was last heard, and drives at 0.8 m/s since then."""
    sent = belief(1.0, 2.0, sigma_m=0.02, turn_rate_rad_s=1.5)
    position = found(teammate_at([sent], int(age_s * SECOND), RULES))
    assert 3.0 * math.sqrt(position.covariance.xx) > driven_m
