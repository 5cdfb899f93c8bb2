"""Where a landmark is that is not on the map, from what a robot has read of it."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    CORNERS,
    LOOP_START,
    SECOND,
    driven,
    frame,
    localizer,
    loop,
    matrix2,
    position_error,
)
from support.sweeps import over_seeds

from cpcbl_team.config import (
    Field,
    Gives,
    LocalizerSettings,
    OdometryNoise,
    SensorSettings,
    Start,
    Unsurveyed,
)
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import InitialPose, Sighting, Sightings
from cpcbl_team.landmark_readings import (
    MOST_READINGS,
    SPACING_NS,
    LandmarkReading,
    with_reading,
)
from cpcbl_team.localizer import Localizer
from cpcbl_team.new_landmarks import LEAST_READINGS, relative_place
from cpcbl_team.state import State

BOX = (3.0, 1.0)
STRAIGHT = tuple(Pose2(0.1 * k, 0.0, 0.0) for k in range(20))
BENT = tuple(Pose2(0.1 * k, 0.004 * k * k, 0.008 * k) for k in range(20))
SURE = (0.01, 0.0, 0.01, 0.0, 0.0, 0.01)
STANDING = (Pose2(0.0, 0.0, 0.0),) * 5


def readings(
    path: tuple[Pose2, ...],
    gives: Gives = "both",
    box: tuple[float, float] = BOX,
    rng: np.random.Generator | None = None,
) -> tuple[LandmarkReading, ...]:
    """What is read of a box along a path: exactly, or with 2 % and 1 deg."""
    found = []
    for k, pose in enumerate(path):
        dx, dy = box[0] - pose.x, box[1] - pose.y
        r, b = math.hypot(dx, dy), wrap_angle(math.atan2(dy, dx) - pose.heading)
        if rng is not None:
            r, b = r * (1.0 + 0.02 * rng.normal()), b + math.radians(1.0) * rng.normal()
        range_m, bearing = None if gives == "bearing" else r, None if gives == "range" else b
        sigmas = 0.02 * math.hypot(dx, dy), math.radians(1.0)
        found.append(LandmarkReading(k * SPACING_NS, pose, range_m, bearing, *sigmas))
    return tuple(found)


@pytest.mark.parametrize(
    ("gives", "path"),
    [("both", STANDING), ("both", STRAIGHT), ("bearing", STRAIGHT), ("range", BENT)],
)
def test_exact_readings_give_the_exact_place(gives: Gives, path: tuple[Pose2, ...]) -> None:
    here = path[-1]
    place = relative_place(readings(path, gives), here)
    assert place is not None
    assert here.transform(place.x, place.y) == pytest.approx(BOX, abs=1e-4)


@pytest.mark.parametrize(
    ("gives", "path", "reason"),
    [
        ("both", STANDING[: LEAST_READINGS - 1], "too few: one may have a wrong name"),
        ("bearing", STANDING, "no parallax"),
        ("bearing", STRAIGHT[:3], "too little parallax"),
        ("range", STANDING, "all round"),
        ("range", STRAIGHT, "left or right"),
    ],
)
def test_no_place_is_better_than_one_of_two(
    gives: Gives, path: tuple[Pose2, ...], reason: str
) -> None:
    assert relative_place(readings(path, gives), path[-1]) is None, reason


def test_two_landmarks_with_one_name_have_no_place() -> None:
    of_two = readings(STRAIGHT)[::2] + readings(STRAIGHT, box=(1.0, -4.0))[1::2]
    assert relative_place(of_two, STRAIGHT[-1]) is None


@pytest.mark.parametrize(("gives", "path"), [("both", STANDING), ("bearing", STRAIGHT)])
def test_a_place_is_as_certain_as_it_says(gives: Gives, path: tuple[Pose2, ...]) -> None:
    """Dead reckoning is exact here, which it is not trusted to be, so along a path the NEES may be
    small, but never large."""
    rng, here, values = np.random.default_rng(4), path[-1], []
    for _ in range(60):
        place = relative_place(readings(path, gives, rng=rng), here)
        if place is not None:
            x, y = here.transform(place.x, place.y)
            off = np.array([x - BOX[0], y - BOX[1]])
            covariance = matrix2(place.covariance.rotated(here.heading))
            values.append(float(off @ np.linalg.solve(covariance, off)))
    assert len(values) > 40
    assert np.mean(values) < 2.6
    assert path is not STANDING or np.mean(values) > 1.4


@over_seeds(60, 400)
@pytest.mark.parametrize("gives", ["both", "range", "bearing"])
def test_a_place_is_as_certain_as_it_says_beside_the_drift_of_odometry(
    gives: Gives, seeds: range
) -> None:
    """What dead reckoning errs by at one reading it errs by at all older ones."""
    values = []
    for seed in seeds:
        rng, heading = np.random.default_rng(seed), 0.0
        believed = true = Pose2(0.0, 0.0, 0.0)
        read: tuple[LandmarkReading, ...] = ()
        for k in range(20):
            (exact,) = readings((true,), gives, rng=rng)
            read = with_reading(
                read, exact._replace(stamp_ns=k * SPACING_NS, odometry_from_robot=believed)
            )
            heading = 0.15 if k % 10 < 7 else -0.1
            believed, noise = step(believed, 0.25, heading), rng.normal(size=2)
            around = math.hypot(0.05 * math.sqrt(0.25), 0.05 * math.sqrt(abs(heading)))
            moved = 0.25 + 0.05 * math.sqrt(0.25) * float(noise[0])
            true = step(true, moved, heading + around * float(noise[1]))
        place = relative_place(read, believed, OdometryNoise())
        if place is not None:
            x, y = true.transform(place.x, place.y)
            off = np.array([x - BOX[0], y - BOX[1]])
            covariance = matrix2(place.covariance.rotated(true.heading))
            values.append(float(off @ np.linalg.solve(covariance, off)))
    assert len(values) > 0.4 * len(seeds)
    assert 1.2 < np.mean(values) < 2.6


def test_readings_are_kept_apart_and_for_some_time() -> None:
    kept: tuple[LandmarkReading, ...] = ()
    for r in readings(STRAIGHT):
        kept = with_reading(kept, r)
        assert with_reading(kept, r._replace(stamp_ns=r.stamp_ns + 1)) is kept
    assert len(kept) == MOST_READINGS
    assert kept[0].stamp_ns == 0
    late = kept[-1]._replace(stamp_ns=kept[-1].stamp_ns + 60 * SECOND)
    assert with_reading(kept, late) == (late,)


# In the filter -----------------------------------------------------------------------------------

NEAR = Field(
    landmarks={
        n: replace(m, x_m=0.7 * m.x_m, y_m=0.7 * m.y_m) for n, m in CORNERS.landmarks.items()
    }
)
"""The corners of a field that is so small that bearings alone determine places."""


def unsurveyed(gives: Gives = "both") -> Field:
    """The corners, of which nobody knows the places."""
    return Field(unsurveyed={name: Unsurveyed(gives=gives) for name in NEAR.landmarks})


def mapping_robot(gives: Gives = "both", rules: LocalizerSettings | None = None) -> Localizer:
    start = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.0, heading_sigma_deg=0.0)
    sensor = SensorSettings(range_share=0.01, bearing_sigma_deg=0.5, max_range_m=20.0)
    return localizer("joint", unsurveyed(gives), start=start, rules=rules, sensor=sensor)


def mapped(robot: Localizer) -> tuple[State, Pose2]:
    """The state after two rounds with exact sensors and wheels, and the true pose."""
    state, truth = robot.start(0), LOOP_START
    for piece, truth in driven(LOOP_START, loop()):
        state = robot.add_odometry(state, piece)
        state = robot.cycle(state, frame(truth, piece.stamp_ns, NEAR))
    return state, truth


@pytest.mark.parametrize("gives", ["both", "range", "bearing"])
def test_exact_readings_draw_the_exact_map(gives: Gives) -> None:
    state, truth = mapped(mapping_robot(gives))
    common = state.common_errors
    assert common is not None
    assert gives != "both" or set(common.objects) == set(NEAR.landmarks)
    assert common.objects
    for name in common.objects:
        mark = NEAR.landmarks[name]
        assert common.place_error(name) == pytest.approx((mark.x_m, mark.y_m), abs=1e-3)
        assert max(common.place_covariance(name)[::2]) < 0.7**2
    assert position_error(state.estimate, truth) < 1e-3
    assert not state.counts.get("gated")


def test_a_robot_whose_pose_is_set_elsewhere_begins_its_map_anew() -> None:
    robot = mapping_robot()
    state, _ = mapped(robot)
    assert state.common_errors is not None
    moved = robot.set_pose(state, InitialPose(state.stamp_ns, 9.0, 9.0, 0.0, SURE))
    assert len(state.common_errors.objects) == 4
    assert moved.common_errors is not None
    assert not moved.common_errors.objects


def test_a_lost_robot_begins_no_landmark() -> None:
    robot = localizer("joint", unsurveyed(), start=None)
    robot.settings = replace(robot.settings, start=None)
    state = robot.start(0)
    assert state.lost
    for k in range(1, 20):
        state = robot.cycle(state, frame(LOOP_START, k * SECOND // 5, NEAR))
    assert state.common_errors is not None
    assert not state.common_errors.objects


def test_one_sighting_with_a_wrong_name_begins_nothing() -> None:
    robot = mapping_robot()
    wrong = Sightings(SECOND, (Sighting("ne", 2.0, 0.1),))
    state = robot.cycle(robot.start(0), wrong)
    assert state.common_errors is not None
    assert not state.common_errors.objects


def test_a_landmark_that_is_moved_is_named_and_moves_no_estimate() -> None:
    """After it was found: its readings are rejected, and the others keep the robot where it is."""
    robot = mapping_robot()
    state, truth = mapped(robot)
    pushed = {**NEAR.landmarks, "ne": replace(NEAR.landmarks["ne"], x_m=5.0, y_m=0.5)}
    worst, named = 0.0, set()
    for piece, pose in driven(truth, loop(), start_ns=state.stamp_ns):
        state = robot.add_odometry(state, piece)
        state = robot.cycle(state, frame(pose, piece.stamp_ns, Field(landmarks=pushed)))
        worst = max(worst, position_error(state.estimate, pose))
        named.add(state.memory.calibration.misplaced(state.stamp_ns))
    assert worst < 0.1
    assert not state.lost
    assert named == {"", "ne"}
