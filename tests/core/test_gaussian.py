import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import least_eigenvalue, matrix2, product_of

from cpcbl_team import estimate
from cpcbl_team.estimate import Covariance3, Estimate, Information
from cpcbl_team.gaussian import Covariance2, Gaussian2, oriented_covariance, sighting_gaussian
from cpcbl_team.geometry import Pose2

sigmas = st.floats(0.01, 3.0)
gaussians = st.builds(
    lambda x, y, major, minor, angle: Gaussian2(x, y, oriented_covariance(major, minor, angle)),
    st.floats(-5.0, 5.0),
    st.floats(-5.0, 5.0),
    sigmas,
    sigmas,
    st.floats(-math.pi, math.pi),
)


def flat(g: Gaussian2) -> tuple[float, ...]:
    return g.x, g.y, *g.covariance


def merge(first: Gaussian2, second: Gaussian2) -> Gaussian2:
    """As the localizer merges, about poses of which the heading is certain."""
    prior = Estimate(
        Pose2(first.x, first.y, 0.0), Covariance3(*first.covariance, xh=0.0, yh=0.0, hh=0.0)
    )
    dx, dy, weight = second.x - first.x, second.y - first.y, second.covariance.inverse()
    vector = weight.xx * dx + weight.xy * dy, weight.xy * dx + weight.yy * dy, 0.0
    evidence = Information(Covariance3(*weight, xh=0.0, yh=0.0, hh=0.0), vector)
    pose, covariance, _ = estimate.merge(prior, evidence)
    return Gaussian2(pose.x, pose.y, covariance.position())


@pytest.mark.parametrize("bearing", [0.0, 0.7, -2.5, math.pi])
def test_a_sighting_is_a_gaussian_along_the_line_of_sight(bearing: float) -> None:
    """Equations 1 and 2 (row 34), against the rotation written out."""
    seen = sighting_gaussian(4.0, bearing, 0.2, math.radians(5.0))
    c, s = math.cos(bearing), math.sin(bearing)
    rotation = np.array([[c, -s], [s, c]])
    axes = np.diag([0.2**2, (4.0 * math.sin(math.radians(5.0))) ** 2])
    assert (seen.x, seen.y) == pytest.approx((4.0 * c, 4.0 * s))
    np.testing.assert_allclose(matrix2(seen.covariance), rotation @ axes @ rotation.T, atol=1e-12)


@given(gaussians, gaussians)
def test_a_merge_is_equations_3_and_4(a: Gaussian2, b: Gaussian2) -> None:
    assert flat(merge(a, b)) == pytest.approx(flat(product_of(a, b)), abs=1e-6)


@given(gaussians, gaussians)
def test_a_merge_does_not_depend_on_the_order(a: Gaussian2, b: Gaussian2) -> None:
    assert flat(merge(a, b)) == pytest.approx(flat(merge(b, a)), abs=1e-6)


@given(gaussians, gaussians)
def test_a_merge_adds_information(a: Gaussian2, b: Gaussian2) -> None:
    inverses = [np.linalg.inv(matrix2(g.covariance)) for g in (a, b)]
    expected = np.linalg.inv(inverses[0] + inverses[1])
    mean = expected @ (inverses[0] @ [a.x, a.y] + inverses[1] @ [b.x, b.y])
    merged = merge(a, b)
    np.testing.assert_allclose(matrix2(merged.covariance), expected, atol=1e-7)
    np.testing.assert_allclose((merged.x, merged.y), mean, atol=1e-5)


@given(gaussians, gaussians)
def test_a_merge_is_never_less_certain_than_either(a: Gaussian2, b: Gaussian2) -> None:
    merged = matrix2(merge(a, b).covariance)
    for g in (a, b):
        assert least_eigenvalue(matrix2(g.covariance) - merged) > -1e-9


@given(sigmas, sigmas, st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_circular_gaussians_merge_by_weighted_averages(
    s1: float, s2: float, x1: float, x2: float
) -> None:
    a, b = s1 * s1, s2 * s2  # row 18
    first = Gaussian2(x1, -x1, Covariance2(a, 0.0, a))
    merged = merge(first, Gaussian2(x2, -x2, Covariance2(b, 0.0, b)))
    mean, variance = (b * x1 + a * x2) / (a + b), a * b / (a + b)
    assert flat(merged) == pytest.approx((mean, -mean, variance, 0.0, variance), abs=1e-9)


@given(st.floats(0.1, 3.0), st.floats(0.0, 0.9), st.floats(-1.5, 1.5))
def test_an_oriented_covariance_has_the_axes_it_was_made_from(
    major: float, share: float, angle: float
) -> None:
    covariance = oriented_covariance(major, share * major, angle)
    assert covariance.along(math.cos(angle), math.sin(angle)) == pytest.approx(major**2)
    across = covariance.along(-math.sin(angle), math.cos(angle))
    assert across == pytest.approx((share * major) ** 2, abs=1e-9)


@given(gaussians)
def test_a_covariance_is_possible_and_what_is_beyond_becomes_so(g: Gaussian2) -> None:
    assert g.covariance.with_possible_correlation() == g.covariance
    beyond = g.covariance._replace(xy=1.001 * math.sqrt(g.covariance.xx * g.covariance.yy))
    assert 0.0 < beyond.with_possible_correlation().determinant() < 1e-5 * beyond.xx * beyond.yy


@given(gaussians, st.floats(-math.pi, math.pi))
def test_the_variance_along_a_direction_is_the_projection(g: Gaussian2, angle: float) -> None:
    n = np.array([math.cos(angle), math.sin(angle)])
    assert g.covariance.along(*n) == pytest.approx(n @ matrix2(g.covariance) @ n, abs=1e-9)


@given(gaussians, st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_the_mahalanobis_distance_is_the_quadratic_form(g: Gaussian2, dx: float, dy: float) -> None:
    d = np.array([dx, dy])
    expected = d @ np.linalg.solve(matrix2(g.covariance), d)
    assert g.covariance.mahalanobis_squared(dx, dy) == pytest.approx(expected, rel=1e-6, abs=1e-9)
