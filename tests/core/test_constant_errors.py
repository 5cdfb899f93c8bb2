"""The constant errors of the motion model: the least-squares fit beside the filter."""

import math

import numpy as np
import pytest
from support.core import diagonal, matrix3

from cpcbl_team.config import OdometryNoise
from cpcbl_team.constant_errors import (
    INSENSITIVE,
    LARGEST,
    NO_ERRORS,
    NOTHING,
    PRIOR,
    Evidence,
    Whitened,
    matrix_of,
    matrix_product,
    pose_offset,
    sensitivity_after,
    whiten,
)
from cpcbl_team.estimate import ZERO3, Covariance3, Estimate, Row
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.miscalibration import BLOCK_NS, Corrected, ModelCheck, after_path, check_models
from cpcbl_team.motion import move

NOISE = OdometryNoise()
TAKEN = Covariance3(4e-4, 1e-4, 9e-4, -5e-5, 2e-4, 4e-4)
DUE = (0.1, 0.02, -0.03, 0.0, 0.2, 0.1, 0.05, -0.1, 0.3)


def symmetric(rng: np.random.Generator) -> Covariance3:
    root = rng.normal(size=(3, 3))
    m = root @ root.T
    return Covariance3(m[0, 0], m[0, 1], m[1, 1], m[0, 2], m[1, 2], m[2, 2])


def test_an_inverse_covariance_is_the_inverse() -> None:
    covariance = symmetric(np.random.default_rng(0))
    assert matrix3(covariance.inverse()) @ matrix3(covariance) == pytest.approx(np.eye(3), abs=1e-9)
    with pytest.raises(ZeroDivisionError):
        ZERO3.inverse()


def test_a_product_is_that_of_matrices() -> None:
    rng = np.random.default_rng(1)
    m, n = symmetric(rng), symmetric(rng)
    product = np.reshape(matrix_product(matrix_of(m), matrix_of(n)), (3, 3))
    assert product == pytest.approx(matrix3(m) @ matrix3(n))


@pytest.mark.parametrize("column", range(3))
def test_the_sensitivity_is_what_a_small_error_leads_to(column: int) -> None:
    """Two blocks of a robot that moves with one small error, against one that does not."""
    small, sensitivity = 1e-6, INSENSITIVE
    errors = [small if i == column else 0.0 for i in range(3)]
    true = believed = Pose2(1.0, 2.0, 0.3)
    for distance, turn in ((0.4, 0.5), (0.3, -0.2)):
        course = believed.heading + 0.5 * turn
        dx, dy = distance * math.cos(course), distance * math.sin(course)
        sensitivity = sensitivity_after(sensitivity, dx, dy, turn)
        moved = distance * (1.0 + errors[0]), turn * (1.0 + errors[1])
        # the heading that biased bearings give is smaller than the one in which the robot drives
        ahead = step(Pose2(true.x, true.y, true.heading + errors[2]), *moved)
        true = Pose2(ahead.x, ahead.y, ahead.heading - errors[2])
        believed = step(believed, distance, turn)
    offset = [a - b for a, b in zip(true, believed, strict=True)]
    assert np.array(sensitivity[column::3]) * small == pytest.approx(np.array(offset), rel=0.06)


def test_whitened_parts_are_independent() -> None:
    correction = (0.02, -0.01, 0.03)
    parts = whiten(correction, DUE, TAKEN, ZERO3)
    root = np.linalg.cholesky(matrix3(TAKEN))
    assert [p.value for p in parts] == pytest.approx(np.linalg.solve(root, correction))
    rows = np.linalg.solve(root, np.reshape(DUE, (3, 3)))
    assert np.array([p[1:] for p in parts]) == pytest.approx(rows)


def test_a_part_of_which_little_was_taken_tells_nothing() -> None:
    parts = whiten((0.02, -0.01, 0.03), DUE, TAKEN, Covariance3(1e-4, 0.0, 1.0, 0.0, 0.0, 1e-5))
    along, aside, heading = parts
    assert aside is NOTHING
    root = np.linalg.cholesky(matrix3(TAKEN)[np.ix_([0, 2], [0, 2])])
    assert (along.value, heading.value) == pytest.approx(np.linalg.solve(root, [0.02, 0.03]))
    assert whiten((1.0, 1.0, 1.0), DUE, TAKEN.scaled(-1.0), ZERO3) == (NOTHING,) * 3


def test_a_bump_counts_as_a_bump() -> None:
    along, _, _ = whiten((5.0, 0.0, 0.0), DUE, TAKEN, ZERO3)
    assert along.value == LARGEST


def evidence_of(errors: Row, blocks: int = 40, noise: float = 0.0) -> Evidence:
    rng, evidence = np.random.default_rng(2), Evidence()
    for _ in range(blocks):
        rows = rng.normal(size=(3, 3)) * 10.0
        values = rows @ errors + noise * rng.normal(size=3)
        first, second, third = (
            Whitened(float(v), *map(float, row)) for v, row in zip(values, rows, strict=True)
        )
        evidence = evidence.plus((first, second, third))
    return evidence


def test_the_fit_finds_what_explains_all() -> None:
    errors = 0.05, -0.02, 0.01
    fit = evidence_of(errors).fit()
    assert fit.errors == pytest.approx(errors, rel=0.02)  # the prior is at zero
    assert fit.scatter == pytest.approx(0.0, abs=1e-3)
    noisy = evidence_of(errors, noise=2.0).fit()
    assert noisy.scatter == pytest.approx(4.0, rel=0.3)
    assert noisy.sigmas == pytest.approx([math.sqrt(noisy.scatter) * s for s in fit.sigmas])


