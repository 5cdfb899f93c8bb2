"""A robot whose settings seem to be wrong is less certain until it knows, and no other robot is."""

import math

import numpy as np
import pytest
from core.test_calibration_filter import MARKS, NOISE, Sensor, Truth, drives, started
from support.core import (
    LOOP_START,
    SECOND,
    Noise,
    diagonal,
    fix,
    followed,
    localizer,
    loop,
    matrix2,
    matrix3,
    sensor_noise,
    state_at,
)
from support.sweeps import sampled, thorough

from cpcbl_team.calibration_doubt import (
    ODDS,
    with_mixture,
    with_probabilities,
    with_remaining_errors,
)
from cpcbl_team.calibration_filter import FILTERS, FIRST_SIGMAS, CalibrationFilter
from cpcbl_team.config import OdometrySettings, SensorSettings
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.filter_corrections import KindsOfError
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Sighting
from cpcbl_team.miscalibration import AS_CONFIGURED, Adaptation
from cpcbl_team.range_errors import NO_RANGE_ERRORS, RangeErrors

TWO = Sensor(names="ac")  # of which each second filter but one sees both
HERE = Pose2(0.0, 0.0, 0.0)
OWN = Estimate(HERE, diagonal(100.0, 100.0))  # no filter contradicts it


def density(off: np.ndarray, covariance: np.ndarray) -> float:
    """Of a Gaussian."""
    square = off @ np.linalg.solve(covariance, off)
    return float(math.exp(-0.5 * square) / math.sqrt(np.linalg.det(2.0 * math.pi * covariance)))


def knowing(errors: np.ndarray, covariance: np.ndarray, pose: Pose2 = HERE) -> CalibrationFilter:
    """A filter that knows this of the bias of bearings and of both errors of ranges."""
    rows = np.diag([1.0] * 8)
    rows[:3, :3], rows[3:6, 3:6] = 0.01 * np.eye(3), covariance
    rows[6:, 6:] = 0.005 * np.eye(2)  # as much as before, by the noise of chords
    return CalibrationFilter(
        0, HERE, pose, (*map(float, errors), 0.0, 0.0), tuple(map(tuple, rows))
    )


def filters_over_time(
    truth: Truth, seed: int, sensor: Sensor, steps: int
) -> list[tuple[CalibrationFilter, ...]]:
    frames, names = drives(truth, seed, sensor, steps=steps), sorted(MARKS)
    filters, found = [started()] * FILTERS, []
    for i in range(0, len(frames), 3):
        filters = [
            f.after(frames[i : i + 3], NOISE, 0.0, frozenset(names[n::FILTERS]))
            for n, f in enumerate(filters)
        ]
        found.append(with_probabilities(tuple(filters), AS_CONFIGURED, OWN, HERE))
    return found


def probability(filters: tuple[CalibrationFilter, ...]) -> float:
    return sum(f.probability for f in filters)


def test_probabilities_are_those_of_bayes() -> None:
    """By the densities of errors that are zero (Dickey 1971), before and after the sightings."""
    errors, first = np.array([0.1, 0.08, -0.05]), np.diag(np.square(FIRST_SIGMAS[:3]))
    root = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [0.02, -0.01, 0.05]])
    after, zero = root @ root.T, np.zeros(3)
    by_all = density(zero, first) / density(errors, after)
    by_bias = density(zero[:1], first[:1, :1]) / density(errors[:1], after[:1, :1])
    assert by_all > 1.0
    assert by_bias > 1.0
    odds = ODDS * (by_all - 1.0 + by_bias - 1.0)
    (found,) = with_probabilities((knowing(errors, after),), AS_CONFIGURED, OWN, HERE)
    assert found.probability == pytest.approx(odds / (1.0 + odds))


def test_errors_that_are_corrected_are_not_doubted() -> None:
    errors, after = np.array([0.1, 0.08, -0.05]), 1e-4 * np.eye(3)
    corrected = Adaptation(bearing_bias_rad=0.1, ranges=RangeErrors(0.08, -0.05))
    filters = (knowing(errors, after),) * FILTERS
    assert probability(with_probabilities(filters, AS_CONFIGURED, OWN, HERE)) == pytest.approx(1.0)
    assert probability(with_probabilities(filters, corrected, OWN, HERE)) == 0.0


