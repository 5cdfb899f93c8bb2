"""A standing robot that is not where it believes to stand, though it accepts what it measures."""

import math

import numpy as np
import pytest
from support.core import (
    PROBABILISTIC,
    SECOND,
    covariance3,
    diagonal,
    displaced,
    frame,
    matrix3,
    placed_at,
    random_matrix,
    sensor_noise,
)
from support.standing import ORIGIN, standing
from support.sweeps import sampled

from cpcbl_team.config import Field, Landmark, SensorSettings, Variant
from cpcbl_team.estimate import Covariance3, Estimate, Information, Sums
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State
from cpcbl_team.stationary_pose import (
    TEST_NS,
    Push,
    StationaryRecord,
    is_stationary,
    observed,
    started,
)

POOR = SensorSettings(range_share=0.05, bearing_sigma_deg=3.0)
PUSHED = Pose2(0.25, 0.2, 0.0)
PERIOD_NS = SECOND // 5


def stood(
    robot: Localizer, seed: int, *, push: Pose2 = ORIGIN, from_s: int = 10, until_s: int = 30
) -> State:
    """The state after standing at the origin, and since `from_s` where somebody pushed it."""
    rng = np.random.default_rng(seed)
    noise, start = sensor_noise(rng, robot.settings.sensor), diagonal(0.02, 0.01)
    drawn = displaced(ORIGIN, start, rng)
    state = robot.start(0)._replace(estimate=Estimate(drawn, start))
    for stamp_ns in range(PERIOD_NS, until_s * SECOND, PERIOD_NS):
        truth = push if stamp_ns > from_s * SECOND else ORIGIN
        seen = frame(truth, stamp_ns, robot.field)
        given = tuple(_as_given(robot.field, noise(exact)) for exact in seen.sightings)
        state = robot.cycle(state, seen.__class__(stamp_ns, given))
    return state


def _as_given(field: Field, seen: Sighting) -> Sighting:
    is_range = field.landmarks[seen.id].gives == "range"
    return Sighting(seen.id, seen.range_m, None if is_range else seen.bearing_rad)


def nees(state: State, truth: Pose2) -> float:
    (x, y, _), covariance, _ = state.estimate
    return covariance.position().mahalanobis_squared(x - truth.x, y - truth.y)


@pytest.mark.parametrize("variant", sampled(PROBABILISTIC, ["oval"]))
def test_a_robot_that_is_pushed_by_less_than_its_gates_finds_out(variant: Variant) -> None:
    robot = standing(variant, sensor=POOR)
    states = [stood(robot, seed, push=PUSHED) for seed in range(12)]
    assert all(state.counts["pushed"] == 1 for state in states)
    assert not any(state.lost for state in states)
    assert np.mean([nees(state, PUSHED) for state in states]) < 4.0  # 2 is due; else over 100
    assert max(nees(state, PUSHED) for state in states) < 20.0


@pytest.mark.parametrize("variant", sampled(PROBABILISTIC, ["joint"]))
def test_a_robot_that_stands_where_it_believes_doubts_nothing(variant: Variant) -> None:
    robot = standing(variant, sensor=POOR)
    states = [stood(robot, seed, until_s=40) for seed in range(12)]
    assert not any("pushed" in state.counts for state in states)
    assert np.mean([nees(state, ORIGIN) for state in states]) < 3.0


