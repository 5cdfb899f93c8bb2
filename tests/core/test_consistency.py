"""Whether the claimed uncertainty is the true one, where the noise is exactly the modelled one.

2-D: a Mahalanobis distance of at most 3 is due for 98.9 % of the samples (resolution h), and a mean
normalized error squared (NEES) of 2. Samples of one run depend on each other, so twenty runs leave
the mean uncertain by about 0.15; fourteen by 0.18.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
from support.core import (
    CORNERS,
    LOOP_START,
    PROBABILISTIC,
    SECOND,
    Matrix,
    covariance2,
    displaced,
    frame,
    localizer,
    loop,
    matrix3,
    point_sighting,
    sensor_noise,
    steered,
)
from support.sweeps import over_seeds, sampled, thorough

from cpcbl_launch.reporting.metrics import Samples, Score, score
from cpcbl_team.config import (
    CollaborationSettings,
    Field,
    Fusion,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
)
from cpcbl_team.estimate import Covariance3
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Fix, Odometry, Sighting, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.motion import motion_noise

ODOMETRY = OdometrySettings()
START = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.05, heading_sigma_deg=3.0)
PIECE_NS = SECOND // 10
FADE_S = 2.0

Perceive = Callable[[np.random.Generator], Callable[[Pose2, int], Sightings | Fix]]


def samples(robot: Localizer, perceive: Perceive, seed: int) -> tuple[Matrix, Matrix, Matrix]:
    """Two rounds: estimates, truths and covariances after each frame or fix."""
    rng = np.random.default_rng(seed)
    look = perceive(rng)
    state, planned, now = robot.start(0), LOOP_START, 0
    truth = displaced(state.estimate.pose, state.estimate.covariance, rng)
    rows: list[tuple[Pose2, Pose2, Covariance3]] = []
    for distance, turn in loop() * 2:
        planned = step(planned, distance, turn)
        turn = steered(truth, planned)
        noise = motion_noise(truth.heading, distance, turn, ODOMETRY)
        truth = displaced(step(truth, distance, turn), noise, rng)
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, distance, turn))
        now += PIECE_NS
        seen = look(truth, now)
        state = robot.add_fix(state, seen) if isinstance(seen, Fix) else robot.cycle(state, seen)
        rows.append((state.estimate.pose, truth, state.estimate.covariance))
    estimates, truths, covariances = zip(*rows, strict=True)
    return np.array(estimates), np.array(truths), np.array(covariances)


def scored(robot: Localizer, perceive: Perceive, seeds: range) -> Score:
    runs = [samples(robot, perceive, seed) for seed in seeds]
    estimate, truth, covariance = (np.concatenate(parts) for parts in zip(*runs, strict=True))
    return score(Samples(estimate, truth, covariance))


def landmarks(sensor: SensorSettings) -> Perceive:
    """The corners within the field of view, with the sensor's noise."""

    def perceive(rng: np.random.Generator) -> Callable[[Pose2, int], Sightings]:
        noise, half = sensor_noise(rng, sensor), math.radians(0.5 * sensor.field_of_view_deg)

        def look(truth: Pose2, now: int) -> Sightings:
            visible = [
                name
                for name, p in CORNERS.landmarks.items()
                if abs(point_sighting(truth, name, p.x_m, p.y_m).bearing_rad or 0.0) <= half
            ]
            return frame(truth, now, names=visible, noise=noise)

        return look

    return perceive


def an_observer(sensor_m: float, observer_m: float) -> Perceive:
    """A teammate whose own pose is off by one sigma, the same way in all fixes of a run."""
    own, its = sensor_m**2 * np.eye(2), observer_m**2 * np.eye(2)

    def perceive(rng: np.random.Generator) -> Callable[[Pose2, int], Fix]:
        direction = rng.uniform(-math.pi, math.pi)
        off = observer_m * np.array([math.cos(direction), math.sin(direction)])

        def look(truth: Pose2, now: int) -> Fix:
            x, y = off + sensor_m * rng.normal(size=2) + (truth.x, truth.y)
            return Fix("me", "mate", now, x, y, covariance2(own), covariance2(its))

        return look

    return perceive


