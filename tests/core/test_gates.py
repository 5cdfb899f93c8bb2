"""The bounds of the gates: 99.9 % of the chi-square distribution of as many readings as are judged.

That is 10.8 with one degree of freedom, 13.8 with two and 16.3 with three.
"""

import math

import pytest
from support.core import belief, diagonal, localizer, state_at

from cpcbl_team.config import Field, Landmark, SensorSettings
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_team.sensors import range_sigma_m
from cpcbl_team.trusted_pose import agrees

ORIGIN = Pose2(0.0, 0.0, 0.0)
RANGE_M = 4.0  # of the object, straight ahead
SIGMA_M, SIGMA_RAD = 0.05, 0.2  # of the prior
SENSOR = SensorSettings()
OWN = range_sigma_m(SENSOR, RANGE_M), SENSOR.bearing_sigma_rad

pair = pytest.mark.parametrize(("nis", "count"), [(13.0, "accepted"), (14.5, "gated")])
alone = pytest.mark.parametrize(("nis", "count"), [(10.0, "accepted"), (11.5, "gated")])


def readings_off(nis: float, readings: int, place_sigma_m: float = 0.0) -> tuple[float, float]:
    """The range (m) and the bearing (rad) of an object straight ahead whose normalized innovations
    squared add up to this, each with the same share of it."""
    range_sigma_m, bearing_sigma = OWN
    position = SIGMA_M**2 + place_sigma_m**2
    of_range = position + range_sigma_m**2
    of_bearing = position / RANGE_M**2 + SIGMA_RAD**2 + bearing_sigma**2
    share = nis / readings
    return RANGE_M + math.sqrt(share * of_range), math.sqrt(share * of_bearing)


@pair
@pytest.mark.parametrize("is_plain", [True, False])
def test_a_range_and_a_bearing_are_judged_together(nis: float, count: str, is_plain: bool) -> None:
    """The same for plain landmarks and for those with sigmas of their own."""
    robot = localizer(field=Field(landmarks={"post": Landmark(x_m=RANGE_M, y_m=0.0)}))
    sigmas = (None, None) if is_plain else OWN
    visible = Sightings(1, (Sighting("post", *readings_off(nis, 2), *sigmas),))
    after = robot.cycle(state_at(ORIGIN, diagonal(SIGMA_M, SIGMA_RAD)), visible)
    assert after.counts == {count: 1}


@alone
@pytest.mark.parametrize("is_plain", [True, False])
def test_a_bearing_alone_is_judged_by_the_smaller_bound(
    nis: float, count: str, is_plain: bool
) -> None:
    robot = localizer(field=Field(landmarks={"post": Landmark(x_m=RANGE_M, y_m=0.0)}))
    sigma = None if is_plain else OWN[1]
    _, bearing = readings_off(nis, 1)
    visible = Sightings(1, (Sighting("post", None, bearing, None, sigma),))
    after = robot.cycle(state_at(ORIGIN, diagonal(SIGMA_M, SIGMA_RAD)), visible)
    assert after.counts == {count: 1}


@pair
def test_a_teammate_is_judged_by_its_own_uncertainty_too(nis: float, count: str) -> None:
    robot = localizer(field=Field())
    state = state_at(ORIGIN, diagonal(SIGMA_M, SIGMA_RAD))
    state = robot.add_teammate_belief(state, belief(RANGE_M, 0.0, sigma_m=0.04))
    visible = Sightings(1, (Sighting("mate", *readings_off(nis, 2, 0.04)),))
    assert robot.cycle(state, visible).counts == {count: 1}


@pytest.mark.parametrize(("nis", "is_the_same"), [(15.5, True), (17.0, False)])
def test_a_pose_is_compared_with_three_degrees_of_freedom(nis: float, is_the_same: bool) -> None:
    """The error of the difference has the variances of both poses."""
    estimate = Estimate(ORIGIN, diagonal(0.3, 0.2))
    off_m, off_rad = math.sqrt(0.25 * nis * 2.0) * 0.3, math.sqrt(0.5 * nis * 2.0) * 0.2
    found = Estimate(Pose2(off_m, -off_m, off_rad), diagonal(0.3, 0.2))
    assert agrees(estimate, found) is is_the_same
