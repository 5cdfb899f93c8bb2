"""What a robot learns of its odometry and camera: the rule alone, then in the localizer."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import (
    CORNERS,
    EXACT,
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

from cpcbl_team.calibration_memory import CalibrationMemory
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
from cpcbl_team.sensors import recalibrated
from cpcbl_team.state import Memory, RecoveryMemory, State

ORIGIN = Pose2(0.0, 0.0, 0.0)
NOISE = OdometryNoise()

scales = st.floats(0.92, 1.08)
biases = st.floats(math.radians(-3.0), math.radians(3.0))


def reference(
    pose: Pose2, odometry: Pose2, seconds: float = 1.0, sigma_m: float = 0.01, sigma: float = 0.01
) -> ReferencePose:
    """A time at which the estimated pose was `pose` and that by odometry `odometry`."""
    estimate = Estimate(pose, diagonal(sigma_m, sigma))
    return ReferencePose(round(seconds * SECOND), estimate, odometry, odometry.heading)


def both(at: ReferencePose) -> ReferencePoses:
    return ReferencePoses(at, at)


BEGIN = both(reference(ORIGIN, ORIGIN, 0.0))


# One comparison -----------------------------------------------------------------------------------


def test_a_distance_shorter_than_odometrys_gives_the_scale_computed_by_hand() -> None:
    """1 m by odometry, 0.95 m by poses: variances 2 x 0.01^2 of poses, 0.05^2 of odometry."""
    now = reference(Pose2(0.95, 0.0, 0.0), Pose2(1.0, 0.0, 0.0))
    found, references = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    gain = 0.0025 / (0.0025 + 0.0002 + 0.0025)
    assert found.distance_scale == pytest.approx(1.0 - 0.05 * gain)
    assert found.distance_variance == pytest.approx((1.0 - gain) * 0.0025)
    assert found.bearing_bias_rad == 0.0
    assert (found.turn_scale, found.turn_variance) == SelfCalibration()[1:5:3]
    assert references == ReferencePoses(BEGIN.turn, now)


def test_a_turn_larger_than_odometrys_gives_the_scale_computed_by_hand() -> None:
    now = reference(Pose2(0.0, 0.0, 1.3), Pose2(0.0, 0.0, 1.2))
    found, references = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    around = 0.05**2 * 1.2
    gain = 0.0025 * 1.2 / (1.2**2 * 0.0025 + 0.0002 + around)
    assert found.turn_scale == pytest.approx(1.0 + 0.1 * gain)
    assert found.turn_variance == pytest.approx((1.0 - 1.2 * gain) * 0.0025)
    assert references.turn == now


def test_a_motion_beside_the_heading_gives_the_bearing_bias_computed_by_hand() -> None:
    aside = math.radians(2.0)
    now = reference(Pose2(math.cos(aside), math.sin(aside), 0.0), Pose2(1.0, 0.0, 0.0))
    found, _ = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    variance = math.radians(1.5) ** 2
    gain = variance / (variance + 0.01**2 + 0.0002 + 0.05**2 / 3.0)
    assert found.bearing_bias_rad == pytest.approx(aside * gain)
    assert found.bearing_variance == pytest.approx((1.0 - gain) * variance)
    assert found.distance_scale == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("across_m", [-0.05, 0.05])
def test_an_error_across_the_motion_does_not_change_the_scale(across_m: float) -> None:
    """Otherwise all scales would be too large: both ends of each distance have such an error."""
    now = reference(Pose2(0.8, across_m, 0.0), Pose2(0.8, 0.0, 0.0))
    found, _ = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    assert found.distance_scale == pytest.approx(1.0, abs=1e-12)
    assert found.bearing_bias_rad * across_m > 0.0


def test_driving_backwards_is_not_a_turn() -> None:
    now = reference(Pose2(-0.95, 0.0, 0.0), Pose2(-1.0, 0.0, 0.0))
    found, _ = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    assert found.distance_scale < 1.0
    assert found.bearing_bias_rad == pytest.approx(0.0)


@pytest.mark.parametrize("odometry", [Pose2(0.5, 0.0, 0.6), Pose2(0.0, 0.6, 0.0), ORIGIN])
def test_too_little_motion_is_not_compared(odometry: Pose2) -> None:
    now = reference(ORIGIN, odometry)
    assert self_calibrate(SelfCalibration(), BEGIN, now, NOISE) == (SelfCalibration(), BEGIN)


def test_after_a_large_turn_the_distance_starts_anew() -> None:
    now = reference(Pose2(0.9, 0.5, 0.9), Pose2(1.0, 0.5, 0.9))
    found, references = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    assert (found, references) == (SelfCalibration(), ReferencePoses(BEGIN.turn, now))


@pytest.mark.parametrize("odometry", [Pose2(1.0, 0.0, 0.0), Pose2(0.0, 0.0, 1.2)])
def test_an_inaccurate_pose_changes_nothing(odometry: Pose2) -> None:
    """The pose is no more accurate than by odometry alone."""
    now = reference(Pose2(0.9, 0.1, 1.0), odometry, sigma_m=0.2, sigma=0.2)
    found, references = self_calibrate(SelfCalibration(), BEGIN, now, NOISE)
    assert found == SelfCalibration()
    assert now in references


@pytest.mark.parametrize(
    ("pose", "odometry"),
    [
        (Pose2(0.5, 0.0, 0.0), Pose2(1.0, 0.0, 0.0)),
        (Pose2(0.0, 0.0, 2.0), Pose2(0.0, 0.0, 1.2)),
        (Pose2(0.6, 0.8, 0.0), Pose2(1.0, 0.0, 0.0)),
    ],
    ids=["way", "turn", "aside"],
)
def test_a_comparison_beyond_the_gate_changes_nothing(pose: Pose2, odometry: Pose2) -> None:
    found, _ = self_calibrate(SelfCalibration(), BEGIN, reference(pose, odometry), NOISE)
    assert found[:3] == pytest.approx((1.0, 1.0, 0.0))


def test_old_references_are_replaced() -> None:
    late, later = (reference(ORIGIN, ORIGIN, LONGEST_NS / SECOND + more) for more in (0.0, 0.01))
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
def test_variances_never_grow(moments: list[tuple[Pose2, Pose2, float, float]]) -> None:
    known, references = SelfCalibration(), BEGIN
    for i, (pose, odometry, sigma_m, sigma) in enumerate(moments):
        now = reference(pose, odometry, i + 1.0, sigma_m, sigma)
        found, references = self_calibrate(known, references, now, NOISE)
        for after, before in zip(found[3:], known[3:], strict=True):
            assert 0.0 < after <= before
        assert all(math.isfinite(v) for v in found)
        known = found


# Many comparisons ---------------------------------------------------------------------------------


def calibrated(
    legs: Iterable[tuple[float, float]], distance_scale: float, turn_scale: float, bias: float
) -> SelfCalibration:
    """After these true legs of 10 s; odometry report true / scale, bearings are too large.

    As in the localizer, what is known already corrects the readings that come next.
    """
    known, references, truth, odometry = SelfCalibration(), BEGIN, ORIGIN, ORIGIN
    for i, (distance, turn) in enumerate([(0.0, 0.0), *legs]):
        truth = step(truth, distance, turn)
        distance *= known.distance_scale / distance_scale
        odometry = step(odometry, distance, known.turn_scale * turn / turn_scale)
        heading = truth.heading - (bias - known.bearing_bias_rad)
        now = reference(truth._replace(heading=heading), odometry, 10.0 * i, 1e-5, 1e-5)
        if i == 0:
            references = both(now)
        known, references = self_calibrate(known, references, now, EXACT)
    return known


TURNS = [(0.0, 1.2), (0.0, -1.2)] * 4
STRAIGHT = [(1.0, 0.0)] * 8


@given(scales, scales, biases)
def test_scales_and_bias_are_recovered_from_exact_poses(
    distance_scale: float, turn_scale: float, bias: float
) -> None:
    found = calibrated(STRAIGHT + TURNS, distance_scale, turn_scale, bias)
    assert found.distance_scale == pytest.approx(distance_scale, abs=2e-3)
    assert found.turn_scale == pytest.approx(turn_scale, abs=2e-4)
    assert found.bearing_bias_rad == pytest.approx(bias, abs=2e-4)
    assert calibrated(STRAIGHT + TURNS, 1.0, 1.0, 0.0)[:3] == pytest.approx(
        (1.0, 1.0, 0.0), abs=1e-9
    )


@pytest.mark.parametrize("turn", [2.0, 3.5, 5.0, 8.0, -3.5])
def test_an_ambiguous_turn_is_not_compared(turn: float) -> None:
    """Beyond half a circle the headings give another turn than odometry."""
    robot, true_scale = calibrating_robot(True), 1.05
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


def calibrating_robot(learns: bool, variant: Variant = "joint") -> Localizer:
    rules = LocalizerSettings(variant=variant, self_calibration=learns)
    return localizer(rules=rules, start=START, sensor=CAMERA, odometry=WHEELS)


def reported(rng: np.random.Generator, distance: float, turn: float) -> tuple[float, float]:
    """The odometry of a true motion, with wrong scales and the noise of the model."""
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
    return [
        (driven(calibrating_robot(True), s), driven(calibrating_robot(False), s))
        for s in range(SEEDS)
    ]


def test_scales_and_bias_are_estimated_while_driving(runs: list[tuple[Drive, Drive]]) -> None:
    for on, _ in runs:
        known = on.state.memory.calibration.learned
        for value, variance, true in zip(known[:3], known[3:], TRUE, strict=True):
            assert abs(value - true) <= 3.0 * math.sqrt(variance)
    scales = np.array([on.state.memory.calibration.learned[:2] for on, _ in runs])
    off = np.abs(1.0 - np.array(TRUE[:2]))
    assert np.all(np.abs(scales - TRUE[:2]).mean(axis=0) < 0.5 * off)


def test_self_calibration_reduces_the_position_error(runs: list[tuple[Drive, Drive]]) -> None:
    """Against `circular`, which does not notice that its settings are wrong; `joint` does, and is
    no worse for it."""
    on, noticing = (np.mean([run.rmse_m for run in side]) for side in zip(*runs, strict=True))
    assert on < 1.05 * noticing
    on, off = (
        np.mean([driven(calibrating_robot(learns, "circular"), s).rmse_m for s in range(SEEDS)])
        for learns in (True, False)
    )
    assert on < 0.95 * off


def test_without_self_calibration_nothing_is_remembered(
    runs: list[tuple[Drive, Drive]],
) -> None:
    for _, off in runs:
        assert off.state.memory.calibration.learned == SelfCalibration()
        assert off.state.memory.calibration.references is None


@pytest.mark.parametrize("variant", PROBABILISTIC)
def test_correct_odometry_and_bearings_stay_unchanged(variant: Variant) -> None:
    robot = calibrating_robot(True, variant)
    for state, _ in followed(robot, robot.start(0), LOOP_START, loop()):
        found = state.memory.calibration.learned
        assert found[:3] == pytest.approx((1.0, 1.0, 0.0), abs=1e-9)
    assert all(
        after < 0.5 * before for after, before in zip(found[3:], SelfCalibration()[3:], strict=True)
    )


def test_the_calibration_corrects_odometry_and_bearings() -> None:
    known = SelfCalibration(0.9, 0.8, 0.1)
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    before = before._replace(memory=Memory(calibration=CalibrationMemory(known)))
    robot = calibrating_robot(True)
    moved = robot.predict(robot.add_odometry(before, Odometry(0, SECOND, 1.0, 0.5)), SECOND)
    assert moved.estimate.pose == pytest.approx(step(ORIGIN, 0.9, 0.4))
    frame_with_bias = recalibrated(frame(ORIGIN, 1), -0.1)
    seen = robot.cycle(before, frame_with_bias).estimate.pose
    assert seen.heading == pytest.approx(0.0, abs=1e-9)


def test_a_robot_that_was_lost_starts_with_new_references() -> None:
    """The robot is carried elsewhere and finds its pose there; it did not drive this distance."""
    robot, elsewhere = calibrating_robot(True), Pose2(1.5, 1.0, 2.0)
    *_, (before, _) = followed(robot, robot.start(0), LOOP_START, loop()[:100])
    assert before.memory.calibration.references is not None
    assert before.memory.calibration.learned != SelfCalibration()
    *_, (last, truth) = followed(robot, before, elsewhere, [(0.0, 0.0)] * 100)
    assert last.counts["found_again"] >= 1
    assert position_error(last.estimate, truth) < 0.2
    assert last.memory.calibration.learned == before.memory.calibration.learned
    assert last.memory.calibration.references is not None
    assert all(
        position_error(at.estimate, elsewhere) < 0.5 for at in last.memory.calibration.references
    )


def test_a_lost_robot_has_no_references() -> None:
    robot = calibrating_robot(True)
    at = reference(LOOP_START, ORIGIN, 0.0)
    lost = robot.start(0)
    calibration = CalibrationMemory(references=both(at))
    memory = Memory(RecoveryMemory(lost="for the test"), calibration=calibration)
    seen = robot.cycle(lost._replace(memory=memory), frame(LOOP_START, SECOND // 10))
    assert seen.counts["accepted"] == len(CORNERS.landmarks)
    assert seen.memory.calibration.references is None


def test_weighted_robots_do_not_calibrate_themselves() -> None:
    assert LocalizerSettings(self_calibration=True).learns
    assert driven(calibrating_robot(True, "weighted"), 1) == driven(
        calibrating_robot(False, "weighted"), 1
    )
