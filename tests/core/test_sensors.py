import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpcbl_team.config import OdometrySettings, SensorSettings
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_team.sensors import (
    corrected_odometry,
    corrected_sighting,
    range_sigma_m,
    recalibrated,
    repetition_variance_factor,
    sighting_fault,
    sighting_sigmas,
    time_at_min_speed_s,
    without_duplicates,
)

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
        (Sighting("a", 1.0, 0.1, None, None, NAN, 0.1), "not_finite"),
        (Sighting("a", 1.0, 0.1, None, None, 0.3, math.inf), "not_finite"),
        (Sighting("a", 1.0, 0.1, None, None, 1e7, 0.1), "implausible_number"),
        (Sighting("a", None, None, None, None, 0.3, 0.1), "empty_sighting"),
        (Sighting("a", 1.0, 0.1, None, None, -3.2, 0.1), "heading_out_of_range"),
        (Sighting("a", 1.0, 0.1, None, None, 0.3), "heading_without_sigma"),
        (Sighting("a", 1.0, 0.1, None, None, 0.3, 0.0), "sigma_not_positive"),
        (Sighting("a", 1.0, 0.1, None, None, None, -0.1), "sigma_not_positive"),
    ],
)
def test_a_faulty_sighting_has_a_reason(sighting: Sighting, fault: str) -> None:
    assert sighting_fault(sighting) == fault  # resolution i


@pytest.mark.parametrize(
    "sighting",
    [
        Sighting("a", 1.0),
        Sighting("a", None, math.pi),
        Sighting("a", None, -math.pi),
        Sighting("a", 1e-6, 0.0, 1e-6, 1e-6),
        Sighting("a", 1.0, 0.1, None, None, math.pi, 1e-6),
        Sighting("a", 1.0, 0.1, None, None, None, 0.1),
    ],
)
def test_a_sighting_may_have_range_or_bearing_or_both(sighting: Sighting) -> None:
    assert sighting_fault(sighting) is None  # row 2


def test_a_range_sigma_is_a_share_of_the_range() -> None:
    range_sigma, bearing_sigma = sighting_sigmas(Sighting("a", 4.0, 0.0), SENSOR)
    assert range_sigma == pytest.approx(0.2)  # row 34
    assert bearing_sigma == pytest.approx(math.radians(5.0))


def test_a_range_sigma_has_a_floor() -> None:
    sensor = SensorSettings(range_share=0.03, range_floor_m=0.04)
    assert range_sigma_m(sensor, 1.0) == pytest.approx(0.05)
    assert range_sigma_m(sensor, 0.0) == pytest.approx(0.04)


@pytest.mark.parametrize(("expected_m", "sigma_m"), [(5.0, 0.25), (100.0, 0.4), (0.1, 0.1)])
def test_the_sigma_follows_the_expected_range_within_a_factor_of_two(
    expected_m: float, sigma_m: float
) -> None:
    """Otherwise readings that are too short would have more weight than those that are too long."""
    assert sighting_sigmas(Sighting("a", 4.0), SENSOR, expected_m)[0] == pytest.approx(sigma_m)


def test_the_sigmas_of_a_sighting_replace_those_of_the_model() -> None:
    assert sighting_sigmas(Sighting("a", 4.0, 0.0, 0.7, 0.3), SENSOR, 8.0) == (0.7, 0.3)


def test_odometry_is_corrected_by_delay_scales_loss_and_bias() -> None:
    s = OdometrySettings(
        delay_s=0.2,
        distance_scale=1.1,
        distance_loss_m_per_rad=0.1,
        turn_scale=0.9,
        turn_bias_rad_per_m=0.05,
    )
    way = 1.1 - 0.02
    found = corrected_odometry(Odometry(0, 10, 1.0, -0.2), s)
    assert (found.from_ns, found.stamp_ns) == (200_000_000, 200_000_010)
    assert found.distance_m == pytest.approx(way)
    assert found.turn_rad == pytest.approx(-0.18 + 0.05 * way)
    backwards = corrected_odometry(Odometry(0, 10, -1.0, 0.2), s)
    assert backwards.distance_m == pytest.approx(-way)


