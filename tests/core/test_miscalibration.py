"""A robot whose settings are wrong notices it by itself, corrects them, and stays consistent."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    CORNERS,
    LOOP_START,
    SECOND,
    belief,
    diagonal,
    displaced,
    frame,
    localizer,
    loop,
    sensor_noise,
    state_at,
    steered,
    wall_sighting,
)
from support.sweeps import over_seeds, sampled, thorough

from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.config import (
    Field,
    OdometryNoise,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
    Wall,
)
from cpcbl_team.constant_errors import INSENSITIVE, Evidence
from cpcbl_team.estimate import Covariance3
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.map_rejections import MapRejections
from cpcbl_team.miscalibration import (
    AS_CONFIGURED,
    BLOCK_NS,
    Adaptation,
    Corrected,
    ModelCheck,
    Rules,
    adapted,
)
from cpcbl_team.motion import motion_noise, shortening
from cpcbl_team.sensors import recalibrated
from cpcbl_team.state import Memory, State

START = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.05, heading_sigma_deg=3.0)
SENSOR = SensorSettings(range_share=0.05, bearing_sigma_deg=3.0, field_of_view_deg=360.0)
NOISE = OdometryNoise()
PIECE_NS = SECOND // 10
ROUNDS = 8


LOOP = tuple(loop() * ROUNDS)
# In a second each: 0.4 m ahead, a quarter of a circle on the spot, nothing
STOP_AND_GO = (((0.04, 0.0),) * 10 + ((0.0, 0.05 * math.pi),) * 10 + ((0.0, 0.0),) * 10) * 30
# In 2 s 1 m ahead, then a quarter of a circle on the spot, then slowly around
PAUSES = (((0.05, 0.0),) * 20 + ((0.0, 0.05 * math.pi),) * 10 + ((0.025, 0.02),) * 10) * 14


class Nees(NamedTuple):
    """Means over time; 2 and 1 are due."""

    position: float
    heading: float


class Truth(NamedTuple):
    """What a robot with the settings above is really like."""

    distance_scale: float = 1.0
    turn_scale: float = 1.0
    bearing_bias_rad: float = 0.0
    motion_sigmas: float = 1.0  # in those of the settings
    sensor_sigmas: float = 1.0


def robot_of(variant: Variant = "joint", field: Field = CORNERS) -> Localizer:
    return localizer(variant, field, start=START, sensor=SENSOR, odometry=OdometrySettings())


def run(
    truth: Truth,
    seed: int,
    variant: Variant = "joint",
    field: Field = CORNERS,
    plan: Sequence[tuple[float, float]] = LOOP,
) -> tuple[State, Nees]:
    """The state after some minutes on the loop, and the NEES in the last third."""
    rng, robot = np.random.default_rng(seed), robot_of(variant, field)
    sensor = SensorSettings(
        range_share=truth.sensor_sigmas * SENSOR.range_share,
        bearing_sigma_deg=truth.sensor_sigmas * SENSOR.bearing_sigma_deg,
    )
    errors, factor = sensor_noise(rng, sensor), truth.motion_sigmas**2
    state, planned, now = robot.start(0), LOOP_START, 0
    pose = displaced(state.estimate.pose, state.estimate.covariance, rng)
    nees = []
    for distance, turn in plan:
        planned = step(planned, distance, turn)
        turn = steered(pose, planned)
        noise = motion_noise(pose.heading, distance, turn, NOISE).scaled(factor)
        pose = displaced(step(pose, distance, turn), noise, rng)
        reading = distance / truth.distance_scale, turn / truth.turn_scale
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, *reading))
        now += PIECE_NS
        seen = frame(pose, now, noise=errors)
        state = robot.cycle(state, recalibrated(seen, -truth.bearing_bias_rad))
        (x, y, heading), covariance, _ = state.reported
        turned = wrap_angle(heading - pose.heading)
        of_position = covariance.position().mahalanobis_squared(x - pose.x, y - pose.y)
        nees.append((of_position, turned**2 / covariance.hh))
    position, turned = np.mean(nees[-len(nees) // 3 :], axis=0)
    return state, Nees(position, turned)


def adaptation_of(state: State) -> Adaptation:
    return state.memory.calibration.adaptation


@pytest.mark.parametrize(
    ("truth", "name", "low", "high"),
    [
        (Truth(distance_scale=1.2), "distance_scale", 1.12, 1.28),
        thorough(Truth(distance_scale=0.8), "distance_scale", 0.72, 0.88),
        (Truth(turn_scale=1.3), "turn_scale", 1.2, 1.4),
        (Truth(bearing_bias_rad=0.1), "bearing_bias_rad", 0.05, 0.15),
        (Truth(motion_sigmas=3.0), "motion_factor", 2.0, 40.0),
        thorough(Truth(sensor_sigmas=3.0), "sensor_factor", 2.0, 40.0),
    ],
    ids=lambda part: "" if isinstance(part, Truth | float) else part,
)
@over_seeds(1, 3)
def test_what_is_wrong_is_found_and_the_estimate_becomes_consistent(
    truth: Truth, name: str, low: float, high: float, seeds: range
) -> None:
    found = [run(truth, seed) for seed in seeds]
    assert all(low < getattr(adaptation_of(state), name) < high for state, _ in found)
    assert all(state.counts["miscalibrated"] for state, _ in found)
    assert np.mean([nees.position for _, nees in found]) < 5.0  # 9 to 84 without


@over_seeds(3, 20, more=8)
def test_the_heading_that_biased_bearings_gave_is_doubted(seeds: range) -> None:
    """Also after the correction, by what that may be off (2 to 3 without)."""
    found = [run(Truth(bearing_bias_rad=math.radians(5.0)), i, plan=PAUSES) for i in seeds]
    assert np.mean([nees.heading for _, nees in found]) < 1.5


@over_seeds(2, 6)
@pytest.mark.parametrize("variant", sampled(["joint", "oval"], ["joint"]))
def test_right_settings_are_left_alone(variant: Variant, seeds: range) -> None:
    found = [run(Truth(), seed, variant) for seed in seeds]
    assert all(adaptation_of(state) is AS_CONFIGURED for state, _ in found)
    assert not any(misplaced_in(state) for state, _ in found)
    assert 1.4 < np.mean([nees.position for _, nees in found]) < 2.8


@over_seeds(3, 8)
@pytest.mark.parametrize("variant", sampled(["joint", "circular"], ["circular"]))
def test_right_settings_of_a_robot_that_turns_on_the_spot_are_left_alone(
    variant: Variant, seeds: range
) -> None:
    """How its noise moves it depends on the path within a block."""
    for seed in seeds:
        state, _ = run(Truth(), seed, variant, plan=STOP_AND_GO)
        assert adaptation_of(state) is AS_CONFIGURED


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("truth", "name", "low"),
    [
        (Truth(distance_scale=1.3), "distance_scale", 1.15),
        (Truth(turn_scale=1.4), "turn_scale", 1.2),
        (Truth(sensor_sigmas=3.0), "sensor_factor", 1.7),
    ],
)
@over_seeds(1, 3)
def test_a_circle_notices_what_is_clear_without_the_covariance_of_errors(
    truth: Truth, name: str, low: float, seeds: range
) -> None:
    found = [run(truth, seed, "circular") for seed in seeds]
    assert all(getattr(adaptation_of(state), name) > low for state, _ in found)
    assert np.mean([nees.position for _, nees in found]) < 4.0


def test_a_variant_without_a_covariance_does_not_judge() -> None:
    state, _ = run(Truth(distance_scale=1.2), 0, "weighted")
    assert adaptation_of(state) is AS_CONFIGURED
    assert state.memory.calibration.check == ModelCheck()


@pytest.mark.parametrize(("distance", "is_changed"), [(0.02, False), (0.04, True)])
def test_an_error_that_is_clear_but_small_changes_nothing(
    distance: float, is_changed: bool
) -> None:
    information = Covariance3(1e5, 0.0, 1e5, 0.0, 0.0, 1e5)
    total = 1e5 * distance**2 + 40.0
    evidence = Evidence(information, (1e5 * distance, 0.0, 0.0), total, parts=40.0)
    changed = adapted(ModelCheck(evidence=evidence), AS_CONFIGURED, 100, Rules(0.999))
    assert (changed is not None) is is_changed


def misplaced_in(state: State) -> str:
    return state.memory.calibration.misplaced(state.stamp_ns)


@over_seeds(1, 3)
@pytest.mark.parametrize("off_m", [1.0, -0.4])  # the gates reject one of them
@pytest.mark.parametrize("variant", sampled(["joint", "oval"], ["joint"]))
def test_a_landmark_that_stands_elsewhere_than_on_the_map_is_named(
    variant: Variant, off_m: float, seeds: range
) -> None:
    moved = replace(CORNERS.landmarks["ne"], x_m=CORNERS.landmarks["ne"].x_m + off_m)
    field = Field(landmarks={**CORNERS.landmarks, "ne": moved})
    found = [run(Truth(), seed, variant, field) for seed in seeds]
    assert {misplaced_in(state) for state, _ in found} == {"ne"}


def test_an_adaptation_is_what_the_right_settings_would_be() -> None:
    """The same numbers from a robot whose settings say so, on both paths of the core."""
    wall = Wall(from_m=(0.0, 0.0), to_m=(8.0, 0.0))
    field = Field(landmarks=CORNERS.landmarks, walls={"wall": wall})
    change = Adaptation(1.1, 0.9, 0.1, motion_factor=4.0, sensor_factor=9.0)
    odometry = OdometrySettings(
        distance_sigma_m_per_sqrt_m=2.0 * NOISE.distance_sigma_m_per_sqrt_m,
        turn_sigma_rad_per_sqrt_rad=2.0 * NOISE.turn_sigma_rad_per_sqrt_rad,
        turn_sigma_rad_per_sqrt_m=2.0 * NOISE.turn_sigma_rad_per_sqrt_m,
    )
    sensor = SensorSettings(
        range_share=3.0 * SENSOR.range_share,
        range_floor_m=3.0 * SENSOR.range_floor_m,
        bearing_sigma_deg=3.0 * SENSOR.bearing_sigma_deg,
    )
    wrong = localizer("joint", field, sensor=SENSOR, odometry=OdometrySettings())
    right = localizer("joint", field, sensor=sensor, odometry=odometry)
    before = state_at(LOOP_START, diagonal(0.1, 0.05))
    memory = Memory(calibration=CalibrationMemory(adaptation=change))
    truth = step(LOOP_START, 1.1, 0.18)
    seen = frame(truth, SECOND)
    seen = Sightings(SECOND, (*seen.sightings, wall_sighting(truth, "wall", wall)))
    adapting = wrong.add_odometry(before._replace(memory=memory), Odometry(0, SECOND, 1.0, 0.2))
    adapting = wrong.cycle(adapting, recalibrated(seen, -0.1))
    expected = right.cycle(right.add_odometry(before, Odometry(0, SECOND, 1.1, 0.18)), seen)
    assert len(expected.updates.objects_ns) == 5
    assert adapting.estimate.pose == pytest.approx(expected.estimate.pose, abs=1e-12)
    assert adapting.estimate.covariance == pytest.approx(expected.estimate.covariance, rel=1e-9)


# What does not count ------------------------------------------------------------------------------


def blocks_after(robot: Localizer, state: State, seconds: int, **also: object) -> float:
    """The number of blocks of driving ahead, each second with a frame."""
    x, y, heading = state.estimate.pose
    for second in range(1, seconds + 1):
        now, odometry = second * SECOND, Odometry((second - 1) * SECOND, second * SECOND, 0.1, 0.0)
        if "gap" in also:
            odometry = Odometry(now - SECOND // 2, now, 0.05, 0.0)
        state = robot.add_odometry(state, odometry)
        if "report" in also:
            state = robot.add_teammate_belief(state, belief(1.0, 0.0, now))
        pose = Pose2(
            x + 0.1 * second * math.cos(heading), y + 0.1 * second * math.sin(heading), heading
        )
        state = robot.cycle(state, frame(pose, now))
    return state.memory.calibration.check.evidence.parts


def test_a_block_with_a_gap_or_a_report_does_not_count() -> None:
    robot = robot_of()
    assert blocks_after(robot, robot.start(0), 12) > 4.0
    assert blocks_after(robot, robot.start(0), 12, gap=True) == 0.0
    assert blocks_after(robot, robot.start(0), 12, report=True) == 0.0


@pytest.mark.parametrize("why", ["lost", "report"])
def test_a_block_after_one_that_does_not_count_begins_without_sensitivity(why: str) -> None:
    """The pose of a robot that was lost, or that a teammate moved, owes nothing to the constant
    errors of the blocks before."""
    robot, check = robot_of(), ModelCheck(sensitivity=(1.0,) * 9)
    begin = Corrected(0, robot.start(0).estimate, Pose2(0.0, 0.0, 0.0), 0)
    check = check._replace(begin=None if why == "lost" else begin)
    state = robot.start(0)._replace(memory=Memory(calibration=CalibrationMemory(check=check)))
    state = robot.add_odometry(state, Odometry(0, 2 * SECOND, 0.0, 0.0))
    if why == "report":
        state = robot.add_teammate_belief(state, belief(1.0, 0.0, SECOND))
    after = robot.cycle(state, frame(LOOP_START, 2 * SECOND)).memory.calibration.check
    assert after.begin is not None
    assert (after.begin.stamp_ns, after.sensitivity) == (2 * SECOND, INSENSITIVE)


def test_an_object_that_is_rejected_again_and_again_says_nothing() -> None:
    moved = ModelCheck()
    for _ in range(50):
        moved = moved.with_rejections(["sw"])
    assert moved.rejections == 1
    for name in ("ne", "sw", "ne"):
        moved = moved.with_rejections([name])
    assert moved.rejections == 4
    assert moved.restarted(7) == ModelCheck(rejected="ne", accepted=7)


def test_all_objects_that_one_frame_rejects_count_once() -> None:
    """One error of the pose is in all of them, as where a turn began within a piece of odometry."""
    check = ModelCheck().with_rejections(["ne", "sw", "se", "nw"])
    assert (check.rejections, check.rejected) == (1, "nw")


@pytest.mark.parametrize(("hh", "added"), [(0.04, 0.0), (0.0, 0.04), (0.02, 0.03)])
def test_an_unknown_heading_shortens_a_straight_way(hh: float, added: float) -> None:
    rng, way_m, parts = np.random.default_rng(5), 0.8, 400
    begin = math.sqrt(hh) * rng.standard_normal((4000, 1))
    steps = math.sqrt(added / parts) * rng.standard_normal((4000, parts))
    short_m = way_m * (1.0 - np.cos(begin + np.cumsum(steps, axis=1)).mean(axis=1))
    expected = shortening(way_m**2, hh, added)
    assert float(np.mean(short_m**2)) == pytest.approx(expected, rel=0.15)


def test_the_first_block_tells_nothing() -> None:
    """What a wide prior left after the first frame is corrected in it."""
    robot = robot_of()
    state, pose, now, parts = robot.start(0), LOOP_START, 0, []
    for _ in range(60):
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, 0.05, 0.0))
        pose, now = step(pose, 0.05, 0.0), now + PIECE_NS
        state = robot.cycle(state, frame(pose, now))
        parts.append(state.memory.calibration.check.evidence.parts)
    first_ns = next(i for i, n in enumerate(parts) if n > 0.0) * PIECE_NS
    assert 2 * BLOCK_NS <= first_ns < 3 * BLOCK_NS


def rejections_of(names: Sequence[str], accepted: int = 100) -> MapRejections:
    """One rejection each second, and so many accepted observations."""
    rejections = MapRejections()
    for i, name in enumerate(names, 1):
        rejections = rejections.plus([name], i * SECOND, i * accepted)
    return rejections


def test_an_object_is_misplaced_where_it_alone_is_rejected() -> None:
    assert rejections_of(["ne"] * 7).misplaced(7 * SECOND) == "ne"
    assert rejections_of(["ne"] * 7 + ["sw"] * 2).misplaced(9 * SECOND) == "ne"
    assert not rejections_of(["ne"] * 5).misplaced(5 * SECOND)  # too few
    assert not rejections_of(["ne"] * 7 + ["sw"] * 5).misplaced(12 * SECOND)  # the robot is wrong
    assert not rejections_of(["ne"] * 7, 1000).misplaced(7 * SECOND)  # as rare as the gate allows
    assert not rejections_of(["ne"] * 7).misplaced(120 * SECOND)  # it was put right


def test_of_two_objects_none_is_called_misplaced() -> None:
    two = Field(landmarks={name: CORNERS.landmarks[name] for name in ("ne", "sw")})
    for field, expected in ((two, ""), (CORNERS, "ne")):
        robot = robot_of(field=field)
        state = robot.start(0)
        seen = frame(LOOP_START, 0)
        (wrong,) = (s for s in seen.sightings if s.id == "ne")
        assert wrong.range_m is not None
        wrong = replace(wrong, range_m=wrong.range_m + 3.0)
        for second in range(1, 9):
            others = [s for s in seen.sightings if s.id == "sw"]
            state = robot.cycle(state, Sightings(second * SECOND, (wrong, *others)))
        assert misplaced_in(state) == expected
