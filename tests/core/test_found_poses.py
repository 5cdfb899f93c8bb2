"""Poses that a lost robot finds, and a robot that was carried away: over many seeds, they err as
far as they claim, or the robot says that it is lost."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import pytest
from support.core import SECOND, frame, localizer, matrix3, sensor_noise, state_at
from support.core import diagonal as diagonal_of
from support.evidence import piece
from support.sweeps import over_seeds, thorough

from cpcbl_team.config import Field, Gives, Landmark, OdometrySettings, SensorSettings, Variant
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry
from cpcbl_team.lost_reasons import with_innovations
from cpcbl_team.recovery_evidence import MOST_PIECES, SPACING_NS
from cpcbl_team.relocalization import relocalize
from cpcbl_team.state import Evidence, Memory, RecoveryMemory, State, Updates

NOISE = OdometrySettings()
SENSOR = SensorSettings(range_share=0.05, bearing_sigma_deg=3.0)
POSE_BOUND = 16.27  # of 99.9 %, with three degrees of freedom
DIAGONAL = ((0.0, 0.0), (8.0, 6.0))
ONE_SIDE = ((0.0, 0.0), (8.0, 0.0))
CORNERS = (*DIAGONAL, (8.0, 0.0), (0.0, 6.0))


def giving(gives: Gives, places: Sequence[tuple[float, float]]) -> Field:
    """Landmarks of this kind at these places."""
    return Field(
        landmarks={f"m{i}": Landmark(x_m=x, y_m=y, gives=gives) for i, (x, y) in enumerate(places)}
    )


def pose_nees(estimate: Estimate, truth: Pose2) -> float:
    """The squared Mahalanobis distance of the whole pose."""
    turn = wrap_angle(estimate.pose.heading - truth.heading)
    error = np.array([estimate.pose.x - truth.x, estimate.pose.y - truth.y, turn])
    return float(error @ np.linalg.solve(matrix3(estimate.covariance), error))


def noisy_step(pose: Pose2, distance: float, turn: float, rng: np.random.Generator) -> Pose2:
    """Where a robot comes to whose odometry reports this."""
    per_m, per_rad = NOISE.turn_sigma_rad_per_sqrt_m, NOISE.turn_sigma_rad_per_sqrt_rad
    around = math.sqrt(per_m**2 * distance + per_rad**2 * abs(turn))
    along = NOISE.distance_sigma_m_per_sqrt_m * math.sqrt(distance)
    return step(pose, distance + along * rng.normal(), turn + around * rng.normal())


def found_nees(seed: int, gives: Gives, places: Sequence[tuple[float, float]]) -> list[float]:
    """Of the first pose that is found on a circle of noisy dead reckoning, if one is."""
    rng, field = np.random.default_rng(seed), giving(gives, places)
    true = Pose2(rng.uniform(2.0, 6.0), rng.uniform(1.5, 4.5), rng.uniform(-3.0, 3.0))
    reckoned, pieces = Pose2(0.0, 0.0, 0.0), []
    for i in range(20):
        for name, mark in field.landmarks.items():
            exact = piece(i * SPACING_NS, true, name, mark.x_m, mark.y_m)
            assert exact.range_m is not None
            assert exact.bearing_rad is not None
            sigma_m, sigma_rad = SENSOR.range_share * exact.range_m, SENSOR.bearing_sigma_rad
            range_m = exact.range_m + sigma_m * rng.normal()
            bearing = exact.bearing_rad + sigma_rad * rng.normal()
            noisy = exact._replace(
                odometry_from_robot=reckoned,
                range_m=range_m if gives != "bearing" else None,
                bearing_rad=bearing if gives != "range" else None,
                range_sigma_m=sigma_m,
                bearing_sigma_rad=sigma_rad,
            )
            pieces.append(noisy)
        found = None
        if i % 4 == 3:
            found = relocalize(tuple(pieces[-MOST_PIECES:]), reckoned, field, NOISE)
        if found is not None:
            return [pose_nees(found, true)]
        reckoned, true = step(reckoned, 0.25, 0.17), noisy_step(true, 0.25, 0.17, rng)
    return []


@over_seeds(6, 20)
@pytest.mark.parametrize(
    ("gives", "places", "least"),
    [
        pytest.param("bearing", DIAGONAL, 5, id="two bearings, on a diagonal"),
        pytest.param("bearing", ONE_SIDE, 1, id="two bearings, on one side"),
        pytest.param("bearing", CORNERS[:3], 20, id="three bearings"),
        pytest.param("range", DIAGONAL, 15, id="two ranges, on a diagonal"),
        pytest.param("range", ONE_SIDE, 15, id="two ranges, on one side"),
        pytest.param("range", CORNERS, 20, id="four ranges"),
        pytest.param("both", ONE_SIDE, 20, id="two landmarks"),
    ],
)
def test_a_pose_is_found_only_where_the_evidence_determines_it(
    gives: Gives, places: tuple[tuple[float, float], ...], least: int, seeds: range
) -> None:
    """`least`: found in so many of twenty runs."""
    nees = [n for seed in seeds for n in found_nees(seed, gives, places)]
    assert len(nees) >= least * len(seeds) // 20
    assert sum(n > POSE_BOUND for n in nees) == 0
    assert np.mean(nees) < 6.0  # 3 is due


# Carried away -------------------------------------------------------------------------------------


@lru_cache
def carried_away(
    seed: int, gives: Gives, count: int, variant: Variant = "joint", seconds: int = 16
) -> tuple[State, Pose2, list[float]]:
    """Carried off from where it knew its pose well; then it drives a circle and sees landmarks. The
    state and the true pose at the end, and the NEES of each pose when it was no longer lost."""
    rng, field = np.random.default_rng(seed), giving(gives, CORNERS[:count])
    robot = localizer(variant, field, sensor=SENSOR, odometry=NOISE)
    noise = sensor_noise(rng, SENSOR)
    state = state_at(Pose2(2.0, 1.5, 0.0), diagonal_of(0.08, 0.03))
    true, now = Pose2(rng.uniform(4.5, 6.0), rng.uniform(3.0, 4.5), rng.uniform(2.0, 4.5)), 0
    found = []
    for _ in range(seconds * 5):
        true = noisy_step(true, 0.1, 0.07, rng)
        state = robot.add_odometry(state, Odometry(now, now + SECOND // 5, 0.1, 0.07))
        now, was_lost = now + SECOND // 5, state.lost
        state = robot.cycle(state, frame(true, now, field=field, noise=noise))
        if was_lost and not state.lost:
            found.append(pose_nees(state.estimate, true))
    return state, true, found


LONG = [
    pytest.param(gives, count, variant, marks=pytest.mark.long)
    for gives, count in (("bearing", 2), ("bearing", 3), ("both", 2))
    for variant in ("oval", "circular")
]


@over_seeds(2, 8)
@pytest.mark.parametrize(
    ("gives", "count", "variant"),
    [
        ("bearing", 2, "joint"),
        ("range", 1, "joint"),
        ("range", 2, "joint"),
        thorough("range", 2, "oval"),
        thorough("range", 2, "circular"),
        ("range", 4, "joint"),
        ("bearing", 3, "joint"),
        ("both", 1, "joint"),
        thorough("both", 1, "oval"),
        thorough("both", 1, "circular"),
        ("both", 2, "joint"),
        *LONG,
    ],
)
def test_a_robot_that_was_carried_away_is_found_or_lost(
    gives: Gives, count: int, variant: Variant, seeds: range
) -> None:
    """Two readings a frame open its gates somewhere, but say nothing of where it is. And what they
    accept while the window of rejections passes may be ranges that fit a wrong heading."""
    wrong, found_wrong = 0, 0
    for seed in seeds:
        state, true, found = carried_away(seed, gives, count, variant)
        wrong += not state.lost and pose_nees(state.estimate, true) > POSE_BOUND
        found_wrong += sum(nees > POSE_BOUND for nees in found)
    assert (wrong, found_wrong) == (0, 0)


def test_ranges_that_its_gates_accept_do_not_confirm_a_heading() -> None:
    """All ranges agree with its position again, before it has inflated its covariance."""
    _, _, found = carried_away(53, "range", 4)
    assert [nees > POSE_BOUND for nees in found] == [False]


@pytest.mark.parametrize(
    ("count", "rejected", "is_lost"), [(1, 3, True), (1, 2, False), (2, 8, False), (2, 9, True)]
)
def test_a_robot_that_measures_ranges_to_two_landmarks_at_most_is_lost_if_it_doubts_its_pose(
    count: int, rejected: int, is_lost: bool
) -> None:
    """Nothing that it measures can dispel the doubt. With two, a wrong sigma is noticed first."""
    here, pieces = Pose2(2.0, 1.5, 0.0), []
    for i in range(1, 9):
        exact = piece(i * SPACING_NS, here, f"m{i % count}", *CORNERS[i % count])
        pieces.append(exact._replace(bearing_rad=None, odometry_from_robot=here))
    memory = Memory(RecoveryMemory(evidence=tuple(pieces), suspected_ns=0))
    doubtful = Updates(innovations=with_innovations(1, 20 - rejected, rejected, 20))
    state = state_at(here, diagonal_of(0.05, 0.05), pieces[-1].stamp_ns)
    robot = localizer(field=giving("range", CORNERS[:count]))
    after = robot.recovery.check(state._replace(memory=memory, updates=doubtful))
    assert bool(after.lost) is is_lost


def test_a_robot_with_two_readings_a_frame_says_why_it_stays_lost() -> None:
    reasons = (carried_away(seed, "bearing", 2, "joint")[0].lost for seed in (3, 2, 1, 0))
    assert any("agree: two readings do not determine a pose" in reason for reason in reasons)


@pytest.mark.parametrize("from_teammate", [False, True])
def test_only_its_own_evidence_moves_a_robot_that_is_not_lost(from_teammate: bool) -> None:
    """Else a liar whose reports it rejects could carry it away."""
    robot, elsewhere, pieces = localizer(field=Field()), Pose2(5.0, 5.0, 0.0), []
    for i in range(1, 9):
        here = Pose2(0.3 * i, 0.05 * i * i, 0.3 * i)
        there = elsewhere @ here
        sigmas = 0.05, 0.0, 0.0
        fix = Evidence((i + 16) * SPACING_NS, here, "mate", there.x, there.y, None, None, *sigmas)
        pieces.append(fix._replace(from_teammate=from_teammate))
    now = pieces[-1].stamp_ns
    memory = Memory(RecoveryMemory(evidence=tuple(pieces), suspected_ns=0))
    state = state_at(pieces[-1].odometry_from_robot, diagonal_of(0.05, 0.05), now)
    suspicious = Updates(innovations=with_innovations(1, 16, 2, 20))
    state = state._replace(memory=memory, updates=suspicious)
    state = state._replace(odometry_from_robot=pieces[-1].odometry_from_robot)
    after = robot.recovery.check(state)
    assert ("found_again" in after.counts) is not from_teammate


# Ranges alone -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gives", "is_corrected"), [("range", True), ("both", False)])
def test_ranges_correct_the_heading_of_oval_where_nothing_else_does(
    gives: Gives, is_corrected: bool
) -> None:
    """After a drive a wrong place says that the heading was wrong too."""
    field = giving("range", CORNERS)
    field.landmarks["last"] = Landmark(x_m=4.0, y_m=9.0, gives=gives)
    robot, begin = localizer("oval", field, sensor=SENSOR), Pose2(3.0, 3.0, 0.0)
    state = state_at(begin, diagonal_of(0.05, 0.3))
    state = robot.add_odometry(state, Odometry(0, SECOND, 1.0, 0.0))
    true = step(Pose2(3.0, 3.0, 0.3), 1.0, 0.0)
    names = [name for name in field.landmarks if name != "last"]
    state = robot.cycle(state, frame(true, SECOND, field=field, names=names))
    assert (state.estimate.pose.heading > 0.1) is is_corrected
