"""Numbers worked out in another way, for terms that hardly show in a whole run."""

import math

import numpy as np
import pytest
from support.core import (
    CORNERS,
    LOOP_START,
    SECOND,
    covariance2,
    covariance3,
    diagonal,
    fix,
    frame,
    localizer,
    matrix2,
    matrix3,
    position_error,
    random_matrix,
    state_at,
)
from support.evidence import piece

from cpcbl_team.config import LocalizerSettings, OdometrySettings, SensorSettings
from cpcbl_team.constraints import Constraint, bearing_heading, range_circle
from cpcbl_team.estimate import (
    HEADING,
    POSE,
    POSITION,
    SHARPEST_VARIANCE,
    SMALLEST_VARIANCE,
    Estimate,
    Scope,
)
from cpcbl_team.fusion import Observation, _merge_with_weight, chi_square_bound, chi_square_bounds
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry
from cpcbl_team.measurements import Measurement, observation_of
from cpcbl_team.motion import bridge, inflate_by_gap
from cpcbl_team.places import ObjectPosition
from cpcbl_team.relocalization import PropagatedEvidence, relocalize
from cpcbl_team.state import Evidence

ORIGIN = Pose2(0.0, 0.0, 0.0)

# Split covariance intersection --------------------------------------------------------------------


def split_example(rows: int) -> tuple[Estimate, Observation]:
    rng = np.random.default_rng(3)
    own, shared = random_matrix(rng, 3), random_matrix(rng, 3)
    prior = Estimate(ORIGIN, covariance3(own + shared), covariance3(shared))
    sensor, place = random_matrix(rng, 2), random_matrix(rng, 2)
    if rows == 1:
        sensor, place = (np.diag([m[0, 0], 0.0]) for m in (sensor, place))
    row = tuple(tuple(r) for r in rng.normal(size=(rows, 3)).tolist())
    residuals = tuple(rng.normal(size=rows).tolist())
    return prior, Observation(row, residuals, covariance2(sensor), covariance2(place))


@pytest.mark.parametrize("rows", [1, 2])
def test_the_parts_of_a_split_merge_are_those_of_the_matrices(rows: int) -> None:
    """P' = (I - K H) P1; its own part has the sensor's noise R_i only, not all of R."""
    weight, (prior, seen) = 0.4, split_example(rows)
    merged = _merge_with_weight(prior, seen, POSE, weight)
    h, shared = np.array(seen.rows), matrix3(prior.shared)
    own = matrix3(prior.covariance) - shared
    sensor = matrix2(seen.independent)[:rows, :rows] + SMALLEST_VARIANCE * np.eye(rows)
    place = matrix2(seen.dependent)[:rows, :rows]
    p, r = shared / weight + own, place / (1.0 - weight) + sensor
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
    left = np.eye(3) - gain @ h
    np.testing.assert_allclose(matrix3(merged.covariance), left @ p, atol=1e-9)
    expected_own = left @ own @ left.T + gain @ sensor @ gain.T
    found_own = matrix3(merged.covariance) - matrix3(merged.shared)
    np.testing.assert_allclose(found_own, expected_own, atol=1e-6)


@pytest.mark.parametrize("scope", [POSITION, HEADING])
def test_what_is_out_of_scope_is_not_inflated_and_neither_is_its_covariance(scope: Scope) -> None:
    """With weight w the rest of the covariance is that of P1 = P / w, times w."""
    rng, weight = np.random.default_rng(4), 0.3
    p = random_matrix(rng, 3)
    prior = Estimate(ORIGIN, covariance3(p), covariance3(p))
    is_heading = scope is HEADING
    h = np.array([[0.0, 0.0, 1.0]]) if is_heading else np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rows = tuple(tuple(row) for row in h.tolist())
    noise = covariance2(np.diag([0.2, 0.0 if is_heading else 0.3]))
    seen = Observation(rows, (0.1,) * len(rows), noise, covariance2(np.zeros((2, 2))))
    merged = matrix3(_merge_with_weight(prior, seen, scope, weight).covariance)
    r = matrix2(noise)[: len(rows), : len(rows)]
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + weight * r)
    whole = (np.eye(3) - gain @ h) @ p  # of P / w, times w
    np.testing.assert_allclose(merged[:2, 2], whole[:2, 2], atol=1e-9)
    kept = (slice(2, 3),) * 2 if scope is POSITION else (slice(0, 2),) * 2
    np.testing.assert_allclose(merged[kept], p[kept], atol=1e-9)


