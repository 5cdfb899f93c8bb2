"""A robot whose ranges are wrong notices it and corrects them."""

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import SECOND, diagonal, frame, localizer, state_at
from support.sweeps import thorough

from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.config import SensorSettings, Variant
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_team.miscalibration import Adaptation, percentages
from cpcbl_team.range_errors import RangeErrors
from cpcbl_team.sensors import recalibrated
from cpcbl_team.state import Memory


@pytest.mark.parametrize(
    ("variant", "correlation_s"),
    [("joint", 0.0), thorough("joint", 2.0), ("oval", 0.0), thorough("circular", 0.0)],
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
