"""What a robot learns of its wheels and camera: the rule alone, then in the localizer."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import (
    CORNERS,
    LOOP_START,
    PROBABILISTIC,
    SECOND,
    diagonal,
    followed,
    frame,
    localizer,
    loop,
    poses,
    position_error,
    sensor_noise,
    state_at,
)

from cpcbl_team.config import (
    LocalizerSettings,
    OdometryNoise,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
)
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry, Sighting
from cpcbl_team.localizer import Localizer
from cpcbl_team.self_calibration import (
    LONGEST_NS,
    ReferencePose,
    ReferencePoses,
    SelfCalibration,
    self_calibrate,
)
from cpcbl_team.sensors import without_bearing_bias
from cpcbl_team.state import CalibrationMemory, Memory, RecoveryMemory, State

ORIGIN = Pose2(0.0, 0.0, 0.0)
NOISE = OdometryNoise()
EXACT = OdometryNoise(
    distance_sigma_m_per_sqrt_m=1e-4,
    turn_sigma_rad_per_sqrt_rad=1e-4,
    turn_sigma_rad_per_sqrt_m=1e-4,
)
LEARNS = LocalizerSettings(self_calibration=True)

scales = st.floats(0.92, 1.08)
biases = st.floats(math.radians(-3.0), math.radians(3.0))


def anchor(
    pose: Pose2, wheels: Pose2, seconds: float = 1.0, sigma_m: float = 0.01, sigma: float = 0.01
) -> ReferencePose:
    """A moment at which the robot was found at `pose`, and by its wheels at `wheels`."""
    estimate = Estimate(pose, diagonal(sigma_m, sigma))
    return ReferencePose(round(seconds * SECOND), estimate, wheels, wheels.heading)


def both(at: ReferencePose) -> ReferencePoses:
    return ReferencePoses(at, at)


BEGIN = both(anchor(ORIGIN, ORIGIN, 0.0))


# One comparison -----------------------------------------------------------------------------------


def test_a_way_shorter_than_the_wheels_said_as_worked_by_hand() -> None:
    """1 m by the wheels, 0.95 m found: 2 x 0.01^2 of place, 0.05^2 of the way."""
    now = anchor(Pose2(0.95, 0.0, 0.0), Pose2(1.0, 0.0, 0.0))
    found, anchors = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    gain = 0.0025 / (0.0025 + 0.0002 + 0.0025)
    assert found.distance_scale == pytest.approx(1.0 - 0.05 * gain)
    assert found.distance_variance == pytest.approx((1.0 - gain) * 0.0025)
    assert found.bearing_bias_rad == 0.0
    assert (found.turn_scale, found.turn_variance) == SelfCalibration()[1:5:3]
    assert anchors == ReferencePoses(BEGIN.turn, now)


def test_a_turn_larger_than_the_wheels_said_as_worked_by_hand() -> None:
    now = anchor(Pose2(0.0, 0.0, 1.3), Pose2(0.0, 0.0, 1.2))
    found, anchors = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    around = 0.05**2 * 1.2
    gain = 0.0025 * 1.2 / (1.2**2 * 0.0025 + 0.0002 + around)
    assert found.turn_scale == pytest.approx(1.0 + 0.1 * gain)
    assert found.turn_variance == pytest.approx((1.0 - 1.2 * gain) * 0.0025)
    assert anchors.turn == now


def test_a_way_aside_of_the_heading_is_a_bias_of_bearings_as_worked_by_hand() -> None:
    aside = math.radians(2.0)
    now = anchor(Pose2(math.cos(aside), math.sin(aside), 0.0), Pose2(1.0, 0.0, 0.0))
    found, _ = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    variance = math.radians(1.5) ** 2
    gain = variance / (variance + 0.01**2 + 0.0002 + 0.05**2 / 3.0)
    assert found.bearing_bias_rad == pytest.approx(aside * gain)
    assert found.bearing_variance == pytest.approx((1.0 - gain) * variance)
    assert found.distance_scale == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("across_m", [-0.05, 0.05])
def test_an_error_across_the_way_does_not_lengthen_it(across_m: float) -> None:
    """It would on average: there is one at both ends of each way."""
    now = anchor(Pose2(0.8, across_m, 0.0), Pose2(0.8, 0.0, 0.0))
    found, _ = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    assert found.distance_scale == pytest.approx(1.0, abs=1e-12)
    assert found.bearing_bias_rad * across_m > 0.0


def test_backwards_is_no_turn_about() -> None:
    now = anchor(Pose2(-0.95, 0.0, 0.0), Pose2(-1.0, 0.0, 0.0))
    found, _ = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    assert found.distance_scale < 1.0
    assert found.bearing_bias_rad == pytest.approx(0.0)


@pytest.mark.parametrize("wheels", [Pose2(0.5, 0.0, 0.6), Pose2(0.0, 0.6, 0.0), ORIGIN])
def test_too_little_motion_is_not_compared(wheels: Pose2) -> None:
    now = anchor(ORIGIN, wheels)
    assert self_calibrate(SelfCalibration(), BEGIN, now, NOISE) == (SelfCalibration(), BEGIN)


def test_after_too_much_of_a_turn_the_way_is_compared_from_there() -> None:
    now = anchor(Pose2(0.9, 0.5, 0.9), Pose2(1.0, 0.5, 0.9))
    found, anchors = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    assert (found, anchors) == (SelfCalibration(), ReferencePoses(BEGIN.turn, now))


@pytest.mark.parametrize("wheels", [Pose2(1.0, 0.0, 0.0), Pose2(0.0, 0.0, 1.2)])
def test_where_nothing_was_renewed_nothing_is_learned(wheels: Pose2) -> None:
    """The robot was only found as well as odometry alone would have left it."""
    now = anchor(Pose2(0.9, 0.1, 1.0), wheels, sigma_m=0.2, sigma=0.2)
    found, anchors = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    assert found == SelfCalibration()
    assert now in anchors


@pytest.mark.parametrize(
    ("pose", "wheels"),
    [
        (Pose2(0.5, 0.0, 0.0), Pose2(1.0, 0.0, 0.0)),
        (Pose2(0.0, 0.0, 2.0), Pose2(0.0, 0.0, 1.2)),
        (Pose2(0.6, 0.8, 0.0), Pose2(1.0, 0.0, 0.0)),
    ],
    ids=["way", "turn", "aside"],
)
def test_what_is_beyond_the_gate_teaches_nothing(pose: Pose2, wheels: Pose2) -> None:
    found, _ = self_calibrate(SelfCalibration(), BEGIN, anchor(pose, wheels), NOISE)
    assert found[:3] == pytest.approx((1.0, 1.0, 0.0))


def test_anchors_move_on_when_they_are_old() -> None:
    late, later = (anchor(ORIGIN, ORIGIN, LONGEST_NS / SECOND + more) for more in (0.0, 0.01))
    assert self_calibrate(SelfCalibration(), BEGIN, late, NOISE) == (SelfCalibration(), BEGIN)
    assert self_calibrate(SelfCalibration(), BEGIN, later, NOISE) == (
        SelfCalibration(),
        both(later),
    )


@given(
    st.lists(
        st.tuples(poses, poses, st.floats(1e-3, 0.5), st.floats(1e-3, 0.5)), min_size=1, max_size=8
    )
)
def test_variances_only_shrink(moments: list[tuple[Pose2, Pose2, float, float]]) -> None:
    so_far, anchors = SelfCalibration(), BEGIN
    for i, (pose, wheels, sigma_m, sigma) in enumerate(moments):
        now = anchor(pose, wheels, i + 1.0, sigma_m, sigma)
        found, anchors = self_calibrate(so_far, anchors, now, NOISE)
        for after, before in zip(found[3:], so_far[3:], strict=True):
            assert 0.0 < after <= before
        assert all(math.isfinite(v) for v in found)
        so_far = found


# Many comparisons ---------------------------------------------------------------------------------


def taught(
    legs: Iterable[tuple[float, float]], distance_scale: float, turn_scale: float, bias: float
) -> SelfCalibration:
    """After these true legs of 10 s; wheels report true / scale, bearings are too large.

    As in the localizer, what is known already corrects the readings that come next.
    """
    so_far, anchors, truth, wheels = SelfCalibration(), BEGIN, ORIGIN, ORIGIN
    for i, (distance, turn) in enumerate([(0.0, 0.0), *legs]):
        truth = step(truth, distance, turn)
        distance *= so_far.distance_scale / distance_scale
        wheels = step(wheels, distance, so_far.turn_scale * turn / turn_scale)
        heading = truth.heading - (bias - so_far.bearing_bias_rad)
        now = anchor(truth._replace(heading=heading), wheels, 10.0 * i, 1e-5, 1e-5)
        if i == 0:
            anchors = both(now)
        so_far, anchors = self_calibrate(so_far, anchors, now, EXACT)
    return so_far


TURNS = [(0.0, 1.2), (0.0, -1.2)] * 4
STRAIGHT = [(1.0, 0.0)] * 8


@given(scales, scales, biases)
def test_scales_and_bias_are_recovered_from_exact_poses(
    distance_scale: float, turn_scale: float, bias: float
) -> None:
    found = taught(STRAIGHT + TURNS, distance_scale, turn_scale, bias)
    assert found.distance_scale == pytest.approx(distance_scale, abs=2e-3)
    assert found.turn_scale == pytest.approx(turn_scale, abs=2e-4)
    assert found.bearing_bias_rad == pytest.approx(bias, abs=2e-4)
    assert taught(STRAIGHT + TURNS, 1.0, 1.0, 0.0)[:3] == pytest.approx((1.0, 1.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("turn", [2.0, 3.5, 5.0, 8.0, -3.5])
def test_turns_between_two_updates_are_not_taken_for_others(turn: float) -> None:
    """Beyond half a circle nothing is learned: the headings tell another turn than the wheels."""
    robot, true_scale = robot_that(True), 1.05
    truth, state = LOOP_START, robot.start(0)
    for i in range(30):
        from_ns, until_ns = 5 * SECOND * i, 5 * SECOND * (i + 1)
        state = robot.add_odometry(state, Odometry(from_ns, until_ns, 0.0, turn / true_scale))
        truth = step(truth, 0.0, turn)
        state = robot.cycle(state, frame(truth, until_ns))
    learned_turn = state.memory.calibration.learned.turn_scale
    assert learned_turn == pytest.approx(true_scale if abs(turn) < 3.0 else 1.0, abs=5e-3)


# In the localizer ---------------------------------------------------------------------------------

TRUE = (0.93, 0.95, math.radians(1.0))
WHEELS = OdometrySettings()
CAMERA = SensorSettings(range_share=0.03, bearing_sigma_deg=2.0)
START = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.02, heading_sigma_deg=1.0)
ROUNDS, SEEDS, PERIOD_NS = 7, 5, SECOND // 10


class Drive(NamedTuple):
    """The last state of a run of three minutes, and the position RMSE on the way."""

    state: State
    rmse_m: float


def robot_that(learns: bool, variant: Variant = "joint") -> Localizer:
    rules = LocalizerSettings(variant=variant, self_calibration=learns)
    return localizer(rules=rules, start=START, sensor=CAMERA, odometry=WHEELS)


def reported(rng: np.random.Generator, distance: float, turn: float) -> tuple[float, float]:
    """What wheels that are off by the scales, and noisy as modelled, say of a true motion."""
    along = WHEELS.distance_sigma_m_per_sqrt_m * math.sqrt(distance)
    around = math.hypot(
        WHEELS.turn_sigma_rad_per_sqrt_rad * math.sqrt(abs(turn)),
        WHEELS.turn_sigma_rad_per_sqrt_m * math.sqrt(distance),
    )
    distance_scale, turn_scale, _ = TRUE
    return (
        (distance + along * rng.normal()) / distance_scale,
        (turn + around * rng.normal()) / turn_scale,
    )


def driven(robot: Localizer, seed: int) -> Drive:
    """Rounds with one corner seen every second; all bearings are too large by the bias."""
    rng = np.random.default_rng(seed)
    noisy = sensor_noise(rng, CAMERA)

    def biased(exact: Sighting) -> Sighting:
        assert exact.bearing_rad is not None
        return noisy(Sighting(exact.id, exact.range_m, wrap_angle(exact.bearing_rad + TRUE[2])))

    state, truth, errors_m = robot.start(0), LOOP_START, []
    corners = list(CORNERS.landmarks)
    for i, (distance, turn) in enumerate(loop() * ROUNDS):
        truth, now = step(truth, distance, turn), (i + 1) * PERIOD_NS
        piece = reported(rng, distance, turn)
        state = robot.predict(
            robot.add_odometry(state, Odometry(now - PERIOD_NS, now, *piece)), now
        )
        if i % 10 == 9:
            corner = corners[i // 10 % len(corners)]
            state = robot.cycle(state, frame(truth, now, names=[corner], noise=biased))
        errors_m.append(position_error(state.estimate, truth))
    return Drive(state, math.sqrt(np.mean(np.square(errors_m))))


@pytest.fixture(scope="module")
def runs() -> list[tuple[Drive, Drive]]:
    """With self-calibration and without, on the same inputs."""
    return [(driven(robot_that(True), s), driven(robot_that(False), s)) for s in range(SEEDS)]


def test_wheels_and_camera_are_found_out_while_driving(runs: list[tuple[Drive, Drive]]) -> None:
    for on, _ in runs:
        known = on.state.memory.calibration.learned
        for value, variance, true in zip(known[:3], known[3:], TRUE, strict=True):
            assert abs(value - true) <= 3.0 * math.sqrt(variance)
    scales = np.array([on.state.memory.calibration.learned[:2] for on, _ in runs])
    off = np.abs(1.0 - np.array(TRUE[:2]))
    assert np.all(np.abs(scales - TRUE[:2]).mean(axis=0) < 0.5 * off)


def test_a_robot_that_learns_knows_better_where_it_is(runs: list[tuple[Drive, Drive]]) -> None:
    on, off = (np.mean([run.rmse_m for run in side]) for side in zip(*runs, strict=True))
    assert on < 0.9 * off


def test_a_robot_that_does_not_learn_remembers_nothing_of_it(
    runs: list[tuple[Drive, Drive]],
) -> None:
    for _, off in runs:
        assert off.state.memory.calibration.learned == SelfCalibration()
        assert off.state.memory.calibration.anchors is None


@pytest.mark.parametrize("variant", PROBABILISTIC)
def test_nothing_is_learned_where_nothing_is_wrong(variant: Variant) -> None:
    robot = robot_that(True, variant)
    for state, _ in followed(robot, robot.start(0), LOOP_START, loop()):
        found = state.memory.calibration.learned
        assert found[:3] == pytest.approx((1.0, 1.0, 0.0), abs=1e-9)
    assert all(
        after < 0.5 * before for after, before in zip(found[3:], SelfCalibration()[3:], strict=True)
    )


@pytest.mark.parametrize("learns", [True, False])
def test_what_is_known_corrects_wheels_and_bearings(learns: bool) -> None:
    known = SelfCalibration(0.9, 0.8, 0.1)
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    before = before._replace(memory=Memory(calibration=CalibrationMemory(known)))
    robot = robot_that(learns)
    moved = robot.predict(robot.add_odometry(before, Odometry(0, SECOND, 1.0, 0.5)), SECOND)
    expected = step(ORIGIN, 0.9, 0.4) if learns else step(ORIGIN, 1.0, 0.5)
    assert moved.estimate.pose == pytest.approx(expected)
    frame_with_bias = without_bearing_bias(frame(ORIGIN, 1), -0.1)
    seen = robot.cycle(before, frame_with_bias).estimate.pose
    assert (abs(seen.heading) < 1e-9) is learns


def test_a_robot_that_was_lost_compares_with_nothing_before() -> None:
    """Carried elsewhere, it finds itself by what it sees there; the way there was not driven."""
    robot, elsewhere = robot_that(True), Pose2(1.5, 1.0, 2.0)
    *_, (before, _) = followed(robot, robot.start(0), LOOP_START, loop()[:100])
    assert before.memory.calibration.anchors is not None
    assert before.memory.calibration.learned != SelfCalibration()
    *_, (last, truth) = followed(robot, before, elsewhere, [(0.0, 0.0)] * 100)
    assert last.counts["found_again"] >= 1
    assert position_error(last.estimate, truth) < 0.2
    assert last.memory.calibration.learned == before.memory.calibration.learned
    assert last.memory.calibration.anchors is not None
    assert all(
        position_error(at.estimate, elsewhere) < 0.5 for at in last.memory.calibration.anchors
    )


def test_while_a_robot_is_lost_it_has_no_anchors() -> None:
    robot = robot_that(True)
    at = anchor(LOOP_START, ORIGIN, 0.0)
    lost = robot.start(0)
    calibration = CalibrationMemory(anchors=both(at))
    memory = Memory(RecoveryMemory(lost="for the test"), calibration=calibration)
    seen = robot.cycle(lost._replace(memory=memory), frame(LOOP_START, SECOND // 10))
    assert seen.counts["accepted"] == len(CORNERS.landmarks)
    assert seen.memory.calibration.anchors is None


def test_a_robot_without_a_covariance_learns_nothing() -> None:
    assert LocalizerSettings(self_calibration=True).learns
    assert driven(robot_that(True, "weighted"), 1) == driven(robot_that(False, "weighted"), 1)