def test_a_robot_that_rejects_half_of_its_landmarks_looks_for_its_pose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It goes on accepting the other half, so it does not become lost by that. Those may agree with
    a wrong pose, so that their mean tells nothing."""
    monkeypatch.setattr("cpcbl_team.stationary_pose.CONTRADICTION", math.inf)
    places = {"m0": (5.0, -4.0), "m1": (-1.0, 4.0), "m2": (5.0, 4.0), "m3": (-1.0, -4.0)}
    marks = {n: Landmark(x_m=x, y_m=y, gives="bearing") for n, (x, y) in places.items()}
    robot = standing("joint", Field(landmarks=marks), sensor=SensorSettings(bearing_sigma_deg=0.5))
    push = Pose2(0.0, 0.3, 0.0)
    for seed in range(6):
        state = stood(robot, seed, push=push, until_s=20)
        assert not state.lost
        assert nees(state, push) < 14.0


def test_a_robot_that_began_beside_its_start_finds_out() -> None:
    robot = standing("joint", sensor=POOR)
    states = [stood(robot, seed, push=PUSHED, from_s=0, until_s=25) for seed in range(10)]
    assert all("pushed" in state.counts for state in states)
    assert np.mean([nees(state, PUSHED) for state in states]) < 4.0


def test_a_robot_that_was_pushed_far_is_found_and_says_so() -> None:
    """Each range and bearing is within the gate of this poor sensor."""
    worse = SensorSettings(range_share=0.2, bearing_sigma_deg=15.0)
    for seed in range(5):
        state = stood(standing("joint", sensor=worse), seed, push=Pose2(0.7, -0.3, 0.1))
        assert not state.lost
        assert state.memory.recovery.kidnapped_ns == -1
        assert state.memory.recovery.jump is not None
        assert nees(state, Pose2(0.7, -0.3, 0.1)) < 14.0


def test_ranges_to_one_landmark_do_not_tell_where_it_was_pushed() -> None:
    field = Field(landmarks={"ne": Landmark(x_m=4.5, y_m=2.5, gives="range")})
    robot = standing("joint", field, sensor=POOR)
    for seed in range(5):
        assert "only ne agrees" in stood(robot, seed, push=Pose2(0.35, 0.2, 0.0)).lost


def test_a_position_sensor_tells_of_a_push_too() -> None:
    robot = standing("joint", Field())
    for seed in range(5):
        rng, state = np.random.default_rng(seed), robot.start(0)
        counts = []
        for i in range(1, 300):
            x, y = (0.25, 0.2) if i > 100 else (0.0, 0.0)
            x, y = x + 0.3 * rng.normal(), y + 0.3 * rng.normal()
            state = robot.add_position(state, placed_at(x, y, i * PERIOD_NS, 0.3))
            counts.append(state.counts.get("pushed", 0))
        assert counts[100] == 0
        assert counts[-1] == 1
        assert nees(state, PUSHED) < 14.0


def test_the_check_is_off_where_a_mean_is_not_due_to_be_right() -> None:
    printed = standing("oval", paper_uncertainty=True, sensor=POOR)
    for robot in (printed, standing("weighted", sensor=POOR)):
        state = stood(robot, 1, push=PUSHED)
        assert "pushed" not in state.counts
        assert state.memory.calibration.stationary is None


# The mean and its covariance ----------------------------------------------------------------------


def evidence_of(rng: np.random.Generator, error: np.ndarray, matrix: Covariance3) -> Sums:
    """Evidence with this matrix about an offset that is `error` in truth."""
    m = matrix3(matrix)
    x, y, h = m @ error + np.linalg.cholesky(m + 1e-9 * np.eye(3)) @ rng.normal(size=3)
    return Information(matrix, (float(x), float(y), float(h)))


def observe(
    rng: np.random.Generator, prior: Covariance3, push: tuple[float, float, float], seconds: int
) -> tuple[Push | None, StationaryRecord]:
    """What is found when frames of any three readings come since a push."""
    error = np.array(displaced(ORIGIN, prior, rng)) + np.array(push)
    record, found = started(0, Estimate(ORIGIN, prior), ORIGIN), None
    for i in range(1, 10 * seconds + 1):
        matrix = covariance3(200.0 * random_matrix(rng, 3))
        frame_evidence = evidence_of(rng, error, matrix)
        record, push_ = observed(record, i * SECOND // 10, Estimate(ORIGIN, prior), frame_evidence)
        found = found or push_
    return found, record


def test_evidence_that_is_right_contradicts_nothing() -> None:
    rng = np.random.default_rng(5)
    for _ in range(100):
        prior = covariance3(0.01 * random_matrix(rng, 3))
        assert observe(rng, prior, (0.0, 0.0, 0.0), 5)[0] is None


def test_a_push_is_found_with_its_size_and_its_time() -> None:
    rng = np.random.default_rng(6)
    for _ in range(20):
        found, _ = observe(rng, diagonal(0.02, 0.01), (0.3, -0.4, 0.2), 3)
        assert found is not None
        assert found.distance_m == pytest.approx(0.5, abs=0.2)
        assert found.turn_rad == pytest.approx(0.2, abs=0.15)
        assert found.stamp_ns == 0
        assert not found.is_of_one_range
        assert found.estimate.position_sigma_m > 0.5


def test_evidence_that_says_nothing_of_a_direction_is_no_contradiction_there() -> None:
    prior = Covariance3(25.0, 24.99, 25.0, 0.0, 0.0, 1e-4)  # long, across what is measured
    sharp = Covariance3(1e6, 0.0, 0.0, 0.0, 0.0, 0.0)
    record = started(0, Estimate(ORIGIN, prior), ORIGIN)
    evidence = Information(sharp, (1e6 * 5.0, 0.0, 0.0))  # one sigma
    record, found = observed(record, TEST_NS, Estimate(ORIGIN, prior), evidence)
    assert found is None
    certain = Estimate(ORIGIN, diagonal(0.1, 0.01))
    _, found = observed(started(0, certain, ORIGIN), TEST_NS, certain, evidence)
    assert found is not None


@pytest.mark.parametrize("row", [(1.0, 0.0, 0.0), (0.6, -0.8, 0.0), (0.3, 0.2, 1.0)])
def test_exact_sensors_do_not_drown_it_in_rounding(row: tuple[float, float, float]) -> None:
    estimate = Estimate(ORIGIN, diagonal(0.02, 0.01))
    record, exact = started(0, estimate, ORIGIN), Information.none()
    for _ in range(100):
        exact = exact.add(row, 1e-5, 1e-8)
    numbers = []
    for second in range(1, 500):
        record, found = observed(record, second * SECOND, estimate, exact)
        assert found is None
        numbers.append(record.checkpoints[-1].number)
    assert max(numbers) > numbers[-1]  # it began anew


def test_what_is_kept_of_a_long_time_is_little() -> None:
    estimate = Estimate(ORIGIN, diagonal(0.1, 0.1))
    record, nothing = started(0, estimate, ORIGIN), Information.none()
    for second in range(1, 601):
        record, found = observed(record, second * SECOND, estimate, nothing)
        assert found is None
    ages = [600 - c.number for c in record.checkpoints]
    assert len(ages) < 25
    assert ages[0] == 600  # the first is kept
    assert ages[-2:] == [1, 0]


@pytest.mark.parametrize(
    ("place", "sigma_m", "still"),
    [
        (Pose2(0.004, 0.0, 0.004), 0.1, True),
        (Pose2(0.006, 0.0, 0.0), 0.1, False),
        (Pose2(0.0, -0.006, 0.0), 0.1, False),
        (Pose2(0.0, 0.0, 0.006), 0.1, False),
        (ORIGIN, 0.11, False),  # something else made it doubt
        (ORIGIN, 0.09, True),
    ],
)
def test_it_stands_as_long_as_neither_odometry_nor_doubt_says_otherwise(
    place: Pose2, sigma_m: float, still: bool
) -> None:
    record = started(0, Estimate(ORIGIN, diagonal(0.1, 0.1)), ORIGIN)
    assert is_stationary(record, Estimate(ORIGIN, diagonal(sigma_m, 0.1)), place) is still
