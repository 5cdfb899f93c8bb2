"""A teammate that tells the heading too: what becomes of it, that it helps, that it claims no more
than it knows."""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import (
    LOOP_START,
    PROBABILISTIC,
    SECOND,
    VARIANTS,
    Matrix,
    diagonal,
    displaced,
    driven,
    fix,
    heading_error,
    localizer,
    loop,
    matrix3,
    placed_at,
    point_sighting,
    position_error,
    state_at,
)
from support.sweeps import over_seeds, sampled

from cpcbl_team.config import (
    CollaborationSettings,
    Field,
    Fusion,
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
)
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.fixes import fix_for, from_fix, from_position_sensor, without_heading
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import BeliefShared, Fix, Odometry, Sighting
from cpcbl_team.localizer import Localizer
from cpcbl_team.motion import motion_noise
from cpcbl_team.sensors import range_sigma_m
from cpcbl_team.state import State

ORIGIN = Pose2(0.0, 0.0, 0.0)
STILL = OdometrySettings(moves=False)
UNKNOWN = Start(known=False, x_m=0.0, y_m=0.0)
SURE = {"sensor_m": 1e-4, "observer_m": 1e-4, "sensor_rad": 1e-4, "observer_rad": 1e-4}
variants = pytest.mark.parametrize("variant", VARIANTS)
probabilistic = pytest.mark.parametrize("variant", PROBABILISTIC)
angles = st.floats(-math.pi, math.pi)


# One heading --------------------------------------------------------------------------------------


@probabilistic
def test_a_heading_is_merged_as_a_scalar(variant: Variant) -> None:
    """0.3 rad, believed at 0 +- 0.2, told with +- 0.1: four fifths of the way."""
    naive = CollaborationSettings(fusion="naive")
    robot = localizer(variant, odometry=STILL, collaboration=naive)
    before = state_at(ORIGIN, diagonal(0.3, 0.2))
    told = fix(0.0, 0.0, 1, heading=0.3, sensor_rad=0.08, observer_rad=0.06)
    after = robot.add_fix(before, told)
    assert after.estimate.pose.heading == pytest.approx(0.24, rel=1e-3)
    assert after.estimate.heading_sigma_rad == pytest.approx(0.2 / math.sqrt(5.0), rel=1e-3)
    plain = robot.add_fix(before, without_heading(told))
    assert after.estimate.pose[:2] == pytest.approx(plain.estimate.pose[:2])
    assert after.estimate.position_sigma_m == pytest.approx(plain.estimate.position_sigma_m)
    assert after.counts == {"accepted": 1}


def test_the_weighted_variant_moves_by_its_static_weight() -> None:
    robot, before = localizer("weighted", odometry=STILL), state_at(ORIGIN, diagonal(0.3, 0.2))
    after = robot.add_fix(before, fix(0.1, 0.0, 1, heading=0.2)).estimate
    assert after.pose.heading == pytest.approx(0.2 * robot.settings.localizer.weights.heading)
    assert after.pose.x == pytest.approx(0.1 * robot.settings.localizer.weights.position)


@given(angles, angles)
def test_a_heading_residual_takes_the_shorter_way_round(own: float, told: float) -> None:
    robot = localizer("joint", odometry=STILL)
    before = state_at(Pose2(0.0, 0.0, own), diagonal(0.3, 2.0))
    after = robot.add_fix(before, fix(0.0, 0.0, 1, heading=told, **SURE)).estimate
    assert abs(after.pose.heading) <= math.pi
    assert heading_error(after, Pose2(0.0, 0.0, told)) < 1e-3


