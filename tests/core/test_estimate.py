import math
from collections.abc import Callable

import numpy as np
import pytest
from support.core import (
    Matrix,
    covariance2,
    covariance3,
    diagonal,
    least_eigenvalue,
    matrix2,
    matrix3,
    random_matrix,
)
from support.sweeps import sampled

from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import (
    ZERO3,
    Covariance3,
    Estimate,
    Information,
    Row,
    Scope,
    merge,
    with_circular_position,
)
from cpcbl_team.fusion import Observation, mark_shared, merge_naive, merge_split, with_all_shared
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.motion import move

NOTHING = Covariance2(0.0, 0.0, 0.0)
PLACE: tuple[Row, Row] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
POSE = Pose2(0.3, -0.7, 0.5)
MOVABLE = {Scope.POSE: [0, 1, 2], Scope.POSITION: [0, 1], Scope.HEADING: [2]}

scopes = pytest.mark.parametrize("scope", list(Scope), ids=lambda scope: scope.value)
seeds = pytest.mark.parametrize("seed", range(8))
ranks = pytest.mark.parametrize("rank", [1, 2])


def vector(pose: Pose2) -> Matrix:
    return np.array(pose)


def random_rows(rng: np.random.Generator, rank: int) -> tuple[Row, ...]:
    rows = rng.normal(size=(rank, 3))
    return tuple((float(x), float(y), float(h)) for x, y, h in rows)


def random_observation(
    rng: np.random.Generator, rank: int, *, dependent: bool = True
) -> Observation:
    return Observation(
        random_rows(rng, rank),
        tuple(0.1 * rng.normal(size=rank)),
        covariance2(random_matrix(rng, 2)),
        covariance2(random_matrix(rng, 2)) if dependent else NOTHING,
    )


def parts(observation: Observation) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """(H, e, independent R, dependent R) as matrices."""
    n = len(observation.rows)
    independent, dependent = (
        matrix2(observation.independent)[:n, :n],
        matrix2(observation.dependent)[:n, :n],
    )
    return np.array(observation.rows), np.array(observation.residuals), independent, dependent


def kalman(prior: Estimate, h: Matrix, e: Matrix, r: Matrix, scope: Scope) -> tuple[Matrix, Matrix]:
    """(pose, covariance) by Joseph's form; the gain's rows out of scope are zero (Schmidt)."""
    P = matrix3(prior.covariance)
    K = P @ h.T @ np.linalg.inv(h @ P @ h.T + r)
    K[[i for i in range(3) if i not in MOVABLE[scope]]] = 0.0
    survive = np.eye(3) - K @ h
    return vector(prior.pose) + K @ e, survive @ P @ survive.T + K @ r @ K.T


def gain(prior: Estimate, observation: Observation, scope: Scope) -> Matrix:
    """K of pose' = pose + K e of the split merge, read off by unit residuals."""
    n = len(observation.rows)
    columns = []
    for i in range(n):
        unit = observation._replace(residuals=tuple(float(i == j) for j in range(n)))
        columns.append(vector(merge_split(prior, unit, scope).pose) - vector(prior.pose))
    return np.stack(columns, axis=1)


def root(m: Matrix) -> Matrix:
    values, vectors = np.linalg.eigh(m)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def contraction(rng: np.random.Generator, rows: int, columns: int) -> Matrix:
    """A random cross correlation, most of them complete along some axis."""
    m = rng.normal(size=(rows, columns))
    return np.asarray(m / np.linalg.norm(m, 2) * rng.choice([1.0, 1.0, 0.5, 0.0]))


# The covariance's algebra -------------------------------------------------------------------------


@seeds
def test_the_three_by_three_algebra_is_that_of_matrices(seed: int) -> None:
    rng = np.random.default_rng(seed)
    c, h, m = random_matrix(rng, 3), rng.normal(size=3), rng.normal(size=(3, 3))
    covariance = covariance3(c)
    np.testing.assert_allclose(covariance.times((h[0], h[1], h[2])), c @ h, atol=1e-12)
    flat = tuple(float(v) for v in m.ravel())
    transformed = covariance.transformed(flat)  # type: ignore[arg-type]
    np.testing.assert_allclose(matrix3(transformed), m @ c @ m.T, atol=1e-12)
    np.testing.assert_allclose(matrix2(covariance.position()), c[:2, :2])


