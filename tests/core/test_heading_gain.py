"""The information gain of headings, and the heading variance that a sender predicts."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.gains import NOTHING, fusions, round_covariance

from cpcbl_team.config import Fusion
from cpcbl_team.information_gain import (
    USUAL_HEADING_SIGMA_RAD,
    HeadingMemory,
    heading_information_gain,
    merged_heading_variance,
    predicted_teammate_heading_variance,
)
from cpcbl_team.inputs import Fix
from cpcbl_team.tiers import LOWEST_TIER

GOOD, USUAL = 5, USUAL_HEADING_SIGMA_RAD**2
variances = st.floats(1e-6, math.pi**2)


def fix_at(distance: float, sensor_m: float = 0.0) -> Fix:
    """A teammate at this distance from (1, 2), where it was last sent its heading."""
    return Fix("mate", "me", 0, 1.0 + distance, 2.0, round_covariance(sensor_m), NOTHING)


def test_sensor_noise_does_not_count_as_motion_of_the_teammate() -> None:
    sent = HeadingMemory(1.0, 2.0, 0.001)
    assert predicted_teammate_heading_variance(GOOD, sent, fix_at(0.2, sensor_m=0.1)) == 0.001
    assert predicted_teammate_heading_variance(GOOD, sent, fix_at(0.2)) > 0.002


def fix_with_heading(sensor_variance: float, observer_variance: float) -> Fix:
    place = Fix("mate", "me", 0, 1.0, 2.0, NOTHING, NOTHING)
    return replace(
        place,
        heading_rad=0.5,
        heading_sensor_variance=sensor_variance,
        heading_observer_variance=observer_variance,
    )


def test_the_gain_of_a_heading_equals_the_value_computed_by_hand() -> None:
    """From 10 to 5 degrees is a factor of two; a lost robot gains from a uniform distribution."""
    after = merged_heading_variance(USUAL, fix_with_heading(USUAL / 3.0, 0.0), "naive")
    assert heading_information_gain(USUAL, after) == pytest.approx(math.log(2.0), rel=1e-6)
    lost = predicted_teammate_heading_variance(LOWEST_TIER, None, fix_at(0.0))
    assert lost == pytest.approx(math.pi**2 / 3.0)
    after = merged_heading_variance(lost, fix_with_heading(math.radians(5.0) ** 2, 0.0), "naive")
    assert heading_information_gain(lost, after) == pytest.approx(
        math.log(1.8138 / 0.08716), rel=1e-3
    )


@given(variances, variances, variances, fusions)
def test_a_heading_gains_no_more_than_its_accuracy_permits(
    prior: float, sensor: float, observer: float, fusion: Fusion
) -> None:
    after = merged_heading_variance(prior, fix_with_heading(sensor, observer), fusion)
    assert -1e-9 <= heading_information_gain(prior, after) < math.inf
    assert after >= 0.99 / (1.0 / prior + 1.0 / (sensor + observer))


@given(variances, variances)
def test_the_second_heading_of_one_observer_gains_almost_nothing(
    prior: float, observer: float
) -> None:
    """Split covariance intersection counts the observer's own heading error once."""
    once = merged_heading_variance(prior, fix_with_heading(0.0, observer), "split-ci")
    twice = merged_heading_variance(once, fix_with_heading(0.0, observer), "split-ci")
    assert twice >= 0.99 * min(prior, observer)
    assert heading_information_gain(once, twice) < 0.05


@given(variances, st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_the_predicted_heading_variance_grows_up_to_the_usual_one(
    left: float, a: float, b: float
) -> None:
    sent = HeadingMemory(1.0, 2.0, min(left, USUAL))
    near, far = (
        predicted_teammate_heading_variance(GOOD, sent, fix_at(distance))
        for distance in sorted((a, b))
    )
    assert (
        sent.variance <= near <= far <= predicted_teammate_heading_variance(GOOD, None, fix_at(a))
    )
    assert predicted_teammate_heading_variance(LOWEST_TIER, sent, fix_at(a)) > USUAL


def test_a_heading_gains_again_after_two_metres() -> None:
    """The observer knows its own heading to 1 degree and the marker's to 3 degrees."""
    fix = fix_with_heading(math.radians(3.0) ** 2, math.radians(1.0) ** 2)
    left, gained = USUAL, []
    for distance in (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0):
        prior = predicted_teammate_heading_variance(
            GOOD, HeadingMemory(1.0, 2.0, left), fix_at(distance)
        )
        left = merged_heading_variance(prior, fix, "split-ci")
        gained.append(heading_information_gain(prior, left))
    assert gained[0] > 1.0
    assert gained[5] < 0.1
    assert gained[6] > 0.3
