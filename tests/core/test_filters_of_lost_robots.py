"""The second filters go on where the robot sees nothing, rejects all that it sees, or is lost."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import CORNERS, SECOND, diagonal, frame, localizer, position_error, state_at

from cpcbl_team.config import Field, SensorSettings
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State

PRECISE = SensorSettings(
    range_share=0.02, range_floor_m=0.02, bearing_sigma_deg=1.0, field_of_view_deg=360.0
)
START, PERIOD = Pose2(0.5, -0.3, 0.4), SECOND // 5


def started(field: Field) -> tuple[Localizer, State]:
    robot = localizer("joint", sensor=PRECISE, field=field)
    return robot, state_at(START, diagonal(0.05, 0.05))


def moved(robot: Localizer, state: State, distance_m: float, turn_rad: float) -> State:
    begin_ns = state.odometry_until_ns
    piece = Odometry(begin_ns, begin_ns + PERIOD, distance_m, turn_rad)
    return robot.predict(robot.add_odometry(state, piece), piece.stamp_ns)


def short(seen: Sightings, share: float, rng: np.random.Generator) -> Sightings:
    """What a sensor sees whose ranges are too short."""
    sightings = tuple(
        replace(
            s,
            range_m=s.range_m * (1.0 - share + 0.02 * rng.normal()),
            bearing_rad=wrap_angle((s.bearing_rad or 0.0) + math.radians(1.0) * rng.normal()),
        )
        for s in seen.sightings
        if s.range_m is not None
    )
    return Sightings(seen.stamp_ns, sightings)


@pytest.mark.parametrize("names", [("ne", "nw", "sw"), ("ne", "nw", "sw", "se")])
@pytest.mark.parametrize("share", [0.15, -0.15])
def test_ranges_that_are_far_from_right_are_found_by_a_robot_that_rejects_them(
    names: tuple[str, ...], share: float
) -> None:
    """7 sigmas: it accepts none of them, and is lost within two seconds. It found no pose for as
    long as it ran."""
    robot, state = started(Field(landmarks={n: CORNERS.landmarks[n] for n in names}))
    truth, rng, was_lost = START, np.random.default_rng(1), False
    for _ in range(5 * 40):
        truth = step(truth, 0.06, 0.04)
        state = moved(robot, state, 0.06, 0.04)
        seen = frame(truth, state.stamp_ns, robot.field)
        state = robot.cycle(state, short(seen, share, rng))
        was_lost |= bool(state.lost)
    assert was_lost
    assert not state.lost
    assert position_error(state.estimate, truth) < 0.1
    ranges = state.memory.calibration.adaptation.ranges
    assert ranges.share + ranges.bias_m / 4.0 == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("share", [0.15, -0.15])
def test_of_two_landmarks_either_may_be_misplaced(share: float) -> None:
    """A robot that blames one of them for what its ranges are is not sure of its pose."""
    robot, state = started(Field(landmarks={n: CORNERS.landmarks[n] for n in ("ne", "sw")}))
    truth, rng = START, np.random.default_rng(1)
    for i in range(5 * 40):
        truth = step(truth, 0.06, 0.04)
        state = moved(robot, state, 0.06, 0.04)
        seen = frame(truth, state.stamp_ns, robot.field)
        state = robot.cycle(state, short(seen, share, rng))
        known = state.reported
        is_settled = i > 50 and not state.lost
        assert not is_settled or position_error(known, truth) < 3.0 * known.position_sigma_m


def test_they_follow_the_odometry_while_nothing_is_seen() -> None:
    """A way of many seconds is not the chord of it: they forgot their pose after ten."""
    robot, state = started(CORNERS)
    truth = START
    for i in range(5 * 60):
        truth = step(truth, 0.06, 0.04)
        state = moved(robot, state, 0.06, 0.04)
        if i < 100:
            state = robot.cycle(state, frame(truth, state.stamp_ns, robot.field))
    first, *_ = state.memory.calibration.filters
    assert state.stamp_ns - first.stamp_ns < 4 * SECOND
    here = first.estimate_at(state.odometry_from_robot, state.estimate)
    assert position_error(here, truth) < 0.1
    assert here.position_sigma_m < 0.6
    assert first.used > 20


def test_a_gap_in_the_odometry_leaves_only_the_errors() -> None:
    robot, state = started(CORNERS)
    truth = START
    for _ in range(100):
        truth = step(truth, 0.06, 0.04)
        state = moved(robot, state, 0.06, 0.04)
        state = robot.cycle(state, frame(truth, state.stamp_ns, robot.field))
    before = state.memory.calibration.filters[0]
    state = robot.predict(state, state.stamp_ns + SECOND)
    gap = Odometry(state.stamp_ns, state.stamp_ns + PERIOD, 0.06, 0.04)
    state = robot.predict(robot.add_odometry(state, gap), gap.stamp_ns)
    for _ in range(16):
        state = moved(robot, state, 0.06, 0.04)
    after = state.memory.calibration.filters[0]
    assert after.gaps == before.gaps + 1
    assert after.errors == before.errors
    assert np.all(np.array(after.covariance)[:3, 3:] == 0.0)