# A teammate as a landmark -------------------------------------------------------------------------


def teammate_example() -> tuple[Estimate, Measurement, list[Constraint]]:
    place = covariance2(1e-2 * np.array([[0.04, 0.03], [0.03, 0.09]]))
    x, y, range_m, bearing = 2.0, 1.0, 2.3, 0.5
    m = Measurement("mate", ObjectPosition(x, y, place), None, True, range_m, bearing, 0.1, 0.05)
    both = (
        range_circle(ORIGIN, x, y, range_m, 0.1),
        bearing_heading(ORIGIN, x, y, bearing, 0.05),
    )
    constraints = [c for c in both if c is not None]
    assert len(constraints) == 2
    return Estimate(ORIGIN, diagonal(1e-3, 1e-3)), m, constraints


def test_a_teammates_place_correlates_its_range_and_its_bearing() -> None:
    """The dependent part is J S J^T; J is how the residuals follow the teammate's place."""
    prior, m, constraints = teammate_example()
    x, y, place = m.position
    step, columns = 1e-6, []
    assert m.range_m is not None
    assert m.bearing is not None
    for dx, dy in ((step, 0.0), (0.0, step)):
        moved = (
            range_circle(ORIGIN, x + dx, y + dy, m.range_m, 0.1),
            bearing_heading(ORIGIN, x + dx, y + dy, m.bearing, 0.05),
        )
        pairs = zip(moved, constraints, strict=True)
        columns.append([(a.residual - b.residual) / step for a, b in pairs if a is not None])
    jacobian = np.array(columns).T
    expected = jacobian @ matrix2(place) @ jacobian.T
    found = matrix2(observation_of(prior, m, constraints).dependent)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert abs(found[0, 1]) > 0.1 * math.sqrt(found[0, 0] * found[1, 1])


def test_a_second_teammate_is_seen_from_where_the_first_has_moved_the_robot() -> None:
    prior, m, constraints = teammate_example()
    found = observation_of(prior, m, constraints).shifted(0.1, -0.2, 0.05).residuals
    expected = [c.residual - float(np.dot(c.row, (0.1, -0.2, 0.05))) for c in constraints]
    assert found == pytest.approx(expected)


# Finding oneself ----------------------------------------------------------------------------------


def test_a_teammates_place_widens_what_was_measured_of_it() -> None:
    seen = piece(0, ORIGIN, "mate", 3.0, 4.0)._replace(teammate_sigma_m=0.2, from_teammate=True)
    of_range, of_bearing = PropagatedEvidence(seen, ORIGIN, 4).rows_without_drift(ORIGIN)
    place = 4.0 * 0.2**2  # four pieces may have the same error
    assert of_range[2] == pytest.approx(0.1**2 + place, rel=1e-6)
    assert of_bearing[2] == pytest.approx(0.03**2 + place / 5.0**2, rel=1e-6)


def test_while_a_pose_is_looked_for_dead_reckoning_errs_by_a_tenth_of_the_way() -> None:
    seen = piece(0, ORIGIN, "ne", 3.0, 4.0)
    assert PropagatedEvidence(seen, Pose2(2.0, 0.0, 0.0), 1).sigma_m == pytest.approx(0.2)
    turned = PropagatedEvidence(seen, Pose2(0.0, 0.0, 1.0), 1)
    assert turned.sigma_m == pytest.approx(0.03)


def evidence_with_errors(sigmas: float) -> tuple[Evidence, ...]:
    """Five looks at the corners from one place; ranges alternate by so many sigmas."""
    return tuple(
        seen._replace(range_m=(seen.range_m or 0.0) + sigmas * (-1.0) ** i * seen.range_sigma_m)
        for i, name in enumerate(["ne", "nw", "sw", "se"] * 2)
        for mark in [CORNERS.landmarks[name]]
        for seen in [piece(i, LOOP_START, name, mark.x_m, mark.y_m)]
    )