def test_errors_that_the_covariance_contains_are_not_doubted() -> None:
    after = 1e-4 * np.eye(3)
    of_bearings = (knowing(np.array([0.1, 0.0, 0.0]), after),) * FILTERS
    known = knowing(np.zeros(3), after)
    rows = [list(row) for row in known.covariance]
    rows[6][6] = 1e-4
    errors = (*known.errors[:3], 0.2, 0.0)
    of_scales = (known._replace(errors=errors, covariance=tuple(map(tuple, rows))),) * FILTERS
    bearing_bias, scales = KindsOfError(False, True), KindsOfError(True, False)
    for filters, is_considered, other in (
        (of_bearings, bearing_bias, scales),
        (of_scales, scales, bearing_bias),
    ):
        found = with_probabilities(filters, AS_CONFIGURED, OWN, HERE, other)
        assert probability(found) > 0.9
        found = with_probabilities(filters, AS_CONFIGURED, OWN, HERE, is_considered)
        assert probability(found) == 0.0


def test_rounding_is_no_evidence() -> None:
    """Of errors that one reading ties together nothing is known but their sum."""
    together = 1e-4 * np.ones((3, 3)) - 1e-20 * np.eye(3)
    (found,) = with_probabilities((knowing(np.zeros(3), together),), AS_CONFIGURED, OWN, HERE)
    assert found.probability == 0.0


def test_the_covariance_is_that_of_the_mixture() -> None:
    """By samples of it."""
    rng, near, far = np.random.default_rng(0), 0.1 * np.eye(3), np.diag([0.2, 0.05, 0.1])
    poses = [Pose2(1.0, 2.0, 3.0), Pose2(1.5, 2.0, -3.1)]
    one, other = (knowing(np.zeros(3), far, pose)._replace(probability=0.2) for pose in poses)
    estimate = Estimate(Pose2(1.0, 2.5, 3.1), Covariance3(0.1, 0.0, 0.1, 0.0, 0.0, 0.1))
    n = 100_000
    at = [rng.multivariate_normal([0.0, 0.0, 0.0], near, 3 * n)]
    for pose in poses:
        x, y, heading = pose
        off = x - 1.0, y - 2.5, math.remainder(heading - 3.1, math.tau)
        at.append(rng.multivariate_normal(off, 0.01 * np.eye(3), n))
    moments = np.concatenate(at)
    wanted = moments.T @ moments / len(moments)
    xx, xy, yy, xh, yh, hh = with_mixture(estimate, HERE, (one, other)).covariance
    found = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    assert found == pytest.approx(wanted, abs=0.003)


def test_without_doubt_the_estimate_is_as_it_was() -> None:
    estimate = Estimate(HERE, diagonal(0.1, 0.1))
    assert with_mixture(estimate, HERE, ()) is estimate
    assert with_mixture(estimate, HERE, (started(),)) is estimate


@pytest.mark.parametrize("names", sampled(["abcde", "ac", "e"], ["ac"]))
def test_right_settings_are_hardly_doubted(names: str) -> None:
    means = []
    for seed in range(6):
        found = filters_over_time(Truth(), seed, Sensor(names=names), 240)
        means.append(np.mean([probability(filters) for filters in found]))
    assert np.mean(means) < 0.03
    assert max(means) < 0.15


@pytest.mark.parametrize(
    "truth",
    [
        Truth(bearing=math.radians(8.0)),
        Truth(share=0.1),
        thorough(Truth(share=-0.1)),
        thorough(Truth(offset_m=0.25)),
    ],
)
def test_wrong_settings_are_doubted_with_two_landmarks(truth: Truth) -> None:
    """With so few nothing is corrected; but the robot is no longer certain of its pose."""
    for seed in range(3):
        found = filters_over_time(truth, seed, TWO, 300)
        assert probability(found[-1]) > 0.9