@over_seeds(6, 14)
@pytest.mark.parametrize(
    "sensor",
    [
        SensorSettings(range_share=0.05, bearing_sigma_deg=5.0),
        SensorSettings(range_share=0.03, bearing_sigma_deg=2.0),
    ],
    ids=["5 % and 5 deg", "3 % and 2 deg"],
)
@pytest.mark.parametrize("variant", sampled(PROBABILISTIC, ["joint"]))
def test_landmarks_give_the_error_that_is_claimed(
    variant: Variant, sensor: SensorSettings, seeds: range
) -> None:
    robot = localizer(variant, start=START, sensor=sensor, odometry=ODOMETRY)
    found = scored(robot, landmarks(sensor), seeds)
    assert found.inside_3_sigma is not None
    assert found.nees is not None
    assert found.inside_3_sigma >= 0.98
    bounds = {"joint": (1.7, 2.3), "oval": (1.6, 2.6), "circular": (0.8, 2.2)}
    low, high = bounds[variant]  # the circle of the major axis is conservative
    assert low <= found.nees <= high


def of_a_standing_robot(correlation_s: float, seed: int) -> float:
    """NEES of the pose after 12 s at 5 Hz; sighting errors are Gauss-Markov, fading in 2 s."""
    sensor = SensorSettings(range_share=0.0, range_floor_m=0.05, correlation_s=correlation_s)
    prior = Start(x_m=0.5, y_m=-0.3, heading_deg=20.0, sigma_m=0.5, heading_sigma_deg=10.0)
    still = OdometrySettings(moves=False)
    robot = localizer(start=prior, sensor=sensor, odometry=still)
    rng, rho = np.random.default_rng(seed), math.exp(-0.2 / FADE_S)
    state, names = robot.start(0), list(CORNERS.landmarks)
    truth = displaced(state.estimate.pose, state.estimate.covariance, rng)
    errors = rng.normal(size=(len(names), 2))

    def noisy(exact: Sighting) -> Sighting:
        assert exact.range_m is not None
        assert exact.bearing_rad is not None
        a, b = errors[names.index(exact.id)] * (0.05, sensor.bearing_sigma_rad)
        return Sighting(exact.id, exact.range_m + a, wrap_angle(exact.bearing_rad + b))

    for i in range(60):
        state = robot.cycle(state, frame(truth, (i + 1) * SECOND // 5, noise=noisy))
        errors = rho * errors + math.sqrt(1.0 - rho * rho) * rng.normal(size=errors.shape)
    x, y, heading = state.estimate.pose
    e = np.array([x - truth.x, y - truth.y, wrap_angle(heading - truth.heading)])
    return float(e @ np.linalg.solve(matrix3(state.estimate.covariance), e))


@pytest.mark.parametrize("seeds", [25, thorough(100)])
def test_correlated_errors_are_claimed_as_such_where_their_time_is_known(seeds: int) -> None:
    """Three degrees of freedom: 95 % of the means over a hundred seeds lie within 3 +- 0.48."""
    known = [of_a_standing_robot(FADE_S, seed) for seed in range(seeds)]
    assert np.mean(known) == pytest.approx(3.0, abs=4.8 / math.sqrt(seeds))
    assert np.mean([of_a_standing_robot(0.0, s) for s in range(10)]) > 15.0


@over_seeds(3, 6)
@pytest.mark.parametrize(("fusion", "honest"), [("split-ci", True), ("naive", False)])
@pytest.mark.parametrize("variant", sampled(PROBABILISTIC, ["joint"]))
def test_an_observer_that_is_off_is_not_believed_more_for_repeating_itself(
    variant: Variant, fusion: Fusion, honest: bool, seeds: range
) -> None:
    """Resolution c; only fixes, no landmarks."""
    robot = localizer(
        variant,
        Field(),
        start=START,
        odometry=ODOMETRY,
        collaboration=CollaborationSettings(fusion=fusion),
    )
    found = scored(robot, an_observer(sensor_m=0.05, observer_m=0.1), seeds)
    assert found.inside_3_sigma is not None
    assert (found.inside_3_sigma >= 0.98) is honest