def test_evidence_that_scatters_more_than_it_claims_gives_a_wider_pose() -> None:
    noise = OdometrySettings()
    exact = relocalize(evidence_with_errors(0.0), LOOP_START, CORNERS, noise)
    scattered = relocalize(evidence_with_errors(1.8), LOOP_START, CORNERS, noise)
    assert exact is not None
    assert scattered is not None
    assert position_error(scattered, LOOP_START) < 0.3
    freedom = 8 * 2 - 3
    ratio = scattered.covariance.xx / exact.covariance.xx
    assert ratio == pytest.approx(8 * 1.8**2 / freedom, rel=0.2)


# Bounds -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("probability", "one", "two"),
    [(0.95, 3.841, 5.991), (0.99, 6.635, 9.210), (0.999, 10.828, 13.816)],
)
def test_gates_have_the_bounds_of_the_tables(probability: float, one: float, two: float) -> None:
    assert chi_square_bounds(probability) == pytest.approx((one, two), abs=1e-3)


@pytest.mark.parametrize(
    ("freedom", "bound"), [(1, 10.83), (2, 13.82), (3, 16.27), (10, 29.59), (30, 59.70)]
)
def test_a_fit_has_the_bound_of_the_tables(freedom: int, bound: float) -> None:
    assert chi_square_bound(freedom) == pytest.approx(bound, rel=0.035)


# Lost odometry ------------------------------------------------------------------------------------


def test_a_gap_makes_the_heading_uncertain_too() -> None:
    """It drove at 1 m/s and 0.4 rad/s; one second is bridged, then it is silent for another."""
    settings = OdometrySettings(gap_speed_m_s=0.3, timeout_s=1.0)
    before = Odometry(0, SECOND, 1.0, 0.4)
    distance, turn, more = bridge(before, None, 0.0, 1.0, settings)
    assert (distance, turn) == pytest.approx((1.0, 0.4))
    assert (more.distance, more.turn) == pytest.approx((0.09, 0.09))
    after = inflate_by_gap(Estimate(ORIGIN, diagonal(0.0, 0.0)), SECOND, before, 0.3)
    c = after.covariance  # who drove may turn since then
    assert c.xx == c.yy == c.hh == pytest.approx(0.09 + 1.0)
    turned = Odometry(0, SECOND, 0.0, 1.5)
    c = inflate_by_gap(Estimate(ORIGIN, diagonal(0.0, 0.0)), SECOND, turned, 0.3).covariance
    assert c.xx == c.yy == c.hh == pytest.approx(0.09 + 2.25)


# Repeated use, exact sensors ----------------------------------------------------------------------


def test_a_teammates_fix_is_not_used_again_within_the_interval_of_an_object() -> None:
    robot = localizer(rules=LocalizerSettings(object_interval_s=1.0))
    state = robot.add_fix(state_at(ORIGIN, diagonal(0.5, 0.1)), fix(0.1, 0.0, SECOND))
    soon = robot.add_fix(state, fix(0.1, 0.0, SECOND + SECOND // 2))
    assert soon.estimate == robot.predict(state, soon.stamp_ns).estimate
    assert soon.counts["accepted"] == 1
    later = robot.add_fix(soon, fix(0.1, 0.0, 2 * SECOND))
    assert later.counts["accepted"] == 2


@pytest.mark.parametrize("variant", ["joint", "oval", "circular"])
def test_a_sensor_that_is_said_to_be_exact_is_as_sharp_as_rounding_allows(variant: str) -> None:
    exact = SensorSettings(range_share=0.0, range_floor_m=0.0, bearing_sigma_deg=0.0)
    rules = LocalizerSettings(variant=variant)  # type: ignore[arg-type]
    robot, state = localizer(rules=rules, sensor=exact), state_at(LOOP_START, diagonal(0.3, 0.1))
    truth = Pose2(LOOP_START.x + 0.2, LOOP_START.y - 0.1, LOOP_START.heading + 0.05)
    for i in range(20):
        state = robot.cycle(state, frame(truth, (i + 1) * SECOND))
    assert position_error(state.estimate, truth) < 1e-3
    values = np.linalg.eigvalsh(matrix3(state.estimate.covariance))
    assert values[0] > 0.0
    assert state.estimate.covariance.hh > 0.01 * SHARPEST_VARIANCE / 20
