"""Scales of odometry that are not known exactly: considered, and estimated beside the pose."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import (
    CORNERS,
    PROBABILISTIC,
    SECOND,
    Matrix,
    covariance3,
    diagonal,
    displaced,
    frame,
    least_eigenvalue,
    localizer,
    matrix3,
    sensor_noise,
)
from support.sweeps import sampled

from cpcbl_team.config import (
    LocalizerSettings,
    OdometryNoise,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
)
from cpcbl_team.estimate import POSE, Estimate, offset_pose
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import InitialPose, InputsMended, Odometry
from cpcbl_team.localizer import Localizer
from cpcbl_team.motion import motion_jacobian, motion_noise, move
from cpcbl_team.parameters import NO_COVARIANCE
from cpcbl_team.scale_errors import EXACT, ScaleErrors
from cpcbl_team.state import State, with_calibration

NOISE = OdometryNoise()
EYE2 = np.eye(2)
SIGMAS = 0.1, 0.2  # of the scales of distances and turns
PIECE_NS = SECOND // 10
ARC = 0.05, 0.04  # m and rad of each piece
START = Start(x_m=0.0, y_m=-1.2, heading_deg=0.0, sigma_m=0.02, heading_sigma_deg=1.0)
SENSOR = SensorSettings(range_share=0.03, bearing_sigma_deg=2.0, field_of_view_deg=360.0)


def moved(
    estimate: Estimate, scales: ScaleErrors, arc: tuple[float, float]
) -> tuple[Estimate, ScaleErrors]:
    """The estimate after an arc by this odometry, and what is known of the scales then."""
    scales, offset = scales.after_updates(estimate).corrected()
    estimate = estimate._replace(pose=offset_pose(estimate.pose, offset, POSE))
    corrected = arc[0] * scales.distance.factor, arc[1] * scales.turn.factor
    after = move(estimate, *corrected, NOISE)
    scales, added = scales.after_motion(estimate, *corrected)
    after = after._replace(covariance=after.covariance.plus(added))
    return after, scales._replace(estimate=after)


def updated(covariance: Matrix, rows: Matrix, noise: float) -> tuple[Matrix, Matrix]:
    """The covariance after an update by readings (`rows`), and 1 - K H."""
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + noise * EYE2)
    left = np.eye(3) - gain @ rows
    return left @ covariance, left


def test_covariance_is_that_of_a_filter_that_considers_both_scales() -> None:
    """Of one with five states, of which only the pose is updated (Schmidt)."""
    rng = np.random.default_rng(1)
    scales, pose = ScaleErrors.of_sigmas(*SIGMAS), Pose2(1.0, 2.0, 0.3)
    estimate = Estimate(pose, diagonal(0.05, 0.02))
    reference = np.zeros((5, 5))
    reference[:3, :3] = matrix3(estimate.covariance)
    reference[3:, 3:] = np.diag(np.square(SIGMAS))
    for i in range(80):
        arc = 0.05, float(rng.uniform(-0.1, 0.1))
        direction = estimate.pose.heading + 0.5 * arc[1]
        dx, dy = arc[0] * math.cos(direction), arc[0] * math.sin(direction)
        whole = np.eye(5)
        whole[:3, :3] = np.reshape(motion_jacobian(estimate.pose.heading, *arc), (3, 3))
        whole[:3, 3:] = [[dx, -0.5 * arc[1] * dy], [dy, 0.5 * arc[1] * dx], [0.0, arc[1]]]
        noise = np.zeros((5, 5))
        noise[:3, :3] = matrix3(motion_noise(estimate.pose.heading, *arc, NOISE))
        reference = whole @ reference @ whole.T + noise
        scales = scales.after_updates(estimate, estimates=False)
        estimate, scales = moved(estimate, scales, arc)
        if i % 10 == 9:
            rows = rng.normal(size=(2, 3))
            now, left = updated(reference[:3, :3], rows, 0.01)
            both = np.eye(5)
            both[:3, :3] = left
            gain = np.zeros((5, 2))
            gain[:3] = now @ rows.T / 0.01
            reference = both @ reference @ both.T + 0.01 * gain @ gain.T
            estimate = estimate._replace(covariance=covariance3(now))
        assert matrix3(estimate.covariance) == pytest.approx(reference[:3, :3], abs=1e-12)
        known = scales.after_updates(estimate, estimates=False)
        both = np.array([known.distance.covariance, known.turn.covariance])
        assert both == pytest.approx(reference[3:, :3], abs=1e-12)


def test_one_update_says_of_the_scales_what_a_filter_with_five_states_says() -> None:
    """The mean of both, and their variances, after a way without updates and one update."""
    rng = np.random.default_rng(2)
    estimate, scales = Estimate(Pose2(1.0, 2.0, 0.3), diagonal(0.05, 0.02)), None
    scales = ScaleErrors.of_sigmas(*SIGMAS)
    for _ in range(40):
        estimate, scales = moved(estimate, scales, (0.05, float(rng.uniform(-0.02, 0.04))))
    whole = np.zeros((5, 5))
    whole[:3, :3] = matrix3(estimate.covariance)
    whole[3:, 3:] = np.diag(np.square(SIGMAS))
    both = np.array([scales.distance.covariance, scales.turn.covariance])
    whole[3:, :3], whole[:3, 3:] = both, both.T
    rows = np.hstack([rng.normal(size=(2, 3)), np.zeros((2, 2))])
    gain = whole @ rows.T @ np.linalg.inv(rows @ whole @ rows.T + 1e-3 * EYE2)
    mean = gain @ np.array([0.02, -0.01])
    left = (np.eye(5) - gain @ rows) @ whole
    x, y, heading = mean[:3].tolist()
    pose = offset_pose(estimate.pose, (x, y, heading), POSE)
    known = scales.after_updates(Estimate(pose, covariance3(left[:3, :3])))
    assert (known.distance.error, known.turn.error) == pytest.approx(mean[3:], abs=1e-12)
    variances = known.distance.variance, known.turn.variance
    assert variances == pytest.approx(np.diag(left)[3:], abs=1e-12)


def test_an_error_that_is_expected_is_no_news() -> None:
    """A correction of the pose by what the error that is known has moved it by."""
    estimate, scales = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.05, 0.02)), None
    scales = ScaleErrors.of_sigmas(*SIGMAS)
    for _ in range(20):
        estimate, scales = moved(estimate, scales, (0.05, 0.02))
    turn = scales.turn._replace(error=0.05, offset=(0.01, 0.02, 0.03))
    scales = scales._replace(turn=turn)
    now = matrix3(estimate.covariance)
    left, remains = updated(now, np.eye(2, 3), 0.01)
    x, y, heading = ((np.eye(3) - remains) @ np.array(scales.offset)).tolist()
    pose = offset_pose(estimate.pose, (x, y, heading), POSE)
    known = scales.after_updates(Estimate(pose, covariance3(left)))
    assert known.turn.error == pytest.approx(0.05)
    assert known.distance.error == pytest.approx(0.0, abs=1e-12)
    assert known.turn.variance < scales.turn.variance


@given(
    st.lists(
        st.tuples(st.floats(-0.5, 0.5), st.floats(-1.0, 1.0), st.booleans(), st.floats(0.0, 0.3)),
        min_size=1,
        max_size=30,
    )
)
def test_covariance_stays_one_whatever_happens(
    events: list[tuple[float, float, bool, float]],
) -> None:
    """Of pose and scales, after motions, updates, and poses and covariances from elsewhere."""
    scales = ScaleErrors.of_sigmas(0.1, 0.2)
    estimate = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.1, 0.1))
    for distance, turn, is_update, sigma in events:
        estimate, scales = moved(estimate, scales, (distance, turn))
        if is_update:
            before = matrix3(estimate.covariance)
            gain = before[:, :2] @ np.linalg.inv(before[:2, :2] + 0.01 * EYE2)
            now = before - gain @ before[:2]
            pose = displaced(estimate.pose, diagonal(0.3, 0.3), np.random.default_rng(1))
            estimate = Estimate(pose, covariance3(0.5 * (now + now.T)))
        elif sigma > 0.2:
            estimate = estimate._replace(covariance=diagonal(sigma, 0.5 * sigma))
        known = scales.after_updates(estimate)
        if 0.1 < sigma < 0.2:  # second filters know these otherwise
            scales = known = known.with_considered(sigma, 0.5 * sigma, estimate)
        whole = np.zeros((5, 5))
        whole[:3, :3] = matrix3(estimate.covariance)
        whole[3, :3] = whole[:3, 3] = known.distance.covariance
        whole[4, :3] = whole[:3, 4] = known.turn.covariance
        whole[3:, 3:] = np.diag([known.distance.considered, known.turn.considered])
        size = float(np.trace(whole))
        assert least_eigenvalue(whole) > -1e-9 * max(size, 1.0)
        assert 0.0 < known.distance.factor < math.inf
        assert 0.0 < known.turn.factor < math.inf


def test_an_error_of_scale_grows_with_the_way_not_with_its_root() -> None:
    estimate = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.0, 0.0))
    scales = ScaleErrors.of_sigmas(0.1, 0.0)
    for _ in range(100):
        estimate, scales = moved(estimate, scales, (0.1, 0.0))
    alone = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.0, 0.0))
    for _ in range(100):
        alone = move(alone, 0.1, 0.0, NOISE)
    assert estimate.covariance.xx - alone.covariance.xx == pytest.approx((0.1 * 10.0) ** 2)
    assert estimate.covariance.yy == pytest.approx(alone.covariance.yy)


def test_a_scale_that_is_exact_stays_so() -> None:
    scales = ScaleErrors.of_sigmas(0.0, 0.2)
    estimate = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.1, 0.1))
    for _ in range(20):
        estimate, scales = moved(estimate, scales, (0.05, 0.05))
    (x, y, heading), covariance, _ = estimate
    now = Estimate(Pose2(x + 0.1, y, heading + 0.05), covariance.scaled(0.5))
    known = scales.after_updates(now)
    assert known.distance.error == 0.0
    assert known.distance.variance == 0.0
    assert known.turn.error > 0.0
    assert known.turn.variance < 0.2**2


def test_a_correction_of_another_size_changes_a_scale_by_three_sigma_at_most() -> None:
    scales, estimate = (
        ScaleErrors.of_sigmas(0.1, 0.0),
        Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.05, 0.02)),
    )
    for _ in range(20):
        estimate, scales = moved(estimate, scales, (0.1, 0.0))
    far = Estimate(Pose2(50.0, 0.0, 0.0), estimate.covariance.scaled(0.1))
    assert 0.0 < scales.after_updates(far).distance.error < 0.31


def test_exact_scales_are_no_states() -> None:
    robot = localizer("joint", start=START, odometry=OdometrySettings())
    state = robot.add_odometry(robot.start(0), Odometry(0, PIECE_NS, *ARC))
    state = robot.predict(state, PIECE_NS)
    assert state.memory.calibration.scales == EXACT


@pytest.mark.parametrize(
    "rules",
    [
        LocalizerSettings(variant="weighted"),
        LocalizerSettings(variant="oval", paper_uncertainty=True),
    ],
)
def test_variants_of_the_paper_take_scales_for_exact(rules: LocalizerSettings) -> None:
    """Nor after their inputs were wrong for some time."""
    odometry = OdometrySettings(distance_scale_sigma=0.1, turn_scale_sigma=0.2)
    robot = localizer(rules=rules, start=START, odometry=odometry)
    state = driven_blind(robot.start(0), robot, 10)
    assert state.memory.calibration.scales == EXACT
    mended = robot.forget_wrong_inputs(state, InputsMended(state.stamp_ns))
    assert mended.memory.calibration.scales == EXACT


def test_a_pose_that_somebody_sets_owes_nothing_to_the_way_to_it() -> None:
    robot = robot_of()
    state = driven_blind(robot.start(0), robot, 50)
    assert state.memory.calibration.scales.distance.covariance != NO_COVARIANCE
    covariance = 0.01, 0.0, 0.01, 0.0, 0.0, 0.01
    given = InitialPose(state.stamp_ns, 1.0, 1.0, 0.0, covariance)
    known = robot.set_pose(state, given).memory.calibration.scales
    assert known.distance.covariance == known.turn.covariance == NO_COVARIANCE
    assert known.estimate is None


def test_a_robot_that_stands_moves_to_where_its_scales_say() -> None:
    """What is corrected of a scale corrects the pose, also if the next piece of odometry is of no
    motion."""
    robot = robot_of()
    state = driven_blind(robot.start(0), robot, 50)
    memory = state.memory.calibration
    turn = memory.scales.turn._replace(error=0.1, offset=(0.3, 0.2, 0.1), variance=1e-4)
    known = memory.scales._replace(turn=turn)
    state = with_calibration(state, memory._replace(scales=known))
    now = state.stamp_ns
    standing = robot.add_odometry(state, Odometry(now, now + PIECE_NS, 0.0, 0.0))
    standing = robot.predict(standing, now + PIECE_NS)
    scales = standing.memory.calibration.scales
    share = 1.0 - scales.turn.offset[0] / 0.3
    assert share > 0.5
    assert standing.estimate.pose.x - state.estimate.pose.x == pytest.approx(0.3 * share)
    assert standing.estimate.pose.y - state.estimate.pose.y == pytest.approx(0.2 * share)


# A robot whose wheels are of another day --------------------------------------------------------


class Figures(NamedTuple):
    nees: float  # of positions; 2 is due
    inside: float  # share of positions in 3 sigma


def robot_of(variant: Variant = "joint", sigmas: tuple[float, float] = SIGMAS) -> Localizer:
    odometry = OdometrySettings(distance_scale_sigma=sigmas[0], turn_scale_sigma=sigmas[1])
    return localizer(variant, CORNERS, start=START, sensor=SENSOR, odometry=odometry)


def driven_blind(state: State, robot: Localizer, pieces: int) -> State:
    """After so many arcs in which it sees nothing."""
    for _ in range(pieces):
        now = state.stamp_ns
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, *ARC))
        state = robot.predict(state, now + PIECE_NS)
    return state


def run(robot: Localizer, seed: int, seconds: int = 60) -> tuple[State, Figures]:
    """A robot whose scales are drawn from their sigmas, that sees landmarks for two seconds in 15:
    its figures while it does not see any."""
    rng, state = np.random.default_rng(seed), robot.start(0)
    by_distance, by_turn = 1.0 + rng.normal(size=2) * SIGMAS
    pose = displaced(state.estimate.pose, state.estimate.covariance, rng)
    errors, squares = sensor_noise(rng, SENSOR), []
    for i in range(10 * seconds):
        distance, turn = ARC[0] * by_distance, ARC[1] * by_turn
        noise = motion_noise(pose.heading, distance, turn, NOISE)
        pose, now = displaced(step(pose, distance, turn), noise, rng), state.stamp_ns
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, *ARC))
        state = robot.predict(state, now + PIECE_NS)
        if i % 150 >= 130:
            state = robot.cycle(state, frame(pose, state.stamp_ns, noise=errors))
        elif i % 10 == 0:
            (x, y, _), covariance, _ = state.reported
            dx, dy = x - pose.x, y - pose.y
            squares.append(covariance.position().mahalanobis_squared(dx, dy))
    return state, Figures(float(np.mean(squares)), float(np.mean(np.array(squares) < 11.83)))


@pytest.mark.parametrize("variant", sampled(PROBABILISTIC, ["joint"]))
def test_sigma_of_dead_reckoning_holds_with_wheels_of_another_day(variant: Variant) -> None:
    figures = [run(robot_of(variant), seed)[1] for seed in range(12)]
    assert np.mean([f.nees for f in figures]) < 2.6
    assert np.mean([f.inside for f in figures]) > 0.975


def test_without_it_a_robot_is_sure_of_a_wrong_pose() -> None:
    figures = [run(robot_of(sigmas=(0.0, 0.0)), seed)[1] for seed in range(4)]
    assert np.mean([f.nees for f in figures]) > 6.0


def after_driving_among_landmarks(robot: Localizer) -> State:
    """After 90 s with wheels that drive 1.15 of each distance, and turn 0.7 of each turn."""
    pose, rng = Pose2(0.0, -1.2, 0.0), np.random.default_rng(5)
    state, errors = robot.start(0), sensor_noise(np.random.default_rng(6), SENSOR)
    for _ in range(900):
        distance, turn = 1.15 * ARC[0], 0.7 * ARC[1]
        noise = motion_noise(pose.heading, distance, turn, NOISE)
        pose, now = displaced(step(pose, distance, turn), noise, rng), state.stamp_ns
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, *ARC))
        state = robot.cycle(state, frame(pose, now + PIECE_NS, noise=errors))
    return state


def test_scales_are_known_after_some_time_among_landmarks() -> None:
    """The settings explain them, so the robot is not called miscalibrated."""
    state = after_driving_among_landmarks(robot_of())
    scales = state.memory.calibration.scales
    assert scales.distance.factor == pytest.approx(1.15, abs=0.03)
    assert scales.turn.factor == pytest.approx(0.7, abs=0.03)
    assert math.sqrt(scales.distance.variance) < 0.02
    assert math.sqrt(scales.turn.variance) < 0.025
    assert "miscalibrated" not in state.counts


def test_scales_that_the_settings_do_not_explain_are_counted() -> None:
    state = after_driving_among_landmarks(robot_of(sigmas=(0.04, 0.08)))
    assert state.memory.calibration.scales.turn.factor == pytest.approx(0.7, abs=0.05)
    assert state.counts["miscalibrated"]


def test_what_wrong_inputs_said_of_the_scales_is_forgotten() -> None:
    robot = robot_of()
    state = after_driving_among_landmarks(robot)
    mended = robot.forget_wrong_inputs(state, InputsMended(state.stamp_ns))
    assert mended.memory.calibration.scales == ScaleErrors.of_sigmas(*SIGMAS)
