"""The non-probabilistic variant: weighted averages (checklist rows 13 to 16)."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import diagonal, frame, product_of, state_at
from support.standing import ORIGIN, TENTH, standing

from cpcbl_team.config import Field, Landmark, Weights
from cpcbl_team.constraints import range_circle
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting, Sightings

PAIR = Field(
    landmarks={
        "near": Landmark(x_m=0.0, y_m=1.0),
        "far": Landmark(x_m=4.0, y_m=0.0),
    }
)
WEIGHTS = Weights(position=0.25, heading=0.5)


def test_readings_are_weighted_by_inverse_distance_then_statically() -> None:
    """Ranges of 1.2 and 3.8 m: 0.2 m to the south and 0.2 m to the east."""
    robot = standing("weighted", PAIR, weights=WEIGHTS)
    visible = Sightings(1, (Sighting("near", 1.2), Sighting("far", 3.8)))
    near, far = 1.0 / 1.2, 1.0 / 3.8  # row 14
    pose = robot.cycle(state_at(ORIGIN, diagonal(0.3, 0.1)), visible).estimate.pose
    assert pose.x == pytest.approx(0.25 * 0.2 * far / (near + far))  # row 15
    assert pose.y == pytest.approx(-0.25 * 0.2 * near / (near + far))
    assert pose.heading == 0.0


def test_headings_are_weighted_the_same_way() -> None:
    robot = standing("weighted", PAIR, weights=WEIGHTS)
    bearings = (Sighting("near", None, 0.5 * math.pi + 0.1), Sighting("far", None, -0.05))
    prior = state_at(ORIGIN, diagonal(0.3, 0.1))
    pose = robot.cycle(prior, Sightings(1, bearings)).estimate.pose
    near, far = 1.0, 0.25
    assert pose.heading == pytest.approx(0.5 * (-0.1 * near + 0.05 * far) / (near + far))
    assert (pose.x, pose.y) == (0.0, 0.0)


@given(
    st.lists(st.floats(-0.1, 0.1), min_size=2, max_size=2),
    st.floats(0.05, 0.95),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
)
def test_weighted_averages_are_circular_gaussians_of_constant_relative_covariance(
    errors: list[float], weight: float, x: float, y: float
) -> None:
    """Row 16: a reading's variance in proportion to its distance, the estimate's to theirs."""
    pose = Pose2(x, y, 0.4)
    ranges = {
        name: math.hypot(p.x_m - x, p.y_m - y) + error
        for (name, p), error in zip(PAIR.landmarks.items(), errors, strict=True)
    }
    sensor = None
    for name, range_m in ranges.items():
        landmark = PAIR.landmarks[name]
        circle = range_circle(pose, landmark.x_m, landmark.y_m, range_m, 0.1)
        assert circle is not None
        point = Gaussian2(*circle.closest_point(pose), Covariance2(range_m, 0.0, range_m))
        sensor = point if sensor is None else product_of(sensor, point)
    assert sensor is not None
    own = sensor.covariance.scaled(weight / (1.0 - weight))
    expected = product_of(Gaussian2(x, y, own), sensor)

    robot = standing("weighted", PAIR, weights=Weights(position=weight))
    visible = Sightings(1, tuple(Sighting(name, r) for name, r in ranges.items()))
    found = robot.cycle(state_at(pose, diagonal(0.5, 0.1)), visible).estimate.pose
    assert (found.x, found.y) == pytest.approx((expected.x, expected.y), abs=1e-9)


def test_a_weighted_robot_claims_a_nominal_quality() -> None:
    w = Weights(nominal_sigma_m=0.2, nominal_heading_sigma_deg=5.0)
    state = state_at(ORIGIN, diagonal(0.5, 0.5))
    robot = standing("weighted", weights=w)
    for i in range(1, 41):
        state = robot.cycle(state, frame(ORIGIN, i * TENTH))
    assert state.estimate.covariance == pytest.approx(diagonal(0.2, math.radians(5.0)))
