"""Outliers, faulty sightings and exact sensors."""

import math

import pytest
from support.core import diagonal, fix, frame, state_at
from support.standing import ORIGIN, TENTH, standing, variants

from cpcbl_team.config import Field, Landmark, SensorSettings, Variant
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Fix, Sighting, Sightings


@variants
def test_an_outlier_is_rejected_and_counted(variant: Variant) -> None:
    robot = standing(variant)
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    true = frame(ORIGIN, 1, names=["ne"]).sightings[0]
    assert true.range_m is not None
    assert true.bearing_rad is not None
    wrong = Sighting("ne", true.range_m + 3.0, true.bearing_rad + 1.0)
    after = robot.cycle(before, Sightings(1, (wrong,)))
    assert after.estimate == before.estimate
    assert after.counts == {"gated": 1}
    assert after.updates.innovations == 0b10  # one, rejected
    assert (after.updates.position_ns, after.updates.heading_ns) == (None, None)


@variants
def test_one_outlier_does_not_keep_the_others_out(variant: Variant) -> None:
    robot = standing(variant)
    visible = frame(ORIGIN, 1).sightings
    wrong = Sighting("ne", 1.0, -2.0)
    state = robot.cycle(state_at(ORIGIN, diagonal(0.1, 0.05)), Sightings(1, (wrong, *visible[1:])))
    assert state.counts == {"accepted": 3, "gated": 1}


@variants
def test_a_fix_far_off_is_rejected_and_counted(variant: Variant) -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    after = standing(variant).add_fix(before, fix(3.0, 0.0, 1))
    assert after.estimate == before.estimate
    assert after.counts == {"gated": 1}


@variants
@pytest.mark.parametrize(
    ("sighting", "reason"),
    [
        (Sighting("ne", math.nan, 0.1), "not_finite"),
        (Sighting("ne", 2.0, math.inf), "not_finite"),
        (Sighting("ne", 0.0, 0.1), "range_not_positive"),
        (Sighting("ne", 2.0, 4.0), "bearing_out_of_range"),
        (Sighting("ne"), "empty_sighting"),
        (Sighting("ne", 2.0, 0.1, -1.0), "sigma_not_positive"),
    ],
)
def test_a_faulty_sighting_is_counted_and_nothing_else(
    variant: Variant, sighting: Sighting, reason: str
) -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05), 1)  # resolution i
    after = standing(variant).cycle(before, Sightings(1, (sighting,)))
    assert after == before._replace(memory=before.memory.counted(reason))


@variants
def test_a_faulty_sighting_does_not_keep_the_others_out(variant: Variant) -> None:
    robot, before = standing(variant), state_at(ORIGIN, diagonal(0.1, 0.05))
    visible = frame(ORIGIN, 1)
    mixed = Sightings(1, (Sighting("ne", math.nan), *visible.sightings))
    assert robot.cycle(before, mixed).estimate == robot.cycle(before, visible).estimate


@variants
@pytest.mark.parametrize("offset_m", [0.0, 1e-9])
def test_standing_on_a_landmark_is_no_crash(variant: Variant, offset_m: float) -> None:
    robot = standing(variant, Field(landmarks={"post": Landmark(x_m=offset_m, y_m=0.0)}))
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    for i in (1, 2):
        state = robot.cycle(before, Sightings(i, (Sighting("post", 0.05, 0.0),)))
        assert state.estimate == before.estimate


def test_frames_of_nothing_known_change_nothing() -> None:
    robot, before = standing("joint"), state_at(ORIGIN, diagonal(0.1, 0.05), 1)
    assert robot.cycle(before, Sightings(1, ())) == before
    assert robot.cycle(before, Sightings(1, (Sighting("ball", 1.0, 0.0),))) == before


@pytest.mark.parametrize(
    "sensor",
    [SensorSettings(bearing_sigma_deg=0.0), SensorSettings(range_share=0.0, range_floor_m=0.0)],
    ids=["bearing", "range"],
)
def test_a_perfect_sensor_that_the_settings_allow_is_no_crash(sensor: SensorSettings) -> None:
    robot = standing("oval", sensor=sensor)
    state = state_at(ORIGIN, diagonal(0.1, 0.05))
    for i in (1, 2):
        state = robot.cycle(state, frame(Pose2(0.02, 0.01, 0.01), i * TENTH))
    assert all(math.isfinite(v) for v in state.estimate.pose)


@pytest.mark.parametrize(
    "sensor_covariance", [(0.0, 0.0, 0.0), (0.01, 0.0, 0.0), (0.01, 0.01, 0.01)]
)
def test_a_singular_fix_that_the_wire_allows_is_no_crash(
    sensor_covariance: tuple[float, float, float],
) -> None:
    sent = Fix("me", "mate", 1, 0.01, 0.01, sensor_covariance, (0.0, 0.0, 0.0))
    state = standing("joint").add_fix(state_at(ORIGIN, diagonal(0.1, 0.05)), sent)
    assert all(math.isfinite(v) for v in state.estimate.pose)
