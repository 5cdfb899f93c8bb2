import math
from collections.abc import Mapping

import numpy as np
import pytest
from support.core import CORNERS, SECOND, belief, diagonal, matrix2, state_at

from cpcbl_team.config import (
    CollaborationSettings,
    Field,
    Gives,
    Landmark,
    LocalizationSettings,
    LocalizerSettings,
    SensorSettings,
    Variant,
    Wall,
)
from cpcbl_team.constraints import bearing_position, bearing_ray, curvature
from cpcbl_team.estimate import Scope
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Belief, Sighting
from cpcbl_team.measurements import (
    Measurement,
    constraints_of,
    gated_object,
    measurement_of,
    observation_of,
)
from cpcbl_team.places import ObjectPosition

HERE = Pose2(0.0, 0.0, 0.0)


def measure(
    sighting: Sighting,
    field: Field = CORNERS,
    *,
    teammates: Mapping[str, tuple[Belief, ...]] | None = None,
    sensor: SensorSettings | None = None,
    passive: bool = True,
    stamp_ns: int = 0,
) -> Measurement | None:
    settings = LocalizationSettings(
        sensor=sensor or SensorSettings(),
        collaboration=CollaborationSettings(passive=passive),
    )
    return measurement_of(sighting, stamp_ns, HERE, field, teammates or {}, settings)


@pytest.mark.parametrize(
    ("gives", "range_m", "bearing"),
    [
        ("both", 2.0, 0.5),
        ("range", 2.0, None),
        ("bearing", None, 0.5),
        ("none", None, None),
    ],
)
def test_a_landmark_gives_what_it_is_configured_to(
    gives: Gives, range_m: float | None, bearing: float | None
) -> None:
    field = Field(
        landmarks={"post": Landmark(x_m=1.0, y_m=2.0, gives=gives)},
        walls={"wall": Wall(from_m=(0.0, 2.0), to_m=(1.0, 2.0), gives=gives)},
    )
    for name in ("post", "wall"):  # rows 2, 11, 19
        measurement = measure(Sighting(name, 2.0, 0.5), field)
        assert measurement is not None
        assert (measurement.range_m, measurement.bearing) == (range_m, bearing)
        assert measurement.has_point_bearing is (name == "post" and bearing is not None)


@pytest.mark.parametrize(("range_m", "used"), [(2.9, 2.9), (3.1, None)])
def test_a_range_beyond_the_good_ones_leaves_the_bearing(
    range_m: float, used: float | None
) -> None:
    measurement = measure(
        Sighting("ne", range_m, 0.5), sensor=SensorSettings(max_range_for_range_m=3.0)
    )
    assert measurement is not None  # row 3
    assert (measurement.range_m, measurement.bearing) == (used, 0.5)


def test_a_sighting_may_lack_a_quantity() -> None:
    measurement = measure(Sighting("ne", None, 0.5))
    assert measurement is not None
    assert measurement.range_m is None


def test_what_is_on_the_map_is_placed_exactly() -> None:
    measurement = measure(Sighting("ne", 2.0, 0.5))
    assert measurement is not None
    assert measurement.position == (4.5, 2.5, (0.0, 0.0, 0.0))
    assert not measurement.is_teammate


def test_the_range_sigma_is_that_of_the_range_to_be_expected() -> None:
    sensor = SensorSettings(range_share=0.1, range_floor_m=0.0)
    field = Field(
        landmarks={"post": Landmark(x_m=3.0, y_m=4.0)},
        walls={"wall": Wall(from_m=(-9.0, 5.0), to_m=(0.0, 5.0))},
    )
    for name in field.landmarks | field.walls:
        measurement = measure(Sighting(name, 4.0, 0.0), field, sensor=sensor)
        assert measurement is not None
        assert measurement.range_sigma == pytest.approx(0.5)


def test_an_unknown_object_is_not_used() -> None:
    assert measure(Sighting("mate", 2.0, 0.5)) is None