def test_a_turn_on_the_spot_does_not_drive_backwards() -> None:
    s = OdometrySettings(distance_loss_m_per_rad=0.1)
    assert corrected_odometry(Odometry(0, 10, 0.01, 1.0), s).distance_m == 0.0


@pytest.mark.parametrize(
    ("commanded", "driven"), [(0.03, 0.03), (0.01, 0.02), (-0.01, -0.02), (0.0, 0.0)]
)
def test_the_corrected_speed_is_at_least_that_of_the_motors(
    commanded: float, driven: float
) -> None:
    s = OdometrySettings(least_speed_m_s=0.02)
    piece = Odometry(0, 500_000_000, 0.5 * commanded, 0.0)
    assert corrected_odometry(piece, s).distance_m == pytest.approx(0.5 * driven)


@pytest.mark.parametrize("share", [1.0, 0.3])
@pytest.mark.parametrize(
    ("commanded", "crawls"), [(0.03, False), (0.01, True), (-0.01, True), (0.0, False)]
)
def test_the_time_at_the_least_speed_is_counted(
    commanded: float, crawls: bool, share: float
) -> None:
    s = OdometrySettings(least_speed_m_s=0.02, distance_scale=0.97)
    driven = corrected_odometry(Odometry(0, 500_000_000, 0.5 * commanded, 0.0), s).distance_m
    seconds = share * 0.5
    assert time_at_min_speed_s(share * driven, seconds, s) == (seconds if crawls else 0.0)
    assert time_at_min_speed_s(share * driven, seconds, OdometrySettings()) == 0.0


@pytest.mark.parametrize("teammate", [False, True])
@pytest.mark.parametrize("is_depth", [False, True])
def test_correction_inverts_the_sensor_model(teammate: bool, is_depth: bool) -> None:
    sensor = SensorSettings(
        range_scale=0.95,
        range_bias_m=0.04,
        robot_range_bias_m=0.07,
        range_is_depth=is_depth,
        optical_axis_deg=2.0,
        bearing_scale=0.97,
        bearing_bias_deg=-1.0,
    )
    range_m, bearing = 3.0, 0.4
    reading = (bearing - math.radians(1.0)) / 0.97
    axis = math.cos(reading - math.radians(2.0)) if is_depth else 1.0
    depth = (range_m + (0.07 if teammate else 0.04)) / 0.95 * axis
    found = corrected_sighting(Sighting("a", depth, reading, 0.1, 0.2), sensor, teammate)
    assert found.range_m == pytest.approx(range_m)
    assert found.bearing_rad == pytest.approx(bearing)
    assert (found.id, found.range_sigma_m, found.bearing_sigma_rad) == ("a", 0.1, 0.2)


@given(
    st.floats(-3.0, 3.0), st.floats(-math.pi, math.pi), st.floats(0.9, 1.1), st.floats(-20.0, 20.0)
)
def test_a_heading_keeps_its_angle_to_the_line_of_sight(
    bearing: float, heading: float, scale: float, bias_deg: float
) -> None:
    """A marker shows its angle to the line of sight."""
    sensor = SensorSettings(bearing_scale=scale, bearing_bias_deg=bias_deg)
    seen = Sighting("a", 2.0, bearing, None, None, heading, 0.1)
    found = corrected_sighting(seen, sensor, True)
    for after in (found, *recalibrated(Sightings(7, (seen,)), 0.3).sightings):
        assert after.heading_rad is not None
        assert after.bearing_rad is not None
        assert abs(after.heading_rad) <= math.pi
        turned = after.heading_rad - after.bearing_rad - (heading - bearing)
        assert math.remainder(turned, math.tau) == pytest.approx(0.0, abs=1e-9)
        assert after.heading_sigma_rad == 0.1


