"""A robot whose ranges are wrong notices it by the distances between landmarks."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import CORNERS, SECOND, diagonal, frame, localizer, state_at

from cpcbl_team.config import Field, Landmark, SensorSettings, Variant
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_team.miscalibration import Adaptation, percentages
from cpcbl_team.range_errors import (
    NO_RANGE_ERRORS,
    NormalEquations,
    RangeErrors,
    RangeEvidence,
    SeenLandmark,
)
from cpcbl_team.sensors import recalibrated
from cpcbl_team.state import CalibrationMemory, Memory

SHARE, FLOOR_M, BEARING_RAD = 0.05, 0.01, 0.05


def seen_from(
    pose: Pose2, field: Field, errors: RangeErrors, rng: np.random.Generator
) -> list[SeenLandmark]:
    """The landmarks of a field where they are, read with noise and too short by the errors."""
    found = []
    for sighting in frame(pose, 0, field=field).sightings:
        r, a = sighting.range_m, sighting.bearing_rad
        assert r is not None
        assert a is not None
        mark, sigma = field.landmarks[sighting.id], math.hypot(SHARE * r, FLOOR_M)
        read = (1.0 - errors.share) * r - errors.bias_m + sigma * rng.normal()
        place = sighting.id, mark.x_m, mark.y_m
        turned = a + BEARING_RAD * rng.normal()
        found.append(SeenLandmark(*place, read, turned, sigma**2, BEARING_RAD))
    return found


def evidence(errors: RangeErrors, seed: int, names: int = 4, moved: str = "") -> RangeEvidence:
    """That of a minute among so many of the corners, one of which may stand 0.8 m elsewhere."""
    rng, found = np.random.default_rng(seed), RangeEvidence()
    marks = dict(list(CORNERS.landmarks.items())[:names])
    for _ in range(120):
        x, y, heading = rng.uniform(-1.5, 1.5, size=3)
        pose = Pose2(x, y, 2.0 * heading)
        seen = seen_from(pose, Field(landmarks=marks), errors, rng)
        for landmark in seen:
            landmark.map_x += 0.8 if landmark.name == moved else 0.0
        found = found.plus([seen])
    return found


@pytest.mark.parametrize("names", [2, 4])
@pytest.mark.parametrize("share", [-0.1, -0.05, 0.05, 0.1])
def test_ranges_that_are_scaled_are_found(share: float, names: int) -> None:
    """Scale and bias look alike; together they are right at the usual range of 5 m."""
    found = evidence(RangeErrors(share), 1, names).errors(NO_RANGE_ERRORS, 1.0)
    assert found.share + found.bias_m / 5.0 == pytest.approx(share, abs=0.012)


@pytest.mark.parametrize("bias_m", [-0.2, 0.2])
def test_ranges_with_a_bias_are_found(bias_m: float) -> None:
    found = evidence(RangeErrors(0.0, bias_m), 1).errors(NO_RANGE_ERRORS, 1.0)
    assert found.share + found.bias_m / 5.0 == pytest.approx(bias_m / 5.0, abs=0.012)


def test_right_ranges_are_left_alone() -> None:
    for seed in range(20):
        found = evidence(NO_RANGE_ERRORS, seed, 2 + seed % 3)
        assert found.errors(NO_RANGE_ERRORS, 1.0) == NO_RANGE_ERRORS


@pytest.mark.parametrize("names", [2, 3])
@pytest.mark.parametrize("sigma_deg", [1.0, 2.0])
def test_a_robot_that_stands_finds_no_large_errors_that_cancel_each_other(
    names: int, sigma_deg: float
) -> None:
    """Noisy bearings would turn into both: with the bias by the bearings of the same frame, 13 % of
    the range and -0.9 m were found within half a minute."""
    sigma, marks = math.radians(sigma_deg), ((0.0, 5.0), (9.0, 5.0), (9.0, 0.0))
    for seed in range(3):
        rng, found, errors = np.random.default_rng(seed), RangeEvidence(), NO_RANGE_ERRORS
        for _ in range(600):
            seen = []
            for name, (x, y) in zip("abc"[:names], marks, strict=False):
                r, a = math.hypot(x - 4.0, y), math.atan2(y, x - 4.0)
                read = r + 0.01 * r * rng.normal(), a + sigma * rng.normal()
                seen.append(SeenLandmark(name, x, y, *read, (0.01 * r) ** 2, sigma))
            found = found.plus([seen])
            errors = found.errors(errors, 1.0)
            assert errors == NO_RANGE_ERRORS
        share, bias_m = NormalEquations(found.fit).errors()
        assert abs(share) < 0.01
        assert abs(bias_m) < 0.05


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("share", "bearing_deg"), [(0.005, 0.5), (0.02, 2.0), (0.05, 3.0)])
@pytest.mark.parametrize("x_m", [4.5, 3.0])
def test_a_robot_that_stands_before_two_landmarks_finds_no_errors_that_cancel(
    x_m: float, share: float, bearing_deg: float, seed: int
) -> None:
    """As the observer of the demonstration. The noise of the bearings seems to tell a scale from a
    bias there; they cancel at the landmarks, and together are wrong by 0.3 m at teammates."""
    rng, found, errors = np.random.default_rng(seed), RangeEvidence(), NO_RANGE_ERRORS
    sigma = math.radians(bearing_deg)
    for n in range(2_000):
        seen = []
        for name, x in (("southwest", 0.0), ("southeast", 9.0)):
            range_m, bearing = math.hypot(x - x_m, 5.0), math.atan2(x - x_m, 5.0)
            sigma_m = share * range_m
            read = range_m + sigma_m * rng.normal(), bearing + sigma * rng.normal()
            seen.append(SeenLandmark(name, x, 0.0, *read, sigma_m**2, sigma))
        found = found.plus([seen])
        if n % 20 == 0:
            errors = found.errors(errors, 1.0)
    assert errors == NO_RANGE_ERRORS


def test_a_landmark_that_stands_elsewhere_is_no_error_of_ranges() -> None:
    for seed in range(4):
        found = evidence(NO_RANGE_ERRORS, seed, moved="ne")
        fit = NormalEquations(found.fit)
        assert fit.explained(*fit.errors()) > 16.0  # but not without that one
        assert found.errors(NO_RANGE_ERRORS, 1.0) == NO_RANGE_ERRORS


def test_what_is_believed_follows_the_evidence() -> None:
    found = evidence(RangeErrors(0.05), 1)
    before = RangeErrors(0.08)
    share, bias_m = NormalEquations(found.fit).errors()
    assert found.errors(before, 1.0) == (share, bias_m)
    near = RangeErrors(share, bias_m + 0.001)
    assert found.errors(near, 1.0) == near


def test_too_little_evidence_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    few = RangeEvidence()
    for _ in range(5):
        few = few.plus([seen_from(Pose2(0.0, 0.0, 0.0), CORNERS, RangeErrors(0.2), rng)])
    assert few.errors(NO_RANGE_ERRORS, 1.0) == NO_RANGE_ERRORS
    long_ones = evidence(RangeErrors(0.05), 1)
    assert long_ones.errors(NO_RANGE_ERRORS, 0.02) == NO_RANGE_ERRORS  # they come in groups
    one = Field(landmarks={"ne": CORNERS.landmarks["ne"]})
    alone = RangeEvidence().plus([seen_from(Pose2(0.0, 0.0, 0.0), one, RangeErrors(0.2), rng)])
    assert alone == RangeEvidence()


def test_landmarks_side_by_side_tell_nothing() -> None:
    """Their distance is bent by noise."""
    rng = np.random.default_rng(0)
    near = Field(landmarks={"a": Landmark(x_m=5.0, y_m=0.0), "b": Landmark(x_m=5.0, y_m=0.5)})
    found = RangeEvidence().plus([seen_from(Pose2(0.0, 0.0, 0.0), near, NO_RANGE_ERRORS, rng)])
    assert found.pairs == 0.0


@pytest.mark.parametrize(
    ("variant", "correlation_s"), [("joint", 0.0), ("joint", 2.0), ("oval", 0.0), ("circular", 0.0)]
)
def test_a_robot_whose_ranges_are_short_says_so_and_corrects_them(
    variant: Variant, correlation_s: float
) -> None:
    """On both paths of the core."""
    sensor = SensorSettings(correlation_s=correlation_s, field_of_view_deg=360.0)
    robot, here = localizer(variant, sensor=sensor), Pose2(0.5, -0.3, 0.4)
    rng = np.random.default_rng(0)
    state = state_at(here, diagonal(0.05, 0.05))
    for i in range(1, 181):
        wrong = tuple(
            replace(s, range_m=0.9 * s.range_m * (1.0 + 0.02 * rng.normal()))
            for s in frame(here, i * SECOND // 2).sightings
            if s.range_m is not None
        )
        state = robot.cycle(
            robot.predict(state, i * SECOND // 2), Sightings(i * SECOND // 2, wrong)
        )
    found = state.memory.calibration.adaptation.ranges
    assert state.counts["miscalibrated"] == 1
    assert found.share + found.bias_m / 5.0 == pytest.approx(0.1, abs=0.015)


def test_corrected_ranges_are_those_of_a_right_sensor() -> None:
    errors = RangeErrors(0.1, 0.05)
    memory = Memory(calibration=CalibrationMemory(adaptation=Adaptation(ranges=errors)))
    before, here = state_at(Pose2(0.1, 0.0, 0.0), diagonal(0.2, 0.1)), Pose2(0.0, 0.0, 0.0)
    for sensor in (SensorSettings(), SensorSettings(correlation_s=1.0)):
        robot = localizer("joint", sensor=sensor)
        exact = frame(here, 1)
        short = tuple(
            replace(s, range_m=0.9 * s.range_m - 0.05) for s in exact.sightings if s.range_m
        )
        expected = robot.cycle(before, exact).estimate
        found = robot.cycle(before._replace(memory=memory), Sightings(1, short)).estimate
        assert found.pose == pytest.approx(expected.pose, abs=2e-3)
    (fixed,) = recalibrated(
        Sightings(1, (Sighting("mate", 1.8, 0.2),)), 0.0, errors.scale
    ).sightings
    assert fixed.range_m == pytest.approx(2.0)
    assert fixed.bearing_rad == 0.2


def test_the_numbers_are_counts() -> None:
    assert percentages(Adaptation(ranges=RangeErrors(0.2, 0.08))) == {
        "range_percent": 125,
        "range_plus_mm": 100,
    }
    assert percentages(Adaptation(ranges=RangeErrors(0.0, -0.1))) == {"range_minus_mm": 100}