@pytest.mark.parametrize("scale", sampled([0.9, 1.1], [0.9]))
def test_a_robot_with_wrong_ranges_reports_that_it_is_uncertain(scale: float) -> None:
    """With two landmarks it never corrects them, and its own covariance knows nothing of it."""
    sensor = SensorSettings(range_share=0.05, bearing_sigma_deg=2.0)
    robot, reported, alone = localizer(sensor=sensor), list[float](), list[float]()
    for seed in range(2):
        noisy = sensor_noise(np.random.default_rng(seed), sensor)

        def wrong(exact: Sighting, noisy: Noise = noisy) -> Sighting:
            seen = noisy(exact)
            assert seen.range_m is not None
            return Sighting(seen.id, scale * seen.range_m, seen.bearing_rad)

        state = state_at(LOOP_START, diagonal(0.05, 0.05))
        for now, truth in followed(
            robot, state, LOOP_START, 3 * loop(), names=lambda i: ("ne", "sw"), noise=wrong
        ):
            state = now
            if state.stamp_ns > 30 * SECOND and not state.lost:
                off = np.array(state.estimate.pose[:2]) - np.array(truth[:2])
                for estimate, squares in ((state.reported, reported), (state.estimate, alone)):
                    position = matrix2(estimate.covariance.position())
                    squares.append(off @ np.linalg.solve(position, off))
    assert state.memory.calibration.adaptation.ranges == NO_RANGE_ERRORS
    assert np.mean(reported) < 4.0
    assert np.mean(alone) > 10.0


def test_a_pose_that_a_filter_contradicts_is_as_likely_wrong_as_the_settings() -> None:
    (near, far), known = ((0.5, 1.5), knowing(np.zeros(3), np.diag(np.square(FIRST_SIGMAS[:3]))))
    for x, expected in ((near, 0.0), (far, 0.5)):
        own = Estimate(Pose2(x, 0.0, 0.0), diagonal(0.1, 0.1))
        (found,) = with_probabilities((known,), AS_CONFIGURED, own, HERE)
        assert found.probability == expected


def test_a_filter_that_only_follows_the_odometry_contradicts_nobody() -> None:
    known = knowing(np.zeros(3), np.diag(np.square(FIRST_SIGMAS[:3])))
    own = Estimate(Pose2(1.5, 0.0, 0.0), diagonal(0.1, 0.1))
    used = known._replace(stamp_ns=61 * SECOND, used_ns={"a": 2 * SECOND})
    for f, expected in ((used, 0.5), (used._replace(stamp_ns=63 * SECOND), 0.0)):
        (found,) = with_probabilities((f,), AS_CONFIGURED, own, HERE)
        assert found.probability == expected


def test_a_robot_that_teammates_help_is_not_doubted_for_its_wheels() -> None:
    """It sees no landmark, its wheels turn 0.8 of each turn, and fixes say where it is."""
    odometry = OdometrySettings(distance_scale_sigma=0.1, turn_scale_sigma=0.2)
    robot, rng = localizer(odometry=odometry), np.random.default_rng(1)
    state = state_at(LOOP_START, diagonal(0.05, 0.05))
    state, truth = robot.start(0)._replace(estimate=state.estimate), LOOP_START
    for i, (distance, turn) in enumerate(6 * loop()):
        now, truth = state.stamp_ns, step(truth, distance, 0.8 * turn)
        state = robot.add_odometry(state, Odometry(now, now + SECOND // 10, distance, turn))
        state = robot.predict(state, now + SECOND // 10)
        if i % 20 == 0:
            x, y = truth[:2] + 0.05 * rng.normal(size=2)
            state = robot.add_fix(state, fix(x, y, state.stamp_ns))
        stated, own = state.reported.position_sigma_m, state.estimate.position_sigma_m
        assert stated < 1.5 * own
    assert state.stamp_ns > 120 * SECOND
    assert math.dist(state.estimate.pose[:2], truth[:2]) < 0.2


def test_what_is_not_known_of_an_error_that_is_corrected_is_in_the_pose() -> None:
    frames = drives(Truth(share=0.1), 1, steps=60)
    known = started().after(frames, NOISE, 0.0)
    estimate, corrected = Estimate(HERE, diagonal(0.02, 0.02)), Adaptation(ranges=RangeErrors(0.1))
    rows = np.array(known.covariance)
    of_errors, with_pose = rows[3:6, 3:6], rows[:3, 3:6]
    added = known.scatter * with_pose @ np.linalg.inv(of_errors) @ with_pose.T
    found = with_remaining_errors(estimate, (known,) * FILTERS, corrected).covariance
    assert matrix3(found) == pytest.approx(matrix3(estimate.covariance) + added)
    assert np.trace(added[:2, :2]) > 1e-4
    for filters, settings in (((known,), AS_CONFIGURED), ((), corrected)):
        assert with_remaining_errors(estimate, filters, settings) is estimate
