import math

import pytest

from cpcbl_team.config import SensorSettings
from cpcbl_team.inputs import Sighting
from cpcbl_team.sensors import sighting_fault, sighting_sigmas

SENSOR = SensorSettings(range_share=0.05, range_floor_m=0.0, bearing_sigma_deg=5.0)
NAN = math.nan


@pytest.mark.parametrize(
    ("sighting", "fault"),
    [
        (Sighting("a", NAN, 0.1), "not_finite"),
        (Sighting("a", math.inf, 0.1), "not_finite"),
        (Sighting("a", 1.0, NAN), "not_finite"),
        (Sighting("a", 1.0, 0.1, NAN), "not_finite"),
        (Sighting("a", 1.0, 0.1, None, -math.inf), "not_finite"),
        (Sighting("a"), "empty_sighting"),
        (Sighting("a", None, None, 0.1, 0.1), "empty_sighting"),
        (Sighting("a", 0.0), "range_not_positive"),
        (Sighting("a", -1.0, 0.1), "range_not_positive"),
        (Sighting("a", 1.0, 3.2), "bearing_out_of_range"),
        (Sighting("a", None, -3.2), "bearing_out_of_range"),
        (Sighting("a", 1.0, 0.1, 0.0), "sigma_not_positive"),
        (Sighting("a", 1.0, 0.1, None, -0.1), "sigma_not_positive"),
    ],
)
def test_a_sighting_that_must_not_be_used_says_why(sighting: Sighting, fault: str) -> None:
    assert sighting_fault(sighting) == fault  # resolution i


@pytest.mark.parametrize(
    "sighting",
    [
        Sighting("a", 1.0),
        Sighting("a", None, math.pi),
        Sighting("a", None, -math.pi),
        Sighting("a", 1e-6, 0.0, 1e-6, 1e-6),
    ],
)
def test_a_sighting_may_give_either_or_both(sighting: Sighting) -> None:
    assert sighting_fault(sighting) == ""  # row 2


def test_a_range_sigma_is_a_share_of_the_range() -> None:
    range_sigma, bearing_sigma = sighting_sigmas(Sighting("a", 4.0, 0.0), SENSOR)
    assert range_sigma == pytest.approx(0.2)  # row 34
    assert bearing_sigma == pytest.approx(math.radians(5.0))


def test_a_range_sigma_has_a_floor() -> None:
    sensor = SensorSettings(range_share=0.03, range_floor_m=0.04)
    assert sensor.range_sigma_m(1.0) == pytest.approx(0.05)
    assert sensor.range_sigma_m(0.0) == pytest.approx(0.04)


@pytest.mark.parametrize(("expected_m", "sigma_m"), [(5.0, 0.25), (100.0, 0.4), (0.1, 0.1)])
def test_the_expected_range_makes_the_sigma_within_a_factor_of_two(
    expected_m: float, sigma_m: float
) -> None:
    """Readings that are too short must not weigh more than those that are too long."""
    assert sighting_sigmas(Sighting("a", 4.0), SENSOR, expected_m)[0] == pytest.approx(sigma_m)


def test_a_sightings_own_sigmas_win() -> None:
    assert sighting_sigmas(Sighting("a", 4.0, 0.0, 0.7, 0.3), SENSOR, 8.0) == (0.7, 0.3)