def test_a_teammate_with_a_belief_is_one_more_landmark() -> None:
    beliefs = {"mate": (belief(1.0, 2.0, sigma_m=0.3),)}
    measurement = measure(Sighting("mate", 2.0, 0.5), teammates=beliefs)
    assert measurement is not None  # row 25
    assert measurement.is_teammate
    assert measurement.position.covariance == pytest.approx((0.09, 0.0, 0.09))
    assert measure(Sighting("mate", 2.0, 0.5), teammates=beliefs, passive=False) is None


def test_a_teammate_whose_belief_is_too_old_is_not_used() -> None:
    beliefs = {"mate": (belief(1.0, 2.0),)}
    late = Sighting("mate", math.sqrt(5.0), 0.5)
    assert measure(late, teammates=beliefs, stamp_ns=2 * SECOND) is None


@pytest.mark.parametrize("scope", Scope)
@pytest.mark.parametrize("name", ["ne", "mate"])
def test_the_gate_measures_the_innovation_of_the_whole_observation(name: str, scope: Scope) -> None:
    """For a landmark in a shorter way, for its place is exact."""
    prior = state_at(HERE, diagonal(0.02, 0.1)).estimate
    measurement = measure(
        Sighting(name, 3.0, 0.7), teammates={"mate": (belief(1.0, 2.0, sigma_m=0.3),)}
    )
    assert measurement is not None
    cs = constraints_of(HERE, measurement, scope, LocalizerSettings())
    whole = observation_of(prior, measurement, cs)
    expected = whole.normalized_innovation_squared(prior.covariance)
    assert expected > 0.0
    assert gated_object(prior, measurement, cs).nis == pytest.approx(expected, rel=1e-12)


def test_a_teammate_nearby_is_as_uncertain_as_its_linear_form_is_wrong() -> None:
    """That part of the error repeats itself, so it counts as the teammate's."""
    prior, place = state_at(HERE, diagonal(0.3, 0.2)).estimate, (0.6, 0.8)
    m = measure(Sighting("mate", 1.0, 0.9), teammates={"mate": (belief(*place, sigma_m=0.2),)})
    assert m is not None
    found = observation_of(prior, m, constraints_of(HERE, m, Scope.POSE, LocalizerSettings()))
    both = prior.covariance.plus(diagonal(0.2, 0.0))
    of_range, of_bearing = curvature(both, *place)
    assert of_range > 0.01
    assert found.dependent.xx == pytest.approx(0.2**2 + of_range)
    assert found.dependent.yy == pytest.approx(0.2**2 + of_bearing)


def test_an_error_of_a_teammates_place_is_in_its_range_and_in_its_bearing() -> None:
    """The dependent part is A C A^T; A: how the two residuals follow an error of the place."""
    place = ObjectPosition(3.0, 4.0, Covariance2(0.04, 0.03, 0.09))
    m = Measurement("mate", place, None, True, 5.0, 0.9, 0.1, 0.05)
    prior = state_at(HERE, diagonal(0.05, 0.1)).estimate
    found = observation_of(prior, m, constraints_of(HERE, m, Scope.POSE, LocalizerSettings()))
    follows = np.array([[-0.6, -0.8], [-0.8 / 5.0, 0.6 / 5.0]])
    expected = follows @ matrix2(place.covariance) @ follows.T
    assert abs(expected[0, 1]) > 0.002
    assert found.dependent.xy == pytest.approx(expected[0, 1])


@pytest.mark.parametrize("variant", ["oval", "circular"])
def test_a_ray_is_linear_at_the_estimate_and_as_drawn_at_the_reading(variant: Variant) -> None:
    m = measure(Sighting("ne", 5.0, 1.2))
    assert m is not None
    place = m.position.x, m.position.y
    read = 1.2, m.bearing_sigma
    for rules, expected in (
        (LocalizerSettings(variant=variant), bearing_position(HERE, *place, *read)),
        (
            LocalizerSettings(variant=variant, paper_uncertainty=True),
            bearing_ray(HERE, *place, *read),
        ),
    ):
        assert expected is not None
        *_, ray = constraints_of(HERE, m, Scope.POSITION, rules)
        assert ray.row[:2] == expected.row[:2]