@pytest.mark.parametrize(
    "sighting",
    [
        Sighting("a", 1.0, None),
        Sighting("a", None, 0.1),
        Sighting("a"),
        Sighting("a", 1.0, 3.2),
        Sighting("a", 1.0, 0.25, None, None, -2.5, 0.1),
        Sighting("a", 1.0, 0.25, None, None, 3.2, 0.1),
    ],
)
def test_a_neutral_correction_changes_nothing(sighting: Sighting) -> None:
    assert corrected_sighting(sighting, SensorSettings(), True) == sighting


def test_correction_keeps_faults() -> None:
    sensor = SensorSettings(range_is_depth=True, range_bias_m=0.1, bearing_bias_deg=1.0)
    for sighting, fault in (
        (Sighting("a", NAN, 0.1), "not_finite"),
        (Sighting("a", 1.0, NAN), "not_finite"),
        (Sighting("a", 1.0, 3.2), "bearing_out_of_range"),
        (Sighting("a", 0.05, 0.1), "range_not_positive"),
        (Sighting("a", 1.0, 0.1, None, None, 3.2, 0.1), "heading_out_of_range"),
        (Sighting("a", 1.0, 0.1, None, None, NAN, 0.1), "not_finite"),
        (Sighting("a", 1.0, 0.1, None, None, 0.1), "heading_without_sigma"),
    ):
        assert sighting_fault(corrected_sighting(sighting, sensor, False)) == fault


def test_a_frame_uses_each_reading_once() -> None:
    """Range and bearing of one object may be separate; faulty sightings stay for the filter."""
    ranged, borne = Sighting("oak", 2.0), Sighting("oak", None, 0.3)
    whole, empty = Sighting("elm", 2.0, 0.3), Sighting("elm")
    each = (ranged, borne, whole, empty, Sighting("elm", None, None, heading_rad=1.0))
    assert without_duplicates(each) == each
    assert without_duplicates(each[:3]) == each[:3]
    assert without_duplicates((whole,) * 100) == (whole,)
    assert without_duplicates((whole, Sighting("elm", 2.1), Sighting("elm", None, 0.31))) == (
        whole,
    )


def test_a_bias_is_subtracted_from_all_valid_bearings() -> None:
    good = (Sighting("a", 1.0, 0.3, 0.1, 0.2), Sighting("b", None, -3.1), Sighting("c", 1.0))
    faulty = (Sighting("d", 1.0, NAN), Sighting("e", 1.0, math.inf), Sighting("f", 1.0, 3.2))
    found = recalibrated(Sightings(7, good + faulty), 0.1)
    turned = Sighting("a", 1.0, 0.3 - 0.1, 0.1, 0.2), Sighting("b", None, math.tau - 3.2)
    assert found.stamp_ns == 7
    assert [s.bearing_rad for s in found.sightings[:2]] == pytest.approx(
        [s.bearing_rad for s in turned]
    )
    assert msgspec.structs.replace(found.sightings[0], bearing_rad=0.3) == good[0]
    assert found.sightings[2] == good[2]
    for after, before in zip(found.sightings[3:], faulty, strict=True):
        assert after is before


def test_a_repeated_reading_has_a_larger_variance() -> None:
    assert repetition_variance_factor(None, 3.0) == 1.0
    assert repetition_variance_factor(0.5, 0.0) == 1.0
    assert repetition_variance_factor(100.0, 3.0) == pytest.approx(1.0)
    assert repetition_variance_factor(1.0, 2.0) > repetition_variance_factor(2.0, 2.0) > 1.0
    assert math.isfinite(repetition_variance_factor(0.0, 2.0))


def test_the_variance_factor_makes_the_mean_of_correlated_readings_consistent() -> None:
    tau, dt, n = 2.0, 0.5, 400
    rho = math.exp(-dt / tau)
    lags = range(1, n)
    variance_of_mean = (n + 2.0 * sum((n - k) * rho**k for k in lags)) / n**2
    assert repetition_variance_factor(dt, tau) / n == pytest.approx(variance_of_mean, rel=0.02)