@given(angles, angles, st.floats(1.0, 10.0))
def test_only_the_sensors_part_is_inflated(own: float, told: float, factor: float) -> None:
    said = from_fix(fix(0.0, 0.0, heading=told, sensor_rad=0.1, observer_rad=0.2))
    once, more = (s.of_heading(Pose2(1.0, 2.0, own)) for s in (said, said.inflated(factor)))
    assert once is not None
    assert more is not None
    assert math.remainder(once.residuals[0] + own - told, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert more.residuals == once.residuals
    assert more.independent.xx == pytest.approx(0.01 * factor)
    assert more.dependent == once.dependent
    assert once.dependent.xx == pytest.approx(0.04)


def test_in_the_joint_variant_a_heading_moves_the_position_through_the_cross_covariance() -> None:
    leaning = Covariance3(0.04, 0.0, 0.04, 0.0, 0.03, 0.04)
    robot = localizer("joint", odometry=STILL)
    vague = {"sensor_m": 50.0, "observer_m": 50.0, "sensor_rad": 0.001, "observer_rad": 0.0}
    after = robot.add_fix(
        state_at(ORIGIN, leaning), fix(0.0, 0.0, 1, heading=0.1, **vague)
    ).estimate
    assert after.pose.y == pytest.approx(0.1 * 0.03 / 0.04, rel=0.01)


@pytest.mark.parametrize("variant", ["oval", "circular", "weighted"])
def test_in_the_other_variants_it_leaves_the_position_alone(variant: Variant) -> None:
    robot = localizer(variant, odometry=STILL)
    before = state_at(ORIGIN, Covariance3(0.04, 0.0, 0.04, 0.0, 0.03, 0.04))
    told = fix(0.1, 0.2, 1, heading=0.1)
    after, plain = (robot.add_fix(before, f).estimate for f in (told, without_heading(told)))
    assert after.pose[:2] == plain.pose[:2]
    assert after.pose.heading != plain.pose.heading == 0.0


def test_a_shared_heading_that_comes_back_is_not_new() -> None:
    """What the robot itself told others (resolution c)."""
    robot = localizer("joint", odometry=STILL)
    state = robot.mark_shared(state_at(ORIGIN, diagonal(0.2, 0.1)), BeliefShared(0))
    for i in range(1, 50):
        same = {"sensor_m": 0.01, "observer_m": 0.2, "sensor_rad": 0.001, "observer_rad": 0.1}
        state = robot.add_fix(state, fix(0.0, 0.0, i, heading=0.0, **same))
    assert state.estimate.heading_sigma_rad > 0.99 * 0.1


def test_a_fix_without_a_heading_and_a_position_sensor_give_no_heading() -> None:
    assert from_fix(fix(1.0, 2.0)).of_heading(ORIGIN) is None
    assert from_position_sensor(placed_at(1.0, 2.0)).of_heading(ORIGIN) is None


# The gate -----------------------------------------------------------------------------------------


@variants
def test_a_heading_far_off_is_rejected_and_counted_but_not_the_position(variant: Variant) -> None:
    robot, before = localizer(variant, odometry=STILL), state_at(ORIGIN, diagonal(0.1, 0.05))
    told = fix(0.05, 0.0, 1, heading=1.5)
    after, plain = (robot.add_fix(before, f) for f in (told, without_heading(told)))
    assert after.estimate == plain.estimate
    assert after.counts == {"gated": 1, "heading_gated": 1}
    assert after.updates.innovations == 0b10  # one, rejected


@pytest.mark.parametrize(
    ("rules", "sensor"),
    [
        (LocalizerSettings(object_interval_s=1.0), SensorSettings()),
        (LocalizerSettings(), SensorSettings(correlation_s=5.0)),
    ],
    ids=["interval", "correlation"],
)
def test_a_position_whose_heading_is_rejected_has_been_used(
    rules: LocalizerSettings, sensor: SensorSettings
) -> None:
    """And is not soon used as news again."""
    robot = localizer(rules=rules, sensor=sensor, odometry=STILL)
    askew = plain = state_at(ORIGIN, diagonal(0.3, 0.05))
    for i in range(1, 6):
        told = fix(0.2, 0.0, i * SECOND // 100, sensor_m=0.1, observer_m=0.0, heading=1.5)
        askew, plain = robot.add_fix(askew, told), robot.add_fix(plain, without_heading(told))
    found, due = (state.estimate.position_sigma_m for state in (askew, plain))
    assert found == pytest.approx(due, rel=1e-3)
    assert askew.counts["heading_gated"] >= 1


@variants
def test_with_a_position_that_is_rejected_the_heading_is_too(variant: Variant) -> None:
    robot, before = localizer(variant, odometry=STILL), state_at(ORIGIN, diagonal(0.1, 0.05))
    after = robot.add_fix(before, fix(3.0, 0.0, 1, heading=0.05))
    assert after.estimate == before.estimate
    assert after.counts == {"gated": 1}


@variants
def test_a_standing_robot_finds_out_that_its_heading_is_wrong(variant: Variant) -> None:
    """Its place is confirmed by each fix, its heading denied."""
    robot, state = localizer(variant, odometry=STILL), state_at(ORIGIN, diagonal(0.02, 0.02))
    for i in range(1, 25):
        state = robot.add_fix(state, fix(0.0, 0.0, i * SECOND // 2, heading=1.5))
    assert state.counts["lost"] == 1
    assert state.lost == ""
    assert heading_error(state.estimate, Pose2(0.0, 0.0, 1.5)) < 0.1


# Runs ---------------------------------------------------------------------------------------------


@variants
def test_without_noise_there_is_no_error(variant: Variant) -> None:
    robot = localizer(variant, Field(), start=UNKNOWN)
    state, errors = robot.start(0), []
    for odometry, truth in driven(LOOP_START, loop()[:200]):
        state = robot.add_odometry(state, odometry)
        told = fix(truth.x, truth.y, odometry.stamp_ns, heading=truth.heading, **SURE)
        state = robot.add_fix(state, told)
        errors.append((position_error(state.estimate, truth), heading_error(state.estimate, truth)))
    assert state.lost == ""
    assert set(state.counts) <= {"accepted", "found_again"}
    assert np.max(errors[20:]) < 1e-4


ODOMETRY = OdometrySettings()
SENSOR = SensorSettings(range_share=0.03, bearing_sigma_deg=2.0, max_range_for_range_m=20.0)
WATCH = Pose2(0.0, -2.5, 0.5 * math.pi)
MARKER_RAD = math.radians(5.0)
START = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.05, heading_sigma_deg=3.0)


class Run(NamedTuple):
    """The errors (x, y, heading) and covariances of a blind robot after each fix."""

    errors: Matrix
    covariances: Matrix

    @property
    def heading_rms_deg(self) -> float:
        return math.degrees(math.sqrt(np.mean(self.errors[:, 2] ** 2)))


class Observer:
    """A teammate that stands; what it believes of itself is off by what it claims, in all its
    fixes the same."""

    def __init__(self, off_m: float, off_deg: float, rng: np.random.Generator) -> None:
        covariance = diagonal(off_m, math.radians(off_deg))
        self._believed = Estimate(displaced(WATCH, covariance, rng), covariance)
        self._rng = rng

    def sees(self, truth: Pose2, stamp_ns: int, headed: bool) -> Fix:
        exact, noise = point_sighting(WATCH, "me", truth.x, truth.y), self._rng.normal
        assert exact.range_m is not None
        assert exact.bearing_rad is not None
        sigma_m = range_sigma_m(SENSOR, exact.range_m)
        seen = Sighting(
            "me",
            exact.range_m + sigma_m * noise(),
            wrap_angle(exact.bearing_rad + SENSOR.bearing_sigma_rad * noise()),
            sigma_m,
            None,
            wrap_angle(truth.heading - WATCH.heading + MARKER_RAD * noise()),
            MARKER_RAD,
        )
        sent = fix_for("mate", stamp_ns, self._believed, seen, SENSOR)
        assert sent is not None
        return sent if headed else without_heading(sent)


def blind(robot: Localizer, seed: int, headed: bool, off_m: float, off_deg: float) -> Run:
    """Half a round among nothing but an observer that sees the robot twice a second."""
    rng = np.random.default_rng(seed)
    state = robot.start(0)
    observer = Observer(off_m, off_deg, rng)
    truth = displaced(state.estimate.pose, state.estimate.covariance, rng)
    errors, covariances = [], []
    for i, (distance, turn) in enumerate(loop()[: len(loop()) // 2]):
        noise = motion_noise(truth.heading, distance, turn, ODOMETRY)
        truth = displaced(step(truth, distance, turn), noise, rng)
        state, now = _driven_on(robot, state, i, distance, turn)
        if i % 5 == 0:
            state = robot.add_fix(state, observer.sees(truth, now, headed))
            x, y, h = state.estimate.pose
            errors.append((x - truth.x, y - truth.y, wrap_angle(h - truth.heading)))
            covariances.append(matrix3(state.estimate.covariance))
    return Run(np.array(errors), np.array(covariances))


def _driven_on(
    robot: Localizer, state: State, piece: int, distance: float, turn: float
) -> tuple[State, int]:
    period = SECOND // 10
    now = (piece + 1) * period
    return robot.add_odometry(state, Odometry(now - period, now, distance, turn)), now


@cache
def runs(
    variant: Variant, fusion: Fusion, headed: bool, off_m: float, off_deg: float, seeds: range
) -> list[Run]:
    rules = CollaborationSettings(fusion=fusion)
    robot = localizer(variant, Field(), start=START, odometry=ODOMETRY, collaboration=rules)
    return [blind(robot, seed, headed, off_m, off_deg) for seed in seeds]


@over_seeds(16, 40)
@pytest.mark.parametrize("variant", sampled(VARIANTS, ["joint"]))
def test_fixes_with_a_heading_improve_the_heading_of_a_blind_robot(
    variant: Variant, seeds: range
) -> None:
    """The same noise with and without; in the mean of the runs, and in most of them."""
    told, untold = (
        np.array([r.heading_rms_deg for r in runs(variant, "split-ci", headed, 0.02, 1.0, seeds)])
        for headed in (True, False)
    )
    assert np.mean(told) < 0.8 * np.mean(untold)
    assert np.mean(told < untold) > 0.7


# Forty runs, the samples of each depending on each other wholly: 95 % of the means lie below.
MOST_POSE_NEES = 3.0 + 1.645 * math.sqrt(6.0 / 40.0)
MOST_HEADING_NEES = 1.0 + 1.645 * math.sqrt(2.0 / 40.0)


@pytest.mark.parametrize(("fusion", "honest"), [("split-ci", True), ("naive", False)])
@pytest.mark.parametrize("variant", sampled(PROBABILISTIC, ["joint"]))
def test_an_observer_whose_heading_is_off_gets_no_more_weight_than_due(
    variant: Variant, fusion: Fusion, honest: bool
) -> None:
    """4 degrees, in what it says of the position and of the heading alike. Of the circle only the
    heading: what it makes of such an observer's thin ellipses claims too much even without one."""
    told = runs(variant, fusion, True, 0.02, 4.0, range(40))
    heading = [np.mean(r.errors[:, 2] ** 2 / r.covariances[:, 2, 2]) for r in told]
    assert bool(np.mean(heading) <= MOST_HEADING_NEES) is honest
    if variant == "circular":
        return
    pose = [
        np.mean([e @ np.linalg.solve(c, e) for e, c in zip(r.errors, r.covariances, strict=True)])
        for r in told
    ]
    assert bool(np.mean(pose) <= MOST_POSE_NEES) is honest


# Lost ---------------------------------------------------------------------------------------------


@variants
def test_a_lost_robot_that_stands_relocalizes_by_fixes(variant: Variant) -> None:
    """Without the heading it never is."""
    robot, truth = localizer(variant, Field(), start=UNKNOWN, odometry=STILL), Pose2(1.0, 2.0, -2.5)
    told = [fix(1.0, 2.0, i * SECOND // 2, heading=-2.5) for i in range(1, 9)]
    state = blank = robot.start(0)
    for seen in told[:2]:
        state, blank = robot.add_fix(state, seen), robot.add_fix(blank, without_heading(seen))
    assert state.lost == ""
    assert position_error(state.estimate, truth) < 0.1
    assert heading_error(state.estimate, truth) < 0.1
    for seen in told[2:]:
        blank = robot.add_fix(blank, without_heading(seen))
    assert blank.lost.startswith("heading sigma")


@pytest.mark.parametrize("variant", ["oval", "circular"])
def test_a_lost_robot_that_drives_relocalizes_at_the_first_fix(variant: Variant) -> None:
    """Where the variant finds no heading in its places it has to wait for two."""
    robot = localizer(variant, Field(), start=UNKNOWN)
    found: dict[bool, int] = {}
    for headed in (True, False):
        state = robot.start(0)
        for odometry, truth in driven(LOOP_START, loop()[:60]):
            state = robot.add_odometry(state, odometry)
            told = fix(truth.x, truth.y, odometry.stamp_ns, heading=truth.heading)
            state = robot.add_fix(state, told if headed else without_heading(told))
            if not state.lost:
                found.setdefault(headed, odometry.stamp_ns)
                assert not headed or heading_error(state.estimate, truth) < 0.3
    assert found[True] == SECOND // 10
    assert found[False] >= 5 * SECOND // 10