def test_evidence_without_errors_is_that_of_other_settings() -> None:
    errors, others = (0.05, -0.02, 0.01), (0.02, 0.01, 0.0)
    rest = tuple(a - b for a, b in zip(errors, others, strict=True))
    found, expected = evidence_of(errors).without(others), evidence_of((rest[0], rest[1], rest[2]))
    assert found.fit().errors == pytest.approx(expected.fit().errors, abs=1e-4)
    assert found.fit().scatter == pytest.approx(expected.fit().scatter, abs=1e-3)


def test_what_nothing_tells_of_keeps_the_prior() -> None:
    evidence = Evidence()
    for _ in range(3000):
        evidence = evidence.plus((Whitened(0.1, 1.0, 0.0, 0.0), NOTHING, NOTHING))
    assert evidence.information.yy == pytest.approx(PRIOR.yy)
    _, of_turn, of_bias = evidence.fit().sigmas
    assert (of_turn, of_bias) == pytest.approx((0.5, 0.5))
    assert evidence.parts == pytest.approx(40.0, rel=0.01)


def checked(errors: Row, blocks: int = 30) -> tuple[ModelCheck, Pose2, Pose2]:
    """The check of a robot on a bent way that moves and measures with these constant errors and
    has no other ones, its pose, and the one that its landmarks show."""
    distance_error, turn_error, bias = errors
    true, place = Pose2(1.0, 2.0, 0.3), Pose2(0.0, 0.0, 0.0)
    estimate = Estimate(Pose2(1.0, 2.0, 0.3 - bias), diagonal(0.02, 0.02))
    check, sensor = ModelCheck(), diagonal(0.03, 0.03).inverse()
    for k in range(blocks):
        check = check_models(check, Corrected(k * BLOCK_NS, estimate, place, 0), NOISE)
        distance, turn = 0.3 + 0.1 * (k % 3), 0.3 * (-1.0) ** (k // 4)
        true = step(true, distance * (1.0 + distance_error), turn * (1.0 + turn_error))
        place, predicted = step(place, distance, turn), move(estimate, distance, turn, NOISE)
        posterior = predicted.covariance.inverse().plus(sensor).inverse()
        x, y, heading = predicted.pose
        off = true.x - x, true.y - y, wrap_angle(true.heading - bias - heading)
        dx, dy, dh = posterior.times(sensor.times(off))
        estimate = Estimate(Pose2(x + dx, y + dy, heading + dh), posterior)
    last = Corrected(blocks * BLOCK_NS, estimate, place, 0)
    return check_models(check, last, NOISE), estimate.pose, true


@pytest.mark.parametrize("errors", [(0.03, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, 0.0, 0.03)])
def test_a_robot_without_noise_finds_each_of_its_errors(errors: Row) -> None:
    check, pose, true = checked(errors)
    assert check.evidence.fit().errors == pytest.approx(errors, abs=0.15 * max(errors))
    # and knows where they led it
    x, y, heading = pose_offset(check.sensitivity, errors)
    assert math.hypot(pose.x + x - true.x, pose.y + y - true.y) < 2e-3
    assert pose.heading + heading == pytest.approx(true.heading, abs=3e-3)


def test_a_robot_without_errors_finds_none() -> None:
    check, _, _ = checked(NO_ERRORS)
    assert check.evidence.fit().errors == pytest.approx(NO_ERRORS, abs=1e-9)
    assert check.evidence.parts > 30.0


def test_an_exact_pose_tells_nothing() -> None:
    start = Corrected(0, Estimate(Pose2(0.0, 0.0, 0.0), ZERO3), Pose2(0.0, 0.0, 0.0), 0)
    exact = OdometryNoise(
        distance_sigma_m_per_sqrt_m=0.0,
        turn_sigma_rad_per_sqrt_rad=0.0,
        turn_sigma_rad_per_sqrt_m=0.0,
    )
    check = check_models(ModelCheck(), start, exact)
    later = start._replace(stamp_ns=BLOCK_NS, odometry_from_robot=Pose2(1.0, 0.0, 0.0))
    assert check_models(check, later, exact).evidence == Evidence()


def test_a_block_knows_the_path_of_its_robot() -> None:
    """It turns on the spot and then drives: by one arc, turns would move it half as far."""
    pieces = [(0.0, 0.1)] * 10 + [(0.04, 0.0)] * 10
    exact = estimate = Estimate(Pose2(1.0, 2.0, 0.3), diagonal(0.01, 0.01))
    place = Pose2(0.0, 0.0, 0.0)
    begin = Corrected(0, estimate, place, 0)
    check = ModelCheck().from_pose(begin)
    for i, piece in enumerate(pieces, 1):
        exact, place = move(exact, *piece, NOISE), step(place, *piece)
        if i % 5 == 0 and i < len(pieces):
            check = check.with_place(i * BLOCK_NS // 20, place)
    by_steps, _ = after_path(begin, check, place, NOISE)
    by_one, _ = after_path(begin, check.from_pose(begin), place, NOISE)
    assert by_steps.pose == pytest.approx(exact.pose, abs=0.001)
    found = matrix3(by_steps.covariance)
    assert found == pytest.approx(matrix3(exact.covariance), rel=0.05, abs=1e-5)
    least = np.linalg.eigvalsh(matrix3(by_one.covariance))
    assert least[0] < 0.85 * np.linalg.eigvalsh(matrix3(exact.covariance))[0]
