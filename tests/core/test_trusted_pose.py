"""A driver's mistake in sightings moves no robot that knew its pose: it is lost, and says why."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    CORNERS,
    LOOP_START,
    Noise,
    diagonal,
    followed,
    heading_error,
    localizer,
    loop,
    position_error,
    sensor_noise,
    state_at,
)
from support.sweeps import thorough

from cpcbl_team.config import SensorSettings
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Sighting
from cpcbl_team.relocalization import readings_of
from cpcbl_team.sensor_mistakes import (
    FOOT_M,
    HALF_OFF,
    IN_FEET,
    LEAST_READINGS,
    MIRRORED,
    QUARTER_OFF,
    mistake_in_evidence,
)
from cpcbl_team.state import State
from cpcbl_team.trusted_pose import OR_MOVED

SENSOR = SensorSettings()
STAND = [(0.0, 0.0)] * 30
SPIN = [(0.0, 0.04)] * 60
TWO = ("ne", "se")
ALL = tuple(CORNERS.landmarks)
Bearing = Callable[[float], float]
MIRROR: Bearing = lambda b: -b  # noqa: E731


def mistaken(bearing: Bearing = lambda b: b, range_scale: float = 1.0) -> Noise:
    """What a driver makes of a noisy sighting."""
    noise = sensor_noise(np.random.default_rng(5), SENSOR)

    def change(seen: Sighting) -> Sighting:
        seen = noise(seen)
        assert seen.bearing_rad is not None
        assert seen.range_m is not None
        wrong = wrap_angle(bearing(seen.bearing_rad))
        return replace(seen, bearing_rad=wrong, range_m=range_scale * seen.range_m)

    return change


def states(
    way: list[tuple[float, float]], noise: Noise, names: tuple[str, ...]
) -> list[tuple[State, Pose2]]:
    begin = state_at(LOOP_START, diagonal(0.1, 0.1))
    robot = localizer()
    return list(followed(robot, begin, LOOP_START, way, names=lambda _: names, noise=noise))


@pytest.mark.parametrize("names", [TWO, thorough(ALL)], ids=["2", "4"])
@pytest.mark.parametrize("way", [STAND, SPIN, loop()[:60]], ids=["stand", "spin", "drive"])
@pytest.mark.parametrize(
    ("noise", "cause"),
    [
        (mistaken(MIRROR), MIRRORED),
        (mistaken(lambda b: b + 0.5 * math.pi), QUARTER_OFF),
        (mistaken(lambda b: b - 0.5 * math.pi), QUARTER_OFF),
        (mistaken(lambda b: b + math.pi), HALF_OFF),
        (mistaken(range_scale=1.0 / FOOT_M), IN_FEET),
    ],
    ids=["mirrored", "90° to the left", "90° to the right", "180°", "feet"],
)
def test_a_mistake_is_named_at_once_and_moves_nothing(
    noise: Noise, cause: str, way: list[tuple[float, float]], names: tuple[str, ...]
) -> None:
    after = states(way, noise, names)
    assert all(state.lost for state, _ in after[15:])
    state, truth = after[-1]
    assert state.lost == f"{cause}; {OR_MOVED}"
    assert position_error(state.estimate, truth) < 0.4
    assert heading_error(state.estimate, truth) < 0.3
    assert "found_again" not in state.counts


def test_evidence_that_fits_as_it_is_needs_no_mistake() -> None:
    """A landmark straight ahead looks the same to mirrored bearings."""
    corner = CORNERS.landmarks["ne"]
    ahead = math.atan2(corner.y_m - LOOP_START.y, corner.x_m - LOOP_START.x)
    begin = Pose2(LOOP_START.x, LOOP_START.y, ahead)
    robot = localizer()
    *_, (state, _) = followed(
        robot, state_at(begin, diagonal(0.1, 0.1)), begin, STAND, names=lambda _: ("ne",)
    )
    evidence = robot.recovery.evidence(state.memory.recovery)
    assert sum(map(readings_of, evidence)) >= LEAST_READINGS
    assert mistake_in_evidence(state.estimate, evidence, state.odometry_from_robot) is None


def test_a_mended_driver_is_believed_again() -> None:
    (state, truth) = states(STAND, mistaken(MIRROR), TWO)[-1]
    assert state.lost
    noise = sensor_noise(np.random.default_rng(6), SENSOR)
    robot, way = localizer(), [(0.0, 0.0)] * 80
    *_, (state, truth) = followed(robot, state, truth, way, names=lambda _: TWO, noise=noise)
    assert state.lost == ""
    assert position_error(state.estimate, truth) < 0.2
    assert state.memory.recovery.trusted is None
    assert state.memory.recovery.jump is None


def test_a_robot_that_is_found_elsewhere_has_jumped() -> None:
    noise = sensor_noise(np.random.default_rng(7), SENSOR)
    elsewhere = Pose2(LOOP_START.x + 3.0, LOOP_START.y + 0.5, 1.2)
    begin = state_at(LOOP_START, diagonal(0.1, 0.1))
    way = [(0.03, 0.02)] * 40
    names = ("ne", "nw", "se")
    *_, (state, truth) = followed(
        localizer(), begin, elsewhere, way, names=lambda _: names, noise=noise
    )
    assert state.lost == ""
    assert position_error(state.estimate, truth) < 0.3
    jump = state.memory.recovery.jump
    assert jump is not None
    assert jump.distance_m == pytest.approx(math.hypot(3.0, 0.5), abs=0.5)
    assert jump.turn_rad == pytest.approx(1.2, abs=0.3)