def test_the_circular_reduction_leaves_a_covariance() -> None:
    """The mean variance alone would be less than the heading's share along one axis."""
    drifted = Covariance3(0.01, 0.0, 1.0, 0.0, 0.99, 1.0)
    reduced = with_circular_position(Estimate(POSE, drifted)).covariance
    assert reduced.xx == reduced.yy
    assert (reduced.xh, reduced.yh, reduced.hh) == (0.0, 0.99, 1.0)
    assert least_eigenvalue(matrix3(reduced)) > -1e-12


# Ordinary merges ----------------------------------------------------------------------------------


@scopes
@ranks
@seeds
def test_a_merge_is_the_kalman_update_of_what_it_may_move(
    seed: int, rank: int, scope: Scope
) -> None:
    rng = np.random.default_rng(seed)
    prior = Estimate(POSE, covariance3(random_matrix(rng, 3)))
    observation = random_observation(rng, rank, dependent=False)
    merged = merge(prior, observation.information(), scope)
    H, e, R, _ = parts(observation)
    pose, covariance = kalman(prior, H, e, R, scope)
    np.testing.assert_allclose(vector(merged.pose), pose, atol=1e-9)
    np.testing.assert_allclose(matrix3(merged.covariance), covariance, atol=1e-9)


@seeds
def test_a_prior_that_is_certain_along_an_axis_stays_so(seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior = Estimate(POSE, covariance3(random_matrix(rng, 3, rank=2)))
    observation = random_observation(rng, 2, dependent=False)
    H, e, R, _ = parts(observation)
    _, covariance = kalman(prior, H, e, R, Scope.POSE)
    merged = matrix3(merge(prior, observation.information()).covariance)
    np.testing.assert_allclose(merged, covariance, atol=1e-9)


@pytest.mark.parametrize(
    ("scope", "kept"), [(Scope.POSITION, [2]), (Scope.HEADING, [0, 1])], ids=["position", "heading"]
)
@pytest.mark.parametrize("merger", [merge_naive, merge_split])
@seeds
def test_what_is_out_of_scope_keeps_its_mean_and_variance(
    seed: int,
    merger: Callable[[Estimate, Observation, Scope], Estimate],
    scope: Scope,
    kept: list[int],
) -> None:
    rng = np.random.default_rng(seed)
    prior = mark_shared(Estimate(POSE, covariance3(random_matrix(rng, 3))))
    observation = random_observation(rng, 2)
    observation = observation._replace(
        independent=observation.independent.scaled(1e-4),
        dependent=observation.dependent.scaled(1e-4),
    )
    merged = merger(prior, observation, scope)
    block = np.ix_(kept, kept)
    assert [merged.pose[i] for i in kept] == [prior.pose[i] for i in kept]
    np.testing.assert_array_equal(
        matrix3(merged.covariance)[block], matrix3(prior.covariance)[block]
    )
    assert least_eigenvalue(matrix3(merged.covariance)) > -1e-12
    assert merged.pose != prior.pose


def test_the_heading_stays_within_half_a_turn() -> None:
    prior = Estimate(Pose2(0.0, 0.0, 3.1), diagonal(0.1, 0.1))
    merged = merge(prior, Information.none().add((0.0, 0.0, 1.0), 0.1, 1e-6))
    assert merged.pose.heading == pytest.approx(3.2 - math.tau, abs=1e-4)


def test_one_range_says_nothing_along_the_tangent_of_its_circle() -> None:
    prior = Estimate(POSE, diagonal(0.3, 0.1))
    merged = merge(prior, Information.none().add((1.0, 0.0, 0.0), 0.2, 0.01))  # row 35
    assert merged.pose == pytest.approx((POSE.x + 0.2 * 0.09 / 0.1, POSE.y, POSE.heading))
    assert merged.covariance == pytest.approx((0.009, 0.0, 0.09, 0.0, 0.0, 0.01))


def test_no_evidence_changes_nothing() -> None:
    prior = Estimate(POSE, diagonal(0.3, 0.1))
    assert merge(prior, Information.none()) == prior


# Observations -------------------------------------------------------------------------------------


@ranks
@seeds
def test_an_observations_information_is_that_of_its_correlated_noise(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    observation = random_observation(rng, rank)
    H, e, independent, dependent = parts(observation)
    inverse = np.linalg.inv(independent + 3.0 * dependent)
    evidence = observation.information(observation.noise(3.0))
    np.testing.assert_allclose(matrix3(evidence.matrix), H.T @ inverse @ H, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(evidence.vector, H.T @ inverse @ e, rtol=1e-6, atol=1e-6)


@ranks
@seeds
def test_the_normalized_innovation_is_the_quadratic_form(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    prior, observation = random_matrix(rng, 3), random_observation(rng, rank)
    H, e, independent, dependent = parts(observation)
    expected = e @ np.linalg.solve(H @ prior @ H.T + independent + dependent, e)
    assert observation.normalized_innovation_squared(covariance3(prior)) == pytest.approx(expected)


@ranks
@seeds
def test_the_naive_merge_takes_a_teammates_error_as_fresh_noise(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    prior = Estimate(POSE, covariance3(random_matrix(rng, 3)))
    observation = random_observation(rng, rank)
    H, e, independent, dependent = parts(observation)
    pose, covariance = kalman(prior, H, e, independent + dependent, Scope.POSE)
    merged = merge_naive(prior, observation)
    np.testing.assert_allclose(vector(merged.pose), pose, atol=1e-9)
    np.testing.assert_allclose(matrix3(merged.covariance), covariance, atol=1e-9)


# Split covariance intersection (resolution c) -----------------------------------------------------


@ranks
@seeds
def test_a_split_merge_of_independent_things_is_the_ordinary_one(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    prior = Estimate(POSE, covariance3(random_matrix(rng, 3)))
    observation = random_observation(rng, rank, dependent=False)
    split, ordinary = merge_split(prior, observation), merge(prior, observation.information())
    np.testing.assert_allclose(vector(split.pose), vector(ordinary.pose), atol=1e-9)
    np.testing.assert_allclose(split.covariance, ordinary.covariance, atol=1e-9)
    np.testing.assert_allclose(split.shared, ZERO3, atol=1e-9)


def true_covariance(
    rng: np.random.Generator, prior: Estimate, observation: Observation, scope: Scope
) -> Matrix:
    """Of the error after a split merge, if the dependent parts are correlated somehow."""
    H, _, independent, dependent = parts(observation)
    K = gain(prior, observation, scope)
    survive = np.eye(3) - K @ H
    n = len(observation.rows)
    cross = root(matrix3(prior.shared)) @ contraction(rng, 3, n) @ root(dependent).T
    mixed = survive @ cross @ K.T
    own = survive @ matrix3(prior.covariance) @ survive.T
    return np.asarray(own + K @ (independent + dependent) @ K.T - mixed - mixed.T)


@scopes
@ranks
@seeds
def test_a_split_merge_is_consistent_whatever_is_correlated(
    seed: int, rank: int, scope: Scope
) -> None:
    """What was moved is at least as certain as claimed."""
    rng = np.random.default_rng(seed)
    block = np.ix_(MOVABLE[scope], MOVABLE[scope])
    for _ in range(20):
        private = random_matrix(rng, 3) if scope is Scope.POSE else np.zeros((3, 3))
        shared = random_matrix(rng, 3)
        prior = Estimate(POSE, covariance3(private + shared), covariance3(shared))
        observation = random_observation(rng, rank)
        claimed = matrix3(merge_split(prior, observation, scope).covariance)
        true = true_covariance(rng, prior, observation, scope)
        assert least_eigenvalue((claimed - true)[block]) > -1e-9


@ranks
@seeds
@pytest.mark.parametrize("scope", [Scope.POSITION, Scope.HEADING])
def test_a_split_merge_correlates_what_it_leaves_alone_as_before(
    seed: int, rank: int, scope: Scope
) -> None:
    """The part out of scope was not inflated, so nor was its covariance with the rest."""
    rng = np.random.default_rng(seed)
    covariance = covariance3(random_matrix(rng, 3))
    prior, observation = Estimate(POSE, covariance, covariance), random_observation(rng, rank)
    H, *_ = parts(observation)
    expected = (np.eye(3) - gain(prior, observation, scope) @ H) @ matrix3(covariance)
    merged = matrix3(merge_split(prior, observation, scope).covariance)
    if scope is Scope.POSITION:
        np.testing.assert_allclose(merged[:2, 2], expected[:2, 2], atol=1e-9)
    else:
        np.testing.assert_allclose(merged[2, :2], expected[2, :2], atol=1e-9)


def test_an_error_that_two_readings_share_wholly_is_no_certainty() -> None:
    """Their difference is then exact, which no evidence may be."""
    together = Covariance2(0.01, 0.01, 0.01)
    observation = Observation(PLACE, (0.1, 0.1), Covariance2(0.0, 0.0, 0.0), together)
    prior = Estimate(POSE, diagonal(0.3, 0.1), diagonal(0.2, 0.1))
    merged = merge_split(prior, observation)
    private = matrix3(merged.covariance) - matrix3(merged.shared)
    assert least_eigenvalue(matrix3(merged.covariance)) > 0.0
    assert least_eigenvalue(matrix3(merged.shared)) > -1e-9
    assert least_eigenvalue(private) > -1e-9


@ranks
@seeds
def test_a_split_merge_counts_as_private_only_what_is(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    private, shared = random_matrix(rng, 3), random_matrix(rng, 3)
    prior = Estimate(POSE, covariance3(private + shared), covariance3(shared))
    observation = random_observation(rng, rank)
    H, _, independent, _ = parts(observation)
    K = gain(prior, observation, Scope.POSE)
    survive = np.eye(3) - K @ H
    merged = merge_split(prior, observation)
    np.testing.assert_allclose(
        matrix3(merged.covariance) - matrix3(merged.shared),
        survive @ private @ survive.T + K @ independent @ K.T,
        atol=1e-9,
    )


def an_event(rng: np.random.Generator, estimate: Estimate, scope: Scope) -> Estimate:
    """A step, a landmark, a teammate, or a belief that leaves."""
    observation = random_observation(rng, int(rng.integers(1, 3)))
    match rng.integers(4):
        case 0:
            estimate = move(estimate, rng.uniform(-0.2, 0.5), rng.normal(), OdometryNoise())
        case 1:
            estimate = merge(estimate, observation.information(), scope)
        case 2:
            estimate = merge_split(estimate, observation, scope)
        case _:
            estimate = mark_shared(estimate)
    return estimate if scope is Scope.POSE else with_all_shared(estimate)


@pytest.mark.parametrize("alternating", [False, True])
@pytest.mark.parametrize("seed", sampled(range(4), [0]))
def test_covariances_stay_covariances_through_long_histories(seed: int, alternating: bool) -> None:
    rng = np.random.default_rng(seed)
    estimate = Estimate(POSE, covariance3(random_matrix(rng, 3)))
    for i in range(1500):
        scope = (Scope.POSITION, Scope.HEADING)[i % 2] if alternating else Scope.POSE
        estimate = an_event(rng, estimate, scope)
        covariance, shared = matrix3(estimate.covariance), matrix3(estimate.shared)
        tolerance = -1e-10 * np.trace(covariance)
        assert least_eigenvalue(covariance) > tolerance
        assert least_eigenvalue(shared) > tolerance
        assert least_eigenvalue(covariance - shared) > tolerance


@pytest.mark.parametrize(("merger", "honest"), [(merge_split, True), (merge_naive, False)])
@pytest.mark.parametrize("scope", [Scope.POSE, Scope.POSITION])
def test_the_same_teammates_error_counts_only_once(
    merger: Callable[[Estimate, Observation, Scope], Estimate], honest: bool, scope: Scope
) -> None:
    """An observer that is off by 0.1 m may send its fix a hundred times."""
    observer = 0.1**2
    observation = Observation(
        PLACE,
        (0.0, 0.0),
        Covariance2(0.05**2, 0.0, 0.05**2),
        Covariance2(observer, 0.0, observer),
    )
    estimate = Estimate(POSE, diagonal(30.0, 0.2))
    for _ in range(100):
        estimate = merger(estimate, observation, scope)
    least = least_eigenvalue(matrix3(estimate.covariance)[:2, :2])
    assert (least > 0.99 * observer) is honest


def test_a_belief_that_was_sent_is_shared_as_a_whole() -> None:
    estimate = Estimate(POSE, diagonal(0.3, 0.1))
    assert with_all_shared(estimate).shared == ZERO3
    assert mark_shared(estimate).shared == estimate.covariance
    partly = merge(mark_shared(estimate), Information.none().add((1.0, 0.0, 0.0), 0.0, 0.01))
    assert partly.shared != partly.covariance
    assert with_all_shared(partly).shared == partly.covariance
